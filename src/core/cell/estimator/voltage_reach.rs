//! Determines how far a constant error of the voltage may have moved the SOC.
//!
//! In: a cell model and the standard deviation of a constant voltage error (V). Out: the reach, which is the standard
//! deviation of the SOC that this error causes, fraction.
//!
//! The filter linearises the open-circuit curve at its estimate. Next to a flat part of the curve, this hides how wrong
//! the SOC may be: at the upper end of an LFP cell, an error of one standard deviation moves the SOC by 1 %, and an
//! error of four standard deviations moves it by 25 %. The reach is therefore measured at [`FAR`] standard deviations
//! and divided by [`FAR`].
//!
//! If a reading contradicts the estimate, the reach is measured from the SOC that this reading shows. A filter whose
//! variance is already small corrects such a contradiction only slowly.

use crate::cell::CellModel;

/// Distance at which the reach is measured, in standard deviations of the voltage error.
pub(super) const FAR: f64 = 4.0;

/// Number of intervals of the SOC grid.
const INTERVALS: usize = 100;

/// The filter may have found the SOC at a steeper place of the curve, up to this many intervals from its present SOC.
const NEAR: usize = 20;

/// Temperature at which the curve is evaluated (degrees C). The curve hardly depends on the temperature.
const TEMPERATURE_C: f64 = 25.0;

/// Reach on a grid of SOC.
#[derive(Debug, Clone)]
pub(super) struct VoltageReach {
    /// Per SOC: the reach (standard deviation of the SOC, fraction), and the slope of the curve divided by the voltage
    /// error (1/fraction). The filter's linear effect times the second value is the share of the reach that counts.
    nodes: Vec<(f64, f64)>,
    /// Open-circuit voltage per SOC (V), not falling.
    ocv_v: Vec<f64>,
    /// [`FAR`] standard deviations of the voltage error (V).
    far_v: f64,
    /// Largest innovation that does not contradict the estimate (V): one standard deviation of noise and voltage error.
    usual_v: f64,
}

impl VoltageReach {
    /// Measures the reach of an error with the standard deviation `std_v` (V). `noise_v`: noise of a reading (V).
    pub(super) fn new(model: &CellModel, std_v: f64, noise_v: f64) -> Self {
        let temperature = model.temperature_position(TEMPERATURE_C);
        let ocv_v = |soc: f64| model.aged_ocv_v(&model.grid_position_at(&temperature, soc), model.capacity_ah);
        let step = 1.0 / INTERVALS as f64;
        let node = |index: usize| {
            let soc = index as f64 * step;
            let reach = |error_v: f64| {
                let far = model.soc_of_aged_ocv(&temperature, model.capacity_ah, ocv_v(soc) + error_v);
                (far.clamp(0.0, 1.0) - soc).abs() / FAR
            };
            let (low, high) = ((soc - step).max(0.0), (soc + step).min(1.0));
            let slope_v = (ocv_v(high) - ocv_v(low)) / (high - low);
            (reach(-FAR * std_v).max(reach(FAR * std_v)), slope_v / std_v)
        };
        let nodes = if std_v > 0.0 { (0..=INTERVALS).map(node).collect() } else { vec![(0.0, 0.0); INTERVALS + 1] };
        let ocv_v = (0..=INTERVALS).map(|index| ocv_v(index as f64 * step)).collect();
        Self { nodes, ocv_v, far_v: FAR * std_v, usual_v: std_v.hypot(noise_v) }
    }

    /// Standard deviation of the SOC caused by the voltage error, fraction. `linear`: change of the SOC per standard
    /// deviation of the error, as the filter has linearised it. The reach at a SOC counts only to the extent that the
    /// filter can have found the SOC there, and not by counting charge.
    ///
    /// `innovation_v`: last innovation (V).
    #[inline]
    pub(super) fn std(&self, soc: f64, linear: f64, innovation_v: f64) -> f64 {
        let (at, linear) = (soc.clamp(0.0, 1.0) * INTERVALS as f64, linear.abs());
        let found = |per_linear: f64| (linear * per_linear).min(1.0);
        let nearest = at.round() as usize;
        let near = nearest.saturating_sub(NEAR)..(nearest + NEAR + 1).min(INTERVALS + 1);
        let mut std = linear;
        for &(reach, per_linear) in &self.nodes[near] {
            std = std.max(found(per_linear) * reach);
        }
        let excess_v = innovation_v.abs() - self.usual_v;
        if excess_v > 0.0 {
            let reach = self.contradicted(at, (self.far_v + excess_v).copysign(innovation_v));
            std = std.max(found(self.nodes[nearest].1) * reach);
        }
        std
    }

    /// Reach from the grid position `at` if the voltage error is `error_v`.
    fn contradicted(&self, at: f64, error_v: f64) -> f64 {
        let left = (at as usize).min(INTERVALS - 1);
        let ocv_v = self.ocv_v[left] + (at - left as f64) * (self.ocv_v[left + 1] - self.ocv_v[left]);
        let far_v = ocv_v + error_v;
        let right = self.ocv_v.partition_point(|&v| v < far_v).clamp(1, INTERVALS);
        let (low_v, high_v) = (self.ocv_v[right - 1], self.ocv_v[right]);
        let part = if high_v > low_v { ((far_v - low_v) / (high_v - low_v)).clamp(0.0, 1.0) } else { 0.5 };
        (right as f64 - 1.0 + part - at).abs() / INTERVALS as f64 / FAR
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;

    #[test]
    fn reach_on_straight_curve_is_linear() {
        let model = small_model();
        let reach = VoltageReach::new(&model, 0.004, 0.0);
        let (soc, slope_v) = (0.5, reach.nodes[50].1 * 0.004);
        let linear = 0.004 / slope_v;
        let ratio = reach.std(soc, linear, 0.0) / linear;
        assert!((1.0..1.5).contains(&ratio), "{ratio}");
    }

    #[test]
    fn counted_charge_has_no_reach() {
        let reach = VoltageReach::new(&small_model(), 0.004, 0.0);
        assert_eq!(reach.std(0.5, 0.0, 0.0), 0.0);
        assert!(reach.std(0.5, 1e-5, 0.0) < 1e-3);
    }
}
