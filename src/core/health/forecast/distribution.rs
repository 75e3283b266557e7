//! Computes the distribution of the use until a cell's level (its capacity without recovery) falls below a threshold.
//! The distribution is a mixture of fade shapes.
//!
//! In: level and rate of fade with their standard deviations, and the loss and use since the highest level. Out:
//! probabilities and quantiles of the use. Losses and capacities are fractions of the reference capacity.
//!
//! Shapes: at a loss l since the highest level, the rate of fade is r ((l + l0) / (lost + l0))^a. Here, r is the
//! present rate, `lost` is the present loss, and l0 is [`ONSET`]. The exponent a sets the shape of the loss as a
//! function of the use: a = -1 is a square root, 0 a straight line, 0.5 a parabola, and 1 an exponential. If a is above
//! 1, the curve has a knee and becomes steeper without limit. The use in which the loss grows from l1 to l2 has a
//! closed form ([`use_of_loss`]).
//!
//! The posterior of (a, ln r) on a grid of [`SHAPES`] x [`RATES`] nodes is the product of four terms:
//! * the prior of the exponent: a t distribution around [`EXPONENT`], mixed with a normal distribution around a
//!   straight line (weight [`STEADY_SHARE`]);
//! * the prior of the mean rate over the next [`TYPICAL_LOSS`]: a Cauchy distribution (see [`PriorRate`]), which
//!   dominates for a cell that has hardly lost capacity. Because of its heavy tails, a measured rate can replace it;
//! * the rate that the filter has found;
//! * the curvature so far: shape and rate together imply how much use has passed since the highest level. The deviation
//!   of the implied use from the actual use has a t distribution.
//!
//! The use until the threshold is computed from the shape, for [`SLICES`] slices of the uncertain level. It is
//! multiplied by a lognormal deviation, which covers future changes of the rate ([`SPREAD_LOSS`]) and the error of any
//! shape ([`SPREAD`]).
//!
//! Assumption: the level passes the threshold only once. The posterior does not depend on the threshold, so
//! probabilities for several thresholds agree with each other.

use crate::filter::{bell, normal_cdf, square};

/// Loss at which the acceleration of a fade begins (fraction of the reference). Below this loss, all shapes are nearly
/// straight lines.
const ONSET: f64 = 0.03;
/// Prior of the exponent: centre and scale of a t distribution with [`EXPONENT_FREEDOM`] degrees of freedom.
const EXPONENT: (f64, f64) = (1.8, 0.6);
const EXPONENT_FREEDOM: f64 = 3.0;
/// Prior probability of a steady fade, and standard deviation of its exponent around 0.
const STEADY_SHARE: f64 = 0.05;
const STEADY_STD: f64 = 0.5;
/// A shape implies how much use has passed since the highest level. Scale of the deviation of this use from the actual
/// use, relative to this use.
const CURVATURE: f64 = 0.3;
/// Minimum of this scale, after multiplication by the rate of fade (fraction of the reference). It matters only for a
/// small loss.
const CURVATURE_FLOOR: f64 = 0.01;
/// Loss over which the prior of the rate is stated.
const TYPICAL_LOSS: f64 = 0.1;
/// Equivalent full cycles in which a typical cell loses `TYPICAL_LOSS`. At a constant rate, this is 800 cycles to 80 %.
const TYPICAL_CYCLES: f64 = 400.0;
/// Scale of the prior of ln(rate), for a rate per cycle and for a rate per day.
const TYPICAL_SCALE: (f64, f64) = (0.7, 2.0);
/// If the prior is the mean rate so far, this is added to the loss (fraction of the reference), so that the rate is
/// above 0.
const LEAST_LOSS: f64 = 0.01;
/// Standard deviation of ln(use) over one e-fold of the loss. It grows with the square root of the number of e-folds.
const SPREAD_LOSS: f64 = 0.25;
/// Standard deviation of ln(use), for any loss.
const SPREAD: f64 = 0.23;

/// First exponent of the grid, step, and number of exponents: -1.5 to 4.5.
const FIRST_EXPONENT: f64 = -1.5;
const EXPONENT_STEP: f64 = 0.5;
const SHAPES: usize = 13;
const RATES: usize = 41;
/// Number of slices of the level, and half-width of the range that is divided into slices (standard deviations). The
/// last slice also contains the upper tail.
const SLICES: usize = 7;
const SLICED: f64 = 3.5;
/// Number of bins of ln(use), and their width. The bins cover 32 e-folds.
const BINS: usize = 320;
const BIN: f64 = 0.1;
/// Node weights below this share of the sum are ignored.
const NEGLIGIBLE: f64 = 1e-9;

/// Number of bisection steps for a capacity: the error is below 1 part in 10^6.
pub(super) const HALVINGS: u32 = 24;

/// Prior of the mean rate over the next [`TYPICAL_LOSS`].
#[derive(Debug, Clone, Copy)]
pub(super) enum PriorRate {
    /// Rate per equivalent full cycle: mean of a typical cell's rate and of the cell's rate since the highest level.
    /// The weight of the cell's own rate grows with its use.
    PerCycle,
    /// Rate per day: mean rate since the first reading. Rates per day differ too much between cells for a typical rate.
    SoFar {
        /// Days since the first reading.
        days: f64,
    },
}

/// State of a cell's filter.
#[derive(Debug, Clone, Copy)]
pub(super) struct FadeState {
    /// Level, mean and standard deviation.
    pub(super) level: (f64, f64),
    /// Rate of fade per unit of use, mean and standard deviation (above 0).
    pub(super) rate: (f64, f64),
    /// Level from which the loss is counted.
    pub(super) new_level: f64,
    /// Highest level; lower than `new_level` if the first reading came from an aged cell.
    pub(super) top_level: f64,
    /// Use since the highest level.
    pub(super) since_top: f64,
    pub(super) prior: PriorRate,
}

/// Posterior of the shape and the rate of a fade.
#[derive(Debug, Clone)]
pub(super) struct FadePosterior {
    state: FadeState,
    /// ln of the first rate of the grid, and step.
    log_rates: (f64, f64),
    /// Probability of each exponent and rate; the sum is 1.
    weights: [[f64; RATES]; SHAPES],
}

/// Distribution of the use until the crossing.
#[derive(Debug, Clone)]
pub(super) struct Crossing {
    /// ln of the use at the lower end of the first bin.
    start: f64,
    /// Probability that the level has passed the threshold before the upper end of each bin.
    cumulative: [f64; BINS],
    /// Probability that the level has already passed the threshold.
    passed: f64,
}

impl FadePosterior {
    pub(super) fn new(state: FadeState) -> Self {
        let FadeState { rate: (rate, rate_std), since_top, .. } = state;
        let lost = state.lost(state.level.0);
        let at_top = state.lost(state.top_level).min(lost);
        let (typical, scale) = match state.prior {
            // Treats the cell as if it had first behaved like a typical cell for [`TYPICAL_CYCLES`].
            PriorRate::PerCycle => ((TYPICAL_LOSS + lost - at_top) / (TYPICAL_CYCLES + since_top), TYPICAL_SCALE.0),
            PriorRate::SoFar { days } => ((lost - ONSET + LEAST_LOSS) / days, TYPICAL_SCALE.1),
        };
        let log_typical = libm::log(typical);
        let (first, last) = log_rate_range(rate, rate_std, log_typical);
        let step = (last - first) / (RATES - 1) as f64;
        let mut weights = [[0.0; RATES]; SHAPES];
        for (index, of_shape) in weights.iter_mut().enumerate() {
            let exponent = exponent(index);
            let log_prior = libm::log(exponent_density(exponent));
            let growth = libm::log(TYPICAL_LOSS / use_of_loss(exponent, lost, lost + TYPICAL_LOSS));
            let implied = -use_of_loss(exponent, lost, at_top);
            let implied_variance = square(CURVATURE * implied) + square(CURVATURE_FLOOR);
            for (index, weight) in of_shape.iter_mut().enumerate() {
                let log_rate = first + step * index as f64;
                let node = libm::exp(log_rate);
                let from_typical = (log_rate + growth - log_typical) / scale;
                let curved = square(implied - node * since_top) / implied_variance;
                *weight = log_prior - libm::log1p(from_typical * from_typical) - 0.5 * square((rate - node) / rate_std);
                if since_top > 0.0 {
                    *weight -= 2.0 * libm::log1p(curved / 3.0);
                }
            }
        }
        normalise(&mut weights);
        Self { state, log_rates: (first, step), weights }
    }

    /// Distribution of the use until the level passes `threshold`.
    pub(super) fn crossing(&self, threshold: f64) -> Crossing {
        let (level, level_std) = self.state.level;
        // The minimum avoids a division by 0 if the level is known exactly; all slices are then equal.
        let level_std = level_std.max(1e-12);
        // The threshold minus the mean of the level, in standard deviations. If the deviation of the true level from
        // the mean is below this value, the level has already passed the threshold.
        let zero = (threshold - level) / level_std;
        let from = zero.max(-SLICED);
        let width = (SLICED.max(from + 1.0) - from) / SLICES as f64;
        let passed = normal_cdf(zero);
        let mut before = passed;
        let slices: [(f64, [f64; SHAPES]); SLICES] = std::array::from_fn(|index| {
            let upper = from + (index + 1) as f64 * width;
            let until = if index + 1 == SLICES { 1.0 } else { normal_cdf(upper) };
            let probability = (until - before).max(0.0);
            before = until;
            let level = level + level_std * (upper - 0.5 * width);
            let lost = self.state.lost(level);
            let end = lost + (level - threshold).max(1e-12);
            (probability, std::array::from_fn(|shape| libm::log(use_of_loss(exponent(shape), lost, end))))
        });
        let longest =
            slices.iter().flat_map(|(_, uses)| uses).fold(f64::NEG_INFINITY, |most, &log_use| most.max(log_use));
        let start = longest - self.log_rates.0 + 2.0 - BIN * BINS as f64;
        let mut bins = [0.0; BINS];
        for (probability, log_uses) in &slices {
            self.add_slice(&mut bins, *probability, log_uses, start);
        }
        let lost = self.state.lost(level);
        let e_folds = libm::log((lost + (level - threshold).max(0.0)) / lost);
        let spread = (SPREAD_LOSS * SPREAD_LOSS * e_folds + SPREAD * SPREAD).sqrt();
        let mut sum = passed;
        let cumulative = spread_bins(&bins, spread / BIN).map(|probability| {
            sum += probability;
            sum
        });
        Crossing { start, cumulative, passed }
    }

    /// Adds the uses of one slice of the level to the bins. Each use is divided between the two nearest bins, so the
    /// mean is not rounded.
    fn add_slice(&self, bins: &mut [f64; BINS], probability: f64, log_uses: &[f64; SHAPES], start: f64) {
        let (first, step) = self.log_rates;
        for (of_shape, log_use) in self.weights.iter().zip(log_uses) {
            for (index, weight) in of_shape.iter().enumerate().filter(|(_, weight)| **weight > NEGLIGIBLE) {
                let place = (log_use - first - step * index as f64 - start) / BIN - 0.5;
                let place = place.clamp(0.0, (BINS - 2) as f64);
                let bin = place as usize;
                let upper = place - bin as f64;
                bins[bin] += probability * weight * (1.0 - upper);
                bins[bin + 1] += probability * weight * upper;
            }
        }
    }
}

impl FadeState {
    /// Loss from `new_level` to `level`, plus [`ONSET`].
    fn lost(&self, level: f64) -> f64 {
        (self.new_level - level).max(0.0) + ONSET
    }
}

impl Crossing {
    /// Probability that the level passes the threshold within `ahead` units of use.
    pub(super) fn probability(&self, ahead: f64) -> f64 {
        let place = (libm::log(ahead) - self.start) / BIN;
        if place <= 0.0 {
            return self.passed;
        }
        let bin = (place as usize).min(BINS - 1);
        let before = if bin == 0 { self.passed } else { self.cumulative[bin - 1] };
        before + (place - bin as f64).min(1.0) * (self.cumulative[bin] - before)
    }

    /// Use within which the level passes the threshold with the probability `probability`.
    pub(super) fn quantile(&self, probability: f64) -> f64 {
        if self.passed >= probability {
            return 0.0;
        }
        let bin = self.cumulative.partition_point(|&sum| sum < probability).min(BINS - 1);
        let before = if bin == 0 { self.passed } else { self.cumulative[bin - 1] };
        let share = ((probability - before) / (self.cumulative[bin] - before)).clamp(0.0, 1.0);
        libm::exp(self.start + BIN * (bin as f64 + share))
    }
}

fn exponent(index: usize) -> f64 {
    FIRST_EXPONENT + EXPONENT_STEP * index as f64
}

/// Prior density of an exponent, up to a constant factor.
fn exponent_density(exponent: f64) -> f64 {
    // Ratio of the peak of a normal density to the peak of a t density with the same scale.
    const PEAKS: f64 = 1.1;
    let squared = square((exponent - EXPONENT.0) / EXPONENT.1);
    let power = -0.5 * (EXPONENT_FREEDOM + 1.0);
    let knee = libm::pow(1.0 + squared / EXPONENT_FREEDOM, power) / EXPONENT.1;
    (1.0 - STEADY_SHARE) * knee + STEADY_SHARE * PEAKS * bell(exponent / STEADY_STD) / STEADY_STD
}

/// Range of ln(rate) that contains the posterior.
fn log_rate_range(rate: f64, rate_std: f64, log_typical: f64) -> (f64, f64) {
    if rate > 3.0 * rate_std {
        let half = (6.0 * rate_std / rate).clamp(0.3, 3.0);
        return (libm::log(rate) - half, libm::log(rate) + half);
    }
    // The data do not exclude a rate near 0, so the prior bounds the rate.
    let last = libm::log(rate + 4.0 * rate_std);
    ((last - 8.0).min(log_typical - 6.0), last)
}

/// Use in which the loss changes from `from` to `to` (both plus [`ONSET`]), for a rate of 1 at `from`. Negative if `to`
/// is smaller.
fn use_of_loss(exponent: f64, from: f64, to: f64) -> f64 {
    let e_folds = libm::log(to / from);
    let power = (1.0 - exponent) * e_folds;
    // (e^x - 1) / x tends to 1.
    let mean = if power.abs() < 1e-9 { 1.0 } else { libm::expm1(power) / power };
    from * e_folds * mean
}

fn normalise(weights: &mut [[f64; RATES]; SHAPES]) {
    let largest = weights.iter().flatten().fold(f64::NEG_INFINITY, |most, &weight| most.max(weight));
    weights.iter_mut().flatten().for_each(|weight| *weight = libm::exp(*weight - largest));
    let sum: f64 = weights.iter().flatten().sum();
    weights.iter_mut().flatten().for_each(|weight| *weight /= sum);
}

/// Convolves the bins with a normal distribution with the standard deviation `std` (bins). Probability beyond the range
/// is kept in the outermost bins.
fn spread_bins(bins: &[f64; BINS], std: f64) -> [f64; BINS] {
    let reach = ((4.0 * std) as usize).min(BINS / 2);
    let mut kernel = [0.0; BINS / 2 + 1];
    for (distance, value) in kernel.iter_mut().enumerate().take(reach + 1) {
        *value = bell(distance as f64 / std);
    }
    let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f64>();
    let mut spread = [0.0; BINS];
    for (bin, &probability) in bins.iter().enumerate().filter(|(_, probability)| **probability > 0.0) {
        for (distance, share) in kernel.iter().enumerate().take(reach + 1) {
            let part = probability * share / sum;
            spread[(bin + distance).min(BINS - 1)] += part;
            if distance > 0 {
                spread[bin.saturating_sub(distance)] += part;
            }
        }
    }
    spread
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cell that has lost 10 % in 100 units of use and fades at a known rate.
    fn state(rate: f64) -> FadeState {
        FadeState {
            level: (0.9, 1e-4),
            rate: (rate, 0.02 * rate),
            new_level: 1.0,
            top_level: 1.0,
            since_top: 100.0,
            prior: PriorRate::PerCycle,
        }
    }

    fn median(state: FadeState) -> f64 {
        FadePosterior::new(state).crossing(0.8).quantile(0.5)
    }

    #[test]
    fn use_of_loss_matches_closed_forms() {
        assert!((use_of_loss(0.0, 0.03, 0.23) - 0.2).abs() < 1e-12);
        assert!((use_of_loss(1.0, 0.1, 0.2) - 0.1 * 2.0_f64.ln()).abs() < 1e-12);
        assert!((use_of_loss(-1.0, 0.1, 0.2) - 0.15).abs() < 1e-12);
        assert!((use_of_loss(2.0, 0.1, 0.2) - 0.05).abs() < 1e-12);
        assert!(use_of_loss(2.0, 0.2, 0.1) < 0.0);
    }

    #[test]
    fn curvature_so_far_decides_the_shape() {
        // Both cells have the same loss and the same present rate. The cell that faded more slowly before has the
        // steeper shape.
        let steady = median(state(0.001));
        let steep = median(FadeState { since_top: 300.0, ..state(0.001) });
        assert!(steady > 60.0 && steep < 0.95 * steady, "{steady} {steep}");
    }

    #[test]
    fn unknown_rate_gives_wide_interval_around_typical_life() {
        let unknown = FadeState { level: (1.0, 1e-4), rate: (0.0, 0.01), since_top: 0.0, ..state(0.001) };
        let crossing = FadePosterior::new(unknown).crossing(0.9);
        let [low, median, high] = [0.05, 0.5, 0.95].map(|probability| crossing.quantile(probability));
        assert!((200.0..800.0).contains(&median), "{median}");
        assert!(low < 0.4 * median && high > 3.0 * median && high.is_finite(), "{low} {high}");
    }

    #[test]
    fn quantile_is_inverse_of_probability() {
        let posterior = FadePosterior::new(state(0.001));
        let crossing = posterior.crossing(0.8);
        for probability in [0.05, 0.5, 0.95] {
            assert!((crossing.probability(crossing.quantile(probability)) - probability).abs() < 1e-9);
        }
        assert!((crossing.probability(1e12) - 1.0).abs() < 1e-6);
        assert_eq!(posterior.crossing(0.95).quantile(0.95), 0.0);
    }
}
