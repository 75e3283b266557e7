//! Detects charge that a replay did not measure because the current was unknown.
//!
//! A replay reports a missing current in these ways:
//!
//! | report | charge |
//! | --- | --- |
//! | the current's signal turns bad or stale | lost from when its last reading is too old until the signal is good again |
//! | the buses fall asleep | no charge: the core reports sleep only while no current flows |
//! | a gap: nothing was recorded | no charge if the buses slept or the pack rested before; otherwise unknown |
//!
//! Assumption: if the pack rests when the recording stops, it rests until the recording continues. If it is used in
//! such a gap but rests at both ends, the use cannot be detected.

use crate::monitor::{Estimate, Event, EventKind};
use crate::quantity::{Channel, Fault, Timestamp};

/// Limits for current and voltage readings.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ReadingLimits {
    /// Maximum age of a current reading that is still used (s).
    pub current_age_s: f64,
    /// Maximum age of a voltage reading that is still used (s).
    pub voltage_age_s: f64,
    /// Largest current of a resting pack (A) per string.
    pub rest_a: f64,
}

#[derive(Debug, Clone, Default)]
pub(super) struct Losses {
    limits: ReadingLimits,
    /// Latest known current (A) per string.
    current_a: Option<f64>,
    /// Start of a loss that has not ended; `None` = the current is known.
    lost_since: Option<Timestamp>,
    is_asleep: bool,
    /// End of the latest period without recording in which no charge moved.
    paused_until: Option<Timestamp>,
    lost_s: f64,
    /// First gap in which an unknown charge may have moved, as text.
    gap: Option<String>,
}

impl Losses {
    pub(super) fn new(limits: ReadingLimits) -> Self {
        Self { limits, ..Self::default() }
    }

    /// Discards earlier losses because another pack was connected. A loss that has not ended counts from `now`.
    pub(super) fn restart(&mut self, now: Timestamp) {
        self.lost_since = self.lost_since.map(|since| since.max(now));
        (self.lost_s, self.gap) = (0.0, None);
    }

    pub(super) fn take_estimate(&mut self, estimate: &Estimate) {
        let current_a = estimate.measured.current_a;
        if current_a.is_finite() {
            self.current_a = Some(current_a);
        }
    }

    pub(super) fn take_event(&mut self, event: &Event) {
        match event.kind {
            EventKind::SignalBad { channel: Channel::Current, fault } => {
                // A stale signal's last reading was used until now, so the loss starts now. With any other fault, the
                // loss starts later, because the last good reading may still be used for a limited time.
                let held_s = if fault == Fault::Stale { 0.0 } else { self.limits.current_age_s };
                self.lost_since.get_or_insert(event.time.plus_secs(held_s));
            }
            EventKind::SignalGood { channel: Channel::Current, .. } => self.end_loss(event.time),
            EventKind::BusAsleep { asleep, .. } => {
                (self.is_asleep, self.paused_until) = (asleep, Some(event.time));
            }
            EventKind::Gap { .. } if self.is_asleep || self.is_at_rest() => self.paused_until = Some(event.time),
            EventKind::Gap { seconds } => {
                let length = seconds.map_or_else(|| "an unknown time".to_owned(), |seconds| format!("{seconds:.0} s"));
                self.gap.get_or_insert_with(|| {
                    format!(
                        "the record has a gap of {length} that started while current flowed, or its current is unknown"
                    )
                });
            }
            _ => {}
        }
    }

    /// Whether the pack rests at this current (A per string).
    pub(super) fn is_rest(&self, current_a: f64) -> bool {
        current_a.abs() <= self.limits.rest_a
    }

    /// Whether recording has paused since `from` while no charge moved.
    pub(super) fn has_paused_since(&self, from: Timestamp) -> bool {
        self.paused_until.is_some_and(|until| until > from)
    }

    fn is_at_rest(&self) -> bool {
        self.lost_since.is_none() && self.current_a.is_some_and(|current_a| self.is_rest(current_a))
    }

    fn end_loss(&mut self, now: Timestamp) {
        if let Some(since) = self.lost_since.take() {
            self.lost_s += now.since(since).max(0.0);
        }
    }

    /// Returns the reason why the charge of the record is unknown; `None` = it is known. The record ends at `end`. Its
    /// charges and discharges last `used_s` in total.
    pub(super) fn finish(&mut self, end: Timestamp, used_s: f64) -> Option<String> {
        self.end_loss(end);
        let lost_s = self.lost_s;
        let is_lost = is_too_much(lost_s, used_s);
        self.gap.take().or_else(|| is_lost.then(|| format!("the current is missing from the record for {lost_s:.0} s")))
    }
}

/// Whether the current was missing for so long (`lost_s` of `used_s`) that the sum of the charge counts as unknown.
pub(super) fn is_too_much(lost_s: f64, used_s: f64) -> bool {
    // A share of 0.1 % tolerates single lost frames. The error of the sum is then far below the gain error of a
    // current sensor.
    lost_s > 1e-3 * used_s
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: ReadingLimits = ReadingLimits { current_age_s: 2.0, voltage_age_s: 5.0, rest_a: 0.1 };
    const USED_S: f64 = 3600.0;

    fn finished(current_a: f64, events: &[(f64, EventKind)]) -> Option<String> {
        let mut losses = Losses::new(LIMITS);
        losses.current_a = Some(current_a);
        for &(time_s, kind) in events {
            losses.take_event(&Event { time: Timestamp::from_secs(time_s), kind });
        }
        losses.finish(Timestamp::from_secs(1000.0), USED_S)
    }

    fn bad(fault: Fault) -> EventKind {
        EventKind::SignalBad { channel: Channel::Current, fault }
    }

    const GOOD: EventKind = EventKind::SignalGood { channel: Channel::Current, bad_readings: 1 };

    #[test]
    fn gap_under_load_loses_charge() {
        let gap = EventKind::Gap { seconds: Some(600.0) };
        assert_eq!(finished(0.05, &[(10.0, gap)]), None);
        let said = finished(5.0, &[(10.0, gap)]).expect("a gap");
        assert!(said.contains("a gap of 600 s"), "{said}");
        assert!(finished(5.0, &[(10.0, EventKind::Gap { seconds: None })]).is_some());
        let asleep = |asleep| EventKind::BusAsleep { asleep, seconds: None };
        assert_eq!(finished(5.0, &[(9.0, asleep(true)), (10.0, gap), (11.0, asleep(false))]), None);
    }

    #[test]
    fn lost_current_counts_beyond_its_age_limit() {
        assert_eq!(
            finished(5.0, &[(10.0, bad(Fault::OutOfRange)), (12.5, GOOD)]),
            None,
            "0.5 s without current in 3600 s of use is tolerated"
        );
        assert!(finished(5.0, &[(10.0, bad(Fault::OutOfRange)), (16.0, GOOD)]).is_some());
        assert!(
            finished(0.0, &[(10.0, bad(Fault::Stale)), (14.0, GOOD)]).is_some(),
            "a stale current counts as lost even if its last value was 0"
        );
        assert!(finished(5.0, &[(10.0, bad(Fault::Stale))]).is_some(), "a loss lasts until the end of the record");
    }

    #[test]
    fn another_pack_starts_without_losses() {
        let mut losses = Losses::new(LIMITS);
        let at = Timestamp::from_secs;
        losses.take_event(&Event { time: at(1.0), kind: bad(Fault::Stale) });
        losses.restart(at(500.0));
        losses.take_event(&Event { time: at(501.0), kind: GOOD });
        assert_eq!(losses.finish(at(600.0), USED_S), None);
    }
}
