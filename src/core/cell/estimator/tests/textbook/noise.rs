//! Computes the process noise of a step and the measurement noise of a voltage reading for the textbook filter (the
//! plain reference filter of the estimator's tests).

use nalgebra::{SMatrix, SVector};

use super::unscented::{Gaussian, MeasurementNoise};
use crate::cell::aged_ocv::MIXES;
use crate::cell::estimator::state_vector::{
    BRANCHES, CAPACITY, CONSTANT_ERRORS, CURRENT_GAIN, CURRENT_OFFSET, CURVE_CAPACITY, CURVE_MIXES, LOG_RESISTANCE,
    SLOW_BRANCH, VOLTAGE_OFFSET, square,
};
use crate::cell::{CellModel, ERROR_WINDOW_S, EstimatorConfig, GridPosition, SensorErrors, TemperaturePosition};
use crate::filter::ScalarGaussian;

/// Maximum time of a step (s) for the random walk of the resistance. Longer steps count as this time, because a cell
/// hardly ages in a gap.
const MAX_WALK_S: f64 = 600.0;

/// Covariance that the random walks gain in `dt_s`. The noise of the capacity is added elsewhere, after each charge or
/// discharge.
pub(super) fn process<const N: usize>(
    model: &CellModel,
    config: &EstimatorConfig,
    position: &GridPosition,
    dt_s: f64,
) -> SMatrix<f64, N, N> {
    let mut q = SMatrix::zeros();
    for i in BRANCHES..N {
        // The noise in a branch decays with the branch's voltage. A step of any length therefore counts as at most
        // tau/2.
        let half_tau_s = 0.5 * model.branch_tau_s(i - BRANCHES, position);
        let effective_s = half_tau_s * -libm::expm1(-dt_s / half_tau_s);
        q[(i, i)] = square(config.process.branch_v_per_sqrt_s) * effective_s;
    }
    q[(LOG_RESISTANCE, LOG_RESISTANCE)] = square(config.process.log_resistance_per_sqrt_s) * dt_s.min(MAX_WALK_S);
    q
}

pub(super) struct VoltageReading {
    pub(super) voltage_v: f64,
    pub(super) current_a: f64,
    pub(super) load_a: f64,
    pub(super) temperature: TemperaturePosition,
    pub(super) information_s: f64,
    /// The capacity (Ah) that was learned up to the end of the last charge or discharge. It selects the open-circuit
    /// curve of the aged cell. Voltage readings do not change it at once, because errors of the model would then be
    /// mistaken for lost capacity.
    pub(super) curve: ScalarGaussian,
    /// Resistance ratio of the slowest branch, in addition to the resistance ratio of the cell.
    pub(super) slow_ratio: f64,
    pub(super) slow_std: f64,
}

impl VoltageReading {
    pub(super) fn branches_v<const N: usize>(&self, x: &SVector<f64, N>) -> f64 {
        (BRANCHES..N - 1).fold(self.slow_ratio * x[N - 1], |sum, i| sum + x[i])
    }

    pub(super) fn noise<const N: usize>(
        &self,
        x: &Gaussian<N>,
        model: &CellModel,
        config: &EstimatorConfig,
    ) -> MeasurementNoise {
        let position = model.grid_position_at(&self.temperature, x.mean[0]);
        let slope_v = model.ocv_slope_v(&position, self.curve.mean);
        let ratio = libm::exp(x.mean[LOG_RESISTANCE]);
        let r0_ohm = model.r0_ohm(&position) * ratio;
        let drop_v = r0_ohm * self.current_a + self.branches_v(&x.mean);
        let load_v = model.settled_ohm(&position) * ratio * self.load_a;
        let base_v_sqrt_s = model
            .voltage_error_v(&position)
            .map_or(config.voltage.model_error_v_sqrt_s, |error_v| error_v * ERROR_WINDOW_S.sqrt());
        let model_variance = square(base_v_sqrt_s)
            + square(config.voltage.drop_error_sqrt_s * drop_v)
            + square(config.voltage.load_error_sqrt_s * load_v);
        let sensor_variance = square(config.voltage.noise_v);
        MeasurementNoise {
            variance: sensor_variance + model_variance / self.information_s,
            gate_variance: sensor_variance
                + square(config.gate.model_error_v)
                + square(config.gate.soc_error * slope_v),
            gate_sigma: config.gate.sigma,
            by_constant: self.by_constant(x, (model, config), &position, slope_v, r0_ohm),
        }
    }

    /// Effect of one standard deviation of each constant error (such as a sensor offset) on the innovation (V).
    fn by_constant<const N: usize>(
        &self,
        x: &Gaussian<N>,
        (model, config): (&CellModel, &EstimatorConfig),
        position: &GridPosition,
        slope_v: f64,
        r0_ohm: f64,
    ) -> SVector<f64, CONSTANT_ERRORS> {
        let SensorErrors { voltage_offset_v, current_offset_a, current_gain, .. } = config.sensor;
        let offset_a = if self.current_a == 0.0 { 0.0 } else { current_offset_a };
        let mut direct_v = SVector::<f64, CONSTANT_ERRORS>::zeros();
        direct_v[VOLTAGE_OFFSET] = voltage_offset_v;
        direct_v[CURRENT_OFFSET] = r0_ohm * offset_a;
        direct_v[CURRENT_GAIN] = r0_ohm * current_gain * self.current_a;
        direct_v[SLOW_BRANCH] = -self.slow_std * x.mean[N - 1];
        let (per_ah_v, mixes_v) = model.aged_ocv_changes_v(position, self.curve.mean);
        direct_v[CURVE_CAPACITY] = -per_ah_v * self.curve.std();
        direct_v.fixed_rows_mut::<MIXES>(CURVE_MIXES).copy_from_slice(&mixes_v);
        let mut slopes = SVector::<f64, N>::repeat(-1.0);
        (slopes[0], slopes[LOG_RESISTANCE], slopes[CAPACITY]) = (slope_v, -r0_ohm * self.current_a, 0.0);
        slopes[N - 1] = -self.slow_ratio;
        direct_v + x.by_constant.tr_mul(&slopes)
    }
}

mod tests;
