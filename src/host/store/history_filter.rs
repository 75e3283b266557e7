//! What of the core's events the history keeps, and what of it is worth a commit of its own: an alarm that flickers must
//! not wear the flash, and must not keep another one from it.

use std::collections::BTreeMap;

use super::rows::{Row, Subject};
use super::token_bucket::{Limit, TokenBucket};
use crate::alarm::Change;
use crate::monitor::{Event, EventKind};
use crate::quantity::{CellIndex, Timestamp};

/// Capacities of one cell written whatever they say: two days' of an electric car at once, then one an hour. Beyond
/// (a hybrid that turns every minute) a row must say something: 100 bytes each, for ever.
const CAPACITIES: Limit = Limit { burst: 64.0, period_s: 3600.0 };
/// Beyond that, what a capacity must have moved by to be written, in standard deviations.
const NEWS_STD: f64 = 0.25;
/// Commits that each alarm has for itself alone, and all filters that start again together: what other alarms do cannot
/// keep it from the disk.
const OWN_COMMITS: Limit = Limit { burst: 10.0, period_s: 6.0 * 3600.0 };
/// Commits for whatever is beyond that (a threshold in the noise, a cell model that does not fit). Beyond both, rows wait
/// for a checkpoint, and of one alarm's or cell's only the first and the last are kept; the count of occurrences tells how
/// many went. A rule that flickers in all of 96 cells makes 1,500 commits on the first day, of some 10 kB, and then 400.
const SHARED_COMMITS: Limit = Limit { burst: 500.0, period_s: 3600.0 };
/// Times that rows in waiting go with a checkpoint or with others: an hour of checkpoints, then once an hour. They stay
/// for ever, and each time there are two of each alarm.
const CARRIED: Limit = Limit { burst: 60.0, period_s: 3600.0 };

/// A capacity as last written.
#[derive(Debug, Clone, Copy)]
struct Written {
    capacity_ah: f64,
    usable_ah: Option<f64>,
    token_bucket: TokenBucket,
}

/// A remaining life as last written: its median, and a deviation of it; `None` = it was not known.
#[derive(Debug, Clone, Copy)]
struct WrittenLife {
    cycles: Option<(f64, f64)>,
    token_bucket: TokenBucket,
}

/// What one input's events are worth.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum CommitDecision {
    /// Nothing was learned, and nothing became of an alarm.
    Nothing,
    /// Rows to commit now, perhaps none, with the state they were learned in.
    Commit(Vec<Row>),
    /// Alarms that come too often: their rows wait.
    Deferred,
}

/// Picks from the core's events what the history keeps.
#[derive(Debug)]
pub(super) struct HistoryFilter {
    written: BTreeMap<CellIndex, Written>,
    written_life: WrittenLife,
    own_commits: BTreeMap<Subject, TokenBucket>,
    shared_commits: TokenBucket,
    carried: TokenBucket,
    deferred: Vec<Row>,
}

impl Default for HistoryFilter {
    fn default() -> Self {
        Self {
            written: BTreeMap::new(),
            written_life: WrittenLife { cycles: None, token_bucket: TokenBucket::new(CAPACITIES) },
            own_commits: BTreeMap::new(),
            shared_commits: TokenBucket::new(SHARED_COMMITS),
            carried: TokenBucket::new(CARRIED),
            deferred: Vec::new(),
        }
    }
}

impl HistoryFilter {
    /// Judges one input's events; rows that waited come with those that do not.
    pub(super) fn take(&mut self, events: &[Event]) -> CommitDecision {
        let Some(now) = events.iter().find(|event| is_learned(&event.kind)).map(|event| event.time) else {
            return CommitDecision::Nothing;
        };
        let learned = || events.iter().map(|event| event.kind).filter(is_learned);
        let may_wait = learned().all(|kind| Subject::of(&kind).is_some());
        if may_wait && !self.may_commit(learned().filter_map(|kind| Subject::of(&kind)), now) {
            learned().for_each(|kind| self.defer(kind));
            return CommitDecision::Deferred;
        }
        let mut rows = self.for_checkpoint(now);
        for kind in learned() {
            if self.is_news(&kind, now) {
                let row = Row::Event(kind);
                // What waited of the same alarm comes before it.
                rows.extend(self.deferred.extract_if(.., |waiting| waiting.repeats(&row)));
                rows.push(row);
            }
        }
        CommitDecision::Commit(rows)
    }

    /// Rows that waited, when a checkpoint may take them.
    pub(super) fn for_checkpoint(&mut self, now: Timestamp) -> Vec<Row> {
        let goes = !self.deferred.is_empty() && self.carried.take(now);
        if goes { self.deferred() } else { Vec::new() }
    }

    /// Rows that waited.
    pub(super) fn deferred(&mut self) -> Vec<Row> {
        std::mem::take(&mut self.deferred)
    }

    fn may_commit(&mut self, mut subjects: impl Iterator<Item = Subject>, now: Timestamp) -> bool {
        let own = &mut self.own_commits;
        let mut of = |subject| own.entry(subject).or_insert(TokenBucket::new(OWN_COMMITS)).take(now);
        subjects.any(&mut of) || self.shared_commits.take(now)
    }

    /// Keeps the first and the last row of each alarm and each cell's filter.
    fn defer(&mut self, kind: EventKind) {
        let row = Row::Event(kind);
        let same: Vec<usize> = (0..self.deferred.len()).filter(|&at| self.deferred[at].repeats(&row)).collect();
        if let [_, .., last] = same[..] {
            self.deferred.remove(last);
        }
        self.deferred.push(row);
    }

    /// As for capacities: when there have been many, one that has hardly moved is no news.
    fn is_news_of_life(&mut self, cycles: Option<(f64, f64)>, now: Timestamp) -> bool {
        let written = &mut self.written_life;
        let has_moved = match (written.cycles, cycles) {
            (Some((before, _)), Some((median, std))) => (median - before).abs() > NEWS_STD * std,
            (before, now) => before.is_some() != now.is_some(),
        };
        let is_news = written.token_bucket.take(now) || has_moved;
        if is_news {
            written.cycles = cycles;
        }
        is_news
    }

    /// A capacity that a half-cycle told nothing about, and whose usable part is the same, is no news; nor is, when
    /// there have been many, one that has hardly moved.
    fn is_news(&mut self, kind: &EventKind, now: Timestamp) -> bool {
        if matches!(kind, EventKind::PackReplaced { .. }) {
            self.written_life.cycles = None;
        }
        if let EventKind::RemainingLife { cycles, cycles_low, .. } = *kind {
            // Half of the interval's lower part: a little less than a deviation.
            return self
                .is_news_of_life(cycles.zip(cycles_low).map(|(median, low)| (median, 0.5 * (median - low))), now);
        }
        let EventKind::Capacity {
            cell, measured_ah, capacity_ah, capacity_std_ah, usable_capacity_ah: usable_ah, ..
        } = *kind
        else {
            return !matches!(kind, EventKind::RechargePeriod { .. });
        };
        let new = Written { capacity_ah, usable_ah, token_bucket: TokenBucket::new(CAPACITIES) };
        let before = self.written.get(&cell).copied();
        if measured_ah.is_none() && before.is_none_or(|before| before.usable_ah == usable_ah) {
            self.written.entry(cell).or_insert(new);
            return false;
        }
        let written = self.written.entry(cell).or_insert(new);
        let far = |a: f64, b: f64| (a - b).abs() >= NEWS_STD * capacity_std_ah;
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

/// What is made durable before it is announced. An alarm whose value went missing or came back is no change of what was
/// announced, and a flickering input makes many of them.
fn is_learned(kind: &EventKind) -> bool {
    match kind {
        EventKind::HalfCycle { .. }
        | EventKind::Capacity { .. }
        | EventKind::RemainingLife { .. }
        | EventKind::RechargePeriod { .. }
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
    use super::super::rows::tests::{alarm, capacity, half_cycle, remaining_life};
    use super::*;
    use crate::alarm::{Rule, Severity};

    fn take(history_filter: &mut HistoryFilter, seconds: f64, kinds: &[EventKind]) -> Option<usize> {
        let time = Timestamp::from_secs(seconds);
        let events: Vec<Event> = kinds.iter().map(|&kind| Event { time, kind }).collect();
        match history_filter.take(&events) {
            CommitDecision::Commit(rows) => Some(rows.len()),
            CommitDecision::Nothing | CommitDecision::Deferred => None,
        }
    }

    #[test]
    fn a_capacity_is_written_when_there_is_something_new_in_it() {
        let mut history_filter = HistoryFilter::default();
        assert_eq!(take(&mut history_filter, 0.0, &[capacity(0, Some(2.4), 2.3)]), Some(1));
        assert_eq!(take(&mut history_filter, 0.0, &[capacity(0, None, 2.3)]), Some(0));
        assert_eq!(take(&mut history_filter, 0.0, &[capacity(0, None, 2.2)]), Some(1));
        assert_eq!(take(&mut history_filter, 0.0, &[half_cycle(0), capacity(0, Some(2.4), 2.2)]), Some(2));
    }

    #[test]
    fn a_flickering_input_writes_nothing() {
        let mut history_filter = HistoryFilter::default();
        assert_eq!(take(&mut history_filter, 0.0, &[alarm(Change::Suppressed), alarm(Change::Resumed)]), None);
        assert_eq!(take(&mut history_filter, 0.0, &[alarm(Change::Raised)]), Some(1));
    }

    #[test]
    fn a_pack_that_turns_every_minute_writes_what_moves() {
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
    fn remaining_lives_are_written_until_there_are_many_and_then_when_they_move() {
        let day = |per_minute: f64| {
            let (mut history_filter, mut rows) = (HistoryFilter::default(), 0);
            for minute in 0..1440 {
                let kinds = [half_cycle(0), remaining_life(per_minute * f64::from(100_000 - minute))];
                rows += take(&mut history_filter, f64::from(minute) * 60.0, &kinds).unwrap() - 1;
            }
            assert!((64 + 22..=64 + 24).contains(&rows), "{rows} rows");
            history_filter
        };
        // Nothing any more, and slowly less.
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
        assert_eq!(take(&mut history_filter, 86_342.0, &[half_cycle(0), unknown]), Some(2), "not known any longer");
        assert_eq!(take(&mut history_filter, 86_343.0, &[half_cycle(0), unknown]), Some(1));
    }

    #[test]
    fn an_alarm_that_flickers_without_end_is_written_now_and_then_with_its_ends() {
        let mut history_filter = HistoryFilter::default();
        let (mut commits, mut rows) = (0, 0);
        for second in 0..86_400 {
            let change = if second % 2 == 0 { Change::Raised } else { Change::Cleared };
            if let Some(written) = take(&mut history_filter, f64::from(second), &[alarm(change)]) {
                (commits, rows) = (commits + 1, rows + written);
            }
        }
        assert!((530..545).contains(&commits) && rows < 1700, "{commits} commits, {rows} rows");
        assert!(history_filter.deferred().len() <= 2);
    }

    #[test]
    fn what_misfits_keeps_no_other_alarm_from_the_disk() {
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
        assert!((500..=525).contains(&commits), "{commits}");
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
    fn rows_that_wait_go_with_a_checkpoint_but_not_with_every_one_for_ever() {
        let mut history_filter = HistoryFilter::default();
        let mut rows = 0;
        for minute in 0..1440_u32 {
            for second in 0..60_u32 {
                let change = if second % 2 == 0 { Change::Raised } else { Change::Cleared };
                take(&mut history_filter, f64::from(minute * 60 + second), &[alarm(change)]);
            }
            let waiting = history_filter.deferred.len();
            let taken = history_filter.for_checkpoint(Timestamp::from_secs(f64::from(minute * 60 + 59))).len();
            assert!(minute > 60 || taken == waiting, "minute {minute}: {taken} of {waiting}");
            rows += taken;
        }
        assert!((100..=200).contains(&rows), "{rows} rows");
    }
}
