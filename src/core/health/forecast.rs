//! Remaining useful life: the further use (in equivalent full cycles and days) until a cell's capacity falls below the
//! end-of-life threshold.
//!
//! In: use between readings (equivalent full cycles, days) and learned capacities (Ah) with their variances. Out:
//! median and 90 % interval, or the reason why no forecast is given ([`InsufficientData`]). Negative and non-finite
//! numbers are ignored.
//!
//! A linear Kalman filter follows the learned capacities, with one step per reading. Cost and memory do not grow with
//! the history. State x = [level, rate, recovery, top], with capacities as fractions of a reference capacity:
//! * level: the capacity without recovery; level -= rate dt. The use t counts equivalent full cycles, or days if the
//!   cycles are unknown;
//! * rate: loss per unit of use. ln(rate) follows a random walk with two parts. The variance of the first part is w1^2
//!   times the capacity lost, with w1 = `RATE_WALK`. The variance of the second part grows by w2^2 while the use since
//!   the first reading grows by a factor of e, with w2 = `RATE_WALK_USE`. Both parts are relative, so the same
//!   constants suit cells that live for 50 cycles and for 5,000. In the linear filter, with the use t0 before the step
//!   and t1 after the step,
//!   Q = (w1^2 rate dt + w2^2 ln(t1 / t0)) (rate^2 + P_rate + (`TRANSIENT` / t0)^2).
//!   Many new cells first gain capacity, so their rate is not above 0. The last term keeps the rate uncertain enough to
//!   rise when the loss begins;
//! * recovery: capacity that returns during rest and is lost again in use (an Ornstein-Uhlenbeck process; measured
//!   cells show 1 to 5 % after days of rest). Successive readings share the recovery, so ten readings within one cycle
//!   do not count as ten independent readings;
//! * top: the highest level, from which the loss is counted. In some families of cells, the capacity first rises by 3
//!   to 8 %. Later readings improve this estimate.
//!
//! A reading is level + recovery + noise; outliers get less weight. The noise and the recovery during use share one
//! scale, which is learned from the innovations, because the readings of different cells scatter by 0.01 to 3 %.
//!
//! The forecast is a mixture of fade shapes, from a square root to a knee. The weights follow from the rate, the
//! curvature since the highest level, and a prior of typical lives (see [`distribution`]). If little has been lost, a
//! forecast is still given, with a wide interval. `tests/rul.md` lists figures and alternatives.

mod distribution;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

use self::distribution::{FadePosterior, FadeState, PriorRate};
use crate::filter::{bisect, square, update_states};
use crate::quantity::{DAY_S, InvalidState};

/// Standard deviation that ln(rate) gains while the whole reference capacity is lost. It grows with the square root of
/// the loss: over a loss of 10 %, one standard deviation is a factor of e^0.32.
const RATE_WALK: f64 = 1.0;
/// Standard deviation that ln(rate) gains while the use since the first reading grows by a factor of e. It grows with
/// the square root of ln(use after / use before).
const RATE_WALK_USE: f64 = 0.45;
/// Capacity that a new cell gains or loses while it settles, fraction of the reference.
const TRANSIENT: f64 = 0.03;
/// The settling of a new cell can hide loss since the highest level. Standard deviation of the hidden loss, fraction of
/// the reference.
const HIDDEN_LOSS: f64 = 0.002;
/// A rise of the capacity since the first reading can hide loss, too. Standard deviation of this hidden loss, relative
/// to the rise.
const HIDDEN_BY_RISE: f64 = 0.5;
/// A rise is counted from the first level whose standard deviation is below this value, fraction of the reference.
const KNOWN_LEVEL: f64 = 0.02;
/// The error of a reading has a part that the reading's variance does not include. Standard deviation of this part,
/// fraction of the reference. It is multiplied by the square root of the learned noise scale.
const NOISE: f64 = 0.003;
/// Standard deviation of the recovery while the cell is used, fraction of the reference. It is also multiplied by the
/// square root of the noise scale.
const RECOVERY_IN_USE: f64 = 0.005;
/// Standard deviation of the recovery gained by rest, fraction of the reference.
const RECOVERY_IN_REST: f64 = 0.02;
/// Time constant of the recovery during rest (days). If use is counted in days, the recovery also decays with this time
/// constant.
const RECOVERY_DAYS: f64 = 1.0;
/// Weight of the initial noise scale (number of readings), and maximum number of readings that the scale averages over.
const SCALE_READINGS: (f64, f64) = (5.0, 20.0);
/// Range of the noise scale (variance).
const SCALE_RANGE: (f64, f64) = (1e-3, 20.0);

/// Minimum number of readings for a forecast: two readings give a rate, and the third can contradict it.
pub const MIN_READINGS: u32 = 3;
/// Time constant of the exponentially weighted sums that give the recent rate of use (days).
const RECENT_DAYS: f64 = 30.0;

const QUANTILES: [f64; 3] = [0.05, 0.5, 0.95];

const LEVEL: usize = 0;
const RATE: usize = 1;
const RECOVERY: usize = 2;
const TOP: usize = 3;
const N: usize = 4;

/// Measure of use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Axis {
    /// Equivalent full cycles.
    Cycles,
    /// Days, for a history that does not record cycles. Whether the cell rested on a day is then unknown.
    Days,
}

/// Use since the previous reading.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Usage {
    /// Equivalent full cycles (charge moved / twice the rated capacity). Ignored on the axis of days.
    pub cycles: f64,
    /// Days, rest included.
    pub days: f64,
    /// Days without current. Ignored on the axis of days.
    pub rest_days: f64,
}

/// A learned capacity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CapacityReading {
    /// Capacity (Ah).
    pub capacity_ah: f64,
    /// Variance of this reading alone (Ah^2), independent of previous readings.
    pub variance_ah2: f64,
    /// Variance of the error that all readings share (the current sensor's gain) (Ah^2); not part of `variance_ah2`.
    pub shared_variance_ah2: f64,
}

/// Median and 90 % interval of a remaining amount.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Remaining {
    /// 5 % quantile.
    pub low: f64,
    /// 50 % quantile.
    pub median: f64,
    /// 95 % quantile.
    pub high: f64,
}

/// Remaining useful life; at least one of `cycles` and `days` is known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RemainingLife {
    /// Equivalent full cycles; `None` on the axis of days.
    pub cycles: Option<Remaining>,
    /// Days at the recent rate of use (`RECENT_DAYS`); `None` while that rate is unknown.
    pub days: Option<Remaining>,
}

/// Reason why no forecast is given.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "reason")]
pub enum InsufficientData {
    /// Too few readings.
    #[error("{found} capacity readings, {MIN_READINGS} are needed")]
    Readings {
        /// Number of readings.
        found: u32,
    },
    /// The cell was not used between the first reading and the last.
    #[error("no use between the first reading and the last")]
    Use,
}

/// Predicted capacity after some further use.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FanPoint {
    /// Use after the last reading, in units of the axis.
    pub ahead: f64,
    /// 5 % quantile (Ah).
    pub low_ah: f64,
    /// 50 % quantile (Ah).
    pub median_ah: f64,
    /// 95 % quantile (Ah).
    pub high_ah: f64,
}

/// The forecast filter of one cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Forecast {
    axis: Axis,
    reference_ah: f64,
    readings: u32,
    /// Use since the first reading.
    used: f64,
    x: [f64; N],
    p: [[f64; N]; N],
    shared_variance: f64,
    /// Learned variance of noise and recovery during use, relative to the constants.
    #[serde(default = "usual_noise")]
    noise_scale: f64,
    /// Level when its standard deviation first fell below [`KNOWN_LEVEL`]; `None` before.
    #[serde(default)]
    first_level: Option<f64>,
    /// Use since the first reading at which the level was highest.
    #[serde(default)]
    used_at_top: f64,
    /// Recent equivalent full cycles and recent days: exponentially weighted sums with the time constant `RECENT_DAYS`.
    recent: [f64; 2],
}

fn usual_noise() -> f64 {
    1.0
}

impl Usage {
    /// Use during a half-cycle that moved `charge_ah` in `duration_s`, and during the rest before it. `since_before_s`:
    /// time from the end of the previous half-cycle to the end of this one. If this time is unknown (`None`), a long
    /// rest is assumed.
    pub fn in_half_cycle(charge_ah: f64, duration_s: f64, since_before_s: Option<f64>, rated_capacity_ah: f64) -> Self {
        let used_days = duration_s / DAY_S;
        let known = since_before_s.map(|seconds| (seconds / DAY_S - used_days).max(0.0));
        Self {
            cycles: charge_ah / (2.0 * rated_capacity_ah),
            // A rest of unknown duration does not change the recent rate of use.
            days: used_days + known.unwrap_or(0.0),
            // After a long rest, the recovery is complete.
            rest_days: known.unwrap_or(30.0),
        }
    }
}

impl Forecast {
    /// Creates a filter for a cell that had the capacity `reference_ah` (Ah) when new. An approximate value suffices,
    /// because the loss is counted from `reference_ah` or from the highest level, whichever is higher.
    pub fn new(axis: Axis, reference_ah: f64) -> Self {
        let mut p = [[0.0; N]; N];
        // Wide priors: the level is practically unknown, and the rate has a standard deviation of 2 % per unit of use.
        p[LEVEL][LEVEL] = 1.0;
        p[RATE][RATE] = 0.02 * 0.02;
        let rest = if axis == Axis::Days { RECOVERY_IN_REST } else { 0.0 };
        p[RECOVERY][RECOVERY] = RECOVERY_IN_USE * RECOVERY_IN_USE + rest * rest;
        // Before the first reading, level and top are equal.
        for (i, j) in [(TOP, TOP), (TOP, LEVEL), (LEVEL, TOP)] {
            p[i][j] = p[LEVEL][LEVEL];
        }
        let x = [1.0, 0.0, 0.0, 1.0];
        Self {
            axis,
            reference_ah,
            readings: 0,
            used: 0.0,
            x,
            p,
            shared_variance: 0.0,
            noise_scale: 1.0,
            first_level: None,
            used_at_top: 0.0,
            recent: [0.0; 2],
        }
    }

    /// Predicts the state after the use `passed`, then updates it with `reading`, the capacity learned at the end of
    /// that use. NaN, infinite and negative numbers are ignored.
    pub fn update(&mut self, passed: Usage, reading: Option<CapacityReading>) {
        let natural = |value: f64| if value.is_finite() { value.max(0.0) } else { 0.0 };
        let Usage { cycles, days, rest_days } = passed;
        let passed = Usage { cycles: natural(cycles), days: natural(days), rest_days: natural(rest_days) };
        self.count_recent(&passed);
        if self.readings > 0 {
            self.advance(&passed);
        }
        let is_sound = |reading: &CapacityReading| {
            let CapacityReading { capacity_ah, variance_ah2, shared_variance_ah2 } = *reading;
            [capacity_ah, variance_ah2, shared_variance_ah2].iter().all(|value| (0.0..1e9).contains(value))
        };
        if let Some(reading) = reading.filter(is_sound) {
            self.observe(&reading);
        }
    }

    /// Adds cycles and days to the exponentially weighted sums. The result does not depend on how a period is divided
    /// into steps.
    fn count_recent(&mut self, passed: &Usage) {
        let ages = passed.days / RECENT_DAYS;
        let kept = libm::exp(-ages);
        let share = if ages > 0.0 { (1.0 - kept) / ages } else { 1.0 };
        let [cycles, days] = self.recent;
        self.recent = [cycles * kept + share * passed.cycles, days * kept + share * passed.days];
    }

    /// Checks the numbers of a stored forecast, which must belong to `axis`.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self, axis: Axis) -> Result<(), InvalidState> {
        InvalidState::unless(self.axis == axis, "the axis of the remaining life", 1.0, "cycles")?;
        InvalidState::unless_capacity("the reference of the remaining life", self.reference_ah)?;
        InvalidState::unless_natural("the use of the remaining life", self.used)?;
        InvalidState::unless_natural("the shared variance of the remaining life", self.shared_variance)?;
        InvalidState::unless_natural("the noise scale of the remaining life", self.noise_scale)?;
        InvalidState::unless_natural("the use at the highest level of the remaining life", self.used_at_top)?;
        let is_before = self.used_at_top <= self.used;
        InvalidState::unless(
            is_before,
            "the use at the highest level of the remaining life",
            self.used_at_top,
            "at most the use",
        )?;
        let is_usual = (SCALE_RANGE.0..=SCALE_RANGE.1).contains(&self.noise_scale);
        InvalidState::unless(is_usual, "the noise scale of the remaining life", self.noise_scale, "0.001 to 20")?;
        if let Some(level) = self.first_level {
            InvalidState::unless_number("the first level of the remaining life", level)?;
        }
        InvalidState::unless_naturals("the recent use of the remaining life", self.recent)?;
        for i in 0..N {
            InvalidState::unless_number("a state of the remaining life", self.x[i])?;
            InvalidState::unless_natural("a variance of the remaining life", self.p[i][i])?;
            for j in 0..i {
                let [one, other] = [self.p[i][j], self.p[j][i]];
                // Rounding may break the symmetry of a covariance.
                let bound = 1.001 * (self.p[i][i] * self.p[j][j]).sqrt() + 1e-12;
                let is_sound = one.abs() <= bound && other.abs() <= bound;
                InvalidState::unless(is_sound, "a covariance of the remaining life", one, "within its variances")?;
            }
        }
        Ok(())
    }

    /// Reference capacity (Ah), as passed to [`Self::new`].
    pub fn reference_ah(&self) -> f64 {
        self.reference_ah
    }

    /// Number of readings that the filter has used.
    pub fn readings(&self) -> u32 {
        self.readings
    }

    /// Capacity without recovery, mean and standard deviation (Ah).
    pub fn level_ah(&self) -> (f64, f64) {
        (self.reference_ah * self.x[LEVEL], self.reference_ah * self.level_variance().sqrt())
    }

    /// Loss per unit of use, mean and standard deviation (Ah).
    pub fn rate_ah(&self) -> (f64, f64) {
        (self.reference_ah * self.x[RATE], self.reference_ah * self.p[RATE][RATE].sqrt())
    }

    /// Remaining use until the level falls below `threshold_ah`.
    ///
    /// # Errors
    /// The reason why no forecast is given.
    pub fn remaining(&self, threshold_ah: f64) -> Result<RemainingLife, InsufficientData> {
        self.check_readings()?;
        let threshold = threshold_ah / self.reference_ah;
        // If the level has passed the threshold with a probability of at least 95 %, the remaining use is 0.
        let has_passed = self.x[LEVEL] + 1.645 * self.level_variance().sqrt() < threshold;
        let remaining = if has_passed { Remaining::default() } else { self.time_to(threshold) };
        let [cycles, days] = self.recent;
        Ok(match self.axis {
            Axis::Days => RemainingLife { cycles: None, days: Some(remaining) },
            Axis::Cycles => {
                let per_cycle = (cycles > 0.0 && days > 0.0).then(|| days / cycles);
                RemainingLife { cycles: Some(remaining), days: per_cycle.map(|factor| remaining.times(factor)) }
            }
        })
    }

    /// Remaining use until the level falls below `threshold`, fraction of the reference.
    fn time_to(&self, threshold: f64) -> Remaining {
        let crossing = self.posterior().crossing(threshold);
        let [low, median, high] = QUANTILES.map(|quantile| crossing.quantile(quantile));
        Remaining { low, median, high }
    }

    /// Predicted capacity at `points` evenly spaced amounts of further use from 0 to `ahead`. Too slow for live data.
    ///
    /// # Errors
    /// The reason why no forecast is given.
    pub fn fan(&self, ahead: f64, points: usize) -> Result<Vec<FanPoint>, InsufficientData> {
        self.check_readings()?;
        let posterior = self.posterior();
        let at = |index: usize| {
            let ahead = ahead * index as f64 / (points.max(2) - 1) as f64;
            let [low_ah, median_ah, high_ah] = QUANTILES.map(|quantile| self.capacity_ah(&posterior, ahead, quantile));
            FanPoint { ahead, low_ah, median_ah, high_ah }
        };
        Ok((0..points).map(at).collect())
    }

    /// Predicts the state after the use `passed`: the recovery relaxes, the level falls at the rate, and rate and
    /// recovery become less certain.
    fn advance(&mut self, passed: &Usage) {
        let (used, rest_days, relaxation) = match self.axis {
            // During use, the recovery decays by a factor of e in ten cycles.
            Axis::Cycles => (passed.cycles, passed.rest_days, 10.0),
            Axis::Days => (passed.days, passed.days, RECOVERY_DAYS),
        };
        let kept = libm::exp(-used / relaxation);
        let walk = self.rate_walk(used);
        let (x, p) = (&mut self.x, &mut self.p);
        x[LEVEL] -= used * x[RATE];
        x[RECOVERY] *= kept;
        let rate_row = p[RATE];
        p[LEVEL].iter_mut().zip(rate_row).for_each(|(level, rate)| *level -= used * rate);
        p[RECOVERY].iter_mut().for_each(|recovery| *recovery *= kept);
        for row in p.iter_mut() {
            row[LEVEL] -= used * row[RATE];
            row[RECOVERY] *= kept;
        }
        // The rate also changes randomly during the step, which makes the level less certain.
        p[RATE][RATE] += walk;
        p[LEVEL][RATE] -= walk * used / 2.0;
        p[RATE][LEVEL] = p[LEVEL][RATE];
        p[LEVEL][LEVEL] += walk * used * used / 3.0;
        let in_use = self.noise_scale * RECOVERY_IN_USE * RECOVERY_IN_USE;
        let in_rest = RECOVERY_IN_REST * RECOVERY_IN_REST;
        let recovery = &mut p[RECOVERY][RECOVERY];
        *recovery += in_use * (1.0 - kept * kept);
        // A rest adds only the part of the recovery that earlier rests have not added.
        *recovery += (1.0 - libm::exp(-2.0 * rest_days / RECOVERY_DAYS)) * (in_use + in_rest - *recovery).max(0.0);
        self.used += used;
    }

    /// Variance that the rate gains over `used` units of use.
    fn rate_walk(&self, used: f64) -> f64 {
        let rate = self.x[RATE].max(0.0);
        // Before any use, the first step counts as growth by a factor of e.
        let e_folds = if self.used > 0.0 { libm::log1p(used / self.used) } else { 1.0 };
        let relative = RATE_WALK * RATE_WALK * rate * used + RATE_WALK_USE * RATE_WALK_USE * e_folds;
        let settling = if self.used > 0.0 { TRANSIENT / self.used } else { 0.0 };
        relative * (rate * rate + self.p[RATE][RATE] + settling * settling)
    }

    fn observe(&mut self, reading: &CapacityReading) {
        let scale = self.reference_ah * self.reference_ah;
        let ph: [f64; N] = std::array::from_fn(|i| self.p[i][LEVEL] + self.p[i][RECOVERY]);
        let own_noise = self.noise_scale * NOISE * NOISE;
        let noise = own_noise + reading.variance_ah2 / scale;
        let innovation = reading.capacity_ah / self.reference_ah - self.x[LEVEL] - self.x[RECOVERY];
        let expected = ph[LEVEL] + ph[RECOVERY] + noise;
        self.learn_noise(innovation * innovation / expected, (own_noise + self.p[RECOVERY][RECOVERY]) / expected);
        // If the innovation exceeds five standard deviations, raises the innovation's variance until the innovation
        // equals five standard deviations.
        let miss = innovation / 5.0;
        let innovation_variance = expected.max(miss * miss);
        update_states(&mut self.x, &mut self.p, &ph, innovation, innovation_variance);
        self.shared_variance = reading.shared_variance_ah2 / scale;
        self.readings = self.readings.saturating_add(1);
        if self.p[LEVEL][LEVEL] < KNOWN_LEVEL * KNOWN_LEVEL {
            self.first_level.get_or_insert(self.x[LEVEL]);
        }
        if self.x[LEVEL] > self.x[TOP] {
            self.restart_top();
        }
    }

    /// Updates the noise scale with an innovation. `ratio`: squared innovation over its expected variance, limited to
    /// three standard deviations. `share`: part of the expected variance that the noise scale explains.
    fn learn_noise(&mut self, ratio: f64, share: f64) {
        let readings = (f64::from(self.readings) + SCALE_READINGS.0).min(SCALE_READINGS.1);
        let factor = 1.0 + share.clamp(0.0, 1.0) * (ratio.min(9.0) - 1.0) / readings;
        self.noise_scale = (self.noise_scale * factor).clamp(SCALE_RANGE.0, SCALE_RANGE.1);
    }

    /// Counts the loss from the present level on.
    fn restart_top(&mut self) {
        self.x[TOP] = self.x[LEVEL];
        self.used_at_top = self.used;
        self.p[TOP] = self.p[LEVEL];
        for row in &mut self.p {
            row[TOP] = row[LEVEL];
        }
    }

    fn check_readings(&self) -> Result<(), InsufficientData> {
        if self.readings < MIN_READINGS {
            return Err(InsufficientData::Readings { found: self.readings });
        }
        if self.used > 0.0 { Ok(()) } else { Err(InsufficientData::Use) }
    }

    /// Variance of the level, including the error that all readings share.
    fn level_variance(&self) -> f64 {
        self.p[LEVEL][LEVEL] + self.shared_variance
    }

    fn posterior(&self) -> FadePosterior {
        let since_top = self.used - self.used_at_top;
        let rise = self.x[TOP] - self.first_level.unwrap_or(self.x[TOP]);
        // The settling of a new cell hides a part of the loss, which makes the rate uncertain.
        let hidden =
            square(HIDDEN_LOSS / since_top.max(1e-3 * self.used)) + square(HIDDEN_BY_RISE * rise.max(0.0) / self.used);
        FadePosterior::new(FadeState {
            level: (self.x[LEVEL], self.level_variance().sqrt()),
            // A rising capacity does not show how fast the capacity falls later.
            rate: (self.x[RATE].max(0.0), (self.p[RATE][RATE] + hidden).sqrt()),
            new_level: self.x[TOP].max(1.0),
            top_level: self.x[TOP],
            since_top,
            prior: match self.axis {
                Axis::Cycles => PriorRate::PerCycle,
                Axis::Days => PriorRate::SoFar { days: self.used },
            },
        })
    }

    /// Quantile of the capacity (Ah) after `ahead` units of use: the level is then below the returned capacity with the
    /// probability `quantile`.
    fn capacity_ah(&self, posterior: &FadePosterior, ahead: f64, quantile: f64) -> f64 {
        let (level, std) = (self.x[LEVEL], self.level_variance().sqrt());
        let is_below = |threshold: f64| posterior.crossing(threshold).probability(ahead) < quantile;
        self.reference_ah * bisect((0.0, level + 5.0 * std), distribution::HALVINGS, is_below).1
    }
}

impl Remaining {
    fn times(self, factor: f64) -> Self {
        Self { low: factor * self.low, median: factor * self.median, high: factor * self.high }
    }
}
