//! Selects the events that the history keeps, and decides when they are committed.
//!
//! In: the events of one input. Out: rows to commit now, if any, and whether to write the state with them. Token
//! buckets limit the rows that differ little from earlier rows. The buckets use the times of the events. Rows of
//! alarm changes are limited only by the debounce of the alarm rules.

use std::collections::BTreeMap;

use super::rows::HistoryRow;
use crate::alarm::Change;
use crate::can::poll::{PollChange, PollSilence};
use crate::monitor::{Command, Event, EventKind};
use crate::quantity::catalogue::Quantity;
use crate::quantity::{CellIndex, Timestamp};
use crate::token_bucket::{BucketSize, TokenBucket};

/// Number of measured capacities of one cell that are written even if they have not changed: 64 at once (two days of
/// an electric car), then one per hour. Further capacities are written only if they have changed, because each row
/// takes 100 bytes and is kept for years. Otherwise, a hybrid that changes between charge and discharge every minute
/// would write too many rows. Remaining lives, and energy and power, have the same limit.
const CAPACITIES: BucketSize = BucketSize { burst: 64.0, period_s: 3600.0 };
/// If the allowance is used up, a capacity or remaining life is written only if it has changed by this many standard
/// deviations.
const MIN_CHANGE_STD: f64 = 0.25;
/// How often deferred rows are written with a checkpoint or with other rows: 60 times at once (one hour of
/// checkpoints), then once an hour. Each time, up to two rows per cell are written, which are kept for years.
const CARRIED: BucketSize = BucketSize { burst: 60.0, period_s: 3600.0 };

#[derive(Debug, Clone, Copy)]
struct WrittenCapacity {
    capacity_ah: f64,
    usable_ah: Option<f64>,
    token_bucket: TokenBucket,
}

/// The remaining life last written: median and standard deviation, cycles; `None` = unknown.
#[derive(Debug, Clone, Copy)]
struct WrittenLife {
    cycles: Option<(f64, f64)>,
    token_bucket: TokenBucket,
}

/// Rows to commit together. If they come from the events of an input, the events are announced after the commit.
#[derive(Debug, PartialEq)]
pub(super) struct HistoryCommit {
    pub rows: Vec<HistoryRow>,
    /// Whether the state is written as well.
    pub with_state: bool,
}

#[derive(Debug)]
pub(super) struct HistoryFilter {
    written: BTreeMap<CellIndex, WrittenCapacity>,
    written_life: WrittenLife,
    outlooks: TokenBucket,
    carried: TokenBucket,
    deferred: Vec<HistoryRow>,
}

impl Default for HistoryFilter {
    fn default() -> Self {
        Self {
            written: BTreeMap::new(),
            written_life: WrittenLife { cycles: None, token_bucket: TokenBucket::new(CAPACITIES) },
            outlooks: TokenBucket::new(CAPACITIES),
            carried: TokenBucket::new(CARRIED),
            deferred: Vec::new(),
        }
    }
}

impl HistoryFilter {
    /// Returns what to commit now; `None` = nothing was learned and no alarm changed.
    pub(super) fn take(&mut self, events: &[Event]) -> Option<HistoryCommit> {
        let now = events.first()?.time;
        let stored = || events.iter().map(|event| event.kind).filter_map(|kind| Some((Urgency::of(&kind)?, kind)));
        stored().filter(|(urgency, _)| *urgency == Urgency::Deferred).for_each(|(_, kind)| self.defer(kind));
        let urgency = stored().map(|(urgency, _)| urgency).max().filter(|urgency| *urgency > Urgency::Deferred)?;
        let mut rows = self.for_checkpoint(now);
        let mut writes_capacity = false;
        for (_, kind) in stored().filter(|(urgency, _)| *urgency > Urgency::Deferred) {
            // Loss modes are derived from the capacity, whose event precedes them, and are written only with it.
            let is_worth_writing = match kind {
                EventKind::LossModes { .. } => writes_capacity,
                _ => self.is_worth_writing(&kind, now),
            };
            if matches!(kind, EventKind::Capacity { .. }) {
                writes_capacity = is_worth_writing;
            }
            rows.extend(is_worth_writing.then_some(HistoryRow::Event(kind)));
        }
        Some(HistoryCommit { rows, with_state: urgency == Urgency::WithState })
    }

    pub(super) fn checkpoint(&mut self, now: Timestamp) -> HistoryCommit {
        HistoryCommit { rows: self.for_checkpoint(now), with_state: true }
    }

    pub(super) fn finish(&mut self) -> HistoryCommit {
        HistoryCommit { rows: std::mem::take(&mut self.deferred), with_state: true }
    }

    /// Takes the deferred rows, if they may be written now.
    fn for_checkpoint(&mut self, now: Timestamp) -> Vec<HistoryRow> {
        let may_go = !self.deferred.is_empty() && self.carried.take(now);
        if may_go { std::mem::take(&mut self.deferred) } else { Vec::new() }
    }

    /// Defers a row. If equal rows are deferred, keeps only the first and the last.
    fn defer(&mut self, kind: EventKind) {
        let row = HistoryRow::Event(kind);
        let same: Vec<usize> = (0..self.deferred.len()).filter(|&at| self.deferred[at] == row).collect();
        if let [_, .., last] = same[..] {
            self.deferred.remove(last);
        }
        self.deferred.push(row);
    }

    /// Whether to write a remaining life. If the allowance (token bucket) is used up, the remaining life is written
    /// only if it has changed.
    fn is_life_worth_writing(&mut self, cycles: Option<(f64, f64)>, now: Timestamp) -> bool {
        let written = &mut self.written_life;
        let has_moved = match (written.cycles, cycles) {
            (Some((before, _)), Some((median, std))) => (median - before).abs() > MIN_CHANGE_STD * std,
            (before, now) => before.is_some() != now.is_some(),
        };
        let is_worth_writing = written.token_bucket.take(now) || has_moved;
        if is_worth_writing {
            written.cycles = cycles;
        }
        is_worth_writing
    }

    /// Whether to write an event. A capacity without a measurement is written only if the usable capacity has changed.
    /// If the allowance (token bucket) is used up, a capacity is written only if it or the usable capacity has changed
    /// by [`MIN_CHANGE_STD`].
    fn is_worth_writing(&mut self, kind: &EventKind, now: Timestamp) -> bool {
        if matches!(kind, EventKind::PackReplaced { .. }) {
            self.written_life.cycles = None;
        }
        if let EventKind::RemainingLife { cycles, cycles_low, .. } = *kind {
            // The lower end of the interval is a little less than two standard deviations below the median. Half of
            // this distance serves as the standard deviation.
            return self.is_life_worth_writing(
                cycles.zip(cycles_low).map(|(median, low)| (median, 0.5 * (median - low))),
                now,
            );
        }
        if matches!(kind, EventKind::Outlook { .. }) {
            return self.outlooks.take(now);
        }
        let EventKind::Capacity { cell, measured_ah, values, .. } = *kind else {
            return !matches!(kind, EventKind::RechargePeriod { .. });
        };
        let Some((capacity_ah, capacity_std_ah)) = values.pair(Quantity::Capacity) else { return false };
        let usable_ah = values.mean(Quantity::UsableCapacity);
        let new = WrittenCapacity { capacity_ah, usable_ah, token_bucket: TokenBucket::new(CAPACITIES) };
        let before = self.written.get(&cell).copied();
        if measured_ah.is_none() && before.is_none_or(|before| before.usable_ah == usable_ah) {
            self.written.entry(cell).or_insert(new);
            return false;
        }
        let written = self.written.entry(cell).or_insert(new);
        let far = |a: f64, b: f64| (a - b).abs() >= MIN_CHANGE_STD * capacity_std_ah;
        let has_moved = before.is_none_or(|before| {
            far(before.capacity_ah, capacity_ah)
                || before.usable_ah.zip(usable_ah).is_some_and(|(before, now)| far(before, now))
        });
        if written.token_bucket.take(now) || has_moved {
            (written.capacity_ah, written.usable_ah) = (capacity_ah, usable_ah);
            return true;
        }
        false
    }
}

/// When and how an event is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Urgency {
    /// The event is stored with a later commit. Filter resets are deferred, because they may be frequent and are not
    /// announced.
    Deferred,
    /// The event is stored as a row before it is announced. After a restart, the daemon can apply it again from the
    /// row.
    AsRow,
    /// The event is stored with the whole state before it is announced. The row alone is not enough to restore the
    /// result.
    WithState,
}

impl Urgency {
    /// The urgency of an event; `None` = the event is not stored. If an alarm's value becomes unknown or known again,
    /// the announced alarm does not change. Such events are not stored, because a flickering input causes many of them.
    const fn of(kind: &EventKind) -> Option<Self> {
        match kind {
            EventKind::HalfCycle { .. }
            | EventKind::Capacity { .. }
            | EventKind::LossModes { .. }
            | EventKind::RemainingLife { .. }
            | EventKind::Outlook { .. }
            | EventKind::RechargePeriod { .. }
            | EventKind::Model { .. }
            | EventKind::PackReplaced { .. }
            | EventKind::PackIdentity { .. }
            // The diagnostic requests after a restart depend on these two events.
            | EventKind::Command { command: Command::Poll { .. }, .. }
            | EventKind::Poll(PollChange::Silent { reason: PollSilence::OtherTester }) => Some(Self::WithState),
            EventKind::Alarm { change: Change::Suppressed | Change::Resumed, .. } => None,
            EventKind::Alarm { .. } | EventKind::AlarmDropped { .. } => Some(Self::AsRow),
            EventKind::FilterReset { .. } => Some(Self::Deferred),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::{alarm, capacity, half_cycle, loss_modes, model, remaining_life};
    use super::*;
    use crate::monitor::Source;
    use crate::quantity::catalogue::RecordedPackValues;

    /// Number of rows that are committed at once.
    fn take(history_filter: &mut HistoryFilter, seconds: f64, kinds: &[EventKind]) -> Option<usize> {
        let time = Timestamp::from_secs(seconds);
        let events: Vec<Event> = kinds.iter().map(|&kind| Event { time, kind }).collect();
        history_filter.take(&events).map(|commit| commit.rows.len())
    }

    #[test]
    fn capacity_is_written_if_it_has_news() {
        let mut history_filter = HistoryFilter::default();
        assert_eq!(take(&mut history_filter, 0.0, &[capacity(0, Some(2.4), 2.3)]), Some(1));
        assert_eq!(take(&mut history_filter, 0.0, &[capacity(0, None, 2.3)]), Some(0));
        assert_eq!(take(&mut history_filter, 0.0, &[capacity(0, None, 2.2)]), Some(1));
        assert_eq!(take(&mut history_filter, 0.0, &[half_cycle(0), capacity(0, Some(2.4), 2.2)]), Some(2));
    }

    #[test]
    fn loss_modes_are_written_with_capacity() {
        let mut history_filter = HistoryFilter::default();
        let cells = [capacity(0, Some(2.4), 2.3), loss_modes(0, 0.1), capacity(1, None, 2.3), loss_modes(1, 0.1)];
        assert_eq!(take(&mut history_filter, 0.0, &cells), Some(2));
        assert_eq!(take(&mut history_filter, 0.0, &[capacity(0, None, 2.3), loss_modes(0, 0.1)]), Some(0));
    }

    #[test]
    fn every_model_change_is_written() {
        let mut history_filter = HistoryFilter::default();
        for second in 0..200 {
            assert_eq!(take(&mut history_filter, f64::from(second), &[model(Some(2.0))]), Some(1), "{second}");
        }
    }

    #[test]
    fn flickering_input_writes_nothing() {
        let mut history_filter = HistoryFilter::default();
        assert_eq!(take(&mut history_filter, 0.0, &[alarm(Change::Suppressed), alarm(Change::Resumed)]), None);
        assert_eq!(take(&mut history_filter, 0.0, &[alarm(Change::Raised)]), Some(1));
    }

    #[test]
    fn frequent_reversals_write_only_changes() {
        let mut history_filter = HistoryFilter::default();
        let mut rows = 0;
        for minute in 0..1440 {
            rows += take(&mut history_filter, f64::from(minute) * 60.0, &[capacity(0, Some(2.4), 2.3)]).unwrap();
        }
        assert!((64 + 22..=64 + 24).contains(&rows), "{rows} rows");
        assert_eq!(take(&mut history_filter, 86_341.0, &[capacity(0, Some(2.4), 2.31)]), Some(0));
        assert_eq!(take(&mut history_filter, 86_342.0, &[capacity(0, Some(2.4), 2.2)]), Some(1), "far");
    }

    #[test]
    fn frequent_remaining_lives_write_only_changes() {
        let day = |per_minute: f64| {
            let (mut history_filter, mut rows) = (HistoryFilter::default(), 0);
            for minute in 0..1440 {
                let kinds = [half_cycle(0), remaining_life(per_minute * f64::from(100_000 - minute))];
                rows += take(&mut history_filter, f64::from(minute) * 60.0, &kinds).unwrap() - 1;
            }
            assert!((64 + 22..=64 + 24).contains(&rows), "{rows} rows");
            history_filter
        };
        // The remaining life is constant, then slowly decreases.
        day(0.0);
        let mut history_filter = day(0.01);
        assert_eq!(take(&mut history_filter, 86_341.0, &[half_cycle(0), remaining_life(700.0)]), Some(2), "far");
        let unknown = EventKind::RemainingLife {
            cell: None,
            cycles: None,
            cycles_low: None,
            cycles_high: None,
            days: None,
            days_low: None,
            days_high: None,
        };
        assert_eq!(
            take(&mut history_filter, 86_342.0, &[half_cycle(0), unknown]),
            Some(2),
            "the remaining life is no longer known"
        );
        assert_eq!(take(&mut history_filter, 86_343.0, &[half_cycle(0), unknown]), Some(1));
    }

    #[test]
    fn energy_and_power_are_written_once_an_hour_at_most_after_burst() {
        let mut history_filter = HistoryFilter::default();
        let outlook = EventKind::Outlook { values: RecordedPackValues::default() };
        let rows = (0..1440).map(|minute| {
            let time = Timestamp::from_secs(60.0 * f64::from(minute));
            let events = [half_cycle(0), outlook].map(|kind| Event { time, kind });
            history_filter.take(&events).map_or(0, |commit| commit.rows.len() - 1)
        });
        assert_eq!(rows.sum::<usize>(), 64 + 23);
    }

    #[test]
    fn alarm_change_is_committed_without_state() {
        let mut history_filter = HistoryFilter::default();
        let mut take = |kinds: &[EventKind]| {
            let events: Vec<Event> = kinds.iter().map(|&kind| Event { time: Timestamp::ZERO, kind }).collect();
            history_filter.take(&events).map(|commit| (commit.rows.len(), commit.with_state))
        };
        for change in [Change::Raised, Change::Cleared].repeat(1000) {
            assert_eq!(take(&[alarm(change)]), Some((1, false)));
        }
        let reset = EventKind::FilterReset { cell: CellIndex(3) };
        assert_eq!([take(&[reset]), take(&[reset]), take(&[reset])], [None; 3]);
        assert_eq!(take(&[alarm(Change::Raised)]), Some((3, false)), "with the first and the last reset");
        assert_eq!(take(&[alarm(Change::Raised), half_cycle(0)]), Some((2, true)));
    }

    #[test]
    fn silence_of_polling_is_committed_with_state() {
        let command = EventKind::Command {
            source: Source::Local,
            command: Command::Poll { standby: true },
            changed: 1,
            refused: 0,
        };
        let tester = EventKind::Poll(PollChange::Silent { reason: PollSilence::OtherTester });
        for kind in [command, tester] {
            let commit = HistoryFilter::default().take(&[Event { time: Timestamp::ZERO, kind }]).unwrap();
            assert!(commit.with_state, "{kind:?}");
        }
    }

    #[test]
    fn waiting_rows_are_written_with_some_checkpoints() {
        let mut history_filter = HistoryFilter::default();
        let mut rows = 0;
        for minute in 0..1440_u32 {
            for second in 0..60_u32 {
                let reset = EventKind::FilterReset { cell: CellIndex(0) };
                take(&mut history_filter, f64::from(minute * 60 + second), &[reset]);
            }
            let waiting = history_filter.deferred.len();
            let taken = history_filter.checkpoint(Timestamp::from_secs(f64::from(minute * 60 + 59))).rows.len();
            assert!(minute >= 60 || taken == waiting, "minute {minute}: {taken} of {waiting}");
            rows += taken;
        }
        assert!((100..=200).contains(&rows), "{rows} rows");
    }
}
