//! The equations of the equivalent circuit, for the estimator and the simulator.
//!
//! State: SOC (fraction) and one voltage per RC branch (V). I > 0 is discharge.
//!
//! dSOC/dt = -I / (3600 C); dU/dt = -U/(R1 C1) + I/C1; V = OCV(SOC, T) - sum U - I R0.
//!
//! Source: "Battery Predictions for Electronic Prognostics", section 3.3.1. Ageing multiplies R0 and every branch
//! resistance by the same ratio and keeps the time constants. Inputs are not checked: NaN gives NaN.

use super::config::Discretisation;
use super::model::{CellModel, GridPosition, TemperaturePosition};

/// SOC after a discharge of `charge_as` (A s) from a cell of `capacity_ah`.
pub fn soc_after(soc: f64, charge_as: f64, capacity_ah: f64) -> f64 {
    soc - charge_as / (3600.0 * capacity_ah)
}

/// One RC branch of an aged cell at one grid position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BranchAt {
    /// Resistance (ohm).
    pub r_ohm: f64,
    /// Time constant (s).
    pub tau_s: f64,
}

impl BranchAt {
    /// Branch `i` of a cell whose resistances are `resistance_ratio` times those of `model`.
    pub fn new(model: &CellModel, i: usize, position: &GridPosition, resistance_ratio: f64) -> Self {
        Self { r_ohm: model.branch_r_ohm(i, position) * resistance_ratio, tau_s: model.branch_tau_s(i, position) }
    }

    /// The branch's voltage (V) after `dt_s` at a constant `current_a`. In steps longer than the time constant, Euler's
    /// rule would overshoot, so such steps are always exact.
    pub fn voltage_after(&self, rule: Discretisation, branch_v: f64, current_a: f64, dt_s: f64) -> f64 {
        let settled_v = self.r_ohm * current_a;
        match rule {
            Discretisation::Euler if dt_s < self.tau_s => branch_v + (settled_v - branch_v) * dt_s / self.tau_s,
            Discretisation::Exact | Discretisation::Euler => {
                settled_v + (branch_v - settled_v) * libm::exp(-dt_s / self.tau_s)
            }
        }
    }
}

/// Terminal voltage (V) of a cell with the open-circuit curve of a new cell. `branches_v` is the sum of the branch
/// voltages.
pub fn terminal_v(
    model: &CellModel,
    position: &GridPosition,
    resistance_ratio: f64,
    branches_v: f64,
    current_a: f64,
) -> f64 {
    model.ocv_v(position) - branches_v - model.r0_ohm(position) * resistance_ratio * current_a
}

/// Terminal voltage (V) of an aged cell. `state` = (SOC, resistance ratio, capacity in Ah). `branches_v` is the sum of
/// the branch voltages.
pub fn aged_terminal_v(
    model: &CellModel,
    state: (f64, f64, f64),
    temperature: &TemperaturePosition,
    branches_v: f64,
    current_a: f64,
) -> f64 {
    let (soc, resistance_ratio, capacity_ah) = state;
    let position = model.grid_position_at(temperature, soc);
    let ocv_v = model.aged_ocv_v(&position, capacity_ah);
    ocv_v - branches_v - model.r0_ohm(&position) * resistance_ratio * current_a
}

/// Temperature after `dt_s` in the lumped thermal model C dT/dt = losses - (T - ambient)/R. Exact for constant losses
/// (W).
pub fn temperature_after(
    thermal: &super::Thermal,
    temperature_c: f64,
    ambient_c: f64,
    losses_w: f64,
    dt_s: f64,
) -> f64 {
    let settled_c = ambient_c + losses_w * thermal.resistance_k_per_w;
    let tau_s = thermal.heat_capacity_j_per_k * thermal.resistance_k_per_w;
    settled_c + (temperature_c - settled_c) * libm::exp(-dt_s / tau_s)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;

    #[test]
    fn exact_branch_is_independent_of_step_size() {
        let model = small_model();
        let position = model.grid_position(0.5, 0.0);
        let branch = BranchAt::new(&model, 0, &position, 1.5);
        let run = |rule, n: u32| (0..n).fold(0.0, |u, _| branch.voltage_after(rule, u, 2.0, 30.0 / f64::from(n)));
        let closed_form = 2.0 * 0.02 * 1.5 * (1.0 - libm::exp(-30.0 / 20.0));
        assert!((run(Discretisation::Exact, 1) - closed_form).abs() < 1e-15);
        assert!((run(Discretisation::Exact, 300) - closed_form).abs() < 1e-13);
        assert!((run(Discretisation::Euler, 3) - closed_form).abs() > 1e-3);
        assert!((run(Discretisation::Euler, 30_000) - closed_form).abs() < 1e-5);
    }

    #[test]
    fn temperature_settles_at_losses_times_resistance() {
        let thermal = small_model().thermal.expect("has one");
        let t = temperature_after(&thermal, 20.0, 20.0, 1.0, 1e6);
        assert!((t - 28.0).abs() < 1e-9);
    }
}
