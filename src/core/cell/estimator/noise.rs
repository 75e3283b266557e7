//! What noise goes with a step of the filter and with a voltage reading, and the memory of rest and load behind it.
//!
//! Deviation 4: model^2 = base^2 + (k drop)^2 + (k' load)^2. The base is the cell model's own error over SOC and
//! temperature where its fit has left one; the drop is the voltage lost in the cell now, the load that of the last
//! minutes: model error is mostly error of the resistances and of diffusion slower than the branches. Effect: a record
//! that begins under load, or the constant-voltage part of a charge, no longer passes for exact, nor does the cold.
//! At rest the error repeats instead of averaging out: a rest of t tells as much as t_r ln(1 + t/t_r) under load.

use nalgebra::SMatrix;

use super::{BRANCHES, CellEstimator, CellStep, LOG_RESISTANCE, square};
use crate::cell::config::EstimatorConfig;
use crate::cell::model::{CellModel, ERROR_WINDOW_S, Place, Row};
use crate::filter::{Gaussian, Noise};

/// Rest after which a cell's voltage says little that is new, s: what still relaxes then is slower than the branches.
pub(super) const REST_REPEATS_S: f64 = 1000.0;

/// Longest time for which the resistance walks between two readings, s: it does not age in a gap.
pub(super) const MAX_WALK_S: f64 = 600.0;

/// Load, per rated capacity, that may have gone on in a gap when there is any beside it: 1 C.
const GAP_LOAD_PER_H: f64 = 1.0;

impl CellEstimator {
    /// Time for which the present reading says something new, s: all of it under load, ever less of a rest.
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

    /// Follows the load; after a gap with a load beside it, what went on in the gap may have been the heaviest usual one.
    pub(super) fn remember_load(&mut self, model: &CellModel, config: &EstimatorConfig, step: &CellStep) {
        let memory = &mut self.memory;
        let keep = |elapsed_s: f64| libm::exp(-elapsed_s / config.load_memory_s);
        if step.measured_s > 0.0 {
            let mean_a = step.charge_as.abs() / step.measured_s;
            memory.load_a = mean_a + (memory.load_a - mean_a) * keep(step.measured_s);
        }
        if step.unmeasured_s > 0.0 {
            memory.load_a *= keep(step.unmeasured_s);
            let beside_a = memory.last_current_a.abs().max(step.current_a.unwrap_or(0.0).abs());
            if beside_a > config.rest_current_a {
                memory.load_a = memory.load_a.max(beside_a).max(model.rated_capacity_ah * GAP_LOAD_PER_H);
            }
        }
    }
}

/// Covariance the random walks gain in `dt_s`; the capacity's is added at transitions.
pub(super) fn process<const N: usize>(
    model: &CellModel,
    config: &EstimatorConfig,
    place: &Place,
    dt_s: f64,
) -> SMatrix<f64, N, N> {
    let mut q = SMatrix::zeros();
    for i in BRANCHES..N {
        // Noise fed into a decaying branch: bounded by tau/2 however long the step.
        let half_tau_s = 0.5 * model.branch_tau_s(i - BRANCHES, place);
        let effective_s = half_tau_s * -libm::expm1(-dt_s / half_tau_s);
        q[(i, i)] = square(config.branch_noise_v_per_sqrt_s) * effective_s;
    }
    q[(LOG_RESISTANCE, LOG_RESISTANCE)] = square(config.log_resistance_noise_per_sqrt_s) * dt_s.min(MAX_WALK_S);
    q
}

/// A voltage reading with what is needed to predict it.
pub(super) struct Reading {
    pub(super) voltage_v: f64,
    pub(super) current_a: f64,
    pub(super) load_a: f64,
    pub(super) row: Row,
    pub(super) information_s: f64,
}

impl Reading {
    /// The noise this reading carries for a cell that is at `x`.
    pub(super) fn noise<const N: usize>(&self, x: &Gaussian<N>, model: &CellModel, config: &EstimatorConfig) -> Noise {
        let place = model.place_in(&self.row, x.mean[0]);
        let slope_v = model.ocv_slope_v(&place);
        let ratio = libm::exp(x.mean[LOG_RESISTANCE]);
        let drop_v = (BRANCHES..N).fold(model.r0_ohm(&place) * ratio * self.current_a, |sum, i| sum + x.mean[i]);
        let load_v = model.settled_ohm(&place) * ratio * self.load_a;
        let base_v_sqrt_s = model
            .voltage_error_v(&place)
            .map_or(config.model_error_v_sqrt_s, |error_v| error_v * ERROR_WINDOW_S.sqrt());
        let model_variance = square(base_v_sqrt_s)
            + square(config.drop_error_sqrt_s * drop_v)
            + square(config.load_error_sqrt_s * load_v);
        let sensor_variance = square(config.voltage_noise_v);
        Noise {
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
