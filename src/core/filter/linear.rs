//! Scalar linear Kalman filter with A = C = 1: a random walk that is measured directly.
//!
//! State x (any unit), variance P. Predict: P += Q. Update with the measurement z and its variance R: K = P / (P + R),
//! x += K (z - x), P = (1 - K) P. Source: the capacity filter in section 3.3.4 of the paper that packwatch follows
//! (docs/src/theory.md). There, x is the capacity in Ah and each charge/discharge transition is a step. NaN in the
//! input gives NaN in the result.

use serde::{Deserialize, Serialize};

use crate::quantity::catalogue::Estimate;

/// A scalar estimate and its variance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ScalarGaussian {
    pub mean: f64,
    /// Variance, not negative.
    pub variance: f64,
}

/// A scalar measurement and its variance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Measurement {
    pub value: f64,
    /// Variance, positive.
    pub variance: f64,
}

impl From<ScalarGaussian> for Estimate {
    fn from(gaussian: ScalarGaussian) -> Self {
        Self { mean: gaussian.mean, std: Some(gaussian.std()) }
    }
}

impl ScalarGaussian {
    /// Creates an estimate from a mean and its standard deviation.
    pub fn from_std(mean: f64, std: f64) -> Self {
        Self { mean, variance: std * std }
    }

    /// Standard deviation.
    pub fn std(&self) -> f64 {
        self.variance.sqrt()
    }

    /// One step of the random walk.
    pub fn predict(&mut self, process_variance: f64) {
        self.variance += process_variance;
    }

    /// Updates the estimate with a measurement.
    pub fn update(&mut self, z: Measurement) {
        let gain = self.variance / (self.variance + z.variance);
        self.mean += gain * (z.value - self.mean);
        self.variance *= 1.0 - gain;
    }

    /// The measurement (value z, variance R) that would change this estimate (x0, P0) to `after` (x1, P1): 1/R = 1/P1 -
    /// 1/P0, z = R (x1/P1 - x0/P0).
    ///
    /// The measurement contains only the information gained since `self`, so the assumptions in `self` do not count as
    /// evidence. `None` if the variance has not fallen (P1 >= P0).
    pub fn information_until(&self, after: &Self) -> Option<Measurement> {
        let information = 1.0 / after.variance - 1.0 / self.variance;
        // Less than a millionth of the information in `self` is a rounding error.
        if !information.is_finite() || information <= 1e-6 / self.variance {
            return None;
        }
        let value = (after.mean / after.variance - self.mean / self.variance) / information;
        Some(Measurement { value, variance: 1.0 / information })
    }
}

/// Updates N states `x` and their covariance `p` with an innovation. `ph` is the covariance of the states with the
/// measurement. The gain is `ph / innovation_variance`.
pub fn update_states<const N: usize>(
    x: &mut [f64; N],
    p: &mut [[f64; N]; N],
    ph: &[f64; N],
    innovation: f64,
    innovation_variance: f64,
) {
    for i in 0..N {
        x[i] += ph[i] / innovation_variance * innovation;
        for (j, ph_j) in ph.iter().enumerate() {
            p[i][j] -= ph[i] * ph_j / innovation_variance;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn information_recovers_the_measurement() {
        let before = ScalarGaussian::from_std(2.0, 0.2);
        let taken = Measurement { value: 1.7, variance: 0.01 };
        let mut after = before;
        after.update(taken);
        let found = before.information_until(&after).expect("the variance fell");
        assert!((found.value - taken.value).abs() < 1e-12);
        assert!((found.variance - taken.variance).abs() < 1e-12);
    }

    #[test]
    fn no_information_is_no_measurement() {
        let before = ScalarGaussian::from_std(2.0, 0.2);
        assert_eq!(before.information_until(&before), None);
        let wider = ScalarGaussian::from_std(2.1, 0.3);
        assert_eq!(before.information_until(&wider), None);
    }

    #[test]
    fn steady_state_variance_is_the_closed_form() {
        let (q, r) = (1.0, 0.1);
        let mut estimate = ScalarGaussian { mean: 30.0, variance: 1.0 };
        for _ in 0..100 {
            estimate.predict(q);
            estimate.update(Measurement { value: 29.0, variance: r });
        }
        // Positive root of P^2 + Q P - Q R = 0 (variance after the update).
        let expected = (-q + (q * q + 4.0 * q * r).sqrt()) / 2.0;
        assert!((estimate.variance - expected).abs() < 1e-12);
        assert!((estimate.mean - 29.0).abs() < 1e-9);
    }
}
