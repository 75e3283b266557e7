//! Manages the times of a replay: the selected part of the log, the time covered by that part, and the pace.

use std::time::{Duration, Instant};

use crate::quantity::Timestamp;

/// A time in the log, as given by the user.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogTime {
    /// A stamp on the log's own clock.
    At(Timestamp),
    /// Nanoseconds after the log's first record.
    After(i64),
}

impl LogTime {
    pub(super) fn resolve(self, first: Timestamp) -> Timestamp {
        match self {
            Self::At(time) => time,
            Self::After(nanos) => first.plus_nanos(nanos),
        }
    }
}

pub(super) struct TimeWindow {
    from: Option<LogTime>,
    pub(super) until: Option<LogTime>,
    /// The log's first stamp, even if it is outside the window.
    pub(super) first: Option<Timestamp>,
}

pub(super) enum WindowPosition {
    Before,
    Inside,
    After,
}

impl TimeWindow {
    pub(super) fn new(from: Option<LogTime>, until: Option<LogTime>) -> Self {
        Self { from, until, first: None }
    }

    pub(super) fn judge(&mut self, time: Timestamp) -> WindowPosition {
        let first = *self.first.get_or_insert(time);
        if self.from.is_some_and(|from| time < from.resolve(first)) {
            WindowPosition::Before
        } else if self.until.is_some_and(|until| time > until.resolve(first)) {
            WindowPosition::After
        } else {
            WindowPosition::Inside
        }
    }
}

/// The time covered by the log, and the time taken by its replay.
pub(super) struct RecordSpan {
    sleep_gap_ns: i64,
    pub(super) first: Option<Timestamp>,
    pub(super) latest: Option<Timestamp>,
    /// Covered time, without the gaps that are longer than `sleep_gap_ns`. Nanoseconds keep the sum of millions of
    /// steps exact.
    awake_ns: i64,
    /// Number of records with a later stamp than all records before them, and how many of them follow a sleep gap.
    steps: u64,
    gaps: u64,
    pub(super) started: Instant,
}

impl RecordSpan {
    pub(super) fn new(sleep_gap_s: f64) -> Self {
        Self {
            sleep_gap_ns: (sleep_gap_s * 1e9) as i64,
            first: None,
            latest: None,
            awake_ns: 0,
            steps: 0,
            gaps: 0,
            started: Instant::now(),
        }
    }

    /// Adds a record. Returns whether the record follows a gap longer than the sleep gap.
    pub(super) fn advance(&mut self, time: Timestamp) -> bool {
        self.first.get_or_insert(time);
        let latest = *self.latest.get_or_insert(time);
        let passed_ns = time.nanos().saturating_sub(latest.nanos());
        if passed_ns <= 0 {
            return false;
        }
        self.latest = Some(time);
        let asleep = passed_ns > self.sleep_gap_ns;
        self.steps += 1;
        self.gaps += u64::from(asleep);
        self.awake_ns += if asleep { 0 } else { passed_ns };
        asleep
    }

    /// The fields `gaps` and `steps`.
    pub(super) fn gaps_and_steps(&self) -> (u64, u64) {
        (self.gaps, self.steps)
    }

    pub(super) fn awake_s(&self) -> f64 {
        self.awake_ns as f64 * 1e-9
    }

    pub(super) fn times_real_time(&self) -> f64 {
        self.awake_s() / self.started.elapsed().as_secs_f64().max(1e-9)
    }
}

/// Paces the replay at a multiple of real time. It uses deadlines, so that delays do not add up.
pub(super) struct Pace {
    pub(super) speed: Option<f64>,
    anchor: Option<(Instant, Timestamp)>,
}

impl Pace {
    pub(super) fn new(speed: Option<f64>) -> Self {
        Self { speed, anchor: None }
    }

    /// Restarts the pace at the next record, so that the replay does not wait through sleep gaps and unknown gaps.
    pub(super) fn rebase(&mut self) {
        self.anchor = None;
    }

    #[inline]
    pub(super) fn wait(&mut self, time: Timestamp) {
        if let Some(speed) = self.speed {
            self.wait_at(speed, time);
        }
    }

    fn wait_at(&mut self, speed: f64, time: Timestamp) {
        let (began, origin) = *self.anchor.get_or_insert_with(|| (Instant::now(), time));
        let due = Duration::try_from_secs_f64(time.since(origin) / speed).unwrap_or_default();
        let ahead = due.saturating_sub(began.elapsed());
        if !ahead.is_zero() {
            std::thread::sleep(ahead);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hole_longer_than_sleep_gap_is_sleep() {
        let mut span = RecordSpan::new(30.0);
        let mut advance = |nanos| span.advance(Timestamp::from_nanos(nanos));
        assert_eq!([0, 30_000_000_000, 60_000_000_001].map(&mut advance), [false, false, true]);
        assert_eq!(span.awake_ns, 30_000_000_000);
    }
}
