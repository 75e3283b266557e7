//! Checks the readings of one signal: range, rate, stuck, stale.
//!
//! In: readings in the channel's unit, with their time. Out: the value or its fault, and each change of the signal
//! between good and bad.
//!
//! * **Range**: a value outside the limits is bad.
//! * **Rate**: a value is bad if it differs from the last good value by more than the fastest plausible change. If
//!   [`ACCEPT_AFTER`] consecutive readings agree with each other, the last of them is accepted. Either the step was
//!   real or the last good value was wrong, and further rejection would lock out a healthy sensor.
//! * **Stuck**: a value that stays exactly the same for too long while it should change is bad until it changes. The
//!   caller passes a clock that runs only while the value should change.
//! * **Stale**: the last good value is older than the maximum age.
//!
//! If the decoder has already found a fault, this fault becomes the outcome.

use serde::{Deserialize, Serialize};

use super::config::Limits;
use crate::quantity::bounds;
use crate::quantity::{Fault, InvalidState, Timestamp};

/// Number of consecutive readings that must agree before a new level is accepted. One disturbance can cause two wrong
/// readings.
pub const ACCEPT_AFTER: u32 = 3;

/// Shortest interval for the rate check (s). Time stamps of consecutive frames jitter by about this much, and the rate
/// in an interval of zero would be infinite.
pub const MIN_RATE_INTERVAL_S: f64 = 1e-3;

/// The share of bad readings is a moving average over about this number of readings.
pub const BAD_SHARE_READINGS: u32 = 100;

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct TimedValue {
    value: f64,
    pub(super) time: Timestamp,
}

impl TimedValue {
    pub(super) fn value(self) -> f64 {
        self.value
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Signal {
    pub(super) good: Option<TimedValue>,
    /// Latest reading that was rejected because of its rate.
    refused: Option<TimedValue>,
    /// Consecutive readings that agree with `refused`.
    refused_count: u32,
    /// Latest value. It has not changed since the clock of the stuck check showed `rests_since_s`.
    rests_at: Option<f64>,
    rests_since_s: f64,
    /// Time of the latest reading, good or bad.
    #[serde(rename = "heard")]
    pub(super) received: Option<Timestamp>,
    fault: Option<Fault>,
    /// Number of bad readings since the signal turned bad.
    bad_readings: u64,
    /// Up to [`BAD_SHARE_READINGS`].
    readings: u32,
    bad_share: f64,
}

/// Outcome of a reading: the checked value, and the new state of the signal if it changed. If the signal became good,
/// `change` contains the number of preceding bad readings.
pub(super) struct SignalUpdate {
    pub(super) value: Result<f64, Fault>,
    pub(super) change: Option<Result<u64, Fault>>,
    /// Whether a new level is accepted after its first readings were rejected.
    pub(super) is_new_level: bool,
}

impl Signal {
    /// Checks a reading. `should_move_s` is the time on the clock of the stuck check (s).
    #[inline]
    pub(super) fn handle(
        &mut self,
        time: Timestamp,
        value: Result<f64, Fault>,
        limits: &Limits,
        should_move_s: f64,
    ) -> SignalUpdate {
        self.received = Some(time);
        let value = self.judge(time, value, limits, should_move_s);
        self.count(value.is_err());
        let is_new_level = value.is_ok() && self.refused_count >= ACCEPT_AFTER;
        if let Ok(value) = value {
            self.good = Some(TimedValue { value, time });
            self.refused_count = 0;
        }
        SignalUpdate { value, change: self.turn(value.err(), 1), is_new_level }
    }

    /// Turns a good signal stale; returns the fault.
    pub(super) fn turn_stale(&mut self) -> Fault {
        self.turn(Some(Fault::Stale), 0);
        Fault::Stale
    }

    /// Earliest time at which the signal is stale. The age of the signal counts from its last good value, but not from
    /// before `began`.
    pub(super) fn stale_from(&self, began: Timestamp, limits: &Limits) -> Timestamp {
        self.good.map_or(began, |good| good.time.max(began)).plus_secs(limits.max_age_s)
    }

    pub(super) fn is_bad(&self) -> bool {
        self.fault.is_some()
    }

    /// The last good value, if it is fresh.
    #[inline]
    pub(super) fn fresh(&self, now: Timestamp, limits: &Limits) -> Option<f64> {
        self.good.filter(|good| now.since(good.time) <= limits.max_age_s).map(|good| good.value)
    }

    /// Time of the latest reading, and share of bad readings; `None` = no reading since `began`.
    #[inline]
    pub(super) fn latest_since(&self, began: Timestamp) -> Option<(Timestamp, f64)> {
        Some((self.received.filter(|&received| received >= began)?, self.bad_share))
    }

    /// Share of bad readings, weighted towards recent readings; `None` = no reading yet.
    pub(super) fn bad_share(&self) -> Option<f64> {
        (self.readings > 0).then_some(self.bad_share)
    }

    /// Handles a gap. Forgets values and times, but keeps the fault and the share of bad readings.
    pub(super) fn handle_gap(&mut self) {
        *self = Self {
            fault: self.fault,
            bad_readings: self.bad_readings,
            readings: self.readings,
            bad_share: self.bad_share,
            ..Self::default()
        };
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let values = [self.good, self.refused].into_iter().flatten().map(|stamped| stamped.value);
        InvalidState::unless_numbers("a signal", values.chain(self.rests_at))?;
        bounds::TIME_S.check("how long a signal has been unchanged", self.rests_since_s)?;
        let share = self.bad_share;
        InvalidState::unless((0.0..=1.0).contains(&share), "the share of a signal's bad readings", share, "0 to 1")
    }

    pub(super) fn rebase(&mut self, by_nanos: i64) {
        for stamped in [&mut self.good, &mut self.refused].into_iter().flatten() {
            stamped.time = stamped.time.plus_nanos(by_nanos);
        }
        self.received = self.received.map(|stamp| stamp.plus_nanos(by_nanos));
    }

    #[inline]
    fn judge(
        &mut self,
        time: Timestamp,
        value: Result<f64, Fault>,
        limits: &Limits,
        should_move_s: f64,
    ) -> Result<f64, Fault> {
        let value = value?;
        if !value.is_finite() {
            return Err(Fault::NotFinite);
        }
        if value < limits.min || value > limits.max {
            return Err(Fault::OutOfRange);
        }
        if self.is_stuck(value, limits, should_move_s) {
            return Err(Fault::Stuck);
        }
        if self.is_too_fast(TimedValue { value, time }, limits) {
            return Err(Fault::RateTooHigh);
        }
        Ok(value)
    }

    #[inline]
    fn is_stuck(&mut self, value: f64, limits: &Limits, should_move_s: f64) -> bool {
        if self.rests_at != Some(value) {
            self.rests_at = Some(value);
            self.rests_since_s = should_move_s;
        }
        limits.stuck_after_s.is_some_and(|limit_s| should_move_s - self.rests_since_s >= limit_s)
    }

    #[inline]
    fn is_too_fast(&mut self, reading: TimedValue, limits: &Limits) -> bool {
        let (Some(rate), Some(good)) = (limits.max_rate_per_s, self.good) else { return false };
        if agree(good, reading, rate) {
            return false;
        }
        let agrees = self.refused_count > 0 && self.refused.is_some_and(|last| agree(last, reading, rate));
        self.refused_count = if agrees { self.refused_count + 1 } else { 1 };
        self.refused = Some(reading);
        self.refused_count < ACCEPT_AFTER
    }

    #[inline]
    fn count(&mut self, bad: bool) {
        self.readings = (self.readings + 1).min(BAD_SHARE_READINGS);
        if !bad && self.bad_share == 0.0 {
            return;
        }
        let now = if bad { 1.0 } else { 0.0 };
        self.bad_share += (now - self.bad_share) / f64::from(self.readings);
    }

    #[inline]
    fn turn(&mut self, fault: Option<Fault>, readings: u64) -> Option<Result<u64, Fault>> {
        match (self.fault, fault) {
            (None, None) => None,
            (None, Some(fault)) => {
                self.fault = Some(fault);
                self.bad_readings = readings;
                Some(Err(fault))
            }
            (Some(_), Some(_)) => {
                self.bad_readings = self.bad_readings.saturating_add(readings);
                None
            }
            (Some(_), None) => {
                self.fault = None;
                Some(Ok(self.bad_readings))
            }
        }
    }
}

#[inline]
fn agree(earlier: TimedValue, later: TimedValue, max_rate_per_s: f64) -> bool {
    let dt_s = later.time.since(earlier.time).max(MIN_RATE_INTERVAL_S);
    (later.value - earlier.value).abs() <= max_rate_per_s * dt_s
}
