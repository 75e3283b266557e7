//! Computes the errors of the SOC, and the coverage of its interval.

use serde::Serialize;

use crate::OF_95;

/// Largest error of a converged estimate (percentage points).
pub const CONVERGED_POINTS: f64 = 2.0;
/// Time for which the error must stay within [`CONVERGED_POINTS`] (s). A wrong estimate that only crosses the truth has
/// not converged.
pub const CONVERGED_HOLD_S: f64 = 600.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SocSample {
    pub(super) time_s: f64,
    pub(super) truth: f64,
    pub(super) soc: f64,
    pub(super) soc_std: f64,
    /// (Innovation / standard deviation) squared; NaN = no innovation.
    pub(super) nis: f64,
}

impl SocSample {
    pub(super) fn error_points(&self) -> f64 {
        100.0 * (self.soc - self.truth)
    }

    pub(super) fn half_width_points(&self) -> f64 {
        100.0 * OF_95 * self.soc_std
    }
}

/// Errors of a run's SOC. Statistics cover the samples after settling and are NaN (JSON: null) without samples. The
/// first error and the convergence also use earlier samples.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SocScore {
    /// Number of samples in the statistics.
    pub samples: usize,
    /// Number of rows left out because they have no truth or no estimate.
    pub left_out_rows: usize,
    /// Error of the first estimate (points).
    pub first_error_points: f64,
    /// Root of the mean squared error (points).
    pub rmse_points: f64,
    /// Mean error (estimate - truth) (points).
    pub mean_error_points: f64,
    /// Mean |error| (points).
    pub mean_abs_error_points: f64,
    /// Largest |error| (points).
    pub max_abs_error_points: f64,
    /// Time after the start (s) from which |error| stayed within 2 points for 10 min; `None` = never.
    pub converge_s: Option<f64>,
    /// Share of samples whose 95 % interval contains the truth, fraction.
    pub coverage: f64,
    /// Mean half-width of the interval (points).
    pub mean_half_width_points: f64,
    /// Mean of (innovation / standard deviation) squared. It is at most about 1 if the filter's statistics are right.
    /// It is far below 1 at high sample rates, because the filter counts information per second.
    pub mean_normalised_innovation_squared: f64,
}

pub(super) fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0_u64), |(sum, count), value| (sum + value, count + 1));
    sum / count as f64
}

pub(super) fn largest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(f64::NAN, f64::max)
}

/// Scores a run whose samples are in order of time.
pub(super) fn score(samples: &[SocSample], settle_s: f64, left_out_rows: usize) -> SocScore {
    let settled = &samples[samples.partition_point(|sample| sample.time_s < settle_s)..];
    let errors = || settled.iter().map(SocSample::error_points);
    let held = |sample: &SocSample| f64::from(sample.error_points().abs() <= sample.half_width_points());
    SocScore {
        samples: settled.len(),
        left_out_rows,
        first_error_points: samples.first().map_or(f64::NAN, SocSample::error_points),
        rmse_points: mean(errors().map(|e| e * e)).sqrt(),
        mean_error_points: mean(errors()),
        mean_abs_error_points: mean(errors().map(f64::abs)),
        max_abs_error_points: largest(errors().map(f64::abs)),
        converge_s: converged_at(samples),
        coverage: mean(settled.iter().map(held)),
        mean_half_width_points: mean(settled.iter().map(SocSample::half_width_points)),
        mean_normalised_innovation_squared: mean(settled.iter().map(|s| s.nis).filter(|nis| nis.is_finite())),
    }
}

/// Returns the start of the first period of at least [`CONVERGED_HOLD_S`] with an error within [`CONVERGED_POINTS`].
fn converged_at(samples: &[SocSample]) -> Option<f64> {
    let near = |sample: &SocSample| sample.error_points().abs() <= CONVERGED_POINTS;
    let stretches = samples.chunk_by(|a, b| near(a) == near(b)).filter(|stretch| near(&stretch[0]));
    let ends = stretches.filter_map(|stretch| Some((stretch.first()?.time_s, stretch.last()?.time_s)));
    ends.into_iter().find(|(begin, end)| end - begin >= CONVERGED_HOLD_S).map(|(begin, _)| begin)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates samples every 10 s with these errors (points) and a standard deviation of 1 point.
    fn samples(errors: &[f64]) -> Vec<SocSample> {
        let of = |(index, error): (usize, &f64)| SocSample {
            time_s: 10.0 * index as f64,
            truth: 0.5,
            soc: 0.5 + error / 100.0,
            soc_std: 0.01,
            nis: if index % 2 == 0 { 2.0 } else { f64::NAN },
        };
        errors.iter().enumerate().map(of).collect()
    }

    fn near(a: f64, b: f64) -> bool {
        (a - b).abs() < 1e-9
    }

    #[test]
    fn statistics_cover_samples_after_settling() {
        let score = score(&samples(&[-20.0, 9.0, 3.0, -1.0, -1.0, 1.0]), 20.0, 7);
        assert_eq!((score.samples, score.left_out_rows), (4, 7));
        assert!(near(score.first_error_points, -20.0));
        assert!(near(score.rmse_points, 3.0_f64.sqrt()), "{}", score.rmse_points); // (9 + 1 + 1 + 1) / 4
        assert!(near(score.mean_error_points, 0.5) && near(score.mean_abs_error_points, 1.5));
        assert!(near(score.max_abs_error_points, 3.0));
        assert!(near(score.coverage, 0.75) && near(score.mean_half_width_points, 1.96));
        assert!(near(score.mean_normalised_innovation_squared, 2.0));
    }

    #[test]
    fn converged_needs_a_held_small_error() {
        let mut errors = vec![-20.0; 5];
        errors.extend([1.0; 10]); // within the limit for only 90 s
        errors.extend([5.0; 5]);
        errors.extend([1.9; 61]); // 600 s
        assert_eq!(score(&samples(&errors), 0.0, 0).converge_s, Some(200.0));
        errors.pop();
        assert_eq!(score(&samples(&errors), 0.0, 0).converge_s, None);
    }

    #[test]
    fn score_without_samples_has_no_numbers() {
        let score = score(&samples(&[1.0]), 600.0, 0);
        assert_eq!(score.samples, 0);
        assert!(score.rmse_points.is_nan() && score.coverage.is_nan() && score.max_abs_error_points.is_nan());
        let json = serde_json::to_value(&score).expect("JSON");
        assert!(json["rmse_points"].is_null() && near(json["first_error_points"].as_f64().expect("number"), 1.0));
    }
}
