//! Describes the origin of a cell model (file, label or the vehicle's own data) and the conditions of the measurements.

use toml::{Table, Value};

use crate::cell::model_bands::CURVE_C;
use crate::cell::{CellModel, Chemistry, Coverage, FleetPrior, ModelBands};
use crate::monitor::{ModelChange, ModelState};

/// Largest rounding error of the ends of a measured range, in the unit of the range.
const ROUNDED: f64 = 0.01;

/// A model state in words.
pub fn state_words(state: ModelState) -> &'static str {
    match state {
        ModelState::Given => "cell model file",
        ModelState::Prior => "label only (prior): values typical of this chemistry",
        ModelState::Learning => "learning from the vehicle's own data",
        ModelState::Learned => "learned from the vehicle's own data",
        ModelState::Unfit => "unfit: the voltages contradict the chemistry on the label",
    }
}

/// The lowest and highest measured conditions; `None` = unknown.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct MeasuredRange {
    /// Temperature (degrees C).
    pub temperature_c: Option<[f64; 2]>,
    /// Current (A), positive = discharge.
    pub current_a: Option<[f64; 2]>,
    /// SOC, fraction.
    pub soc: Option<[f64; 2]>,
}

/// The origin of a cell model.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelSource {
    /// Whether the model comes from a file, from a label or from the vehicle's own data.
    pub state: ModelState,
    /// Chemistry, for display.
    pub chemistry: Option<String>,
    /// The measured conditions.
    pub measured: MeasuredRange,
    /// `[provenance]` of the file; empty if not given.
    pub provenance: Table,
    /// For a model that is learned in the vehicle: the label's model, and the data behind the learned values.
    pub learned: Option<LearnedFrom>,
    /// The fleet prior (what other vehicles have learned about such cells) of the key `pack.prior`, if the model starts
    /// from it.
    pub fleet: Option<Box<FleetPrior>>,
}

/// The data behind a learned model.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedFrom {
    /// The model made from the label.
    pub prior: Box<CellModel>,
    /// The conditions covered by the data that the fits use.
    pub seen: Coverage,
    /// Root mean square of the residuals (V); `None` = nothing is learned yet.
    pub residual_v: Option<f64>,
    /// A chemistry that explains the voltages better than the chemistry on the label; `None` = there is no such
    /// chemistry.
    pub chemistry: Option<Chemistry>,
    /// Number of fits.
    pub fits: u32,
    /// The latest changes of the model, oldest first.
    pub changes: Vec<ModelChange>,
}

impl ModelSource {
    /// The first of `keys` that is a string in `[provenance]`.
    fn text(&self, keys: &[&str]) -> Option<&str> {
        keys.iter().find_map(|key| self.provenance.get(*key)?.as_str())
    }

    /// Where the data come from.
    pub fn citation(&self) -> Option<&str> {
        self.text(&["citation", "source", "references"])
    }

    pub fn licence(&self) -> Option<&str> {
        self.text(&["licence"])
    }

    /// Root mean square of the fit's residuals (V).
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

/// A cell model and its origin.
#[derive(Debug, Clone, PartialEq)]
pub struct SourcedModel {
    pub model: CellModel,
    /// The origin of the model.
    pub source: ModelSource,
}

/// What the values of one part of a model (the open-circuit curve or the resistances) are based on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum KnownBy {
    /// The part lies within the measured range.
    Measured,
    /// The part lies beyond the measured range.
    Extrapolated,
    /// The file does not state the measured range.
    NotStated,
    /// The values are typical of the chemistry.
    Prior,
    /// The values come from the vehicle's own data.
    Data,
}

impl KnownBy {
    /// The basis in words.
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
    /// What the open-circuit curve at a SOC is based on.
    pub fn curve_known_by(&self, soc: f64) -> KnownBy {
        let std_v = |model: &CellModel| ModelBands::new(model).curve_std_v(soc);
        self.by_prior(&std_v).unwrap_or_else(|| self.source.by_range(self.source.measured.soc, soc))
    }

    /// What the resistances at a temperature are based on.
    pub fn resistances_known_by(&self, temperature_c: f64) -> KnownBy {
        let std = |model: &CellModel| Some(ModelBands::new(model).resistance(0.5, temperature_c).std());
        self.by_prior(&std).unwrap_or_else(|| self.source.by_range(self.source.measured.temperature_c, temperature_c))
    }

    /// If the model is learned in the vehicle, returns what one part of the model (curve or resistances) is based on.
    /// Returns `None` for other models. `std` returns the standard deviation of this part in a given model. The result
    /// is `Data` if `std(learned) <= 0.7 * std(label)`, else `Prior`.
    fn by_prior(&self, std: &dyn Fn(&CellModel) -> Option<f64>) -> Option<KnownBy> {
        let learned = self.source.learned.as_ref()?;
        let (left, before) = (std(&self.model)?, std(&learned.prior)?);
        // At a ratio of 0.7 (about 1/sqrt 2), the data carry as much information as the label.
        Some(if left <= 0.7 * before { KnownBy::Data } else { KnownBy::Prior })
    }

    /// Root mean square of the model's voltage error over all SOC values (V). The error is computed at the temperature
    /// of the open-circuit curve. `None` = the model states no error.
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
            // Files state the ends of the range with few digits.
            (_, Some([low, high])) if (low - ROUNDED..=high + ROUNDED).contains(&value) => KnownBy::Measured,
            (_, Some(_)) => KnownBy::Extrapolated,
        }
    }
}
