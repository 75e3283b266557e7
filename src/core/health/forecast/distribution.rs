//! Computes the distribution of the use until a cell's level (its capacity without recovery) has fallen by a given
//! loss.
//!
//! In: mean and covariance of the remaining loss (fraction of the reference capacity) and of the rate (loss per unit of
//! use). Out: probabilities and quantiles of the use. The logarithms of extreme uses and rates are limited to
//! [`LOG_RANGE`].
//!
//! Given the loss L and the initial rate r, the use is T = integral over l from 0 to L of exp(-g(l) - W(l)) / r. g(l)
//! is the expected growth of the rate's logarithm in the [`knee`]. W(l) is the random walk of this logarithm, a
//! Brownian motion with variance v(l). With m = exp(v / 2 - g):
//! * E T = (1 / r) integral of m(l);
//! * E T^2 = (2 / r^2) integral over l of m(l) (integral over s from 0 to l of m(s) e^v(s)).
//!
//! Both integrals use the midpoint rule. T is approximated by a lognormal with these moments. The rate r is
//! approximated by a lognormal with the mean and variance of the rate's normal distribution, truncated to positive
//! values. The random walk of the rate with use adds variance.
//!
//! The loss L is normal. If L <= 0, the level has already fallen that far: T = 0, with the probability of L <= 0. The
//! range L > 0 is divided into slices of equal width. Each slice is a lognormal for the loss at the slice's centre,
//! with the rate conditional on this loss. The width w of the slice adds a variance of (w / L)^2 / 12.

use super::{KNEE_DRIFT, RATE_WALK_USE, knee, walk_variance};
use crate::filter::{bell, bisect, normal_cdf};

/// Number of slices of the loss.
const SLICES: usize = 10;
/// Half-width of the range that is divided into slices, in standard deviations of the loss. The last slice also
/// contains the upper tail.
const SLICED: f64 = 3.5;

/// Number of bisection steps: they narrow a range of about 20 e-folds to 1 part in 10^6.
pub(super) const HALVINGS: u32 = 24;

/// Allowed range of the logarithms of use and rate.
const LOG_RANGE: (f64, f64) = (-20.0, 40.0);

/// Number of steps of an integral over the loss.
const STEPS: usize = 16;

/// A slice of the loss: probability of the slice, and mean and standard deviation of the logarithm of the use.
type Slice = (f64, (f64, f64));

/// The distribution of the use until the crossing.
#[derive(Debug, Clone)]
pub(super) struct Crossing {
    /// Probability that the level has already passed the threshold.
    passed: f64,
    slices: [Slice; SLICES],
}

impl Crossing {
    /// `mean`: [remaining loss, rate]. `covariance`: [variance of the loss, covariance of loss and rate, variance of
    /// the rate]. `lost` and `used`: loss and use until now.
    pub(super) fn new(mean: [f64; 2], covariance: [f64; 3], lost: f64, used: f64) -> Self {
        let [loss_variance, both, rate_variance] = covariance;
        // The minimum avoids a division by 0 if the loss is known exactly; all slices are then equal.
        let loss_std = loss_variance.max(1e-24).sqrt();
        let by_loss = both / (loss_std * loss_std);
        let left = (rate_variance - by_loss * both).max(0.0);
        // Deviation from the mean, in standard deviations, at which the loss is 0.
        let zero = -mean[0] / loss_std;
        let from = zero.max(-SLICED);
        let width = (SLICED.max(from + 1.0) - from) / SLICES as f64;
        let mut before = normal_cdf(zero);
        let passed = before;
        let slices = std::array::from_fn(|index| {
            let upper = from + (index + 1) as f64 * width;
            let until = if index + 1 == SLICES { 1.0 } else { normal_cdf(upper) };
            let probability = (until - before).max(0.0);
            before = until;
            let deviation = upper - 0.5 * width;
            let loss = mean[0] + loss_std * deviation;
            let (log_rate, log_rate_variance) = positive(mean[1] + by_loss * loss_std * deviation, left);
            let (log_use, walked) = use_of_loss(lost, loss);
            let log_mean = log_use - log_rate;
            // The rate also walks with use. The crossing depends on the rate averaged over the use, so about half of
            // the walk's variance counts.
            let ahead = libm::log1p(libm::exp(log_mean.min(LOG_RANGE.1)) / used.max(f64::MIN_POSITIVE));
            let own_width = loss_std * width / loss;
            let variance =
                log_rate_variance + walked + 0.5 * RATE_WALK_USE * RATE_WALK_USE * ahead + own_width * own_width / 12.0;
            (probability, (log_mean, variance.sqrt()))
        });
        Self { passed, slices }
    }

    /// Probability that the level passes the threshold within `ahead` units of use.
    pub(super) fn probability(&self, ahead: f64) -> f64 {
        self.probability_of_log(libm::log(ahead))
    }

    fn probability_of_log(&self, log_use: f64) -> f64 {
        let of_slice = |(weight, (mean, std)): &Slice| weight * normal_cdf((log_use - mean) / std);
        self.passed + self.slices.iter().map(of_slice).sum::<f64>()
    }

    /// Use within which the level passes the threshold with the probability `probability`.
    pub(super) fn quantile(&self, probability: f64) -> f64 {
        if self.passed >= probability {
            return 0.0;
        }
        let likely = || self.slices.iter().filter(|(weight, _)| *weight > 0.0);
        // The search range extends six standard deviations beyond the mean of each slice.
        let ends = |sign: f64| likely().map(move |(_, (mean, std))| mean + sign * 6.0 * std);
        let least = ends(-1.0).fold(LOG_RANGE.1, f64::min).max(LOG_RANGE.0);
        let most = ends(1.0).fold(least, f64::max).min(LOG_RANGE.1);
        libm::exp(bisect((least, most), HALVINGS, |log_use| self.probability_of_log(log_use) < probability).1)
    }
}

/// Mean and variance of the logarithm of a lognormal. The lognormal has the same moments as the normal distribution
/// (`mean`, `variance`) truncated to values above 0.
fn positive(mean: f64, variance: f64) -> (f64, f64) {
    let std = variance.max(1e-24 * mean * mean).sqrt();
    if std == 0.0 {
        return (LOG_RANGE.0, 0.0);
    }
    // If the mean is below -8 standard deviations, the ratio of density to tail probability cannot be computed in f64.
    // The rate is then close to 0 anyway.
    let place = (mean / std).max(-8.0);
    let density = bell(place) / (2.0 * std::f64::consts::PI).sqrt();
    let hazard = density / normal_cdf(place);
    let first = std * (place + hazard);
    let second = (std * std * (1.0 - hazard * (hazard + place))).max(1e-24 * first * first);
    let log_variance = libm::log1p(second / (first * first));
    (libm::log(first) - 0.5 * log_variance, log_variance)
}

/// Mean and variance of the logarithm of the use until a further loss of `loss`, for an initial rate of 1.
fn use_of_loss(lost: f64, loss: f64) -> (f64, f64) {
    let step = loss / STEPS as f64;
    // Integrals over the loss: of m, of m e^v, and the second moment.
    let (mut mean, mut inner, mut second) = (0.0, 0.0, 0.0);
    for index in 0..STEPS {
        let at = lost + (index as f64 + 0.5) * step;
        let variance = walk_variance(lost, at);
        let m = libm::exp(0.5 * variance - KNEE_DRIFT * (knee(at) - knee(lost)));
        let own = m * libm::exp(variance);
        second += m * (2.0 * inner + own);
        mean += m;
        inner += own;
    }
    let log_variance = libm::log(second / (mean * mean)).max(0.0);
    (libm::log(mean * step) - 0.5 * log_variance, log_variance)
}

#[cfg(test)]
mod tests {
    use super::super::KNEE;
    use super::*;

    #[test]
    fn moments_of_use_agree_with_sampled_walk() {
        // A generator with a fixed seed makes the test reproducible; antithetic pairs make the first moment nearly
        // exact. The loss starts before the knee and ends after it.
        let (lost, loss, steps, paths) = (0.05, 0.3, 200, 4000);
        let mut seed = 1_u64;
        let mut uniform = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((seed >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
        };
        let mut sum = [0.0; 2];
        for _ in 0..paths {
            let (mut walk, mut uses) = (0.0, [0.0; 2]);
            for step in 0..steps {
                let [from, to] = [step, step + 1].map(|step| lost + loss * f64::from(step) / f64::from(steps));
                let growth = KNEE_DRIFT * (knee(0.5 * (from + to)) - knee(lost));
                let normal = (-2.0 * uniform().ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos();
                let before = walk;
                walk += walk_variance(from, to).sqrt() * normal;
                for (total, sign) in uses.iter_mut().zip([-1.0, 1.0]) {
                    *total +=
                        loss / f64::from(steps) * 0.5 * ((sign * before - growth).exp() + (sign * walk - growth).exp());
                }
            }
            for total in uses {
                sum[0] += total / f64::from(2 * paths);
                sum[1] += total * total / f64::from(2 * paths);
            }
        }
        let (log_mean, log_variance) = use_of_loss(lost, loss);
        let (mean, second) = ((log_mean + 0.5 * log_variance).exp(), (2.0 * log_mean + 2.0 * log_variance).exp());
        assert!((sum[0] / mean - 1.0).abs() < 0.01, "{} {mean}", sum[0]);
        assert!(((sum[1] - sum[0] * sum[0]) / (second - mean * mean) - 1.0).abs() < 0.1, "{} {second}", sum[1]);
    }

    #[test]
    fn small_loss_uses_the_current_rate() {
        let (log_mean, log_variance) = use_of_loss(0.3, 1e-9);
        assert!(
            (log_mean - 1e-9_f64.ln()).abs() < 1e-6 && (0.0..1e-6).contains(&log_variance),
            "{log_mean} {log_variance}"
        );
    }

    #[test]
    fn loss_in_knee_takes_less_use() {
        let (through, behind) = (use_of_loss(KNEE.0, 0.1).0, use_of_loss(KNEE.1, 0.1).0);
        assert!((through - behind) < -0.2, "{through} {behind}");
    }

    #[test]
    fn certain_positive_rate_keeps_its_moments() {
        let (log_mean, log_variance) = positive(2.0, 0.01);
        assert!(((log_mean + 0.5 * log_variance).exp() - 2.0).abs() < 1e-9);
        let (log_mean, _) = positive(-1.0, 1.0);
        assert!(log_mean.is_finite());
    }

    #[test]
    fn quantile_is_inverse_of_probability() {
        let crossing = Crossing::new([0.1, 0.002], [1e-4, -1e-7, 1e-7], 0.1, 50.0);
        for probability in [0.05, 0.5, 0.95] {
            assert!((crossing.probability(crossing.quantile(probability)) - probability).abs() < 1e-6);
        }
        assert_eq!(Crossing::new([-0.1, 0.002], [1e-6, 0.0, 1e-7], 0.3, 50.0).quantile(0.95), 0.0);
    }
}
