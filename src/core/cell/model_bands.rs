//! Computes the uncertainty of a cell model: bands of its open-circuit curve and resistances, and the resulting SOC
//! errors.
//!
//! In: a [`CellModel`]. Out: standard deviations of a cell's voltage (V), ln(resistance) and SOC (fraction) around the
//! model. If the model states no error of its curve, voltage and SOC are `None`. The estimator starts with the same
//! standard deviations.
//!
//! * Curve: the modes (typical shapes) by which the curves of cells differ, and a remaining error. The remaining error
//!   is the smallest `voltage_error_v` of all temperatures at this SOC. Where this error is smallest, the resistances
//!   matter least, so it is mostly an error of the curve. If the model has no table `voltage_error_v`, the constant
//!   `curve_v` of its [`ModelSpread`] is used.
//! * Resistances: a common error (`log_resistance` of the spread) and a local error, which depends on SOC and
//!   temperature. The local error has two parts: the relative standard deviation of the voltage drop over
//!   [`ERROR_WINDOW_S`], and the part of `voltage_error_v` that exceeds the curve's error, relative to the drop at a
//!   usual load.

mod advice;

pub use advice::{Advice, Measurement, advise};

use super::chemistry::USUAL_LOAD_PER_H;
use super::model::{CellModel, ERROR_WINDOW_S, GridPosition, ModelSpread};
use crate::filter::square;

/// Temperature of a displayed curve (degrees C). Outside the table, the nearest breakpoint is used.
pub const CURVE_C: f64 = 25.0;

/// Variance of an unknown SOC: uniform over 0 to 1.
const EVEN_VARIANCE: f64 = 1.0 / 12.0;

/// Standard deviation of ln(resistance).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResistanceBand {
    /// The same at every SOC and temperature.
    pub common: f64,
    /// Specific to this SOC and temperature.
    pub local: f64,
}

impl ResistanceBand {
    /// Common and local standard deviation together.
    pub fn std(&self) -> f64 {
        self.common.hypot(self.local)
    }
}

/// The bands of a cell model.
#[derive(Debug, Clone, Copy)]
pub struct ModelBands<'a> {
    model: &'a CellModel,
}

impl<'a> ModelBands<'a> {
    /// The bands of this model.
    pub fn new(model: &'a CellModel) -> Self {
        Self { model }
    }

    /// Open-circuit voltage at [`CURVE_C`] (V).
    pub fn ocv_v(&self, soc: f64) -> f64 {
        self.model.ocv_v(&self.at(soc))
    }

    /// Slope of the open-circuit voltage at [`CURVE_C`] (V per unit of SOC), averaged over 5 % of SOC. The SOC filter
    /// does not resolve less.
    pub fn slope_v(&self, soc: f64) -> f64 {
        let (low, high) = ((soc - 0.025).max(0.0), (soc + 0.025).min(1.0));
        (self.ocv_v(high) - self.ocv_v(low)) / (high - low)
    }

    /// Standard deviation of the open-circuit voltage (V); `None` if the model states no error.
    pub fn curve_std_v(&self, soc: f64) -> Option<f64> {
        let [a, b] = self.modes_v(soc);
        Some(self.curve_rest_v(soc)?.hypot(a).hypot(b))
    }

    pub(super) fn modes_v(&self, soc: f64) -> [f64; 2] {
        let has_spread = self.model.spread.is_some();
        let modes_v = self.model.aged_ocv_changes_v(&self.at(soc), self.model.capacity_ah).1;
        if has_spread { modes_v } else { [0.0; 2] }
    }

    /// Standard deviation of the curve (V) without the modes.
    pub(super) fn curve_rest_v(&self, soc: f64) -> Option<f64> {
        let of_row = |t: &f64| self.model.voltage_error_v(&self.model.grid_position(soc, *t));
        let least = self.model.temperature_c.iter().filter_map(of_row).reduce(f64::min);
        least.or(self.model.spread.map(|spread| spread.curve_v))
    }

    /// Standard deviation of ln(resistance).
    pub fn resistance(&self, soc: f64, temperature_c: f64) -> ResistanceBand {
        let position = self.model.grid_position(soc, temperature_c);
        let beyond_curve_v = |error_v: f64| {
            let curve_v = self.curve_rest_v(soc).unwrap_or(0.0);
            (error_v * error_v - curve_v * curve_v).max(0.0).sqrt()
        };
        let stated_v = self.model.voltage_error_v(&position).map_or(0.0, beyond_curve_v);
        let spread = self.spread();
        let local = (spread.drop_sqrt_s / ERROR_WINDOW_S.sqrt()).hypot(stated_v / self.usual_drop_v(&position));
        ResistanceBand { common: spread.log_resistance, local }
    }

    /// Standard deviation of the capacity (fraction).
    pub fn capacity_std(&self) -> f64 {
        self.spread().capacity
    }

    fn spread(&self) -> ModelSpread {
        self.model.spread()
    }

    /// Standard deviation of the SOC (fraction) from one voltage at rest.
    pub fn rest_soc_std(&self, soc: f64) -> Option<f64> {
        Some(soc_variance(square(self.curve_std_v(soc)?), self.slope_v(soc), EVEN_VARIANCE).sqrt())
    }

    /// Standard deviation of the SOC (fraction) from one voltage under a usual load (C/2).
    pub fn load_soc_std(&self, soc: f64, temperature_c: f64) -> Option<f64> {
        let drop_v = self.usual_drop_v(&self.model.grid_position(soc, temperature_c));
        let error_v = self.curve_std_v(soc)?.hypot(self.resistance(soc, temperature_c).std() * drop_v);
        Some(soc_variance(square(error_v), self.slope_v(soc), EVEN_VARIANCE).sqrt())
    }

    pub(super) fn usual_drop_v(&self, position: &GridPosition) -> f64 {
        USUAL_LOAD_PER_H * self.model.rated_capacity_ah * self.model.settled_ohm(position)
    }

    fn at(&self, soc: f64) -> GridPosition {
        self.model.grid_position(soc, CURVE_C)
    }
}

/// Variance of the SOC after a voltage reading. `before`: the variance before the reading. `voltage_variance`: variance
/// of the voltage (V^2). `slope_v`: slope of the curve (V per unit of SOC).
fn soc_variance(voltage_variance: f64, slope_v: f64, before: f64) -> f64 {
    1.0 / (slope_v * slope_v / voltage_variance + 1.0 / before)
}

#[cfg(test)]
mod tests;
