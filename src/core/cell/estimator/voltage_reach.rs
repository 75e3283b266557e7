//! Computes how far a constant error of the voltage may have moved the SOC.
//!
//! In: a cell model and the standard deviation of the voltage error (V). Out: the reach, which is the standard
//! deviation of the SOC (fraction) that this error causes.
//!
//! The filter linearises the open-circuit curve at its estimate. Near a flat part of the curve, this understates the
//! error of the SOC. At the upper end of an LFP cell, for example, an error of one standard deviation moves the SOC by
//! 1 %, but an error of four standard deviations moves it by 25 %. The reach is therefore measured at [`FAR`] standard
//! deviations and divided by [`FAR`].
//!
//! The filter may have found the SOC from the voltage at another SOC, and then counted charge up to the present SOC.
//! Therefore, the reach at SOCs up to [`NEAR`] grid intervals away counts, too, if a flat part of the curve is within
//! reach of these SOCs.
//!
//! If a reading near a flat part contradicts the estimate, the reading is assumed to have an additional error of
//! [`FAR`] standard deviations. The reach then extends to the SOC that follows from this assumption. Reason: a filter
//! with a small variance corrects the contradiction only slowly.

use crate::cell::CellModel;
use crate::cell::model::TemperaturePosition;

/// Distance at which the reach is measured, in standard deviations of the voltage error.
pub(super) const FAR: f64 = 4.0;

const INTERVALS: usize = 100;

/// Maximum distance (grid intervals) of another SOC whose reach counts.
const NEAR: usize = 20;

/// A flat part of the curve is within reach if a voltage error moves the SOC more than this many times as far as the
/// slope of the curve says.
pub(super) const FLAT: f64 = 2.0;

/// Smallest slope of a curve (V per unit of SOC). Limits the reach where the extrapolated curve is flat.
const LEAST_SLOPE_V: f64 = 1e-3;

/// Temperature at which the curve is evaluated (degrees C). The curve hardly depends on the temperature.
const TEMPERATURE_C: f64 = 25.0;

/// Standard deviation (fraction) of a SOC that was found from a voltage. `soc`: the SOC. `error_v`: standard deviation
/// of the voltage (V). `capacity_ah`: capacity that selects the curve (Ah). Near a flat part of the curve, the slope at
/// this SOC is not enough. The result is therefore at least the SOC change caused by [`FAR`] standard deviations,
/// divided by [`FAR`].
pub fn reach_of_error(
    model: &CellModel,
    temperature: &TemperaturePosition,
    capacity_ah: f64,
    (soc, error_v): (f64, f64),
) -> f64 {
    let position = model.grid_position_at(temperature, soc);
    let ocv_v = model.aged_ocv_v(&position, capacity_ah);
    let by_slope = error_v / model.ocv_slope_v(&position, capacity_ah).max(LEAST_SLOPE_V);
    let far = [-FAR, FAR].map(|far| model.soc_of_aged_ocv(temperature, capacity_ah, ocv_v + far * error_v));
    far.into_iter().map(|far| (far - soc).abs() / FAR).fold(by_slope, f64::max)
}

/// Reach over a grid of SOCs.
#[derive(Debug, Clone)]
pub(super) struct VoltageReach {
    /// Per SOC: the reach (fraction), and the slope of the curve divided by the standard deviation of the voltage error
    /// (1/fraction). The second value times `linear` (see [`Self::std`]) is the share of the reach that counts. It is 1
    /// if the filter has found the SOC from the voltage alone.
    nodes: Vec<(f64, f64)>,
    has_flat: bool,
    /// Open-circuit voltage per SOC (V), never falling.
    ocv_v: Vec<f64>,
    far_v: f64,
    /// Innovation (V) above which a reading widens the reach: one standard deviation of noise and voltage error.
    usual_v: f64,
}

impl VoltageReach {
    /// `std_v`: standard deviation of the constant voltage error (V). `noise_v`: noise of a reading (V).
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
        let nodes = (0..=INTERVALS).map(|index| if std_v > 0.0 { node(index) } else { (0.0, 0.0) });
        let nodes: Vec<(f64, f64)> = nodes.collect();
        let has_flat = nodes.iter().any(is_flat);
        let ocv_v = (0..=INTERVALS).map(|index| ocv_v(index as f64 * step)).collect();
        Self { nodes, has_flat, ocv_v, far_v: FAR * std_v, usual_v: std_v.hypot(noise_v) }
    }

    /// Standard deviation of the SOC (fraction) caused by the voltage error. `linear`: change of the SOC per standard
    /// deviation of the error, as linearised by the filter. `innovation_v`: last innovation (V). The more the filter
    /// has relied on counted charge instead of the voltage, the smaller is the share of the reach that counts.
    #[inline]
    pub(super) fn std(&self, soc: f64, linear: f64, innovation_v: f64) -> f64 {
        let (at, linear) = (soc.clamp(0.0, 1.0) * INTERVALS as f64, linear.abs());
        let found = |per_linear: f64| (linear * per_linear).min(1.0);
        let nearest = at.round() as usize;
        let (reach, per_linear) = self.nodes[nearest];
        let mut std = linear.max(found(per_linear) * reach);
        if self.has_flat {
            let near = nearest.saturating_sub(NEAR)..=(nearest + NEAR).min(INTERVALS);
            for &(reach, per_linear) in self.nodes[near].iter().filter(|node| is_flat(node)) {
                std = std.max(found(per_linear) * reach);
            }
        }
        let excess_v = innovation_v.abs() - self.usual_v;
        if excess_v > 0.0 {
            let error_v = self.far_v + excess_v;
            let reach = self.contradicted(at, error_v.copysign(innovation_v));
            if reach * per_linear * self.far_v > FLAT * error_v {
                std = std.max(found(per_linear) * reach);
            }
        }
        std
    }

    /// SOC change from the grid position `at` that a voltage error of `error_v` causes, divided by [`FAR`].
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

fn is_flat(&(reach, per_linear): &(f64, f64)) -> bool {
    reach * per_linear > FLAT
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;

    /// Slopes of the curve (V per unit of SOC): 1.5 up to 10 %, 0.0125 up to 90 %, 0.5 up to 96 %, then 3.
    fn flat_model() -> CellModel {
        let mut model = small_model();
        model.soc = vec![0.0, 0.1, 0.9, 0.96, 1.0];
        model.ocv_v.values = vec![vec![3.15, 3.3, 3.31, 3.34, 3.46]; 2];
        model
    }

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

    #[test]
    fn flat_part_near_steep_end_widens_soc() {
        let reach = VoltageReach::new(&flat_model(), 0.01, 0.0);
        // Four standard deviations are 40 mV. From SOC 92 %, the first 10 mV lead down to 90 %, the next 10 mV lead
        // down to 10 %, and the last 20 mV lead below 10 %.
        let (linear, far) = (0.01 / 0.5, (0.92 - 0.1 + 0.02 / 1.5) / FAR);
        let at_end = reach.std(0.92, linear, 0.0);
        assert!((at_end - far).abs() < 0.01, "{at_end} {far}");
        // Counting charge does not make the SOC more certain.
        assert!(reach.std(0.8, linear, 0.0) >= 0.9 * at_end);
        assert!(reach.std(0.6, linear, 0.0) < 0.2 * at_end, "limit: beyond [`NEAR`], the error is ignored");
    }

    #[test]
    fn contradicting_reading_is_within_reach() {
        let reach = VoltageReach::new(&flat_model(), 0.004, 0.003);
        let (soc, linear) = (0.99, 0.004 / 3.0);
        let usual = reach.std(soc, linear, 0.0);
        assert_eq!(reach.std(soc, linear, -0.005), usual, "usual noise");
        // The reading shows SOC 90 %. An additional error of 16 mV (four standard deviations) leads below the flat
        // part.
        let wide = reach.std(soc, linear, -0.12);
        assert!(wide > 0.2 && wide > 5.0 * usual, "{wide} {usual}");
        // If the SOC comes from counted charge, the voltage error hardly matters.
        assert!(reach.std(soc, 1e-5, -0.12) < 0.01);
    }
}
