//! Process noise of a step, and measurement noise of a voltage reading.
//!
//! In: steps and readings (V, A, s, degrees C). Out: variances in the units of the states, V^2 for the voltage. Inputs are
//! not checked: a NaN gives a variance that the filter rejects.
//!
//! Deviation 4: model^2 = base^2 + (k drop)^2 + (k' load)^2. The base is the cell model's own error over SOC and
//! temperature where its fit states one; the drop is the present voltage drop in the cell, the load that of the last
//! minutes: model error is mostly error of the resistances and of diffusion slower than the branches. Effect: a record
//! that begins under load, the constant-voltage part of a charge, and cold cells no longer count as exact.
//! At rest the error repeats instead of averaging out: a rest of t counts as t_r ln(1 + t/t_r) under load.

use nalgebra::SMatrix;

use super::state_vector::{BRANCHES, CAPACITY, LOG_RESISTANCE, square};
use crate::cell::{CellModel, ERROR_WINDOW_S, EstimatorConfig, GridPosition, TemperaturePosition};
use crate::filter::{Gaussian, MeasurementNoise};

/// Longest time of the resistance's random walk between two readings, s: it does not age in a gap.
pub(super) const MAX_WALK_S: f64 = 600.0;

/// Covariance that the random walks gain in `dt_s`; the capacity's is added at transitions.
pub(super) fn process<const N: usize>(
    model: &CellModel,
    config: &EstimatorConfig,
    position: &GridPosition,
    dt_s: f64,
) -> SMatrix<f64, N, N> {
    let mut q = SMatrix::zeros();
    for i in BRANCHES..N {
        // Noise fed into a decaying branch: bounded by tau/2 however long the step.
        let half_tau_s = 0.5 * model.branch_tau_s(i - BRANCHES, position);
        let effective_s = half_tau_s * -libm::expm1(-dt_s / half_tau_s);
        q[(i, i)] = square(config.process.branch_v_per_sqrt_s) * effective_s;
    }
    q[(LOG_RESISTANCE, LOG_RESISTANCE)] = square(config.process.log_resistance_per_sqrt_s) * dt_s.min(MAX_WALK_S);
    q
}

/// A voltage reading with the inputs of its prediction.
pub(super) struct VoltageReading {
    pub(super) voltage_v: f64,
    pub(super) current_a: f64,
    pub(super) load_a: f64,
    pub(super) temperature: TemperaturePosition,
    pub(super) information_s: f64,
}

impl VoltageReading {
    /// Measurement noise of this reading for a cell at state `x`.
    pub(super) fn noise<const N: usize>(
        &self,
        x: &Gaussian<N>,
        model: &CellModel,
        config: &EstimatorConfig,
    ) -> MeasurementNoise {
        let position = model.grid_position_at(&self.temperature, x.mean[0]);
        let slope_v = model.ocv_slope_v(&position, x.mean[CAPACITY]);
        let ratio = libm::exp(x.mean[LOG_RESISTANCE]);
        let drop_v = (BRANCHES..N).fold(model.r0_ohm(&position) * ratio * self.current_a, |sum, i| sum + x.mean[i]);
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
        }
    }
}

#[cfg(test)]
mod tests;
