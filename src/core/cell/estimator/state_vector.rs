//! Layout of the estimator's state vector, and small helper functions.
//!
//! In and out: means and variances in the units of the states. Inputs are not checked.

use crate::filter::ScalarGaussian;
pub(super) use crate::filter::square;

/// Variance of a known value: smaller than any noise, larger than rounding errors.
pub(super) const KNOWN_VARIANCE: f64 = 1e-12;

/// Variance of an unknown SOC: uniform over 0 to 1.
pub(super) const UNKNOWN_SOC_VARIANCE: f64 = 1.0 / 12.0;

/// Index of ln rho in the state.
pub(super) const LOG_RESISTANCE: usize = 1;
/// Index of the capacity in the state.
pub(super) const CAPACITY: usize = 2;
/// Index of the first branch voltage in the state.
pub(super) const BRANCHES: usize = 3;

/// The SOC variance increased by `by`, but not above the variance of an unknown SOC.
#[inline]
pub(super) fn widened(variance: f64, by: f64) -> f64 {
    variance.max((variance + by).min(UNKNOWN_SOC_VARIANCE))
}

/// Limits a state of charge to 0 to 1. A value outside this range is an error of the model.
#[inline]
pub(super) fn within_bounds(soc: ScalarGaussian) -> ScalarGaussian {
    ScalarGaussian { mean: soc.mean.clamp(0.0, 1.0), ..soc }
}

/// Number of constant errors whose effect the filter follows.
pub(super) const CONSTANT_ERRORS: usize = 7;
/// Number of constant errors that the gain considers. They are the first ones in the order of the indices.
pub(super) const CONSIDERED: usize = 4;

/// Index of the voltage sensor's offset (measured minus true) among the constant errors.
pub(super) const VOLTAGE_OFFSET: usize = 0;
/// Index of the current sensor's offset (measured minus true).
pub(super) const CURRENT_OFFSET: usize = 1;
/// Index of the current sensor's gain error (measured over true, minus 1).
pub(super) const CURRENT_GAIN: usize = 2;
/// Index of the error (true minus estimated) of the slowest branch's ratio ([`super::slow_branch`]).
pub(super) const SLOW_BRANCH: usize = 3;
/// Index of the error of the open-circuit curve's capacity (capacity of the curve minus true capacity).
pub(super) const CURVE_CAPACITY: usize = 4;
/// Index of the error of the first mix of losses (see `crate::cell::aged_ocv`); the second mix follows.
pub(super) const CURVE_MIXES: usize = 5;
