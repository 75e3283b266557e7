//! Determines how far a constant error of the voltage may have moved the SOC.
//!
//! In: a cell model and the standard deviation of a constant voltage error (V). Out: the reach, which is the standard
//! deviation of the SOC that this error causes, fraction.
//!
//! The filter linearises the open-circuit curve at its estimate. Next to a flat part of the curve, this hides how wrong
//! the SOC may be: at the upper end of an LFP cell, an error of one standard deviation moves the SOC by 1 %, and an
//! error of four standard deviations moves it by 25 %. The reach is therefore measured at [`FAR`] standard deviations
//! and divided by [`FAR`].

use crate::cell::CellModel;

/// Distance at which the reach is measured, in standard deviations of the voltage error.
pub(super) const FAR: f64 = 4.0;

/// Number of intervals of the SOC grid.
const INTERVALS: usize = 100;

/// Temperature at which the curve is evaluated (degrees C). The curve hardly depends on the temperature.
const TEMPERATURE_C: f64 = 25.0;

/// Reach on a grid of SOC.
#[derive(Debug, Clone)]
pub(super) struct VoltageReach {
    /// Per SOC: the reach (standard deviation of the SOC, fraction), and the slope of the curve divided by the voltage
    /// error (1/fraction). The filter's linear effect times the second value is the share of the reach that counts.
    nodes: Vec<(f64, f64)>,
}

impl VoltageReach {
    /// Measures the reach of an error with the standard deviation `std_v` (V).
    pub(super) fn new(model: &CellModel, std_v: f64) -> Self {
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
        Self { nodes }
    }

    /// Standard deviation of the SOC caused by the voltage error, fraction. `linear`: change of the SOC per standard
    /// deviation of the error, as the filter has linearised it. The reach counts only to the extent that the filter
    /// found the SOC from the voltage at this SOC, and not from the charge counted since another SOC.
    #[inline]
    pub(super) fn std(&self, soc: f64, linear: f64) -> f64 {
        let at = soc.clamp(0.0, 1.0) * INTERVALS as f64;
        let (reach, per_linear) = self.nodes[at.round() as usize];
        linear.abs().max((linear.abs() * per_linear).min(1.0) * reach)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;

    #[test]
    fn reach_on_straight_curve_is_linear() {
        let model = small_model();
        let reach = VoltageReach::new(&model, 0.004);
        let (soc, slope_v) = (0.5, reach.nodes[50].1 * 0.004);
        let linear = 0.004 / slope_v;
        let ratio = reach.std(soc, linear) / linear;
        assert!((1.0..1.5).contains(&ratio), "{ratio}");
    }

    #[test]
    fn counted_charge_has_no_reach() {
        let reach = VoltageReach::new(&small_model(), 0.004);
        assert_eq!(reach.std(0.5, 0.0), 0.0);
        assert!(reach.std(0.5, 1e-5) < 1e-3);
    }
}
