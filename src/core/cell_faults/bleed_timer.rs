//! Measures for how long the BMS bled one cell, from its balancing bits.
//!
//! In: bits with their time and how long each holds; beginnings and ends of rows. Out: of the time between the middles of two rows,
//! how long the cell was bled, how long nothing is known of that, and how long no bits came. A row shows the charge of its middle, so
//! half of what was bled in it belongs to the next one; what was bled between two rows, while the buses slept, belongs to the later one.

use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp};

/// What the bits of a BMS mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BalancingConfig {
    /// Current that a balancing resistor takes out of one cell, A.
    pub bleed_a: f64,
    /// Longest time for which a bit holds, s.
    pub max_age_s: f64,
    /// No cell is bled while no bits come. Otherwise nothing is known of that time.
    pub is_only_while_sent: bool,
}

/// A time, divided by what the bits say, s.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BleedTime {
    /// The cell was bled.
    pub(super) bled_s: f64,
    /// A bit came that cannot be read.
    pub(super) unknown_s: f64,
    /// No bit came.
    pub(super) silent_s: f64,
}

impl BleedTime {
    fn plus(self, other: Self) -> Self {
        Self {
            bled_s: self.bled_s + other.bled_s,
            unknown_s: self.unknown_s + other.unknown_s,
            silent_s: self.silent_s + other.silent_s,
        }
    }

    fn half(self) -> Self {
        Self { bled_s: 0.5 * self.bled_s, unknown_s: 0.5 * self.unknown_s, silent_s: 0.5 * self.silent_s }
    }
}

/// The latest bit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Bit {
    /// `None` = it could not be read.
    is_bled: Option<bool>,
    holds_until: Timestamp,
}

/// The time of one cell since the middle of the last row.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BleedTimer {
    /// A bit that could be read has come so far.
    pub(super) has_bits: bool,
    bit: Option<Bit>,
    counted_until: Option<Timestamp>,
    /// From the middle of the last row to the present row, s.
    before: BleedTime,
    /// In the present row, s.
    row: BleedTime,
}

impl BleedTimer {
    /// Takes a bit that holds until another time, or the next bit; `None` = it cannot be read.
    pub(super) fn take(&mut self, time: Timestamp, is_bled: Option<bool>, holds_until: Timestamp) {
        self.count(time);
        self.counted_until.get_or_insert(time);
        self.has_bits |= is_bled.is_some();
        self.bit = Some(Bit { is_bled, holds_until });
    }

    /// Takes that nothing was received from a time to another: the daemon did not run.
    pub(super) fn note_unheard(&mut self, from: Timestamp, to: Timestamp) {
        if self.has_bits {
            self.take(from, None, to);
        }
    }

    /// Counts the time up to `now`; nothing before the first bit.
    fn count(&mut self, now: Timestamp) {
        if !self.has_bits && self.bit.is_none() {
            return;
        }
        let from = *self.counted_until.get_or_insert(now);
        let held_until = self.bit.map_or(from, |bit| bit.holds_until).max(from).min(now);
        let held_s = held_until.since(from).max(0.0);
        match self.bit.and_then(|bit| bit.is_bled) {
            Some(true) => self.row.bled_s += held_s,
            Some(false) => {}
            None => self.row.unknown_s += held_s,
        }
        self.row.silent_s += now.since(held_until.max(from)).max(0.0);
        self.counted_until = Some(from.max(now));
    }

    /// A row begins, or begins again.
    pub(super) fn begin_row(&mut self, now: Timestamp) {
        self.count(now);
        self.before = self.before.plus(std::mem::take(&mut self.row));
    }

    /// Ends a row: the time since the middle of the row before.
    pub(super) fn end_row(&mut self, now: Timestamp) -> BleedTime {
        self.count(now);
        let half = std::mem::take(&mut self.row).half();
        std::mem::replace(&mut self.before, half).plus(half)
    }

    /// The time so far does not count.
    pub(super) fn forget_time(&mut self) {
        *self = Self { has_bits: self.has_bits, ..Self::default() };
    }

    /// Moves every stamp by `by_nanos`, onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        self.counted_until = self.counted_until.map(|until| until.plus_nanos(by_nanos));
        self.bit = self.bit.map(|bit| Bit { holds_until: bit.holds_until.plus_nanos(by_nanos), ..bit });
    }

    /// Checks the numbers of a stored state.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let seconds = [self.before, self.row].into_iter().flat_map(|it| [it.bled_s, it.unknown_s, it.silent_s]);
        InvalidState::unless_naturals("the time for which a cell was bled", seconds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AGE_S: f64 = 10.0;

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_secs(seconds)
    }

    fn take(timer: &mut BleedTimer, seconds: f64, is_bled: impl Into<Option<bool>>) {
        timer.take(at(seconds), is_bled.into(), at(seconds + AGE_S));
    }

    fn assert_near(found: BleedTime, wanted: BleedTime) {
        let all = |it: BleedTime| [it.bled_s, it.unknown_s, it.silent_s];
        assert!(all(found).iter().zip(all(wanted)).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}, not {wanted:?}");
    }

    fn bled(bled_s: f64) -> BleedTime {
        BleedTime { bled_s, ..BleedTime::default() }
    }

    #[test]
    fn half_of_what_is_bled_in_a_row_belongs_to_the_next() {
        let mut timer = BleedTimer::default();
        (0..100).for_each(|second| take(&mut timer, f64::from(second), second >= 40));
        assert_near(timer.end_row(at(100.0)), bled(30.0));
        timer.begin_row(at(100.0));
        assert_near(timer.end_row(at(100.0)), bled(30.0));
        assert_near(timer.end_row(at(100.0)), bled(0.0));
    }

    #[test]
    fn what_is_bled_between_two_rows_belongs_to_the_later() {
        let mut timer = BleedTimer::default();
        take(&mut timer, 0.0, false);
        timer.end_row(at(0.0));
        (10..=50).for_each(|second| take(&mut timer, f64::from(second), true));
        take(&mut timer, 50.0, false);
        timer.rebase(7_000_000_000);
        timer.begin_row(at(1007.0));
        assert_near(timer.end_row(at(1007.0)), BleedTime { silent_s: 940.0, ..bled(40.0) });
    }

    #[test]
    fn nothing_is_known_behind_the_time_for_which_a_bit_holds_and_of_one_that_cannot_be_read() {
        let mut timer = BleedTimer::default();
        timer.begin_row(at(0.0));
        assert_near(timer.end_row(at(50.0)), bled(0.0));
        assert_eq!(timer, BleedTimer::default(), "none came");
        take(&mut timer, 50.0, true);
        timer.begin_row(at(110.0));
        assert_near(timer.end_row(at(110.0)), BleedTime { silent_s: 50.0, ..bled(10.0) });
        take(&mut timer, 90.0, true);
        assert_near(timer.end_row(at(110.0)), bled(0.0));
        take(&mut timer, 110.0, None);
        timer.begin_row(at(125.0));
        assert_near(timer.end_row(at(125.0)), BleedTime { unknown_s: 10.0, silent_s: 5.0, ..bled(0.0) });
        timer.forget_time();
        assert_near(timer.end_row(at(200.0)), bled(0.0));
        assert!(timer.has_bits);
    }

    #[test]
    fn impossible_times_are_refused() {
        for seconds in [-1.0, f64::NAN, f64::INFINITY] {
            let timers = [bled(seconds), BleedTime { silent_s: seconds, ..bled(0.0) }];
            assert!(timers.iter().all(|row| BleedTimer { row: *row, ..BleedTimer::default() }.check().is_err()));
        }
    }
}
