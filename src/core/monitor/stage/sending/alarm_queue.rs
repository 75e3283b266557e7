//! Decides which alarm is sent next. In: changed alarms, the alarm engine, the time. Out: one alarm at a time, most
//! severe first.
//!
//! A changed alarm is sent at once and then repeated. In addition, all raised alarms are sent *in turn*, one after
//! another, each once per period. All frames share one budget, a token bucket: [`BURST`] frames at once, then one frame
//! every [`ALARM_DELAY_MS`]. The first frames of changes have the highest priority. Frames in turn come next, and use
//! at most half of the budget. Repetitions have the lowest priority.
//!
//! Deviation: a frame shows the alarm's state at the time of sending, not at each change. Effect: if an alarm changes
//! twice while the budget is used up, the receiver gets only the second change.

use std::cmp::Reverse;

use serde::{Deserialize, Serialize};

use crate::alarm::{Alarm, AlarmEngine, AlarmState, Rule, Severity};
use crate::can::encode::{ALARM_DELAY_MS, CHANGE_REPETITION_MS, CHANGE_REPETITIONS};
use crate::quantity::{CellIndex, Timestamp};

/// Number of frames that may be sent at once after a pause. One event usually changes fewer alarms, for example the
/// alarms of a few cells or of all modules.
const BURST: i64 = 20;
/// Shortest time between frames in turn, in units of [`ALARM_DELAY_MS`]. Half of the budget thus remains for changes.
const TURN_DELAYS: u32 = 2;
/// Maximum number of alarms for which a frame announces that their state is unknown. It is more than the 54 thresholds
/// (18 rules, three severities). Further unknown alarms are not announced, but the digest (the frame with the state of
/// every rule) shows their rules as unknown.
const MAX_UNKNOWN: usize = 64;

const NANOS_PER_MS: i64 = 1_000_000;
const DELAY_NS: i64 = ALARM_DELAY_MS as i64 * NANOS_PER_MS;
const REPETITION_NS: i64 = CHANGE_REPETITION_MS as i64 * NANOS_PER_MS;

/// Identity of an alarm; ordered most severe first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct AlarmKey {
    severity: Reverse<Severity>,
    rule: Rule,
    cell: Option<CellIndex>,
}

impl AlarmKey {
    pub(crate) fn new(rule: Rule, severity: Severity, cell: Option<CellIndex>) -> Self {
        Self { severity: Reverse(severity), rule, cell }
    }

    fn of(alarm: &Alarm) -> Self {
        Self::new(alarm.rule, alarm.severity, alarm.cell)
    }

    pub(crate) fn parts(self) -> (Rule, Severity, Option<CellIndex>) {
        (self.rule, self.severity.0, self.cell)
    }

    fn find(self, engine: &AlarmEngine) -> Option<Alarm> {
        engine.find(self.rule, self.severity.0, self.cell)
    }
}

/// A changed alarm whose frames have not all been sent.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct ChangedAlarm {
    key: AlarmKey,
    /// Number of frames left to send.
    frames: u32,
    due: Timestamp,
}

impl ChangedAlarm {
    const fn is_first(&self) -> bool {
        self.frames > CHANGE_REPETITIONS
    }
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct AlarmQueue {
    /// Changed alarms, most severe first; each alarm at most once.
    changed: Vec<ChangedAlarm>,
    /// Alarms that were announced as unknown and are not yet known again.
    unknown: Vec<AlarmKey>,
    /// The raised alarm that was last sent in turn.
    last: Option<AlarmKey>,
    /// Time of the next frame in turn; `None` if no alarm is raised.
    turn: Option<Timestamp>,
    /// Time from which the budget allows a frame.
    free: Timestamp,
}

impl AlarmQueue {
    pub(crate) fn has_unknown(&self) -> bool {
        !self.unknown.is_empty()
    }

    /// Time in which every raised alarm is sent once in turn (s).
    pub(crate) fn pass_time_s(engine: &AlarmEngine, period_s: f64) -> f64 {
        let count = i64::try_from(engine.count()).unwrap_or(i64::MAX).max(1);
        Timestamp::from_nanos(Self::turn_ns(engine, period_s).saturating_mul(count)).secs()
    }

    /// Time between two frames in turn (ns). All raised alarms are sent in each period, unless the budget requires more
    /// time.
    fn turn_ns(engine: &AlarmEngine, period_s: f64) -> i64 {
        let period_ns = Timestamp::ZERO.plus_secs(period_s).nanos().max(1);
        let count = i64::try_from(engine.count()).unwrap_or(i64::MAX).max(1);
        let least_ns = i64::from(TURN_DELAYS) * DELAY_NS;
        period_ns.saturating_add(count - 1).checked_div(count).unwrap_or(period_ns).max(least_ns)
    }

    /// Schedules a changed alarm, which is sent at once and repeated.
    pub(crate) fn note_change(&mut self, now: Timestamp, key: AlarmKey) {
        let entry = ChangedAlarm { key, frames: 1 + CHANGE_REPETITIONS, due: now };
        match self.changed.binary_search_by_key(&key, |changed| changed.key) {
            Ok(place) => self.changed[place] = entry,
            Err(place) => self.changed.insert(place, entry),
        }
    }

    /// The next alarm whose first frame after a change is due and within the budget.
    pub(crate) fn take_changed(&mut self, now: Timestamp) -> Option<AlarmKey> {
        self.take_entry(now, ChangedAlarm::is_first)
    }

    /// The next alarm to send; `None` if no alarm is due or the budget is used up.
    pub(crate) fn take(&mut self, now: Timestamp, engine: &AlarmEngine, period_s: f64) -> Option<AlarmKey> {
        self.take_changed(now)
            .or_else(|| self.take_turn(now, engine, period_s))
            .or_else(|| self.take_entry(now, |_| true))
    }

    fn take_entry(&mut self, now: Timestamp, accepts: impl Fn(&ChangedAlarm) -> bool) -> Option<AlarmKey> {
        if self.free > now {
            return None;
        }
        let place = self.changed.iter().position(|changed| changed.due <= now && accepts(changed))?;
        self.pay(now);
        let entry = &mut self.changed[place];
        let key = entry.key;
        (entry.frames, entry.due) = (entry.frames.saturating_sub(1), now.plus_nanos(REPETITION_NS));
        if entry.frames == 0 {
            self.changed.remove(place);
        }
        Some(key)
    }

    /// The next raised alarm in turn, if its frame is due.
    fn take_turn(&mut self, now: Timestamp, engine: &AlarmEngine, period_s: f64) -> Option<AlarmKey> {
        if engine.count() == 0 {
            self.turn = None;
            return None;
        }
        let step_ns = Self::turn_ns(engine, period_s);
        let due = *self.turn.get_or_insert(now.plus_nanos(step_ns));
        if due > now || self.free > now {
            return None;
        }
        // Missed turns are made up for, for example if a tick was late, but only those of the last `BURST` delays.
        let earliest = now.plus_nanos(-BURST * DELAY_NS);
        self.turn = Some(due.max(earliest).plus_nanos(step_ns));
        let keys = || engine.raised().map(|alarm| AlarmKey::of(&alarm));
        let next = keys().filter(|key| self.last.is_none_or(|last| *key > last)).min().or_else(|| keys().min())?;
        self.last = Some(next);
        self.pay(now);
        Some(next)
    }

    /// Skips the frames in turn that are due.
    pub(crate) fn skip_turns(&mut self, now: Timestamp, engine: &AlarmEngine, period_s: f64) {
        let next = now.plus_nanos(Self::turn_ns(engine, period_s));
        self.turn = self.turn.map(|turn| if turn > now { turn } else { next });
    }

    /// The next alarm to announce as unknown, if any. Returns `None` if the budget is used up, or if a new alarm would
    /// exceed [`MAX_UNKNOWN`].
    pub(crate) fn take_unknown(&mut self, now: Timestamp, engine: &AlarmEngine, turn: usize) -> Option<Alarm> {
        let alarm = engine.unknown_alarm(turn).filter(|_| self.free <= now)?;
        let key = AlarmKey::of(&alarm);
        if !self.unknown.contains(&key) {
            if self.unknown.len() >= MAX_UNKNOWN {
                return None;
            }
            self.unknown.push(key);
        }
        self.pay(now);
        Some(alarm)
    }

    /// Schedules a change for each alarm that was announced as unknown and is known again.
    pub(crate) fn note_known(&mut self, now: Timestamp, engine: &AlarmEngine) {
        let is_open = |key: &AlarmKey| {
            let state = key.find(engine).map(|alarm| alarm.state);
            matches!(state, Some(AlarmState::Unknown | AlarmState::Pending))
        };
        let known: Vec<AlarmKey> = self.unknown.extract_if(.., |key| !is_open(key)).collect();
        for key in known {
            self.note_change(now, key);
        }
    }

    fn pay(&mut self, now: Timestamp) {
        self.free = self.free.max(now.plus_nanos(-(BURST - 1) * DELAY_NS)).plus_nanos(DELAY_NS);
    }

    /// Time at which the next frame is due and within the budget; `None` if nothing waits.
    pub(crate) fn next_due(&self) -> Option<Timestamp> {
        let changed = self.changed.iter().map(|changed| changed.due).min();
        changed.into_iter().chain(self.turn).min().map(|due| due.max(self.free))
    }

    /// Number of frames that become due up to `now` if no alarm changes.
    pub(crate) fn frames_until(&self, now: Timestamp, engine: &AlarmEngine, period_s: f64) -> u64 {
        let due = |from: Timestamp, step_ns: i64| {
            let past_ns = now.nanos().saturating_sub(from.nanos());
            if past_ns < 0 { 0 } else { u64::try_from(past_ns / step_ns.max(1)).unwrap_or(0) + 1 }
        };
        let repeated = self.changed.iter().map(|it| due(it.due, REPETITION_NS).min(it.frames.into()));
        let turns = self.turn.map_or(0, |turn| due(turn, Self::turn_ns(engine, period_s)));
        repeated.fold(turns, u64::saturating_add)
    }

    /// Moves every due time that is later than `now` to `now`. Called after a start, after a sleep, and after the clock
    /// was set back.
    pub(crate) fn restart(&mut self, now: Timestamp) {
        self.free = self.free.min(now);
        self.turn = self.turn.map(|turn| turn.min(now));
        self.changed.iter_mut().for_each(|changed| changed.due = changed.due.min(now));
    }

    /// Corrects the due times of a queue that was stored at `stored` and is restored at `now`: no frame is due later
    /// than one period after `now`. If time has passed since the queue was stored, the budget is used up at first,
    /// because an earlier process may have sent a burst just before its end.
    pub(crate) fn limit(&mut self, stored: Timestamp, now: Timestamp, period_s: f64) {
        let least = if stored < now { now.plus_nanos(DELAY_NS) } else { self.free };
        self.free = least.min(now.plus_nanos(DELAY_NS));
        self.turn = self.turn.map(|turn| turn.min(now.plus_secs(period_s)));
        self.changed.iter_mut().for_each(|changed| changed.due = changed.due.min(now.plus_nanos(REPETITION_NS)));
    }

    /// Uses up the budget, because frames of an earlier process may have used it at any time up to `now`.
    pub(crate) fn use_up(&mut self, now: Timestamp) {
        self.free = now.plus_nanos(DELAY_NS);
    }

    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.free = self.free.plus_nanos(by_nanos);
        self.turn = self.turn.map(|turn| turn.plus_nanos(by_nanos));
        self.changed.iter_mut().for_each(|changed| changed.due = changed.due.plus_nanos(by_nanos));
    }

    pub(crate) fn clear(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests;
