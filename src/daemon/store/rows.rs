//! The rows of the history and how they are made from the core's events.

use std::collections::BTreeMap;

use rusqlite::types::Value;
use serde::Serialize;

use super::allowance::{Allowance, Limit};
use super::stamp::Stamp;
use crate::alarm::Change;
use crate::monitor::{Event, EventKind};
use crate::quantity::{CellIndex, Timestamp};

/// One row to write.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Row {
    /// A half-cycle, a capacity, an alarm, a filter that started again, another pack: as the core told it.
    Event(EventKind),
    /// Something that happened to the store itself.
    Own {
        /// A word for what: `damaged`, `rows_lost`.
        reason: &'static str,
        /// The rest, for people.
        detail: String,
    },
}

/// Rows of one moment.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Batch {
    /// When.
    pub(crate) stamp: Stamp,
    /// What, in the order in which it was told.
    pub(crate) rows: Vec<Row>,
}

/// A table of the history.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Table {
    /// Charges and discharges; the oldest are thinned.
    HalfCycle,
    /// Capacities learned; chained, never thinned.
    Capacity,
    /// Alarms; chained, never thinned.
    Alarm,
    /// Resets, other packs, damages; chained, never thinned.
    Reset,
}

impl Table {
    /// All, in the order in which they are shown.
    pub(crate) const ALL: [Self; 4] = [Self::HalfCycle, Self::Capacity, Self::Alarm, Self::Reset];
    /// Those whose rows are chained by hash.
    pub(crate) const CHAINED: [Self; 3] = [Self::Capacity, Self::Alarm, Self::Reset];

    /// Its name in the database.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::HalfCycle => "half_cycle",
            Self::Capacity => "capacity",
            Self::Alarm => "alarm",
            Self::Reset => "reset",
        }
    }

    /// Its columns besides the moment, the sequence number and the hash.
    pub(crate) const fn columns(self) -> &'static [&'static str] {
        match self {
            Self::HalfCycle => &[
                "cell",
                "mode",
                "charge_ah",
                "swing",
                "swing_std",
                "duration_s",
                "mean_current_a",
                "mean_temperature_c",
            ],
            Self::Capacity => &[
                "cell",
                "measured_ah",
                "measured_std_ah",
                "capacity_ah",
                "capacity_std_ah",
                "usable_capacity_ah",
                "usable_capacity_std_ah",
                "resistance_ratio",
                "resistance_ratio_std",
            ],
            Self::Alarm => &[
                "cell",
                "rule",
                "severity",
                "change",
                "state",
                "active",
                "value",
                "probability",
                "threshold",
                "occurrences",
                "acknowledged",
            ],
            Self::Reset => &["cell", "reason", "capacity_ah", "capacity_std_ah", "detail"],
        }
    }
}

impl Row {
    /// Its table and the values of the table's columns; `None` = the history has no row for it. Cells count from 0.
    pub(super) fn values(&self) -> Option<(Table, Vec<Value>)> {
        let row = match self {
            Self::Own { reason, detail } => (
                Table::Reset,
                vec![Value::Null, Value::Text((*reason).to_owned()), Value::Null, Value::Null, detail.clone().into()],
            ),
            Self::Event(kind) => event_values(kind)?,
        };
        Some(row)
    }

    /// Detail that may go first when there is no room for all.
    pub(super) const fn is_detail(&self) -> bool {
        matches!(self, Self::Event(EventKind::HalfCycle { .. }))
    }

    /// Whether both are of one alarm, or of one cell's filter.
    fn repeats(&self, other: &Self) -> bool {
        let key = |row: &Self| match row {
            Self::Event(EventKind::Alarm { rule, cell, severity, .. }) => Some((Some((*rule, *severity)), *cell)),
            Self::Event(EventKind::FilterReset { cell }) => Some((None, Some(*cell))),
            _ => None,
        };
        key(self).is_some() && key(self) == key(other)
    }

    /// The number of the pack that is connected, as it is told here.
    pub(super) const fn pack_identity(&self) -> Option<f64> {
        match self {
            Self::Event(EventKind::PackIdentity { identity }) => Some(*identity),
            _ => None,
        }
    }

    /// Whether another pack begins after it.
    pub(super) const fn replaces_pack(&self) -> bool {
        matches!(self, Self::Event(EventKind::PackReplaced { .. }))
    }
}

fn event_values(kind: &EventKind) -> Option<(Table, Vec<Value>)> {
    Some(match *kind {
        EventKind::HalfCycle {
            cell,
            mode,
            charge_ah,
            swing,
            swing_std,
            duration_s,
            mean_current_a,
            mean_temperature_c,
        } => (
            Table::HalfCycle,
            vec![
                whole(cell.0),
                word(&mode),
                real(charge_ah),
                maybe(swing),
                maybe(swing_std),
                real(duration_s),
                real(mean_current_a),
                maybe(mean_temperature_c),
            ],
        ),
        EventKind::Capacity {
            cell,
            measured_ah,
            measured_std_ah,
            capacity_ah,
            capacity_std_ah,
            usable_capacity_ah,
            usable_capacity_std_ah,
            resistance_ratio,
            resistance_ratio_std,
        } => (
            Table::Capacity,
            vec![
                whole(cell.0),
                maybe(measured_ah),
                maybe(measured_std_ah),
                real(capacity_ah),
                real(capacity_std_ah),
                maybe(usable_capacity_ah),
                maybe(usable_capacity_std_ah),
                real(resistance_ratio),
                real(resistance_ratio_std),
            ],
        ),
        EventKind::Alarm {
            rule,
            cell,
            change,
            state,
            active,
            severity,
            value,
            probability,
            threshold,
            occurrences,
            acknowledged,
        } => (
            Table::Alarm,
            vec![
                cell.map_or(Value::Null, |cell| whole(cell.0)),
                Value::Text(rule.name().to_owned()),
                word(&severity),
                word(&change),
                word(&state),
                whole(u8::from(active)),
                maybe(value),
                maybe(probability),
                real(threshold),
                whole(occurrences),
                whole(u8::from(acknowledged)),
            ],
        ),
        EventKind::FilterReset { cell } => {
            (Table::Reset, vec![whole(cell.0), word(&"filter_reset"), Value::Null, Value::Null, Value::Null])
        }
        EventKind::PackReplaced { capacity_ah, capacity_std_ah } => (
            Table::Reset,
            vec![Value::Null, word(&"pack_replaced"), maybe(capacity_ah), maybe(capacity_std_ah), Value::Null],
        ),
        EventKind::PackIdentity { identity } => (
            Table::Reset,
            vec![Value::Null, word(&"pack_identity"), Value::Null, Value::Null, Value::Text(identity.to_string())],
        ),
        _ => return None,
    })
}

fn whole(value: impl Into<i64>) -> Value {
    Value::Integer(value.into())
}

fn real(value: f64) -> Value {
    // SQLite has no NaN: it would store NULL, and the hash would differ.
    if value.is_nan() { Value::Null } else { Value::Real(value) }
}

fn maybe(value: Option<f64>) -> Value {
    value.map_or(Value::Null, real)
}

/// A choice as events and configurations write it.
fn word(value: &impl Serialize) -> Value {
    match serde_json::to_value(value) {
        Ok(serde_json::Value::String(word)) => Value::Text(word),
        _ => Value::Null,
    }
}

/// Capacities of one cell written whatever they say: two days' of an electric car at once, then one an hour. Beyond
/// (a hybrid that turns every minute) a row must say something: 100 bytes each, for ever.
const CAPACITIES: Limit = Limit { burst: 64.0, period_s: 3600.0 };
/// Beyond that, what a capacity must have moved by to be written, in standard deviations.
const NEWS_STD: f64 = 0.25;
/// Commits for alarms and filters that start again alone: a thousand at once, then one an hour. Beyond (a threshold in
/// the noise, a cell model that does not fit) rows wait, and of one alarm's or cell's only the first and the last are
/// kept; the count of occurrences tells how many went. The state with the alarms in it is checkpointed all the same.
const ALARM_COMMITS: Limit = Limit { burst: 1000.0, period_s: 3600.0 };

/// A capacity as last written.
#[derive(Debug, Clone, Copy)]
struct Written {
    capacity_ah: f64,
    usable_ah: Option<f64>,
    allowance: Allowance,
}

/// What one input's events are worth.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Worth {
    /// Nothing was learned, and nothing became of an alarm.
    Nothing,
    /// Rows to commit now, perhaps none, with the state they were learned in.
    Commit(Vec<Row>),
    /// Alarms that come too often: their rows wait.
    Deferred,
}

/// Picks from the core's events what the history keeps.
#[derive(Debug)]
pub(crate) struct Gatherer {
    written: BTreeMap<CellIndex, Written>,
    alarm_commits: Allowance,
    deferred: Vec<Row>,
}

impl Default for Gatherer {
    fn default() -> Self {
        Self { written: BTreeMap::new(), alarm_commits: Allowance::new(ALARM_COMMITS), deferred: Vec::new() }
    }
}

impl Gatherer {
    /// Judges one input's events; rows that waited come with those that do not.
    pub(crate) fn take(&mut self, events: &[Event]) -> Worth {
        let Some(now) = events.iter().find(|event| is_learned(&event.kind)).map(|event| event.time) else {
            return Worth::Nothing;
        };
        let learned = || events.iter().map(|event| event.kind).filter(is_learned);
        let alarms_only = learned().all(|kind| matches!(kind, EventKind::Alarm { .. } | EventKind::FilterReset { .. }));
        if alarms_only && !self.alarm_commits.take(now) {
            learned().for_each(|kind| self.defer(kind));
            return Worth::Deferred;
        }
        let mut rows = self.deferred();
        rows.extend(learned().filter(|kind| self.is_news(kind, now)).map(Row::Event));
        Worth::Commit(rows)
    }

    /// Rows that waited.
    pub(crate) fn deferred(&mut self) -> Vec<Row> {
        std::mem::take(&mut self.deferred)
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

    /// A capacity that a half-cycle told nothing about, and whose usable part is the same, is no news; nor is, when
    /// there have been many, one that has hardly moved.
    fn is_news(&mut self, kind: &EventKind, now: Timestamp) -> bool {
        let EventKind::Capacity {
            cell, measured_ah, capacity_ah, capacity_std_ah, usable_capacity_ah: usable_ah, ..
        } = *kind
        else {
            return !matches!(kind, EventKind::RechargePeriod { .. });
        };
        let new = Written { capacity_ah, usable_ah, allowance: Allowance::new(CAPACITIES) };
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
        if written.allowance.take(now) || has_moved {
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
        | EventKind::RechargePeriod { .. }
        | EventKind::FilterReset { .. }
        | EventKind::PackReplaced { .. }
        | EventKind::PackIdentity { .. } => true,
        EventKind::Alarm { change, .. } => !matches!(change, Change::Suppressed | Change::Resumed),
        _ => false,
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::alarm::{Rule, Severity, State};
    use crate::quantity::Mode;

    /// A capacity of a cell, with or without information.
    pub(in crate::daemon::store) fn capacity(cell: u16, measured_ah: Option<f64>, usable_ah: f64) -> EventKind {
        EventKind::Capacity {
            cell: CellIndex(cell),
            measured_ah,
            measured_std_ah: measured_ah.map(|_| 0.1),
            capacity_ah: 2.5,
            capacity_std_ah: 0.05,
            usable_capacity_ah: Some(usable_ah),
            usable_capacity_std_ah: Some(0.06),
            resistance_ratio: 1.1,
            resistance_ratio_std: 0.02,
        }
    }

    /// A half-cycle of a cell.
    pub(in crate::daemon::store) fn half_cycle(cell: u16) -> EventKind {
        EventKind::HalfCycle {
            cell: CellIndex(cell),
            mode: Mode::Charge,
            charge_ah: 1.5,
            swing: Some(0.6),
            swing_std: None,
            duration_s: 3600.0,
            mean_current_a: -1.5,
            mean_temperature_c: Some(25.0),
        }
    }

    /// An alarm of the pack.
    pub(in crate::daemon::store) fn alarm(change: Change) -> EventKind {
        EventKind::Alarm {
            rule: Rule::SocLow,
            cell: None,
            change,
            state: State::Active,
            active: true,
            severity: Severity::Warning,
            value: Some(0.05),
            probability: None,
            threshold: 0.1,
            occurrences: 1,
            acknowledged: false,
        }
    }

    fn take(gatherer: &mut Gatherer, seconds: f64, kinds: &[EventKind]) -> Option<usize> {
        let time = Timestamp::from_secs(seconds);
        let events: Vec<Event> = kinds.iter().map(|&kind| Event { time, kind }).collect();
        match gatherer.take(&events) {
            Worth::Commit(rows) => Some(rows.len()),
            Worth::Nothing | Worth::Deferred => None,
        }
    }

    #[test]
    fn every_row_has_a_value_per_column() {
        let own = Row::Own { reason: "damaged", detail: "x".to_owned() };
        let kinds = [
            half_cycle(3),
            capacity(3, None, 2.4),
            alarm(Change::Raised),
            EventKind::FilterReset { cell: CellIndex(1) },
            EventKind::PackReplaced { capacity_ah: Some(2.0), capacity_std_ah: None },
        ];
        for row in kinds.into_iter().map(Row::Event).chain([own]) {
            let (table, values) = row.values().unwrap();
            assert_eq!(values.len(), table.columns().len(), "{row:?}");
        }
    }

    #[test]
    fn a_capacity_is_written_when_there_is_something_new_in_it() {
        let mut gatherer = Gatherer::default();
        assert_eq!(take(&mut gatherer, 0.0, &[capacity(0, Some(2.4), 2.3)]), Some(1));
        assert_eq!(take(&mut gatherer, 0.0, &[capacity(0, None, 2.3)]), Some(0));
        assert_eq!(take(&mut gatherer, 0.0, &[capacity(0, None, 2.2)]), Some(1));
        assert_eq!(take(&mut gatherer, 0.0, &[half_cycle(0), capacity(0, Some(2.4), 2.2)]), Some(2));
    }

    #[test]
    fn a_flickering_input_writes_nothing() {
        let mut gatherer = Gatherer::default();
        assert_eq!(take(&mut gatherer, 0.0, &[alarm(Change::Suppressed), alarm(Change::Resumed)]), None);
        assert_eq!(take(&mut gatherer, 0.0, &[alarm(Change::Raised)]), Some(1));
    }

    #[test]
    fn a_pack_that_turns_every_minute_writes_what_moves() {
        let mut gatherer = Gatherer::default();
        let mut rows = 0;
        for minute in 0..1440 {
            rows += take(&mut gatherer, f64::from(minute) * 60.0, &[capacity(0, Some(2.4), 2.3)]).unwrap();
        }
        assert!((64 + 22..=64 + 24).contains(&rows), "{rows} rows");
        assert_eq!(take(&mut gatherer, 86_341.0, &[capacity(0, Some(2.4), 2.31)]), Some(0));
        assert_eq!(take(&mut gatherer, 86_342.0, &[capacity(0, Some(2.4), 2.2)]), Some(1), "far");
    }

    #[test]
    fn an_alarm_that_flickers_without_end_is_written_now_and_then_with_its_ends() {
        let mut gatherer = Gatherer::default();
        let (mut commits, mut rows) = (0, 0);
        for second in 0..86_400 {
            let change = if second % 2 == 0 { Change::Raised } else { Change::Cleared };
            if let Some(written) = take(&mut gatherer, f64::from(second), &[alarm(change)]) {
                (commits, rows) = (commits + 1, rows + written);
            }
        }
        assert!((1020..1030).contains(&commits) && rows < 1100, "{commits} commits, {rows} rows");
        assert!(gatherer.deferred().len() <= 2);
    }
}
