//! Where a cell model comes from: file, label or the vehicle's own data, and where it was measured.

use toml::{Table, Value};

use crate::cell::model_bands::CURVE_C;
use crate::cell::{CellModel, Chemistry, Coverage, ModelBands};
use crate::monitor::{ModelChange, ModelState};

/// Most that the end of a measured range is rounded.
const ROUNDED: f64 = 0.01;

/// A state of the model in words.
pub fn state_words(state: ModelState) -> &'static str {
    match state {
        ModelState::Given => "cell model file",
        ModelState::Prior => "label alone (prior): what all cells of this chemistry have in common",
        ModelState::Learning => "learning from the vehicle's own data",
        ModelState::Learned => "learned from the vehicle's own data",
        ModelState::Unfit => "unfit: the voltages contradict the chemistry on the label",
    }
}

/// Where a cell was measured, lowest and highest; `None` = not known.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct MeasuredRange {
    /// Degrees C.
    pub temperature_c: Option<[f64; 2]>,
    /// A, positive = discharge.
    pub current_a: Option<[f64; 2]>,
    /// Fraction.
    pub soc: Option<[f64; 2]>,
}

/// Where a cell model comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelSource {
    /// How well it is known.
    pub state: ModelState,
    /// Chemistry, for people.
    pub chemistry: Option<String>,
    /// Where it was measured.
    pub measured: MeasuredRange,
    /// `[provenance]` of its file; empty without one.
    pub provenance: Table,
    /// Of a learned model: that of the label, and what the data have seen.
    pub learned: Option<LearnedFrom>,
}

/// What a learned model is learned from.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedFrom {
    /// The model of the label.
    pub prior: Box<CellModel>,
    /// What the rows in the notebook have seen.
    pub seen: Coverage,
    /// Root mean square of the residuals, V; `None` = nothing is learned yet.
    pub residual_v: Option<f64>,
    /// The chemistry that explains the voltages better than that on the label.
    pub chemistry: Option<Chemistry>,
    /// Fits so far.
    pub fits: u32,
    /// The latest changes, oldest first.
    pub changes: Vec<ModelChange>,
}

impl ModelSource {
    /// A text of `[provenance]`; `None` = not stated.
    fn text(&self, keys: &[&str]) -> Option<&str> {
        keys.iter().find_map(|key| self.provenance.get(*key)?.as_str())
    }

    /// Where the data come from.
    pub fn citation(&self) -> Option<&str> {
        self.text(&["citation", "source", "references"])
    }

    /// Terms under which the data may be used.
    pub fn licence(&self) -> Option<&str> {
        self.text(&["licence"])
    }

    /// Root mean square of the fit's residuals, V.
    pub fn residual_v(&self) -> Option<f64> {
        let number = |key: &str, unit_v: f64| match self.provenance.get(key)? {
            Value::Float(value) => Some(unit_v * value),
            Value::Integer(value) => Some(unit_v * *value as f64),
            _ => None,
        };
        let learned = self.learned.as_ref().and_then(|learned| learned.residual_v);
        learned.or(number("residual_rmse_mv", 1e-3)).or(number("residual_rms_v", 1.0))
    }
}

/// A cell model with where it comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct SourcedModel {
    /// The model.
    pub model: CellModel,
    /// Where it comes from.
    pub source: ModelSource,
}

/// Why a part of a model is as it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum KnownBy {
    /// Within what was measured.
    Measured,
    /// Beyond what was measured: continued.
    Extrapolated,
    /// The file does not state where it was measured.
    NotStated,
    /// What all cells of the chemistry have in common.
    Prior,
    /// The vehicle's own data.
    Data,
}

impl KnownBy {
    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Extrapolated => "extrapolated",
            Self::NotStated => "not stated",
            Self::Prior => "prior",
            Self::Data => "data",
        }
    }
}

impl SourcedModel {
    /// How the open-circuit curve is known at a SOC.
    pub fn curve_known_by(&self, soc: f64) -> KnownBy {
        let std_v = |model: &CellModel| ModelBands::new(model).curve_std_v(soc);
        self.by_prior(&std_v).unwrap_or_else(|| self.source.by_range(self.source.measured.soc, soc))
    }

    /// How the resistances are known at a temperature.
    pub fn resistances_known_by(&self, temperature_c: f64) -> KnownBy {
        let std = |model: &CellModel| Some(ModelBands::new(model).resistance(0.5, temperature_c).std());
        self.by_prior(&std).unwrap_or_else(|| self.source.by_range(self.source.measured.temperature_c, temperature_c))
    }

    /// Of a label: by data where these have made a deviation clearly smaller than that of the label.
    fn by_prior(&self, std: &dyn Fn(&CellModel) -> Option<f64>) -> Option<KnownBy> {
        let learned = self.source.learned.as_ref()?;
        let (left, before) = (std(&self.model)?, std(&learned.prior)?);
        // A deviation of 0.7 of the label's is left where data say as much as the label.
        Some(if left <= 0.7 * before { KnownBy::Data } else { KnownBy::Prior })
    }

    /// Error of the model's voltage, V, as root mean square over SOC at the temperature of its curve; `None` = not stated.
    pub fn error_v(&self) -> Option<f64> {
        let errors =
            self.model.soc.iter().map(|&soc| self.model.voltage_error_v(&self.model.grid_position(soc, CURVE_C)));
        let squares = errors.map(|error_v| error_v.map(|v| v * v)).collect::<Option<Vec<f64>>>()?;
        Some((squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
    }
}

impl ModelSource {
    fn by_range(&self, range: Option<[f64; 2]>, value: f64) -> KnownBy {
        match (self.state, range) {
            (ModelState::Prior | ModelState::Unfit, None) => KnownBy::Prior,
            (_, None) => KnownBy::NotStated,
            // The ends are written with few digits.
            (_, Some([low, high])) if (low - ROUNDED..=high + ROUNDED).contains(&value) => KnownBy::Measured,
            (_, Some(_)) => KnownBy::Extrapolated,
        }
    }
}
