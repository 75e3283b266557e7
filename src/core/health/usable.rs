//! Usable capacity: charge that a full cell delivers at a given current and temperature until its voltage under load
//! falls to a cut-off voltage. The usable capacity depends on the cell's capacity and resistance.
//!
//! In: model, load, SOC when full, capacity (Ah) and resistance ratios. Out: Ah, with variance. If the voltage is below
//! the cut-off from the start, the usable capacity is 0.
//!
//! The discharge is simulated with the circuit's equations at constant current until the voltage falls to the cut-off.
//! The simulation starts from the SOC after a full charge, with relaxed RC branches. The variance is propagated to
//! first order from three quantities: the capacity, ln rho (rho is the cell's resistance relative to the model), and
//! the slow ratio (additional resistance ratio of the slowest branch). Capacity and ln rho are correlated.

use super::UsableConfig;
use crate::cell::circuit::{BranchAt, aged_terminal_v, soc_after};
use crate::cell::{CellEstimator, CellModel, Discretisation, EstimatorConfig, MAX_BRANCHES};
use crate::filter::ScalarGaussian;

/// Maximum number of steps of a simulated discharge.
const MAX_STEPS: u32 = 2000;

/// Step of the forward differences in ln rho, ln capacity and slow ratio.
const LOG_STEP: f64 = 0.01;

/// Charge (Ah) that a cell of capacity `capacity_ah` delivers from `full_soc` until its voltage falls to the cut-off.
/// The two ratios are the resistance ratio of the cell and the additional ratio of its slowest branch.
pub fn usable_ah(
    model: &CellModel,
    config: &UsableConfig,
    full_soc: f64,
    capacity_ah: f64,
    (resistance_ratio, slow_ratio): (f64, f64),
) -> f64 {
    let step_ah = capacity_ah / 400.0;
    let step_s = 3600.0 * step_ah / config.current_a;
    let mut branch_v = [0.0; MAX_BRANCHES];
    let mut soc = full_soc;
    let temperature = model.temperature_position(config.temperature_c);
    let voltage = |soc: f64, branch_v: &[f64; MAX_BRANCHES]| {
        let state = (soc, resistance_ratio, capacity_ah);
        let slowest = model.branches.len() - 1;
        let branches_v = branch_v[..slowest].iter().fold(slow_ratio * branch_v[slowest], |sum, v| sum + v);
        aged_terminal_v(model, state, &temperature, branches_v, config.current_a)
    };
    let mut before_v = voltage(soc, &branch_v);
    if before_v <= config.cutoff_v {
        return 0.0;
    }
    for k in 0..MAX_STEPS {
        let next = soc_after(soc, 3600.0 * step_ah, capacity_ah);
        let position = model.grid_position_at(&temperature, 0.5 * (soc + next));
        for (i, v) in branch_v.iter_mut().enumerate().take(model.branches.len()) {
            let branch = BranchAt::new(model, i, &position, resistance_ratio);
            *v = branch.voltage_after(Discretisation::Exact, *v, config.current_a, step_s);
        }
        let after_v = voltage(next, &branch_v);
        if next <= 0.0 {
            // The cell is empty before the voltage reaches the cut-off, so the cell delivers all its charge.
            return capacity_ah * full_soc;
        }
        if after_v <= config.cutoff_v {
            let part = (before_v - config.cutoff_v) / (before_v - after_v);
            return step_ah * (f64::from(k) + part);
        }
        (soc, before_v) = (next, after_v);
    }
    step_ah * f64::from(MAX_STEPS)
}

/// Usable capacity (Ah) with its variance. `capacity` is the published estimate, whose variance may be larger than the
/// capacity variance in the cell's filter.
pub fn usable_capacity(
    model: &CellModel,
    config: &UsableConfig,
    (cell, estimator): (&CellEstimator, &EstimatorConfig),
    capacity: ScalarGaussian,
    full_soc: f64,
) -> ScalarGaussian {
    let (log_r, slow) = (cell.log_resistance(), cell.slow_ratio(estimator));
    let at = |log_capacity: f64, log_ratio: f64, more_slow: f64| {
        let capacity_ah = capacity.mean * libm::exp(log_capacity);
        usable_ah(model, config, full_soc, capacity_ah, (libm::exp(log_r.mean + log_ratio), slow.mean + more_slow))
    };
    let mean = at(0.0, 0.0, 0.0);
    let by_capacity = (at(LOG_STEP, 0.0, 0.0) - mean) / (LOG_STEP * capacity.mean);
    let by_log_r = (at(0.0, LOG_STEP, 0.0) - mean) / LOG_STEP;
    let by_slow = (at(0.0, 0.0, LOG_STEP) - mean) / LOG_STEP;
    let variance = by_capacity * by_capacity * capacity.variance
        + by_log_r * by_log_r * log_r.variance
        + by_slow * by_slow * slow.variance
        + 2.0 * by_capacity * by_log_r * cell.capacity_resistance_covariance();
    ScalarGaussian { mean, variance: variance.max(0.0) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;

    const CONFIG: UsableConfig =
        UsableConfig { current_a: 0.2, temperature_c: 0.0, cutoff_v: 3.3, taper_current_a: 0.05 };

    #[test]
    fn usable_capacity_without_resistance_follows_open_circuit_curve() {
        // OCV = 3.0 + 1.2 s up to s = 0.5, so 3.3 V at s = 0.25: the cell delivers 75 % of 2 Ah.
        let usable = usable_ah(&small_model(), &CONFIG, 1.0, 2.0, (1e-12, 1.0));
        assert!((usable - 1.5).abs() < 1e-6, "{usable}");
        assert!((usable_ah(&small_model(), &CONFIG, 0.9, 2.0, (1e-12, 1.0)) - 1.3).abs() < 1e-6);
    }

    #[test]
    fn usable_capacity_is_limited_by_charge() {
        let config = UsableConfig { cutoff_v: 1.0, ..CONFIG };
        assert_eq!(usable_ah(&small_model(), &config, 0.9, 2.0, (1.0, 1.0)), 0.9 * 2.0);
    }

    #[test]
    fn resistance_lowers_the_usable_capacity() {
        // At 0.2 A, every branch (time constant 20 to 40 s) settles. The cut-off is reached at 3.0 + 1.2 s - 0.2 rho
        // (0.12 - 0.08 s) = 3.3.
        for ratio in [1.0, 3.0] {
            let end = (0.3 + 0.2 * ratio * 0.12) / (1.2 + 0.2 * ratio * 0.08);
            let usable = usable_ah(&small_model(), &CONFIG, 1.0, 2.0, (ratio, 1.0));
            assert!((usable - 2.0 * (1.0 - end)).abs() < 1e-3, "ratio {ratio}: {usable}");
        }
        assert_eq!(usable_ah(&small_model(), &CONFIG, 1.0, 2.0, (1000.0, 1.0)), 0.0);
    }
}
