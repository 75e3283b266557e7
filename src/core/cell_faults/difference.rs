//! Filter of the difference between one cell and the middle of its pack.
//!
//! In: per row (a few minutes of samples), the cell's voltage minus the middle voltage of the pack, which is the mean
//! of the middle half of the cell voltages. Out: the states that explain this voltage difference. The filter is a
//! linear Kalman filter, linearised at the cell's own SOC. It can distinguish the states because their effects differ:
//!
//! | state | effect on the voltage difference |
//! | --- | --- |
//! | charge | follows the slope of the open-circuit curve |
//! | capacity | follows the charge moved |
//! | resistance | follows the whole voltage drop, which depends on load and temperature and has a delay |
//! | contact | follows the current without delay, independently of the temperature |
//! | channel | constant |
//! | leak | grows with time |
//!
//! Sources: Plett, Battery Management Systems II, section 4.11 (bar-delta filtering: one filter for the mean cell,
//! one filter for each difference). Zheng et al., J. Power Sources 241 (2013) 181 (contact resistance of one cell in
//! a vehicle).

use serde::{Deserialize, Serialize};

use crate::filter::ScalarGaussian;
use crate::quantity::InvalidState;

/// State: difference in SOC from the mean cell, fraction.
pub const SOC: usize = 0;
/// State: difference in capacity, fraction of the mean cell's capacity.
pub const CAPACITY: usize = 1;
/// State: difference in resistance, fraction of the mean cell's resistance.
pub const RESISTANCE: usize = 2;
/// State: difference in contact resistance, fraction of the mean cell's series resistance at SOC 0.5 and 25 degrees C.
pub const CONTACT: usize = 3;
/// State: offset of the voltage channel (V).
pub const CHANNEL: usize = 4;
/// State: charge that the cell loses through a leak, fraction of the capacity per day.
pub const LEAK: usize = 5;
/// Number of states.
pub const STATES: usize = 6;
const PAIRS: usize = STATES * (STATES + 1) / 2;

/// Standard deviations before the first row. The value for the voltage channel is typical of cell monitors.
const FIRST_STD: [f64; STATES] = [0.05, 0.1, 0.2, 0.5, 0.005, 0.05];
/// Random walk of the states: standard deviations gained within one day.
const DAILY_STD: [f64; STATES] = [1e-4, 3e-4, 5e-3, 5e-3, 3e-4, 1e-4];
/// Standard deviation that the state [`SOC`] gains during a charge or discharge, per unit of change of the mean cell's
/// SOC.
const MOVED_STD: f64 = 5e-4;
/// Standard deviations added after a sudden change of a single cell: its contact or its channel has changed, or the
/// cell has been replaced. The value for the SOC is small, because the SOC cannot change without a current.
const ALONE_STD: [f64; STATES] = [0.005, 0.05, 0.2, 0.5, 0.04, 0.01];
/// Standard deviations added after a sudden change of neighbouring cells: a module was replaced.
const REPLACED_STD: [f64; STATES] = [0.05, 0.1, 0.3, 0.1, 0.005, 0.01];
/// Standard deviations added if only the resistance has changed suddenly. Resistance grows by ageing over weeks, so the
/// cause must be the contact.
const RESISTANCE_STD: [f64; STATES] = [0.0, 0.0, 0.01, 0.5, 0.0, 0.0];
/// Standard deviation of the charge that a cell loses if a BMS may bleed it (discharge it for balancing), fraction of
/// the capacity per day. With 0.01, the detector would miss exchanged channels and modules. A larger loss in a time
/// without rows is handled by `open_charge`.
const BLED_PER_DAY: f64 = 0.002;
/// Limits of the innovation, in standard deviations. Above `HUBER`, a row has a reduced weight. Above `JUMP` (for the
/// mean voltage) or `STEPS_JUMP` (for the resistance from current steps), a row is odd. Three consecutive odd rows
/// whose innovations have the same sign are a jump.
const HUBER: f64 = 3.0;
const JUMP: f64 = 4.0;
const STEPS_JUMP: f64 = 3.0;

/// The filter of one cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Difference {
    mean: [f64; STATES],
    /// Covariance of the states: upper triangle, row by row.
    covariance: [f64; PAIRS],
    /// Number of consecutive rows with an odd mean voltage, with the sign of the innovation.
    odd_rows: i8,
    /// Number of consecutive rows with an odd resistance from steps, with the sign of the innovation.
    odd_steps: i8,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Jump {
    /// A single cell changed.
    Alone,
    /// A cell changed together with a neighbour.
    Replaced,
}

/// Counts consecutive deviations with the same sign that reach `limit`. The third such deviation is a jump: resets the
/// count and returns true.
fn count_odd(odd: &mut i8, deviations: f64, limit: f64) -> bool {
    let side = if deviations.abs() < limit { 0 } else { deviations.signum() as i8 };
    *odd = if side == 0 || odd.signum() * side < 0 { side } else { *odd + side };
    let is_jump = odd.unsigned_abs() >= 3;
    if is_jump {
        *odd = 0;
    }
    is_jump
}

/// An observation: observed value minus expected value, derivatives with respect to the states, and variance of the
/// error.
#[derive(Debug, Clone, Copy)]
pub(super) struct Observation {
    pub(super) innovation: f64,
    pub(super) slope: [f64; STATES],
    pub(super) variance: f64,
}

/// Index of the covariance of the states `i` and `j` in the upper triangle.
const fn pair(i: usize, j: usize) -> usize {
    let (a, b) = if i < j { (i, j) } else { (j, i) };
    a * STATES - a * (a + 1) / 2 + b
}

impl Difference {
    pub(super) fn new() -> Self {
        let mut covariance = [0.0; PAIRS];
        for (i, std) in FIRST_STD.iter().enumerate() {
            covariance[pair(i, i)] = std * std;
        }
        Self { mean: [0.0; STATES], covariance, odd_rows: 0, odd_steps: 0 }
    }

    /// Mean and variance of a state.
    pub fn state(&self, state: usize) -> ScalarGaussian {
        ScalarGaussian { mean: self.mean[state], variance: self.covariance[pair(state, state)] }
    }

    /// Difference in SOC from the mean cell after the mean cell's SOC has changed by `soc_change`. Computed to first
    /// order from the difference in capacity, without the leak.
    pub(super) fn soc_after(&self, soc_change: f64) -> ScalarGaussian {
        let variance = self.covariance[pair(SOC, SOC)]
            + soc_change
                * (soc_change * self.covariance[pair(CAPACITY, CAPACITY)] - 2.0 * self.covariance[pair(SOC, CAPACITY)]);
        ScalarGaussian { mean: self.mean[SOC] - soc_change * self.mean[CAPACITY], variance: variance.max(0.0) }
    }

    pub(super) fn mean(&self) -> &[f64; STATES] {
        &self.mean
    }

    /// Predicts the states after `days` in which the mean cell's SOC changes by `soc_change`.
    pub(super) fn pass(&mut self, days: f64, soc_change: f64) {
        // charge += (1 / (1 + capacity) - 1) * soc_change - leak * days
        let part = 1.0 / (1.0 + self.mean[CAPACITY]).max(0.1);
        let (by_capacity, by_leak) = (-part * part * soc_change, -days);
        self.mean[SOC] += (part - 1.0) * soc_change + by_leak * self.mean[LEAK];
        let get = |cov: &[f64; PAIRS], i, j| cov[pair(i, j)];
        let old = self.covariance;
        for j in 1..STATES {
            self.covariance[pair(SOC, j)] += by_capacity * get(&old, CAPACITY, j) + by_leak * get(&old, LEAK, j);
        }
        self.covariance[pair(SOC, SOC)] += 2.0
            * (by_capacity * get(&old, SOC, CAPACITY) + by_leak * get(&old, SOC, LEAK))
            + by_capacity * by_capacity * get(&old, CAPACITY, CAPACITY)
            + 2.0 * by_capacity * by_leak * get(&old, CAPACITY, LEAK)
            + by_leak * by_leak * get(&old, LEAK, LEAK);
        for (i, std) in DAILY_STD.iter().enumerate() {
            self.covariance[pair(i, i)] += std * std * days;
        }
        let moved = MOVED_STD * soc_change;
        self.covariance[pair(SOC, SOC)] += moved * moved;
        self.keep_possible();
    }

    /// Subtracts charge that left the cell without passing the current sensor. `soc`: this charge as a fraction of the
    /// capacity; `variance`: variance of this fraction.
    pub(super) fn remove_charge(&mut self, soc: f64, variance: f64) {
        self.mean[SOC] -= soc;
        self.covariance[pair(SOC, SOC)] += variance;
        self.keep_possible();
    }

    pub(super) fn forget_charge(&mut self) {
        for j in 0..STATES {
            self.covariance[pair(SOC, j)] = 0.0;
        }
        self.covariance[pair(SOC, SOC)] = FIRST_STD[SOC] * FIRST_STD[SOC];
    }

    /// Resets the leak, because the BMS may bleed the cell from now on.
    pub(super) fn forget_leak(&mut self) {
        self.begin_leak(BLED_PER_DAY);
    }

    /// Resets the leak, because the BMS no longer bleeds the cell. Any further loss is therefore a leak.
    pub(super) fn watch_leak(&mut self) {
        self.begin_leak(FIRST_STD[LEAK]);
    }

    fn begin_leak(&mut self, std: f64) {
        self.mean[LEAK] = 0.0;
        for j in 0..STATES {
            self.covariance[pair(LEAK, j)] = 0.0;
        }
        self.covariance[pair(LEAK, LEAK)] = std * std;
    }

    /// Handles an hour or more without rows, in which the cell may have lost more charge than usual. If the next row
    /// contradicts the prediction, raises the uncertainty of the SOC and of the channel offset. The next drive then
    /// shows which of the two has changed.
    pub(super) fn open_charge(&mut self, days: f64, observed: &Observation) {
        if days >= 0.04 && self.deviations(observed).abs() > JUMP {
            let lost = FIRST_STD[LEAK] * days;
            self.covariance[pair(SOC, SOC)] += lost * lost;
            self.covariance[pair(CHANNEL, CHANNEL)] += ALONE_STD[CHANNEL] * ALONE_STD[CHANNEL];
        }
    }

    /// Expected reading of the channel at rest, relative to the middle voltage of the pack (V). `slope_v`: slope of the
    /// open-circuit curve (V per unit of SOC).
    pub(super) fn reading_v(&self, slope_v: f64) -> ScalarGaussian {
        let mean = slope_v * self.mean[SOC] + self.mean[CHANNEL];
        let variance = slope_v * slope_v * self.covariance[pair(SOC, SOC)]
            + 2.0 * slope_v * self.covariance[pair(SOC, CHANNEL)]
            + self.covariance[pair(CHANNEL, CHANNEL)];
        ScalarGaussian { mean, variance: variance.max(0.0) }
    }

    /// The innovation, in standard deviations.
    pub(super) fn deviations(&self, observed: &Observation) -> f64 {
        observed.innovation / self.by_slope(observed).1.sqrt()
    }

    /// Covariance of the innovation with each state, and variance of the innovation.
    fn by_slope(&self, observed: &Observation) -> ([f64; STATES], f64) {
        let Observation { slope, variance, .. } = observed;
        let with: [f64; STATES] =
            std::array::from_fn(|i| (0..STATES).map(|j| self.covariance[pair(i, j)] * slope[j]).sum());
        let total = variance + with.iter().zip(slope).map(|(with, slope)| with * slope).sum::<f64>();
        (with, total.max(f64::MIN_POSITIVE))
    }

    /// Updates with a row's mean voltage. Returns true if the cell has changed suddenly, that is, if consecutive rows
    /// contradict the prediction. The states then stay unchanged, and the caller calls [`Self::open`] or exchanges
    /// the filters of two cells.
    pub(super) fn observe(&mut self, observed: &Observation) -> bool {
        let off = self.deviations(observed);
        let is_jump = count_odd(&mut self.odd_rows, off, JUMP);
        if !is_jump {
            self.update(observed, (off.abs() / HUBER).max(1.0));
        }
        is_jump
    }

    pub(super) fn observe_steps(&mut self, observed: &Observation) {
        let off = self.deviations(observed);
        if count_odd(&mut self.odd_steps, off, STEPS_JUMP) {
            self.widen(&RESISTANCE_STD);
            self.update(observed, 1.0);
        } else {
            self.update(observed, (off.abs() / HUBER).max(1.0));
        }
    }

    pub(super) fn open(&mut self, jump: Jump, observed: &Observation) {
        self.widen_as(jump);
        self.update(observed, 1.0);
    }

    pub(super) fn widen_as(&mut self, jump: Jump) {
        self.widen(match jump {
            Jump::Alone => &ALONE_STD,
            Jump::Replaced => &REPLACED_STD,
        });
    }

    /// Updates the states. The innovation variance is multiplied by `beyond`, which limits the weight of an outlier
    /// (Huber).
    fn update(&mut self, observed: &Observation, beyond: f64) {
        let (with, total) = self.by_slope(observed);
        let total = total * beyond;
        for (mean, with) in self.mean.iter_mut().zip(&with) {
            *mean += with / total * observed.innovation;
        }
        for i in 0..STATES {
            for j in i..STATES {
                self.covariance[pair(i, j)] -= with[i] * with[j] / total;
            }
        }
        self.keep_possible();
    }

    /// Keeps the variances positive despite rounding. If a number is impossible, restarts the filter, because the
    /// readings cannot come from a cell.
    fn keep_possible(&mut self) {
        for i in 0..STATES {
            let variance = &mut self.covariance[pair(i, i)];
            *variance = variance.max(1e-12);
        }
        let numbers = self.mean.iter().chain(&self.covariance);
        // The limit is a thousand times larger than any plausible value.
        if !numbers.clone().all(|number| number.abs() <= 1e3) {
            *self = Self::new();
        }
    }

    pub(super) fn is_settled(&self) -> bool {
        self.odd_rows == 0
    }

    pub(super) fn settle(&mut self, mean: &[f64; STATES]) {
        (self.mean, self.odd_rows) = (*mean, 0);
    }

    fn widen(&mut self, added: &[f64; STATES]) {
        for (i, std) in added.iter().enumerate() {
            self.covariance[pair(i, i)] += std * std;
        }
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        InvalidState::unless_numbers(
            "a cell's difference from its pack",
            self.mean.iter().chain(&self.covariance).copied(),
        )?;
        (0..STATES).try_for_each(|i| {
            InvalidState::unless_natural("the variance of a cell's difference", self.covariance[pair(i, i)])
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Simulates days of driving and rest for a cell with the differences `truth` and a voltage channel without noise.
    /// Returns the filter afterwards.
    fn watched(truth: [f64; STATES], days: usize) -> Difference {
        let (mut filter, mut charge, mut soc) = (Difference::new(), truth[SOC], 0.8);
        for row in 0..days * 60 {
            let change = match row % 60 {
                0..30 => -0.02,
                30..40 => 0.06,
                _ => 0.0,
            };
            let (passed_days, current) = (if change == 0.0 { 1.0 / 30.0 } else { 1.0 / 120.0 }, -change);
            soc += change;
            charge += (1.0 / (1.0 + truth[CAPACITY]) - 1.0) * change - truth[LEAK] * passed_days;
            filter.pass(passed_days, change);
            // The slope of the open-circuit curve depends on the SOC, and a part of the voltage drop is slow.
            let slope_v = 0.4 + 12.0 * (soc - 0.5) * (soc - 0.5);
            let drop_v = 3.0 * current + if row % 2 == 0 { 0.02 } else { 0.0 };
            let slope = [slope_v, 0.0, -drop_v, -1.5 * current, 1.0, 0.0];
            let states = [charge, truth[CAPACITY], truth[RESISTANCE], truth[CONTACT], truth[CHANNEL], truth[LEAK]];
            let differs: f64 = slope.iter().zip(&states).zip(filter.mean()).map(|((s, x), m)| s * (x - m)).sum();
            filter.observe(&Observation { innovation: differs, slope, variance: 4e-6 });
        }
        filter
    }

    #[test]
    fn each_state_is_found_without_the_others() {
        let faults = [(CAPACITY, -0.1), (RESISTANCE, 0.2), (CONTACT, 0.2), (CHANNEL, 0.03), (LEAK, 0.002)];
        for (state, size) in faults {
            let mut truth = [0.0; STATES];
            truth[state] = size;
            let filter = watched(truth, 14);
            for (other, expected) in truth.iter().enumerate().skip(1) {
                let found = filter.state(other);
                let off = (found.mean - expected).abs();
                assert!(off < 3.0 * found.std() + 1e-9, "{state}: state {other} is {found:?}, not {expected}");
            }
            assert!((filter.state(state).mean / size - 1.0).abs() < 0.15, "{state}: {:?}", filter.state(state));
        }
    }

    #[test]
    fn impossible_readings_leave_a_valid_filter() {
        let slopes = [[1e9; STATES], [0.0; STATES], [f64::NAN; STATES], [1e-30, 1.0, -1e12, 3.0, 1.0, f64::INFINITY]];
        for (slope, innovation) in slopes.into_iter().flat_map(|slope| [1e300, -1e9, f64::NAN, 0.0].map(|v| (slope, v)))
        {
            let mut filter = watched([0.0; STATES], 1);
            for _ in 0..5 {
                let observed = Observation { innovation, slope, variance: 1e-300 };
                filter.open_charge(1e5, &observed);
                if filter.observe(&observed) {
                    filter.open(Jump::Replaced, &observed);
                }
                filter.forget_leak();
                filter.pass(1e5, 1e3);
                filter.watch_leak();
                assert_eq!(filter.check(), Ok(()), "{innovation} by {slope:?}");
            }
        }
    }

    #[test]
    fn sudden_change_is_reported_once_and_followed() {
        let mut filter = watched([0.0; STATES], 5);
        let row = |filter: &Difference| Observation {
            innovation: 0.03 - filter.mean()[SOC] - filter.mean()[CHANNEL],
            slope: [1.0, 0.0, -0.05, -0.02, 1.0, 0.0],
            variance: 4e-6,
        };
        let jumps: Vec<bool> = (0..20)
            .map(|_| {
                let observed = row(&filter);
                filter.pass(0.003, 0.0);
                let is_jump = filter.observe(&observed);
                if is_jump {
                    filter.open(Jump::Alone, &observed);
                }
                is_jump
            })
            .collect();
        assert_eq!(jumps.iter().filter(|jumped| **jumped).count(), 1);
        assert!(jumps[2], "the third row reports the jump");
        assert!(row(&filter).innovation.abs() < 0.003, "{:?}", row(&filter));
    }
}
