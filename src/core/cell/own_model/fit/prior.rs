//! Computes the prior of a fit's parameters from the cell's label, as an information matrix.

use nalgebra::DMatrix;

use super::basis::{BEGINNINGS, BY_TEMPERATURE, COLD_SAG, FACTORS, LOG_CAPACITY, OFFSET};
use crate::cell::chemistry::{FACTOR_SOC, LabelPrior, RESISTANCES, curve};
use crate::cell::own_model::{FACTOR_NODES, SOC_NODES};
use crate::filter::bell;

/// All resistances of a cell share a part of ln(resistance). This is the standard deviation of this part between cells.
/// This constant and the next three come from the five cells that also gave the usual resistances of the label's model.
const COMMON_LOG_STD: f64 = 0.35;
/// Standard deviation of ln(resistance) of each resistance, in addition to the shared part.
const PART_LOG_STD: [f64; RESISTANCES] = [0.3, 0.4, 0.4, 0.5];
/// Standard deviation with which each ln(resistance) varies over the SOC.
const SHAPE_LOG_STD: f64 = 0.15;
/// Additional standard deviation at the first three SOC nodes, shared by all resistances. Near empty, the open-circuit
/// curve is steep, so diffusion appears as resistance.
const LOW_LOG_STD: [f64; 3] = [0.7, 0.6, 0.5];

/// Information matrix of the parameters' prior. The means of the prior are the expected values. Returns `None` if a
/// covariance is not positive definite.
pub(super) fn information(of: &LabelPrior, size: usize) -> Option<DMatrix<f64>> {
    let log_ratio = of.log_resistance_ratio;
    let mut prior = DMatrix::zeros(size, size);
    let curve = curve::information(&of.curve.covariance)?;
    prior.view_mut((0, 0), (SOC_NODES, SOC_NODES)).copy_from(&curve);
    let count = RESISTANCES * FACTOR_NODES;
    let covariance = DMatrix::from_fn(count, count, factor_covariance) * (log_ratio * log_ratio);
    prior.view_mut((FACTORS, FACTORS), (count, count)).copy_from(&covariance.cholesky()?.inverse());
    let mut near = |i: usize, std: f64| prior[(i, i)] = 1.0 / (std * std);
    (BY_TEMPERATURE..COLD_SAG).for_each(|i| near(i, 0.25 * log_ratio));
    near(COLD_SAG, of.cold_sag_std_v);
    near(LOG_CAPACITY, of.capacity_std);
    // Standard deviation of the current sensor's offset: C/700.
    near(OFFSET, of.label.rated_ah / 700.0);
    // SOC at the start of each stretch (a period with a continuously measured current). The prior is wide, because the
    // voltages determine this SOC.
    (BEGINNINGS..size).for_each(|i| near(i, 0.5));
    Some(prior)
}

/// Covariance of the two parameters in [`FACTORS`] with the indices `a` and `b`.
fn factor_covariance(a: usize, b: usize) -> f64 {
    let ((i, n), (j, m)) = ((a / FACTOR_NODES, a % FACTOR_NODES), (b / FACTOR_NODES, b % FACTOR_NODES));
    let near = |width: f64| bell((FACTOR_SOC[n] - FACTOR_SOC[m]) / width);
    let low = |n: usize| LOW_LOG_STD.get(n).copied().unwrap_or(0.0);
    let common = COMMON_LOG_STD * COMMON_LOG_STD + low(n) * low(m) * near(0.1);
    let part = PART_LOG_STD[i] * PART_LOG_STD[i] + SHAPE_LOG_STD * SHAPE_LOG_STD * near(0.3);
    common + if i == j { part } else { 0.0 } + if a == b { 1e-4 } else { 0.0 }
}

pub(super) fn log_determinant(matrix: &DMatrix<f64>) -> Option<f64> {
    let lower = matrix.clone().cholesky()?.unpack();
    Some((0..lower.nrows()).map(|i| 2.0 * libm::log(lower[(i, i)])).sum())
}
