//! Process noise of a step, measurement noise of a voltage reading, and the memory of rest and load behind them.
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

use super::{BRANCHES, CellEstimator, CellStep, LOG_RESISTANCE, square};
use crate::cell::config::EstimatorConfig;
use crate::cell::model::{CellModel, ERROR_WINDOW_S, GridPosition, TemperaturePosition};
use crate::filter::{Gaussian, MeasurementNoise};

/// Rest after which a cell's voltage adds little information, s: what still relaxes then is slower than the branches.
pub(super) const REST_REPEATS_S: f64 = 1000.0;

/// Longest time of the resistance's random walk between two readings, s: it does not age in a gap.
pub(super) const MAX_WALK_S: f64 = 600.0;

/// Assumed load in a gap that has a load next to it, per rated capacity: 1 C.
const GAP_LOAD_PER_H: f64 = 1.0;

impl CellEstimator {
    /// Time that counts as new information in the present reading, s: all of it under load, a decreasing part at rest.
    pub(super) fn new_information_s(&mut self, config: &EstimatorConfig, step: &CellStep) -> f64 {
        let elapsed_s = step.measured_s + step.unmeasured_s;
        if step.charge_as.abs() > config.rest_current_a * step.measured_s || step.unmeasured_s > 0.0 {
            self.memory.rest_s = 0.0;
            return elapsed_s;
        }
        let before_s = self.memory.rest_s;
        self.memory.rest_s += elapsed_s;
        REST_REPEATS_S * libm::log((REST_REPEATS_S + self.memory.rest_s) / (REST_REPEATS_S + before_s))
    }

    /// Updates the load's low-pass. A gap with a load next to it counts as the heaviest usual load.
    pub(super) fn update_load_memory(&mut self, model: &CellModel, config: &EstimatorConfig, step: &CellStep) {
        let memory = &mut self.memory;
        let keep = |elapsed_s: f64| libm::exp(-elapsed_s / config.load_memory_s);
        if step.measured_s > 0.0 {
            let mean_a = step.charge_as.abs() / step.measured_s;
            memory.load_a = mean_a + (memory.load_a - mean_a) * keep(step.measured_s);
        }
        if step.unmeasured_s > 0.0 {
            memory.load_a *= keep(step.unmeasured_s);
            let adjacent_a = memory.last_current_a.abs().max(step.current_a.unwrap_or(0.0).abs());
            if adjacent_a > config.rest_current_a {
                memory.load_a = memory.load_a.max(adjacent_a).max(model.rated_capacity_ah * GAP_LOAD_PER_H);
            }
        }
    }
}

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
        q[(i, i)] = square(config.branch_noise_v_per_sqrt_s) * effective_s;
    }
    q[(LOG_RESISTANCE, LOG_RESISTANCE)] = square(config.log_resistance_noise_per_sqrt_s) * dt_s.min(MAX_WALK_S);
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
        let slope_v = model.ocv_slope_v(&position);
        let ratio = libm::exp(x.mean[LOG_RESISTANCE]);
        let drop_v = (BRANCHES..N).fold(model.r0_ohm(&position) * ratio * self.current_a, |sum, i| sum + x.mean[i]);
        let load_v = model.settled_ohm(&position) * ratio * self.load_a;
        let base_v_sqrt_s = model
            .voltage_error_v(&position)
            .map_or(config.model_error_v_sqrt_s, |error_v| error_v * ERROR_WINDOW_S.sqrt());
        let model_variance = square(base_v_sqrt_s)
            + square(config.drop_error_sqrt_s * drop_v)
            + square(config.load_error_sqrt_s * load_v);
        let sensor_variance = square(config.voltage_noise_v);
        MeasurementNoise {
            variance: sensor_variance + model_variance / self.information_s,
            gate_variance: sensor_variance
                + square(config.gate_model_error_v)
                + square(config.gate_soc_error * slope_v),
            gate_sigma: config.gate_sigma,
        }
    }
}

#[cfg(test)]
mod tests;
