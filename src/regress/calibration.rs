//! How wide an interval has to be to hold a stated part of the measurements.
//!
//! A Gaussian interval holds what it says only if the residuals are Gaussian and equally wide everywhere. The factor
//! here is taken from training rows alone: each of a seeded choice is predicted without itself, and the factor is the
//! quantile of |residual| / standard deviation (with the correction of split conformal prediction for few rows).

/// Part of the measurements that an interval is to hold.
pub(super) const LEVEL: f64 = 0.95;
/// Half width of the Gaussian interval of that level, in standard deviations.
pub(super) const GAUSSIAN: f64 = 1.959_963_984_540_054;
/// Rows that are left out, one at a time; the factor's own standard error is then about 1 %.
pub(super) const ROWS: usize = 4000;

/// Half width of the interval in standard deviations, from residuals and variances of rows predicted without themselves.
pub(super) fn factor(left_out: &[(f64, f64)]) -> f64 {
    let mut ratios: Vec<f64> = left_out.iter().map(|(residual, variance)| residual.abs() / variance.sqrt()).collect();
    ratios.retain(|ratio| ratio.is_finite());
    ratios.sort_by(f64::total_cmp);
    let rank = ((ratios.len() + 1) as f64 * LEVEL).ceil() as usize;
    // Too few rows to say: the Gaussian one.
    if rank == 0 || rank > ratios.len() { GAUSSIAN } else { ratios[rank - 1] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factor_holds_the_stated_part() {
        let rows: Vec<(f64, f64)> = (1..=1000).map(|k| (f64::from(k) / 100.0, 4.0)).collect();
        assert!((factor(&rows) - 951.0 / 200.0).abs() < 1e-12, "{}", factor(&rows));
        assert_eq!(factor(&rows[..10]), GAUSSIAN);
        assert_eq!(factor(&[]), GAUSSIAN);
    }
}
