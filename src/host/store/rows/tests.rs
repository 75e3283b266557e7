//! Creates events for the tests of the store, and tests the rows made from these events.

use super::*;
use crate::alarm::{AlarmState, Change, Rule, Severity};
use crate::cell::Chemistry;
use crate::monitor::ModelState;
use crate::quantity::catalogue::{Quantity, RecordedPackValues, RecordedValues};
use crate::quantity::{CellIndex, Mode};

pub(in crate::store) fn capacity(cell: u16, measured_ah: Option<f64>, usable_ah: f64) -> EventKind {
    EventKind::Capacity {
        cell: CellIndex(cell),
        measured_ah,
        measured_std_ah: measured_ah.map(|_| 0.1),
        values: RecordedValues::default()
            .with(Quantity::Capacity, Some((2.5, 0.05)))
            .with(Quantity::UsableCapacity, Some((usable_ah, 0.06)))
            .with(Quantity::ResistanceRatio, Some((1.1, 0.02))),
    }
}

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

pub(in crate::store) fn loss_modes(cell: u16, lli: f64) -> EventKind {
    EventKind::LossModes {
        cell: CellIndex(cell),
        lli,
        lli_std: 0.03,
        lam_ne: 0.05,
        lam_ne_std: 0.05,
        lam_pe: 0.05,
        lam_pe_std: 0.05,
    }
}

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

/// A learned cell model with this capacity; `None` = the daemon returns to the model made from the cell's label.
pub(in crate::store) fn model(capacity_ah: Option<f64>) -> EventKind {
    EventKind::Model {
        state: capacity_ah.map_or(ModelState::Prior, |_| ModelState::Learning),
        capacity_ah,
        capacity_std_ah: capacity_ah.map(|_| 0.05),
        residual_v: capacity_ah.map(|_| 0.003),
        chemistry: None,
        is_taken_back: capacity_ah.is_none(),
    }
}

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
    let own = HistoryRow::Own { reason: "damaged", detail: "x".to_owned() };
    let kinds = [
        half_cycle(3),
        capacity(3, None, 2.4),
        loss_modes(3, 0.1),
        remaining_life(100.0),
        EventKind::Outlook { values: RecordedPackValues::default() },
        model(None),
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
    for row in kinds.into_iter().map(HistoryRow::Event).chain([own]) {
        let (table, values) = row.values().unwrap();
        assert_eq!(values.len(), table.columns().len(), "{row:?}");
    }
}

#[test]
fn unknown_model_values_are_null() {
    let text = |word: &str| Value::Text(word.to_owned());
    let values = |kind: EventKind| HistoryRow::Event(kind).values().unwrap();
    let (table, learning) = values(model(Some(2.0)));
    assert_eq!(table, HistoryTable::Model);
    let [capacity, std, residual] = [2.0, 0.05, 0.003].map(Value::Real);
    assert_eq!(learning, [Value::Null, text("learning"), capacity, std, residual, Value::Null, Value::Integer(0)]);
    let [_, state, unknown @ .., taken_back] = &values(model(None)).1[..] else { panic!() };
    assert_eq!((state, taken_back), (&text("prior"), &Value::Integer(1)));
    assert!(unknown.len() == 4 && unknown.iter().all(|value| *value == Value::Null), "{unknown:?}");
    let (state, chemistry) = (ModelState::Unfit, Some(Chemistry::LfpGraphite));
    let (capacity_ah, is_taken_back) = (Some(f64::NAN), false);
    let unfit =
        EventKind::Model { state, capacity_ah, capacity_std_ah: None, residual_v: None, chemistry, is_taken_back };
    let row = values(unfit).1;
    assert_eq!((&row[1], &row[2], &row[5]), (&text("unfit"), &Value::Null, &text("lfp-graphite")));
}

#[test]
fn values_have_their_columns_types() {
    let text = |word: &str| Value::Text(word.to_owned());
    let values = |kind: EventKind| HistoryRow::Event(kind).values().unwrap().1;
    let expected = [
        Value::Integer(3),
        text("charge"),
        Value::Real(1.5),
        Value::Real(0.6),
        Value::Null,
        Value::Real(3600.0),
        Value::Real(-1.5),
        Value::Real(25.0),
    ];
    assert_eq!(values(half_cycle(3)), expected);
    let [cell, rule, severity, change, state, active, value, ..] = &values(alarm(Change::Raised))[..] else { panic!() };
    assert_eq!((cell, rule, severity), (&Value::Null, &text("soc_low"), &text("warning")));
    assert_eq!((change, state), (&text("raised"), &text("active")));
    assert_eq!((active, value), (&Value::Integer(1), &Value::Real(0.05)));
    let (rule, severity) = (Rule::SocLow, Severity::Severe);
    let dropped = EventKind::AlarmDropped { rule, severity, cell: None, active: true, occurrences: 3 };
    let [_, _, _, change, state, active, .., occurrences, acknowledged] = &values(dropped)[..] else { panic!() };
    assert_eq!((change, state), (&text("dropped"), &text("inactive")));
    assert_eq!((active, occurrences, acknowledged), (&Value::Integer(0), &Value::Integer(3), &Value::Integer(0)));
    for rule in Rule::ALL {
        let EventKind::Alarm { cell, change, state, active, severity, value, probability, .. } = alarm(Change::Raised)
        else {
            panic!()
        };
        let (threshold, occurrences, acknowledged) = (f64::NAN, 1, false);
        let kind = EventKind::Alarm {
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
        };
        let row = values(kind);
        assert_eq!((&row[1], &row[8]), (&text(rule.name()), &Value::Null), "SQLite has no NaN");
    }
}
