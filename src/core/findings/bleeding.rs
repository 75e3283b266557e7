//! For how long one cell was bled, by the bits of its BMS.
//!
//! In: bits with their time and how long each holds, s; whether the buses slept; ends of rows. Out: the time bled between the
//! middles of two rows, s, with its variance, and whether the bit is known. A row shows the charge of its middle, so half of what was
//! bled in it belongs to the next one.
//!
//! Behind the time for which a bit holds nothing is known: the cell was bled for any part of it. While the buses sleep a BMS continues,
//! also when a short drive came between: a cell that is bled when they wake was bled all the time, one whose bit was 1 some time
//! before they slept was bled for any part. Another one was probably not: a BMS may begin with it when the voltages settle (`take_unseen`).

use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp};

/// Variance of a part that may be anything from nothing to all.
const UNIFORM: f64 = 1.0 / 12.0;

/// Time after a bit of 1 in which a BMS that sleeps bleeds the cell again, s: a drive home from the charger.
const CONTINUED_S: f64 = 7200.0;

/// A time for which a cell was bled.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BledTime {
    /// Mean, s.
    pub(super) seconds: f64,
    /// Variance, s^2.
    pub(super) variance_s2: f64,
}

impl BledTime {
    fn add(&mut self, other: Self) {
        self.seconds += other.seconds;
        self.variance_s2 += other.variance_s2;
    }

    fn half(self) -> Self {
        Self { seconds: 0.5 * self.seconds, variance_s2: 0.25 * self.variance_s2 }
    }
}

/// The latest bit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Bit {
    is_bled: bool,
    holds_until: Timestamp,
    counted_until: Timestamp,
}

/// What the bits show of one cell.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Bleeding {
    bit: Option<Bit>,
    /// Time of the latest bit that was 1.
    last_on: Option<Timestamp>,
    /// Whether the buses have slept since the latest bit.
    has_slept: bool,
    /// Whether the bit was known at the end of the last row.
    pub(super) is_known: bool,
    /// Bled since the middle of the last row, before the present row and in it.
    before: BledTime,
    row: BledTime,
    /// Variance of what was bled asleep without a bit of 1 before or after, s^2.
    unseen_s2: f64,
}

impl Bleeding {
    /// Takes a bit that holds until another time. `sampled`: the latest sample of the pack.
    pub(super) fn take(&mut self, time: Timestamp, is_bled: bool, holds_until: Timestamp, sampled: Option<Timestamp>) {
        self.note_sleep(sampled);
        self.count(time, is_bled);
        if is_bled {
            self.last_on = Some(time);
        }
        let counted_until = self.bit.map_or(time, |bit| bit.counted_until.max(time));
        self.bit = Some(Bit { is_bled, holds_until, counted_until });
        self.has_slept = false;
    }

    /// Takes the latest sample of the pack: with none behind the time for which the bit holds, the buses sleep.
    pub(super) fn note_sleep(&mut self, sampled: Option<Timestamp>) {
        self.has_slept |= self.bit.is_some_and(|bit| sampled.is_none_or(|sampled| sampled <= bit.holds_until));
    }

    /// Counts the time bled up to `now`. `is_bled`: whether it is certainly bled now.
    fn count(&mut self, now: Timestamp, is_bled: bool) {
        let Some(bit) = &mut self.bit else { return };
        let known_s = now.min(bit.holds_until).since(bit.counted_until).max(0.0);
        if bit.is_bled {
            self.row.seconds += known_s;
        }
        let unknown_s = now.since(bit.holds_until.max(bit.counted_until)).max(0.0);
        let any_part = BledTime { seconds: 0.5 * unknown_s, variance_s2: UNIFORM * unknown_s * unknown_s };
        let was_on = self.last_on.is_some_and(|on| bit.holds_until.since(on) <= CONTINUED_S);
        match (self.has_slept, is_bled) {
            (true, true) => self.before.seconds += unknown_s,
            (true, false) if was_on => self.before.add(any_part),
            (true, false) => self.unseen_s2 += any_part.variance_s2,
            (false, _) => self.row.add(any_part),
        }
        bit.counted_until = bit.counted_until.max(now);
    }

    /// Ends a row: the time bled since the middle of the row before.
    pub(super) fn end_row(&mut self, now: Timestamp) -> BledTime {
        self.count(now, false);
        self.is_known = self.bit.is_some_and(|bit| bit.holds_until >= now);
        let half = self.row.half();
        let mut bled = std::mem::replace(&mut self.before, half);
        bled.add(half);
        self.row = BledTime::default();
        bled
    }

    /// Variance of the time for which the cell was bled asleep without any sign since this was last asked, s^2.
    pub(super) fn take_unseen(&mut self) -> f64 {
        std::mem::take(&mut self.unseen_s2)
    }

    /// The present row begins again.
    pub(super) fn interrupt(&mut self) {
        let row = std::mem::take(&mut self.row);
        self.before.add(row);
    }

    /// Moves every stamp by `by_nanos`, onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        self.last_on = self.last_on.map(|on| on.plus_nanos(by_nanos));
        if let Some(bit) = &mut self.bit {
            bit.holds_until = bit.holds_until.plus_nanos(by_nanos);
            bit.counted_until = bit.counted_until.plus_nanos(by_nanos);
        }
    }

    /// Checks the numbers of a stored state.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let Self { before, row, unseen_s2, .. } = *self;
        [before.seconds, before.variance_s2, row.seconds, row.variance_s2, unseen_s2]
            .into_iter()
            .try_for_each(|number| InvalidState::unless_natural("the time for which a cell was bled", number))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AGE_S: f64 = 10.0;

    fn is_near(a: BledTime, b: BledTime) -> bool {
        (a.seconds - b.seconds).abs() < 1e-6 && (a.variance_s2 - b.variance_s2).abs() < 1e-6
    }

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_secs(seconds)
    }

    fn take(bleeding: &mut Bleeding, seconds: f64, is_bled: bool, sampled_s: f64) {
        bleeding.take(at(seconds), is_bled, at(seconds + AGE_S), Some(at(sampled_s)));
    }

    #[test]
    fn the_time_with_bit_1_is_bled_half_before_the_middle_of_the_row() {
        let mut bleeding = Bleeding::default();
        (0..100).for_each(|second| take(&mut bleeding, f64::from(second), second >= 40, f64::from(second)));
        let first = bleeding.end_row(at(100.0));
        let rest = bleeding.end_row(at(100.0));
        assert_eq!((first.seconds, rest.seconds), (30.0, 30.0));
        assert_eq!((first.variance_s2, rest.variance_s2), (0.0, 0.0));
        assert!(bleeding.is_known);
    }

    #[test]
    fn asleep_a_cell_is_bled_by_its_bits_before_and_after() {
        let any_part = BledTime { seconds: 500.0, variance_s2: 1000.0 * 1000.0 / 12.0 };
        let nothing = BledTime::default();
        let all = BledTime { seconds: 1000.0, variance_s2: 0.0 };
        for (on_s, is_on_after, expected) in [
            (Some(0.0), false, any_part),
            (Some(0.0), true, all),
            (None, false, nothing),
            (Some(-CONTINUED_S - 100.0), false, nothing),
        ] {
            for is_sample_first in [false, true] {
                let mut bleeding = Bleeding::default();
                if let Some(on_s) = on_s {
                    take(&mut bleeding, on_s, true, on_s);
                }
                take(&mut bleeding, 0.0, false, 0.0);
                bleeding.end_row(at(0.0));
                bleeding.end_row(at(0.0));
                if is_sample_first {
                    bleeding.note_sleep(Some(at(0.0)));
                }
                take(&mut bleeding, 10.0 + 1000.0, is_on_after, if is_sample_first { 1010.0 } else { 0.0 });
                let bled = bleeding.end_row(at(1010.0));
                assert!(is_near(bled, expected), "{on_s:?} {is_on_after} {is_sample_first}: {bled:?}");
            }
        }
    }

    #[test]
    fn a_bit_that_does_not_come_while_others_do_is_unknown() {
        let mut bleeding = Bleeding::default();
        assert!(bleeding.end_row(at(0.0)).seconds == 0.0 && !bleeding.is_known, "none came");
        take(&mut bleeding, 0.0, false, 0.0);
        let bled = bleeding.end_row(at(110.0));
        assert!(!bleeding.is_known);
        assert!(is_near(bled, BledTime { seconds: 25.0, variance_s2: 0.25 * 100.0 * 100.0 / 12.0 }), "{bled:?}");
        take(&mut bleeding, 111.0, false, 111.0);
        bleeding.end_row(at(112.0));
        assert!(bleeding.is_known);
    }

    #[test]
    fn impossible_times_are_refused() {
        for seconds in [-1.0, f64::NAN, f64::INFINITY] {
            let row = BledTime { seconds, variance_s2: 0.0 };
            assert!(Bleeding { row, ..Bleeding::default() }.check().is_err(), "{seconds}");
        }
    }
}
