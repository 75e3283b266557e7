//! The rows of the history, and the values of their columns from the core's events.

use rusqlite::types::Value;
use serde::Serialize;

use super::stamp::Stamp;
use crate::alarm::{AlarmState, Rule, Severity};
use crate::monitor::EventKind;
use crate::quantity::CellIndex;

/// One row to write.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Row {
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
pub(super) struct Batch {
    /// When.
    pub stamp: Stamp,
    /// What, in the order in which it was told.
    pub rows: Vec<Row>,
}

/// A table of the history.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Table {
    /// Charges and discharges; the oldest are thinned.
    HalfCycle,
    /// Capacities learned; chained, never thinned.
    Capacity,
    /// What remained of the life of the cell whose life ends first; chained, never thinned.
    RemainingLife,
    /// Alarms; chained, never thinned.
    Alarm,
    /// Resets, other packs, damages; chained, never thinned.
    Reset,
}

impl Table {
    /// All, in the order in which they are shown.
    pub(super) const ALL: [Self; 5] = [Self::HalfCycle, Self::Capacity, Self::RemainingLife, Self::Alarm, Self::Reset];
    /// Those whose rows are chained by hash.
    pub(super) const CHAINED: [Self; 4] = [Self::Capacity, Self::RemainingLife, Self::Alarm, Self::Reset];

    /// Whether a database of this layout's version has it.
    pub(super) const fn is_in(self, version: i32) -> bool {
        version >= if matches!(self, Self::RemainingLife) { 2 } else { 1 }
    }

    /// Its name in the database.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::HalfCycle => "half_cycle",
            Self::Capacity => "capacity",
            Self::RemainingLife => "remaining_life",
            Self::Alarm => "alarm",
            Self::Reset => "reset",
        }
    }

    /// Its columns besides the moment, the sequence number and the hash.
    pub(super) const fn columns(self) -> &'static [&'static str] {
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
            Self::RemainingLife => &["cell", "cycles", "cycles_low", "cycles_high", "days", "days_low", "days_high"],
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
    pub(super) fn repeats(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Event(EventKind::FilterReset { cell }), Self::Event(EventKind::FilterReset { cell: other })) => {
                cell == other
            }
            (Self::Event(one), Self::Event(other)) => {
                let subject = Subject::of(one);
                subject.is_some_and(|subject| subject != Subject::Filters) && subject == Subject::of(other)
            }
            _ => false,
        }
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

/// What may come again and again without anything having been learned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Subject {
    /// Filters that start again, of whatever cell.
    Filters,
    /// An alarm.
    Alarm(Rule, Severity, Option<CellIndex>),
}

impl Subject {
    /// Of an event; `None` = it is of another kind.
    pub(super) const fn of(kind: &EventKind) -> Option<Self> {
        match *kind {
            EventKind::FilterReset { .. } => Some(Self::Filters),
            EventKind::Alarm { rule, severity, cell, .. } => Some(Self::Alarm(rule, severity, cell)),
            _ => None,
        }
    }
}

fn event_values(kind: &EventKind) -> Option<(Table, Vec<Value>)> {
    let reset = |cell: Value, reason: &str, detail: Value| {
        (Table::Reset, vec![cell, Value::Text(reason.to_owned()), Value::Null, Value::Null, detail])
    };
    Some(match *kind {
        EventKind::HalfCycle { .. } => (Table::HalfCycle, half_cycle_values(kind)?),
        EventKind::Capacity { .. } => (Table::Capacity, capacity_values(kind)?),
        EventKind::RemainingLife { cell, cycles, cycles_low, cycles_high, days, days_low, days_high } => {
            let mut values = vec![cell.map_or(Value::Null, |cell| whole(cell.0))];
            values.extend([cycles, cycles_low, cycles_high, days, days_low, days_high].map(maybe));
            (Table::RemainingLife, values)
        }
        EventKind::Alarm { .. } => (Table::Alarm, alarm_values(kind)?),
        EventKind::AlarmDropped { rule, severity, cell, active: _, occurrences } => {
            (Table::Alarm, dropped_values(rule, severity, cell, occurrences))
        }
        EventKind::FilterReset { cell } => reset(whole(cell.0), "filter_reset", Value::Null),
        EventKind::PackIdentity { identity } => reset(Value::Null, "pack_identity", Value::Text(identity.to_string())),
        EventKind::PackReplaced { capacity_ah, capacity_std_ah } => (
            Table::Reset,
            vec![Value::Null, word(&"pack_replaced"), maybe(capacity_ah), maybe(capacity_std_ah), Value::Null],
        ),
        _ => return None,
    })
}

fn half_cycle_values(kind: &EventKind) -> Option<Vec<Value>> {
    let EventKind::HalfCycle {
        cell,
        mode,
        charge_ah,
        swing,
        swing_std,
        duration_s,
        mean_current_a,
        mean_temperature_c,
    } = *kind
    else {
        return None;
    };
    Some(vec![
        whole(cell.0),
        word(&mode),
        real(charge_ah),
        maybe(swing),
        maybe(swing_std),
        real(duration_s),
        real(mean_current_a),
        maybe(mean_temperature_c),
    ])
}

fn capacity_values(kind: &EventKind) -> Option<Vec<Value>> {
    let EventKind::Capacity {
        cell,
        measured_ah,
        measured_std_ah,
        capacity_ah,
        capacity_std_ah,
        usable_capacity_ah,
        usable_capacity_std_ah,
        resistance_ratio,
        resistance_ratio_std,
    } = *kind
    else {
        return None;
    };
    Some(vec![
        whole(cell.0),
        maybe(measured_ah),
        maybe(measured_std_ah),
        real(capacity_ah),
        real(capacity_std_ah),
        maybe(usable_capacity_ah),
        maybe(usable_capacity_std_ah),
        real(resistance_ratio),
        real(resistance_ratio_std),
    ])
}

fn alarm_values(kind: &EventKind) -> Option<Vec<Value>> {
    let EventKind::Alarm {
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
    } = *kind
    else {
        return None;
    };
    Some(vec![
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
    ])
}

/// An alarm that nothing watches any more has ended, without a value that said so.
fn dropped_values(rule: Rule, severity: Severity, cell: Option<CellIndex>, occurrences: u32) -> Vec<Value> {
    vec![
        cell.map_or(Value::Null, |cell| whole(cell.0)),
        Value::Text(rule.name().to_owned()),
        word(&severity),
        word(&"dropped"),
        word(&AlarmState::Inactive),
        whole(0),
        Value::Null,
        Value::Null,
        Value::Null,
        whole(occurrences),
        whole(0),
    ]
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

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::alarm::Change;
    use crate::quantity::Mode;

    /// A capacity of a cell, with or without information.
    pub(in crate::store) fn capacity(cell: u16, measured_ah: Option<f64>, usable_ah: f64) -> EventKind {
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
    pub(in crate::store) fn half_cycle(cell: u16) -> EventKind {
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

    /// What remains of the pack's life, cycles.
    pub(in crate::store) fn remaining_life(cycles: f64) -> EventKind {
        EventKind::RemainingLife {
            cell: Some(CellIndex(2)),
            cycles: Some(cycles),
            cycles_low: Some(0.5 * cycles),
            cycles_high: Some(2.0 * cycles),
            days: None,
            days_low: None,
            days_high: None,
        }
    }

    /// An alarm of the pack.
    pub(in crate::store) fn alarm(change: Change) -> EventKind {
        EventKind::Alarm {
            rule: Rule::SocLow,
            cell: None,
            change,
            state: AlarmState::Active,
            active: true,
            severity: Severity::Warning,
            value: Some(0.05),
            probability: None,
            threshold: 0.1,
            occurrences: 1,
            acknowledged: false,
        }
    }

    #[test]
    fn every_row_has_a_value_per_column() {
        let own = Row::Own { reason: "damaged", detail: "x".to_owned() };
        let kinds = [
            half_cycle(3),
            capacity(3, None, 2.4),
            remaining_life(100.0),
            alarm(Change::Raised),
            EventKind::AlarmDropped {
                rule: Rule::SocLow,
                severity: Severity::Severe,
                cell: None,
                active: true,
                occurrences: 3,
            },
            EventKind::FilterReset { cell: CellIndex(1) },
            EventKind::PackReplaced { capacity_ah: Some(2.0), capacity_std_ah: None },
        ];
        for row in kinds.into_iter().map(Row::Event).chain([own]) {
            let (table, values) = row.values().unwrap();
            assert_eq!(values.len(), table.columns().len(), "{row:?}");
        }
    }
}
