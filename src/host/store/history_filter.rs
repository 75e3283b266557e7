//! Selects the events that are kept in the history, and those that are committed at once.
//!
//! A flickering alarm must not wear out the flash memory or delay another alarm. In: the events of one input. Out: rows
//! to commit now, if any. Limits are token buckets and the bytes of written states ([`super::checkpoint`]); times are
//! taken from the events.

use std::collections::BTreeMap;

use super::rows::{EventSubject, HistoryRow};
use crate::alarm::Change;
use crate::monitor::{Event, EventKind};
use crate::quantity::catalogue::Quantity;
use crate::quantity::{CellIndex, Timestamp};
use crate::token_bucket::{BucketSize, TokenBucket};

/// Number of capacities of one cell that are written unconditionally: 64 at once (two days of an electric car), then
/// one per hour. Further capacities (of a hybrid that reverses every minute) are written only if they have changed,
/// because each row takes 100 bytes for years.
const CAPACITIES: BucketSize = BucketSize { burst: 64.0, period_s: 3600.0 };
/// Smallest change for which a further capacity is written, in standard deviations.
const MIN_CHANGE_STD: f64 = 0.25;
/// Commits reserved for each alarm, and for all filter resets together. Other alarms cannot use them up. Further
/// commits depend on the write budget. If both are used up, rows wait for a checkpoint, and only the first and the last
/// row of each alarm or cell are kept. The occurrence count covers the other rows. A rule that flickers in 96 cells at
/// different times causes 290 commits of about 70 kB on the first day.
const OWN_COMMITS: BucketSize = BucketSize { burst: 2.0, period_s: 86_400.0 };
/// How often waiting rows may be written with a checkpoint or with other rows: 60 times at once (one hour of
/// checkpoints), then once per hour. Each write adds two rows per alarm, which are kept for years.
const CARRIED: BucketSize = BucketSize { burst: 60.0, period_s: 3600.0 };

/// The capacity last written.
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

/// Selects the events that are kept in the history.
#[derive(Debug)]
pub(super) struct HistoryFilter {
    written: BTreeMap<CellIndex, WrittenCapacity>,
    written_life: WrittenLife,
    own_commits: BTreeMap<EventSubject, TokenBucket>,
    carried: TokenBucket,
    deferred: Vec<HistoryRow>,
}

impl Default for HistoryFilter {
    fn default() -> Self {
        Self {
            written: BTreeMap::new(),
            written_life: WrittenLife { cycles: None, token_bucket: TokenBucket::new(CAPACITIES) },
            own_commits: BTreeMap::new(),
            carried: TokenBucket::new(CARRIED),
            deferred: Vec::new(),
        }
    }
}

impl HistoryFilter {
    /// Returns the rows to commit with the state now (possibly none), including rows that waited. Returns `None` if
    /// nothing was learned and no alarm changed. Alarms that change too often do not count, and their rows wait.
    /// `has_room` states whether the write budget allows a commit.
    pub(super) fn take(&mut self, events: &[Event], has_room: bool) -> Option<Vec<HistoryRow>> {
        let now = events.iter().find(|event| is_learned(&event.kind))?.time;
        let learned = || events.iter().map(|event| event.kind).filter(is_learned);
        let may_wait = learned().all(|kind| EventSubject::of(&kind).is_some());
        if may_wait && !self.may_commit(learned().filter_map(|kind| EventSubject::of(&kind)), now) && !has_room {
            learned().for_each(|kind| self.defer(kind));
            return None;
        }
        let mut rows = self.for_checkpoint(now);
        let mut writes_capacity = false;
        for kind in learned() {
            // Loss modes follow from the cell's capacity, whose event comes first.
            let is_worth_writing = match kind {
                EventKind::LossModes { .. } => writes_capacity,
                _ => self.is_worth_writing(&kind, now),
            };
            if matches!(kind, EventKind::Capacity { .. }) {
                writes_capacity = is_worth_writing;
            }
            if is_worth_writing {
                let row = HistoryRow::Event(kind);
                // Waiting rows of the same alarm are written first.
                rows.extend(self.deferred.extract_if(.., |waiting| waiting.repeats(&row)));
                rows.push(row);
            }
        }
        Some(rows)
    }

    /// Takes the waiting rows, if a checkpoint may write them.
    pub(super) fn for_checkpoint(&mut self, now: Timestamp) -> Vec<HistoryRow> {
        let may_go = !self.deferred.is_empty() && self.carried.take(now);
        if may_go { self.deferred() } else { Vec::new() }
    }

    /// Takes the waiting rows.
    pub(super) fn deferred(&mut self) -> Vec<HistoryRow> {
        std::mem::take(&mut self.deferred)
    }

    fn may_commit(&mut self, mut subjects: impl Iterator<Item = EventSubject>, now: Timestamp) -> bool {
        let own = &mut self.own_commits;
        let mut of = |subject| own.entry(subject).or_insert(TokenBucket::new(OWN_COMMITS)).take(now);
        subjects.any(&mut of)
    }

    /// Keeps the first and the last row of each alarm and each cell's filter.
    fn defer(&mut self, kind: EventKind) {
        let row = HistoryRow::Event(kind);
        let same: Vec<usize> = (0..self.deferred.len()).filter(|&at| self.deferred[at].repeats(&row)).collect();
        if let [_, .., last] = same[..] {
            self.deferred.remove(last);
        }
        self.deferred.push(row);
    }

    /// Whether to write a remaining life. If the allowance is used up, it is written only if it has changed.
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

    /// Whether to write an event. A capacity is not written if it has no measurement and the same usable part. If the
    /// allowance is used up, it is not written if it has hardly changed.
    fn is_worth_writing(&mut self, kind: &EventKind, now: Timestamp) -> bool {
        if matches!(kind, EventKind::PackReplaced { .. }) {
            self.written_life.cycles = None;
        }
        if let EventKind::RemainingLife { cycles, cycles_low, .. } = *kind {
            // Half of the interval's lower part is a little less than a standard deviation.
            return self.is_life_worth_writing(
                cycles.zip(cycles_low).map(|(median, low)| (median, 0.5 * (median - low))),
                now,
            );
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

/// Whether an event must be durable before it is announced. Losing and regaining an alarm's value does not change what was
/// announced, and a flickering input causes many of these changes.
fn is_learned(kind: &EventKind) -> bool {
    match kind {
        EventKind::HalfCycle { .. }
        | EventKind::Capacity { .. }
        | EventKind::LossModes { .. }
        | EventKind::RemainingLife { .. }
        | EventKind::RechargePeriod { .. }
        | EventKind::Model { .. }
        | EventKind::AlarmDropped { .. }
        | EventKind::FilterReset { .. }
        | EventKind::PackReplaced { .. }
        | EventKind::PackIdentity { .. } => true,
        EventKind::Alarm { change, .. } => !matches!(change, Change::Suppressed | Change::Resumed),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::{alarm, capacity, half_cycle, loss_modes, model, remaining_life};
    use super::*;
    use crate::alarm::{Rule, Severity};

    /// Number of rows committed at once although the write budget is used up.
    fn take(history_filter: &mut HistoryFilter, seconds: f64, kinds: &[EventKind]) -> Option<usize> {
        let time = Timestamp::from_secs(seconds);
        let events: Vec<Event> = kinds.iter().map(|&kind| Event { time, kind }).collect();
        history_filter.take(&events, false).map(|rows| rows.len())
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
        // Constant, and slowly decreasing.
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
    fn flickering_alarm_keeps_first_and_last_row() {
        let mut history_filter = HistoryFilter::default();
        let (mut commits, mut rows) = (0, 0);
        for second in 0..10 * 86_400 {
            let change = if second % 2 == 0 { Change::Raised } else { Change::Cleared };
            if let Some(written) = take(&mut history_filter, f64::from(second), &[alarm(change)]) {
                (commits, rows) = (commits + 1, rows + written);
            }
        }
        assert!((11..=12).contains(&commits) && rows < 40, "{commits} commits, {rows} rows");
        let event = Event { time: Timestamp::from_secs(864_000.0), kind: alarm(Change::Raised) };
        assert!(
            history_filter.take(&[event], true).is_some_and(|rows| rows.len() == 3),
            "the new rows and those that waited"
        );
        assert!(history_filter.deferred().is_empty());
    }

    #[test]
    fn flickering_alarm_delays_no_other() {
        let mut history_filter = HistoryFilter::default();
        let of = |of_rule, of_severity, of_cell| {
            let mut kind = alarm(Change::Raised);
            if let EventKind::Alarm { rule, severity, cell, .. } = &mut kind {
                (*rule, *severity, *cell) = (of_rule, of_severity, of_cell);
            }
            kind
        };
        let noisy = of(Rule::SocLow, Severity::Warning, Some(CellIndex(0)));
        let mut commits = 0;
        for second in 0..2000 {
            let reset = EventKind::FilterReset { cell: CellIndex(second % 96) };
            for kind in [reset, noisy] {
                commits += u32::from(take(&mut history_filter, f64::from(second), &[kind]).is_some());
            }
        }
        assert_eq!(commits, 4, "two of each");
        assert_eq!(take(&mut history_filter, 2000.0, &[noisy]), None);
        let others = [
            of(Rule::SocLow, Severity::Severe, Some(CellIndex(0))),
            of(Rule::SocLow, Severity::Warning, Some(CellIndex(1))),
            of(Rule::SocLow, Severity::Warning, None),
        ];
        for kind in others {
            assert!(take(&mut history_filter, 2000.0, &[kind]).is_some(), "{kind:?}");
        }
    }

    #[test]
    fn waiting_rows_are_written_with_some_checkpoints() {
        let mut history_filter = HistoryFilter::default();
        let mut rows = 0;
        for minute in 0..1440_u32 {
            for second in 0..60_u32 {
                let change = if second % 2 == 0 { Change::Raised } else { Change::Cleared };
                take(&mut history_filter, f64::from(minute * 60 + second), &[alarm(change)]);
            }
            let waiting = history_filter.deferred.len();
            let taken = history_filter.for_checkpoint(Timestamp::from_secs(f64::from(minute * 60 + 59))).len();
            assert!(minute >= 60 || taken == waiting, "minute {minute}: {taken} of {waiting}");
            rows += taken;
        }
        assert!((100..=200).contains(&rows), "{rows} rows");
    }
}
