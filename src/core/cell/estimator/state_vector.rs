//! Layout of the estimator's state vector, and helper functions for its values. Inputs are not checked.

use crate::filter::ScalarGaussian;
pub(super) use crate::filter::square;

/// Variance of a known value: smaller than any noise, larger than rounding errors.
pub(super) const KNOWN_VARIANCE: f64 = 1e-12;

/// Variance of an unknown SOC: uniform over 0 to 1.
pub(super) const UNKNOWN_SOC_VARIANCE: f64 = 1.0 / 12.0;

/// Index of ln rho. rho is the cell's resistance relative to the model.
pub(super) const LOG_RESISTANCE: usize = 1;
/// Index of the capacity.
pub(super) const CAPACITY: usize = 2;
/// Index of the first branch voltage.
pub(super) const BRANCHES: usize = 3;

/// Returns the SOC variance increased by `by`, but at most the variance of an unknown SOC.
#[inline]
pub(super) fn widened(variance: f64, by: f64) -> f64 {
    variance.max((variance + by).min(UNKNOWN_SOC_VARIANCE))
}

#[inline]
pub(super) fn within_bounds(soc: ScalarGaussian) -> ScalarGaussian {
    ScalarGaussian { mean: soc.mean.clamp(0.0, 1.0), ..soc }
}

/// Number of constant errors (errors that do not change with time) whose effects the filter tracks.
pub(super) const CONSTANT_ERRORS: usize = 7;
/// Number of constant errors that the Kalman gain takes into account (Schmidt 1966): those with the lowest indices.
pub(super) const CONSIDERED: usize = 4;

/// Index of the voltage sensor's offset (measured minus true) among the constant errors.
pub(super) const VOLTAGE_OFFSET: usize = 0;
/// Index of the current sensor's offset (measured minus true).
pub(super) const CURRENT_OFFSET: usize = 1;
/// Index of the current sensor's gain error (measured over true, minus 1).
pub(super) const CURRENT_GAIN: usize = 2;
/// Index of the error (true minus estimated) of the slowest branch's ratio ([`super::slow_branch`]).
pub(super) const SLOW_BRANCH: usize = 3;
/// Index of the error of the capacity for which the aged open-circuit curve is computed (this capacity minus the true
/// capacity).
pub(super) const CURVE_CAPACITY: usize = 4;
/// Index of the error of the first "mix" of the aged curve: the share of active material that one electrode has lost,
/// or the shift of the curve (see `crate::cell::aged_ocv`). The second mix follows.
pub(super) const CURVE_MIXES: usize = 5;
