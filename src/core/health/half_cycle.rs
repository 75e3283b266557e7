//! A half-cycle: one charge or one discharge of a cell.

use super::CapacityConfig;
use crate::cell::model_bands::CURVE_C;
use crate::cell::{CellModel, reach_of_error};
use crate::filter::{Measurement, ScalarGaussian, square};
use crate::quantity::Mode;

/// One completed half-cycle of one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HalfCycle {
    /// Charge or discharge.
    pub mode: Mode,
    /// Charge moved (Ah), positive.
    pub charge_ah: f64,
    /// Change of the SOC (fraction) with its variance; positive if the SOC rose during a charge or fell during a
    /// discharge. The variance treats the SOC errors at the two ends as independent. `None` if the SOC at the start or
    /// the end was not estimated.
    pub swing: Option<ScalarGaussian>,
    /// SOC at the end, fraction; `None` if it was not estimated.
    pub end_soc: Option<f64>,
    /// SOC at the start and the end, fractions; `None` if the SOC at the end was not estimated. If only the SOC at the
    /// start is unknown, both values are the SOC at the end.
    pub ends: Option<[f64; 2]>,
    /// SOC at the start and the end according to the voltages alone, fractions; known only with the model of a label.
    pub ends_by_voltage: Option<[f64; 2]>,
    /// Variance of the charge that has flowed while no current was measured (square of a fraction of the capacity).
    pub uncounted: f64,
    /// Duration (s).
    pub duration_s: f64,
    /// Mean current (A); positive = discharge.
    pub mean_current_a: f64,
    /// Mean temperature (degrees C); `None` without a temperature reading.
    pub mean_temperature_c: Option<f64>,
}

impl HalfCycle {
    /// The capacity (Ah): counted charge divided by the change of the SOC that the voltages show. `None` if the SOC by
    /// voltage is unknown or has not changed in the direction of the charge. `soc_error`: error of the SOC by voltage
    /// that comes from the loads before (fraction).
    pub(super) fn capacity_by_voltage(
        &self,
        model: &CellModel,
        config: &CapacityConfig,
        soc_error: f64,
    ) -> Option<Measurement> {
        let [start, end] = self.ends_by_voltage?;
        let swing = if self.mode == Mode::Charge { end - start } else { start - end };
        if swing <= 0.0 {
            return None;
        }
        let value = self.charge_ah / swing;
        let offset_ah = config.current_offset_std_a * self.duration_s / 3600.0;
        let soc_variance = |soc: f64| {
            let temperature = model.temperature_position(self.mean_temperature_c.unwrap_or(CURVE_C));
            let position = model.grid_position_at(&temperature, soc);
            // The model of a label always states its error.
            let error_v = model.voltage_error_v(&position).unwrap_or(0.0);
            square(reach_of_error(model, &temperature, model.capacity_ah, (soc, error_v))) + square(soc_error)
        };
        let of_swing = (soc_variance(start) + soc_variance(end) + self.uncounted) / square(swing);
        Some(Measurement { value, variance: value * value * (square(offset_ah / self.charge_ah) + of_swing) })
    }
}
