//! For how long one cell was bled, by the bits of its BMS.
//!
//! In: bits with their time and how long each holds; beginnings and ends of rows. Out: the time bled between the middles of two
//! rows, s, and the time of which no bit says whether it was. A row shows the charge of its middle, so half of what was bled in it
//! belongs to the next one; what was bled between two rows, while the buses slept, belongs to the later one.

use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp};

/// What the bits of a BMS mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BalancingBits {
    /// Current that a balancing resistor takes out of one cell, A.
    pub bleed_a: f64,
    /// Longest time for which a bit holds, s.
    pub max_age_s: f64,
    /// No cell is bled while no bits come. Otherwise nothing is known of that time.
    pub is_only_while_sent: bool,
}

/// A time, by whether the cell was bled in it, s.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BledTime {
    pub(super) bled_s: f64,
    pub(super) unknown_s: f64,
}

impl BledTime {
    fn plus(self, other: Self) -> Self {
        Self { bled_s: self.bled_s + other.bled_s, unknown_s: self.unknown_s + other.unknown_s }
    }

    fn half(self) -> Self {
        Self { bled_s: 0.5 * self.bled_s, unknown_s: 0.5 * self.unknown_s }
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
    /// Since the middle of the last row, up to the present row, and in it.
    before: BledTime,
    row: BledTime,
}

impl Bleeding {
    /// Whether a bit has come so far.
    pub(super) fn has_bits(&self) -> bool {
        self.bit.is_some()
    }

    /// Takes a bit that holds until another time, or the next bit.
    pub(super) fn take(&mut self, time: Timestamp, is_bled: bool, holds_until: Timestamp) {
        self.count(time);
        let counted_until = self.bit.map_or(time, |bit| bit.counted_until);
        self.bit = Some(Bit { is_bled, holds_until, counted_until });
    }

    /// Counts the time up to `now`.
    fn count(&mut self, now: Timestamp) {
        let Some(bit) = &mut self.bit else { return };
        let known_s = now.min(bit.holds_until).since(bit.counted_until).max(0.0);
        if bit.is_bled {
            self.row.bled_s += known_s;
        }
        self.row.unknown_s += now.since(bit.holds_until.max(bit.counted_until)).max(0.0);
        bit.counted_until = bit.counted_until.max(now);
    }

    /// A row begins, or begins again.
    pub(super) fn begin_row(&mut self, now: Timestamp) {
        self.count(now);
        self.before = self.before.plus(std::mem::take(&mut self.row));
    }

    /// Ends a row: the time since the middle of the row before.
    pub(super) fn end_row(&mut self, now: Timestamp) -> BledTime {
        self.count(now);
        let half = std::mem::take(&mut self.row).half();
        std::mem::replace(&mut self.before, half).plus(half)
    }

    /// Moves every stamp by `by_nanos`, onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        if let Some(bit) = &mut self.bit {
            bit.holds_until = bit.holds_until.plus_nanos(by_nanos);
            bit.counted_until = bit.counted_until.plus_nanos(by_nanos);
        }
    }

    /// Checks the numbers of a stored state.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        [self.before, self.row]
            .into_iter()
            .flat_map(|time| [time.bled_s, time.unknown_s])
            .try_for_each(|number| InvalidState::unless_natural("the time for which a cell was bled", number))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AGE_S: f64 = 10.0;

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_secs(seconds)
    }

    fn take(bleeding: &mut Bleeding, seconds: f64, is_bled: bool) {
        bleeding.take(at(seconds), is_bled, at(seconds + AGE_S));
    }

    #[test]
    fn half_of_what_is_bled_in_a_row_belongs_to_the_next() {
        let mut bleeding = Bleeding::default();
        (0..100).for_each(|second| take(&mut bleeding, f64::from(second), second >= 40));
        assert_eq!(bleeding.end_row(at(100.0)), BledTime { bled_s: 30.0, unknown_s: 0.0 });
        bleeding.begin_row(at(100.0));
        assert_eq!(bleeding.end_row(at(100.0)), BledTime { bled_s: 30.0, unknown_s: 0.0 });
        assert_eq!(bleeding.end_row(at(100.0)), BledTime::default());
    }

    #[test]
    fn what_is_bled_between_two_rows_belongs_to_the_later() {
        let mut bleeding = Bleeding::default();
        take(&mut bleeding, 0.0, false);
        bleeding.end_row(at(0.0));
        (10..=50).for_each(|second| take(&mut bleeding, f64::from(second), true));
        take(&mut bleeding, 50.0, false);
        bleeding.begin_row(at(1000.0));
        assert_eq!(bleeding.end_row(at(1000.0)), BledTime { bled_s: 40.0, unknown_s: 940.0 });
    }

    #[test]
    fn nothing_is_known_behind_the_time_for_which_a_bit_holds() {
        let mut bleeding = Bleeding::default();
        bleeding.begin_row(at(0.0));
        assert!(bleeding.end_row(at(50.0)) == BledTime::default() && !bleeding.has_bits(), "none came");
        take(&mut bleeding, 50.0, true);
        bleeding.begin_row(at(110.0));
        assert_eq!(bleeding.end_row(at(110.0)), BledTime { bled_s: 10.0, unknown_s: 50.0 });
        take(&mut bleeding, 90.0, true);
        assert_eq!(bleeding.end_row(at(110.0)), BledTime::default(), "counted twice");
    }

    #[test]
    fn impossible_times_are_refused() {
        for bled_s in [-1.0, f64::NAN, f64::INFINITY] {
            let row = BledTime { bled_s, unknown_s: 0.0 };
            assert!(Bleeding { row, ..Bleeding::default() }.check().is_err(), "{bled_s}");
        }
    }
}
