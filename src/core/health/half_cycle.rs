//! A half-cycle: one charge or one discharge of a cell.

use super::CapacityConfig;
use crate::cell::model_bands::CURVE_C;
use crate::cell::{CellModel, reach_of_error};
use crate::filter::{Measurement, ScalarGaussian, square};
use crate::quantity::Mode;

/// Largest difference of two measurements of the same capacity, in standard deviations of the difference.
const SIGMA: f64 = 3.0;

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
    /// Whether the charge and the change of the SOC allow the measured capacity `z` (Ah). A cell cannot hold less than
    /// the charge that it has taken or given in one go. The charge divided by the change of the SOC is a second
    /// measurement of the capacity; both must agree. `tolerance_ah`: a smaller difference is never a contradiction,
    /// because the SOC follows a fading capacity late.
    pub(super) fn allows(&self, z: &Measurement, tolerance_ah: f64) -> bool {
        let least_ah = z.value + tolerance_ah.max(SIGMA * z.variance.sqrt());
        let Some(swing) = self.swing.filter(|swing| swing.mean > SIGMA * swing.std()) else {
            return self.charge_ah <= least_ah;
        };
        let by_swing_ah = self.charge_ah / swing.mean;
        let std_ah = by_swing_ah * swing.std() / swing.mean;
        let limit_ah = tolerance_ah.max(SIGMA * std_ah.hypot(z.variance.sqrt()));
        self.charge_ah <= least_ah && (z.value - by_swing_ah).abs() <= limit_ah
    }

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_cycle_allows_capacity_near_charge_over_swing_only() {
        let half_cycle = |charge_ah: f64, swing: f64| HalfCycle {
            mode: Mode::Charge,
            charge_ah,
            swing: Some(ScalarGaussian::from_std(swing, 0.05)),
            end_soc: Some(0.9),
            ends: Some([0.9 - swing, 0.9]),
            ends_by_voltage: None,
            uncounted: 0.0,
            duration_s: 3600.0,
            mean_current_a: -charge_ah,
            mean_temperature_c: None,
        };
        let z = |value: f64| Measurement { value, variance: 0.01 };
        // 1 Ah in 50 %: 2 +- 0.2 Ah. The measurement has a deviation of 0.1 Ah.
        assert!([1.4, 2.0, 2.6].iter().all(|&value| half_cycle(1.0, 0.5).allows(&z(value), 0.0)));
        assert!([1.2, 2.8].iter().all(|&value| !half_cycle(1.0, 0.5).allows(&z(value), 0.0)));
        assert!(half_cycle(1.0, 0.5).allows(&z(2.8), 0.9));
        // The swing is too small to say anything, but the cell has taken 1 Ah.
        assert!(half_cycle(1.0, 0.1).allows(&z(0.8), 0.0) && !half_cycle(1.0, 0.1).allows(&z(0.6), 0.0));
    }
}
