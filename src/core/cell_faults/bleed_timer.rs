//! Measures from the balancing bits how long the BMS bled one cell, that is, discharged it through a balancing
//! resistor.
//!
//! In: balancing bits with their expiry, and the starts and ends of rows (a few minutes of samples each). Out: for
//! the time from the middle of one row to the middle of the next, a [`BleedTime`].
//!
//! A row gives the charge of the cell at the middle of the row, so half of the row's bleed time counts in the next row.
//! Bleed time between two rows, while the buses sleep, counts in the later row.

use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp};

/// Meaning of a BMS's balancing bits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BalancingConfig {
    /// Current through the balancing resistor of one cell (A).
    pub bleed_a: f64,
    /// Time after which a bit expires (s).
    pub max_age_s: f64,
    /// Whether the BMS bleeds cells only while it sends bits. If false, it may also bleed cells while it sends no
    /// bits.
    pub is_only_while_sent: bool,
}

/// Times within a period (s): the cell was bled, the latest bit could not be read, or no bit was valid. For the rest
/// of the period, the cell was not bled.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BleedTime {
    pub(super) bled_s: f64,
    pub(super) unknown_s: f64,
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

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Bit {
    /// Value of the bit; `None` if it could not be read.
    is_bled: Option<bool>,
    holds_until: Timestamp,
}

/// Bleed time of one cell since the middle of the last row.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BleedTimer {
    /// Whether a readable bit has been received.
    pub(super) has_bits: bool,
    bit: Option<Bit>,
    counted_until: Option<Timestamp>,
    /// Bleed time from the middle of the last row to the start of the current row (s).
    before: BleedTime,
    row: BleedTime,
}

impl BleedTimer {
    /// Handles a balancing bit. The bit is valid until `holds_until` or until the next bit. `is_bled` is `None` if the
    /// bit cannot be read.
    pub(super) fn take(&mut self, time: Timestamp, is_bled: Option<bool>, holds_until: Timestamp) {
        self.count(time);
        self.counted_until.get_or_insert(time);
        self.has_bits |= is_bled.is_some();
        self.bit = Some(Bit { is_bled, holds_until });
    }

    /// Handles a period in which the daemon did not run.
    pub(super) fn note_missed_bits(&mut self, from: Timestamp, to: Timestamp) {
        if self.has_bits {
            self.take(from, None, to);
        }
    }

    /// Adds the time up to `now` to the counters. Time before the first bit does not count.
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

    /// Starts a row; if a row has already started, restarts it.
    pub(super) fn begin_row(&mut self, now: Timestamp) {
        self.count(now);
        self.before = self.before.plus(std::mem::take(&mut self.row));
    }

    /// Ends a row. Returns the bleed time since the middle of the previous row.
    pub(super) fn end_row(&mut self, now: Timestamp) -> BleedTime {
        self.count(now);
        let half = std::mem::take(&mut self.row).half();
        std::mem::replace(&mut self.before, half).plus(half)
    }

    pub(super) fn forget_time(&mut self) {
        *self = Self { has_bits: self.has_bits, ..Self::default() };
    }

    pub(super) fn rebase(&mut self, by_nanos: i64) {
        self.counted_until = self.counted_until.map(|until| until.plus_nanos(by_nanos));
        self.bit = self.bit.map(|bit| Bit { holds_until: bit.holds_until.plus_nanos(by_nanos), ..bit });
    }

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
    fn half_of_bleed_time_counts_in_next_row() {
        let mut timer = BleedTimer::default();
        (0..100).for_each(|second| take(&mut timer, f64::from(second), second >= 40));
        assert_near(timer.end_row(at(100.0)), bled(30.0));
        timer.begin_row(at(100.0));
        assert_near(timer.end_row(at(100.0)), bled(30.0));
        assert_near(timer.end_row(at(100.0)), bled(0.0));
    }

    #[test]
    fn bleed_time_between_rows_counts_in_later_row() {
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
    fn expired_and_unreadable_bits_count_as_unknown() {
        let mut timer = BleedTimer::default();
        timer.begin_row(at(0.0));
        assert_near(timer.end_row(at(50.0)), bled(0.0));
        assert_eq!(timer, BleedTimer::default(), "no bit was received");
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
    fn impossible_stored_times_are_rejected() {
        for seconds in [-1.0, f64::NAN, f64::INFINITY] {
            let timers = [bled(seconds), BleedTime { silent_s: seconds, ..bled(0.0) }];
            assert!(timers.iter().all(|row| BleedTimer { row: *row, ..BleedTimer::default() }.check().is_err()));
        }
    }
}
