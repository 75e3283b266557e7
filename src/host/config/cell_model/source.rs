//! Where a cell model comes from: file, label or the vehicle's own data, and where it was measured.

use toml::{Table, Value};

use crate::cell::CellModel;

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
