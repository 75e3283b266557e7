//! Where a cell model comes from: file, label or the vehicle's own data, and where it was measured.

use toml::{Table, Value};

use crate::cell::CellModel;
use crate::cell::model_bands::CURVE_C;

/// Most that the end of a measured range is rounded.
const ROUNDED: f64 = 0.01;

/// What a cell model stands on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelOrigin {
    /// A cell model file.
    File,
    /// Chemistry and label alone.
    Prior,
    /// The label, and what the vehicle has noted of its own cells.
    Learned,
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
    /// What it stands on.
    pub origin: ModelOrigin,
    /// Chemistry, for people.
    pub chemistry: Option<String>,
    /// Where it was measured.
    pub measured: MeasuredRange,
    /// `[provenance]` of its file; empty without one.
    pub provenance: Table,
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
        number("residual_rmse_mv", 1e-3).or(number("residual_rms_v", 1.0))
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
}

impl KnownBy {
    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Extrapolated => "extrapolated",
            Self::NotStated => "not stated",
            Self::Prior => "prior",
        }
    }
}

impl SourcedModel {
    /// How the open-circuit curve is known at a SOC.
    pub fn curve_known_by(&self, soc: f64) -> KnownBy {
        self.source.by_range(self.source.measured.soc, soc)
    }

    /// How the resistances are known at a temperature.
    pub fn resistances_known_by(&self, temperature_c: f64) -> KnownBy {
        self.source.by_range(self.source.measured.temperature_c, temperature_c)
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
        match (self.origin, range) {
            (ModelOrigin::Prior, _) => KnownBy::Prior,
            (_, None) => KnownBy::NotStated,
            // The ends are written with few digits.
            (_, Some([low, high])) if value >= low - ROUNDED && value <= high + ROUNDED => KnownBy::Measured,
            (_, Some(_)) => KnownBy::Extrapolated,
        }
    }
}
