//! How well a cell model is known: bands of its open-circuit curve and of its resistances, and what they mean for the SOC.
//!
//! In: a [`CellModel`]. Out: standard deviations of a cell from it, in V, as a fraction and in SOC; `None` where the model states no
//! error of its curve. They are those with which the estimator begins.
//!
//! * Curve: the modes of the spread between cells, and the least `voltage_error_v` of any temperature at this SOC: where the
//!   resistances matter least, that is mostly an error of the curve. Without that table the constant error of the spread.
//! * Resistances: what all of them have in common (`log_resistance` of the spread, or that of cells of one type), and what differs
//!   between SOC and temperatures: the voltage drop's own deviation over [`ERROR_WINDOW_S`], and the part of `voltage_error_v` beyond
//!   that of the curve, relative to the drop at a usual load.

mod advice;

pub use advice::{Advice, Measurement, advise};

use super::chemistry::USUAL_LOAD_PER_H;
use super::model::{CellModel, ERROR_WINDOW_S, GridPosition, ModelSpread};
use crate::filter::square;

/// Temperature at which a curve is shown, degrees C; a table without it has the nearest.
pub const CURVE_C: f64 = 25.0;

/// Variance of an SOC of which nothing is known: evenly distributed between 0 and 1.
const EVEN_VARIANCE: f64 = 1.0 / 12.0;

/// Standard deviation of ln(resistance).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResistanceBand {
    /// Common to all SOC and temperatures.
    pub common: f64,
    /// Of this SOC and temperature.
    pub local: f64,
}

impl ResistanceBand {
    /// Of both.
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

    /// Open-circuit voltage at [`CURVE_C`], V.
    pub fn ocv_v(&self, soc: f64) -> f64 {
        self.model.ocv_v(&self.at(soc))
    }

    /// Slope of the open-circuit voltage there, V per unit of SOC, over 5 % of SOC: a filter sees no finer.
    pub fn slope_v(&self, soc: f64) -> f64 {
        let (low, high) = ((soc - 0.025).max(0.0), (soc + 0.025).min(1.0));
        (self.ocv_v(high) - self.ocv_v(low)) / (high - low)
    }

    /// Standard deviation of the open-circuit voltage, V; `None` = the model states none.
    pub fn curve_std_v(&self, soc: f64) -> Option<f64> {
        let [a, b] = self.modes_v(soc);
        Some(self.curve_rest_v(soc)?.hypot(a).hypot(b))
    }

    /// Modes of the spread between cells, V per standard deviation.
    pub(super) fn modes_v(&self, soc: f64) -> [f64; 2] {
        let has_spread = self.model.spread.is_some();
        let modes_v = self.model.aged_ocv_changes_v(&self.at(soc), self.model.capacity_ah).1;
        if has_spread { modes_v } else { [0.0; 2] }
    }

    /// Deviation of the curve beside the modes, V.
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

    /// Standard deviation of the capacity, fraction.
    pub fn capacity_std(&self) -> f64 {
        self.spread().capacity
    }

    fn spread(&self) -> ModelSpread {
        self.model.spread.unwrap_or(ModelSpread::usual(self.model.branches.len()))
    }

    /// Standard deviation of the SOC by one voltage at rest, fraction.
    pub fn rest_soc_std(&self, soc: f64) -> Option<f64> {
        Some(soc_variance(square(self.curve_std_v(soc)?), self.slope_v(soc), EVEN_VARIANCE).sqrt())
    }

    /// Standard deviation of the SOC by one voltage under a usual load, C/2, fraction.
    pub fn load_soc_std(&self, soc: f64, temperature_c: f64) -> Option<f64> {
        let drop_v = self.usual_drop_v(&self.model.grid_position(soc, temperature_c));
        let error_v = self.curve_std_v(soc)?.hypot(self.resistance(soc, temperature_c).std() * drop_v);
        Some(soc_variance(square(error_v), self.slope_v(soc), EVEN_VARIANCE).sqrt())
    }

    /// Voltage that a usual load drops in the cell once it has settled, V.
    pub(super) fn usual_drop_v(&self, position: &GridPosition) -> f64 {
        USUAL_LOAD_PER_H * self.model.rated_capacity_ah * self.model.settled_ohm(position)
    }

    fn at(&self, soc: f64) -> GridPosition {
        self.model.grid_position(soc, CURVE_C)
    }
}

/// Variance of the SOC by a voltage of this variance, V^2, on a curve of this slope, V per unit of SOC, when it was known with the
/// variance `before`.
fn soc_variance(voltage_variance: f64, slope_v: f64, before: f64) -> f64 {
    1.0 / (slope_v * slope_v / voltage_variance + 1.0 / before)
}

#[cfg(test)]
mod tests;
