//! Counts the charge through the pack and the time without a current measurement.
//!
//! In: good current readings (A), positive = discharge. Out: cumulative charge (As) and cumulative unmeasured time (s);
//! only their differences are meaningful. `max_age_s` is the maximum age of a usable reading. An interval between two
//! current readings counts as follows:
//! * At most `max_age_s`: the charge is the mean of the two readings times the elapsed time (trapezoid).
//! * Longer than `max_age_s`: the first reading is held for `max_age_s`. The rest of the interval is unmeasured,
//!   regardless of the cause (bad readings, lost frames, sleep, a restart).
//! * Longer than `max_age_s`, but at most [`SHORT_GAP`] times as long: the trapezoid replaces the held charge, because
//!   a steady load is likely. The rest still counts as unmeasured, so the SOC becomes more uncertain.
//!
//! After the latest reading, the current is also held for `max_age_s`. While a valid reading says that the contactors
//! are open, the current counts as zero, regardless of the current sensor. Unmeasured time never decreases and never
//! grows faster than time. Before the first current reading, all time is unmeasured.

use serde::{Deserialize, Serialize};

use crate::quantity::bounds;
use crate::quantity::{InvalidState, Timestamp};

/// In intervals up to this multiple of `max_age_s`, the mean of both readings is the most likely current.
const SHORT_GAP: f64 = 4.0;

/// Cumulative charge and unmeasured time at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ChargeTotals {
    /// Charge taken out of the pack.
    pub charge_as: f64,
    /// Time in which the reading was not exactly zero and therefore included the sensor's offset.
    pub offset_s: f64,
    /// Time without a usable current.
    pub unmeasured_s: f64,
    /// Time in which current flowed, in either direction.
    pub(super) flowing_s: f64,
    pub(super) discharging_s: f64,
}

/// Totals up to `counted_to`, and the current afterwards.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct ChargeCounter {
    totals: ChargeTotals,
    /// `None` = no input yet.
    counted_to: Option<Timestamp>,
    /// `None` = unmeasured.
    current_a: Option<f64>,
    /// `None` = the contactors are closed, or their state is unknown.
    open_until: Option<Timestamp>,
}

impl ChargeCounter {
    /// Starts the clock at the first input of any kind.
    pub(super) fn begin(&mut self, time: Timestamp) {
        self.counted_to.get_or_insert(time);
    }

    /// Handles a good reading. `flow_a` is the smallest current that counts as flowing.
    pub(super) fn handle_current(&mut self, time: Timestamp, current_a: f64, max_age_s: f64, flow_a: f64) {
        let dt_s = self.passed_s(time);
        match self.current_a {
            Some(last_a) if dt_s <= self.hold_s(max_age_s) => {
                self.totals.add((last_a + current_a) / 2.0, dt_s, flow_a);
                self.totals.offset_s += dt_s * (offset_part(last_a) + offset_part(current_a)) / 2.0;
            }
            Some(last_a) if dt_s <= SHORT_GAP * max_age_s && self.open_until.is_none() => {
                let before_as = self.totals.charge_as;
                self.totals = self.totals_at(time, max_age_s);
                self.totals.charge_as = before_as + (last_a + current_a) / 2.0 * dt_s;
            }
            _ => self.totals = self.totals_at(time, max_age_s),
        }
        self.counted_to = Some(self.counted_to.map_or(time, |last| last.max(time)));
        self.current_a = Some(current_a);
    }

    /// Totals at `time`. Holds the latest reading for at most `max_age_s`.
    #[inline]
    pub(super) fn totals_at(&self, time: Timestamp, max_age_s: f64) -> ChargeTotals {
        let dt_s = self.passed_s(time);
        let mut totals = self.totals;
        let held_s = self.current_a.map_or(0.0, |_| dt_s.min(self.hold_s(max_age_s)));
        totals.charge_as += self.current_a.unwrap_or(0.0) * held_s;
        totals.offset_s += offset_part(self.current_a.unwrap_or(0.0)) * held_s;
        totals.unmeasured_s += dt_s - held_s;
        totals
    }

    /// Handles a gap of unknown length: totals are final up to `latest` and continue at `time`.
    pub(super) fn handle_gap(&mut self, latest: Timestamp, time: Timestamp, max_age_s: f64) {
        self.totals = self.totals_at(latest, max_age_s);
        self.counted_to = Some(time);
        (self.current_a, self.open_until) = (None, None);
    }

    /// Whether open contactors keep the current at zero at `now`.
    #[inline]
    pub(super) fn is_open(&self, now: Timestamp) -> bool {
        self.open_until.is_some_and(|until| now <= until)
    }

    /// Notes that the contactors are open: no current flows from `time` to `until`, unless the contactors close
    /// earlier.
    pub(super) fn open(&mut self, time: Timestamp, until: Timestamp, max_age_s: f64) {
        self.hold(time, Some(0.0), max_age_s);
        self.open_until = Some(until);
    }

    /// If the contactors were open, the current is `measured_a` from `time` on.
    pub(super) fn close(&mut self, time: Timestamp, measured_a: Option<f64>, max_age_s: f64) {
        if self.open_until.is_some() {
            self.hold(time, measured_a, max_age_s);
            self.open_until = None;
        }
    }

    /// Makes the totals final up to `time`, and then holds `current_a`.
    fn hold(&mut self, time: Timestamp, current_a: Option<f64>, max_age_s: f64) {
        self.totals = self.totals_at(time, max_age_s);
        self.counted_to = Some(self.counted_to.map_or(time, |last| last.max(time)));
        self.current_a = current_a;
    }

    /// Longest time for which the present current is held: `max_age_s`, or longer while the contactors are open.
    #[inline]
    fn hold_s(&self, max_age_s: f64) -> f64 {
        match (self.open_until, self.counted_to) {
            (Some(until), Some(from)) => until.since(from).max(max_age_s),
            _ => max_age_s,
        }
    }

    pub(super) fn forget_contactors(&mut self) {
        self.open_until = None;
    }

    pub(super) fn rebase(&mut self, by_nanos: i64) {
        for stamp in [&mut self.counted_to, &mut self.open_until].into_iter().flatten() {
            *stamp = stamp.plus_nanos(by_nanos);
        }
    }

    /// Returns the first impossible number.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let ChargeTotals { charge_as, offset_s, unmeasured_s, flowing_s, discharging_s } = self.totals;
        bounds::CHARGE_AS.check("the counted charge", charge_as)?;
        bounds::CURRENT_A.check_all("the current of the charge counter", self.current_a)?;
        bounds::TIME_S.check_all("the times of the charge counter", [offset_s, unmeasured_s, flowing_s, discharging_s])
    }

    fn passed_s(&self, time: Timestamp) -> f64 {
        self.counted_to.map_or(0.0, |from| time.since(from).max(0.0))
    }
}

/// 1 if the reading includes the sensor's offset, else 0. Only a reading of exactly zero does not include the offset.
fn offset_part(current_a: f64) -> f64 {
    if current_a == 0.0 { 0.0 } else { 1.0 }
}

impl ChargeTotals {
    fn add(&mut self, current_a: f64, dt_s: f64, flow_a: f64) {
        self.charge_as += current_a * dt_s;
        if current_a.abs() >= flow_a {
            self.flowing_s += dt_s;
        }
        if current_a >= flow_a {
            self.discharging_s += dt_s;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_secs(seconds)
    }

    fn counter(readings: &[(f64, f64)]) -> ChargeCounter {
        let mut counter = ChargeCounter::default();
        for &(time, current) in readings {
            counter.handle_current(at(time), current, 2.0, 0.1);
        }
        counter
    }

    fn charge_and_gap(counter: &ChargeCounter, time: f64) -> (f64, f64) {
        let totals = counter.totals_at(at(time), 2.0);
        (totals.charge_as, totals.unmeasured_s)
    }

    #[test]
    fn ramp_integrates_exactly_with_uneven_steps() {
        // The current equals the time, so the charge is t^2 / 2.
        let counter = counter(&[(0.0, 0.0), (0.5, 0.5), (2.5, 2.5), (2.75, 2.75), (4.0, 4.0)]);
        assert_eq!(charge_and_gap(&counter, 4.0), (8.0, 0.0));
    }

    #[test]
    fn next_reading_replaces_hold_by_trapezoid() {
        let mut counter = counter(&[(0.0, 1.0)]);
        assert_eq!(charge_and_gap(&counter, 1.0), (1.0, 0.0));
        counter.handle_current(at(2.0), 3.0, 2.0, 0.1);
        assert_eq!(charge_and_gap(&counter, 2.0), (4.0, 0.0));
    }

    #[test]
    fn short_hole_counts_as_unmeasured_trapezoid() {
        let mut counter = counter(&[(0.0, 1.0)]);
        counter.handle_current(at(6.0), 3.0, 2.0, 0.1);
        assert_eq!(charge_and_gap(&counter, 6.0), (12.0, 4.0));
    }

    #[test]
    fn hole_is_held_for_age_limit_then_unmeasured() {
        let mut counter = counter(&[(0.0, 1.0)]);
        assert_eq!(charge_and_gap(&counter, 10.0), (2.0, 8.0));
        counter.handle_current(at(10.0), 50.0, 2.0, 0.1);
        assert_eq!(charge_and_gap(&counter, 10.0), (2.0, 8.0), "the 50 A do not count backwards");
    }

    #[test]
    fn time_before_the_first_current_is_unmeasured() {
        let mut counter = ChargeCounter::default();
        counter.begin(at(5.0));
        counter.handle_current(at(8.0), 1.0, 2.0, 0.1);
        assert_eq!(charge_and_gap(&counter, 9.0), (1.0, 3.0));
    }

    #[test]
    fn gap_counts_neither_charge_nor_time() {
        let mut counter = counter(&[(0.0, 1.0), (1.0, 1.0)]);
        counter.handle_gap(at(2.0), at(1000.0), 2.0);
        assert_eq!(charge_and_gap(&counter, 1000.0), (2.0, 0.0));
        counter.handle_current(at(1000.0), 1.0, 2.0, 0.1);
        assert_eq!(charge_and_gap(&counter, 1001.0), (3.0, 0.0));
    }

    #[test]
    fn open_contactors_hold_zero_until_closed_or_stale() {
        let mut counter = counter(&[(0.0, 3.0)]);
        counter.open(at(1.0), at(11.0), 2.0);
        assert!(counter.is_open(at(11.0)) && !counter.is_open(at(11.1)));
        assert_eq!(
            charge_and_gap(&counter, 9.0),
            (3.0, 0.0),
            "held until the contactors open, zero afterwards, no unmeasured time"
        );
        assert_eq!(charge_and_gap(&counter, 14.0), (3.0, 3.0), "unmeasured once the contactor reading is too old");
        counter.open(at(8.0), at(18.0), 2.0);
        counter.close(at(9.0), Some(2.0), 2.0);
        assert_eq!(charge_and_gap(&counter, 10.0), (5.0, 0.0));
        counter.close(at(10.5), None, 2.0);
        assert_eq!(charge_and_gap(&counter, 11.0), (7.0, 0.0), "already closed: the current is still held");
    }

    #[test]
    fn backward_time_stamp_counts_nothing() {
        let counter = counter(&[(10.0, 1.0), (4.0, 1.0), (11.0, 1.0)]);
        assert_eq!(charge_and_gap(&counter, 11.0), (1.0, 0.0));
    }
}
