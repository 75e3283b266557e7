//! Distribution of the use until a level has fallen by a loss.
//!
//! In: mean and covariance of loss and rate (parts of the reference, per unit of use). Out: probabilities and quantiles of
//! the use. Extreme inputs saturate within [`LOG_RANGE`].
//!
//! Given the loss L and the rate r, the use is T = integral over l from 0 to L of exp(-w W(l)) / r, W a Brownian motion
//! (the rate's logarithm walks with the loss). With k = w^2:
//! E T = (L / r) (e^a - 1) / a with a = k L / 2, and
//! E T^2 = (4 / (k r^2)) (e^a (e^{3a} - 1) / (1.5 k) - (e^{4a} - 1) / (2 k)); a lognormal of that mean and variance.
//! The rate, positive, is a lognormal of its truncated normal's mean and variance; the walk with use adds its variance;
//! the loss is normal. Its part at or below 0 counts as a crossing in the past: T = 0 with that probability. The rest is
//! divided into slices of equal width; each is a lognormal of its middle loss, with the rate conditional on it and, for
//! its own width w, an added variance of (w / L)^2 / 12.

use super::{RATE_WALK, RATE_WALK_USE};
use crate::filter::bisect;

/// Slices of the loss.
const SLICES: usize = 10;
/// Half-width of the sliced range of the loss, deviations; the tails count with the outermost slices.
const SLICED: f64 = 3.5;

/// Steps of the bisections: from some 20 e-folds to a part in 10^6.
pub(super) const HALVINGS: u32 = 24;

/// Half-width of the search for a quantile, deviations of each slice.
const REACH: f64 = 6.0;

/// Range of the logarithm of use and rate.
const LOG_RANGE: (f64, f64) = (-20.0, 40.0);

/// Below this the moments' closed form loses digits, and the series applies.
const SMALL: f64 = 1e-3;

/// A slice: its probability, and mean and standard deviation of the logarithm of its use.
type Slice = (f64, (f64, f64));

/// The distribution of the use until the crossing.
#[derive(Debug, Clone)]
pub(super) struct Crossing {
    /// Probability that the crossing lies in the past.
    passed: f64,
    slices: [Slice; SLICES],
}

impl Crossing {
    /// From mean [loss to come, rate], covariance [loss, loss and rate, rate] and the use so far.
    pub(super) fn new(mean: [f64; 2], covariance: [f64; 3], used: f64) -> Self {
        let [loss_variance, both, rate_variance] = covariance;
        // With a certain loss all slices are equal.
        let loss_std = loss_variance.max(1e-24).sqrt();
        let by_loss = both / (loss_std * loss_std);
        let left = (rate_variance - by_loss * both).max(0.0);
        // Deviation from the mean at which the loss is 0.
        let zero = -mean[0] / loss_std;
        let from = zero.max(-SLICED);
        let width = (SLICED.max(from + 1.0) - from) / SLICES as f64;
        let mut before = normal(zero);
        let passed = before;
        let slices = std::array::from_fn(|index| {
            let upper = from + (index + 1) as f64 * width;
            let until = if index + 1 == SLICES { 1.0 } else { normal(upper) };
            let probability = (until - before).max(0.0);
            before = until;
            let deviation = upper - 0.5 * width;
            let loss = mean[0] + loss_std * deviation;
            let (log_rate, log_rate_variance) = positive(mean[1] + by_loss * loss_std * deviation, left);
            let (log_use, walked) = use_of_loss(loss);
            let log_mean = log_use - log_rate;
            // The rate continues its walk with use; the mean over the walk counts, about half.
            let ahead = libm::log1p(libm::exp(log_mean.min(LOG_RANGE.1)) / used.max(f64::MIN_POSITIVE));
            let own_width = loss_std * width / loss;
            let variance =
                log_rate_variance + walked + 0.5 * RATE_WALK_USE * RATE_WALK_USE * ahead + own_width * own_width / 12.0;
            (probability, (log_mean, variance.sqrt()))
        });
        Self { passed, slices }
    }

    /// Probability of the crossing within `ahead` units of use.
    pub(super) fn probability(&self, ahead: f64) -> f64 {
        self.probability_of_log(libm::log(ahead))
    }

    fn probability_of_log(&self, log_use: f64) -> f64 {
        let to_come: f64 = self.slices.iter().map(|(weight, log)| weight * below(log_use, *log)).sum();
        self.passed + to_come
    }

    /// Use within which the crossing has this probability.
    pub(super) fn quantile(&self, probability: f64) -> f64 {
        if self.passed >= probability {
            return 0.0;
        }
        let likely = || self.slices.iter().filter(|(weight, _)| *weight > 0.0);
        let ends = |sign: f64| likely().map(move |(_, (mean, std))| mean + sign * REACH * std);
        let least = ends(-1.0).fold(LOG_RANGE.1, f64::min).max(LOG_RANGE.0);
        let most = ends(1.0).fold(least, f64::max).min(LOG_RANGE.1);
        libm::exp(bisect((least, most), HALVINGS, |log_use| self.probability_of_log(log_use) < probability).1)
    }
}

/// Probability of a standard normal distribution below `value`.
fn normal(value: f64) -> f64 {
    0.5 * libm::erfc(-value / std::f64::consts::SQRT_2)
}

/// Probability of a normal distribution (mean, standard deviation) below `value`.
fn below(value: f64, (mean, std): (f64, f64)) -> f64 {
    normal((value - mean) / std)
}

/// Mean and variance of the logarithm of a lognormal that has the moments of the normal (mean, variance) above 0.
fn positive(mean: f64, variance: f64) -> (f64, f64) {
    let std = variance.max(1e-24 * mean * mean).sqrt();
    if std == 0.0 {
        return (LOG_RANGE.0, 0.0);
    }
    // Further below 0 the ratio of density and tail exceeds f64; the rate is then merely small.
    let place = (mean / std).max(-8.0);
    let density = libm::exp(-0.5 * place * place) / (2.0 * std::f64::consts::PI).sqrt();
    let hazard = density / (0.5 * libm::erfc(-place / std::f64::consts::SQRT_2));
    let first = std * (place + hazard);
    let second = (std * std * (1.0 - hazard * (hazard + place))).max(1e-24 * first * first);
    let log_variance = libm::log1p(second / (first * first));
    (libm::log(first) - 0.5 * log_variance, log_variance)
}

/// Mean and variance of the logarithm of the use that a loss takes at rate 1.
fn use_of_loss(loss: f64) -> (f64, f64) {
    let k = RATE_WALK * RATE_WALK;
    let a = 0.5 * k * loss;
    if a < SMALL {
        return (libm::log(loss) + a / 6.0, 2.0 * a / 3.0);
    }
    let mean = loss * libm::expm1(a) / a;
    let second = 4.0 / k * (libm::exp(a) * libm::expm1(3.0 * a) / (1.5 * k) - libm::expm1(4.0 * a) / (2.0 * k));
    let log_variance = libm::log(second / (mean * mean));
    (libm::log(mean) - 0.5 * log_variance, log_variance)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_moments_of_the_use_agree_with_a_sampled_walk() {
        // Antithetic pairs of a fixed generator: reproducible, and the first moment nearly exact.
        let (loss, steps, paths) = (0.3, 200, 4000);
        let mut seed = 1_u64;
        let mut uniform = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((seed >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
        };
        let mut sum = [0.0; 2];
        for _ in 0..paths {
            let (mut walk, mut uses) = (0.0, [0.0; 2]);
            for _ in 0..steps {
                let normal = (-2.0 * uniform().ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos();
                let before = walk;
                walk += RATE_WALK * (loss / f64::from(steps)).sqrt() * normal;
                for (total, sign) in uses.iter_mut().zip([-1.0, 1.0]) {
                    *total += loss / f64::from(steps) * 0.5 * ((sign * before).exp() + (sign * walk).exp());
                }
            }
            for total in uses {
                sum[0] += total / f64::from(2 * paths);
                sum[1] += total * total / f64::from(2 * paths);
            }
        }
        let (log_mean, log_variance) = use_of_loss(loss);
        let (mean, second) = ((log_mean + 0.5 * log_variance).exp(), (2.0 * log_mean + 2.0 * log_variance).exp());
        assert!((sum[0] / mean - 1.0).abs() < 0.01, "{} {mean}", sum[0]);
        assert!(((sum[1] - sum[0] * sum[0]) / (second - mean * mean) - 1.0).abs() < 0.1, "{} {second}", sum[1]);
    }

    #[test]
    fn series_and_closed_form_meet() {
        let (below, above) = (use_of_loss(1.999e-3), use_of_loss(2.001e-3));
        assert!((below.0 - above.0).abs() < 2e-3 && (below.1 - above.1).abs() < 1e-5, "{below:?} {above:?}");
    }

    #[test]
    fn a_certain_rate_far_above_zero_keeps_its_moments() {
        let (log_mean, log_variance) = positive(2.0, 0.01);
        assert!(((log_mean + 0.5 * log_variance).exp() - 2.0).abs() < 1e-9);
        let (log_mean, _) = positive(-1.0, 1.0);
        assert!(log_mean.is_finite());
    }

    #[test]
    fn quantile_and_probability_are_each_others_inverse() {
        let crossing = Crossing::new([0.1, 0.002], [1e-4, -1e-7, 1e-7], 50.0);
        for probability in [0.05, 0.5, 0.95] {
            assert!((crossing.probability(crossing.quantile(probability)) - probability).abs() < 1e-6);
        }
        assert_eq!(Crossing::new([-0.1, 0.002], [1e-6, 0.0, 1e-7], 50.0).quantile(0.95), 0.0);
    }
}
