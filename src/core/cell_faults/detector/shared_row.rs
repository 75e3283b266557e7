//! A row summarises a few minutes of samples. This module computes what the voltage difference in a row says about a
//! cell's states. The states explain the difference: for example, the cell's SOC or resistance differs from the mean
//! cell's, or its voltage channel has an offset.
//!
//! In: the values of the row that all cells share, the estimated means of a cell's states, and the voltage difference
//! (the cell's voltage minus the middle voltage of the pack, V). Out: an [`Observation`].

use crate::cell::{CellModel, GridPosition};
use crate::cell_faults::difference::{CHANNEL, CONTACT, Observation, RESISTANCE, SOC, STATES};
use crate::filter::ScalarGaussian;

/// Standard deviations of a row's errors: voltage (V), voltage drop (fraction of the drop), and SOC on the
/// open-circuit curve (fraction).
const ROW_V: f64 = 0.002;
const ROW_DROP: f64 = 0.03;
const ROW_CURVE: f64 = 0.001;
/// Additional errors of a cell, per unit of SOC difference from the mean cell: `FAR_V` in the open-circuit voltage (V)
/// and `FAR_DROP` in the voltage drop (fraction). `MOST_ELSEWHERE` limits the model's resistance at the cell's SOC,
/// divided by its resistance at the mean cell's SOC.
const FAR_V: f64 = 0.05;
const FAR_DROP: f64 = 1.0;
const MOST_ELSEWHERE: f64 = 3.0;
/// Values of a row that all cells share.
pub(super) struct Row<'a> {
    pub(super) model: &'a CellModel,
    /// True slope of the open-circuit curve divided by the model's slope, with the variance of its error
    /// ([`PackSlope::factor`](crate::cell_faults::pack_slope::PackSlope::factor)).
    pub(super) factor: ScalarGaussian,
    pub(super) capacity_ah: f64,
    pub(super) soc: f64,
    pub(super) curve_soc: f64,
    pub(super) temperature_c: f64,
    pub(super) current_a: f64,
    pub(super) drop_v: f64,
    pub(super) charge_ah: f64,
}

impl Row<'_> {
    /// Compares `difference_v`, a cell's voltage minus the middle voltage of the pack, with its expected value. The
    /// result is linearised at the means of the cell's states. `soc_variance`: variance of the state [`SOC`].
    pub(super) fn observation(&self, means: &[f64; STATES], soc_variance: f64, difference_v: f64) -> Observation {
        let (model, own, middle) = (self.model, self.at(means[SOC]), self.at(0.0));
        let model_slope_v = model.ocv_slope_v(&own, self.capacity_ah).max(0.0);
        let slope_v = self.factor.mean * model_slope_v;
        let contact_v = self.current_a * self.contact_ohm();
        let slope = [slope_v, 0.0, -self.drop_v, -contact_v, 1.0, 0.0];
        let curve_v = self.factor.mean * self.curve_v(means[SOC]);
        // The resistance depends on the SOC, so even a healthy cell has another resistance at another SOC.
        let elsewhere = (model.r0_ohm(&own) / model.r0_ohm(&middle)).clamp(1.0 / MOST_ELSEWHERE, MOST_ELSEWHERE) - 1.0;
        let expected_v = curve_v - self.drop_v * elsewhere
            + slope[RESISTANCE] * means[RESISTANCE]
            + slope[CONTACT] * means[CONTACT]
            + means[CHANNEL];
        let far = means[SOC].abs();
        let (drop_v, on_curve_v) = ((ROW_DROP + far * FAR_DROP) * self.drop_v, ROW_CURVE * slope_v);
        let far_v = far * FAR_V;
        let by_slope = self.factor.variance * model_slope_v * model_slope_v * (far * far + soc_variance);
        let variance = ROW_V * ROW_V + far_v * far_v + drop_v * drop_v + on_curve_v * on_curve_v + by_slope;
        Observation { innovation: difference_v - expected_v, slope, variance }
    }

    fn at(&self, charge: f64) -> GridPosition {
        self.model.grid_position((self.curve_soc + charge).clamp(0.0, 1.0), self.temperature_c)
    }

    /// Change of the model's open-circuit voltage (V) from the mean cell's SOC to that SOC plus `charge` (fraction).
    pub(super) fn curve_v(&self, charge: f64) -> f64 {
        let ocv_v = |charge: f64| self.model.aged_ocv_v(&self.at(charge), self.capacity_ah);
        ocv_v(charge) - ocv_v(0.0)
    }

    pub(super) fn model_slope_v(&self) -> f64 {
        self.model.ocv_slope_v(&self.at(0.0), self.capacity_ah)
    }

    pub(super) fn ohm(&self) -> f64 {
        self.model.r0_ohm(&self.model.grid_position(self.soc, self.temperature_c))
    }

    /// Series resistance at SOC 0.5 and 25 degrees C (ohm). The contact resistance depends on neither SOC nor
    /// temperature, so it is stated as a fraction of this value.
    pub(super) fn contact_ohm(&self) -> f64 {
        self.model.r0_ohm(&self.model.grid_position(0.5, 25.0))
    }
}
