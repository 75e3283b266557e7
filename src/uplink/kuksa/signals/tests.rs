//! Tests the values of the signals for given documents: signs, unknown values, and consistency of the table.

use std::collections::BTreeSet;

use packwatch_host::quantity::catalogue::{Estimate, Values};
use packwatch_host::status::client::parse;

use super::*;

/// The document that the tests with real clients use, with all missing values filled in.
fn document() -> StatusDocument {
    let mut document = parse(include_bytes!("../../../../tests/kuksa/status.json")).unwrap();
    fill(&mut document.pack.values);
    document.cells.iter_mut().for_each(|cell| fill(&mut cell.values));
    document
}

fn fill<const IS_PACK: bool>(values: &mut Values<IS_PACK>) {
    for (row, _) in Values::<IS_PACK>::rows() {
        let made_up = Estimate { mean: 0.5, std: row.std_key.map(|_| 0.1) };
        values.set(row.quantity, values.get(row.quantity).or(Some(made_up)));
    }
}

fn value(document: &StatusDocument, name: &str) -> Option<Value> {
    let signal = all().find(|signal| signal.name == name).unwrap();
    signal.value(document)
}

#[test]
fn complete_document_gives_every_signal_a_value() {
    let document = document();
    let mut names = BTreeSet::new();
    for signal in all() {
        let value = signal.value(&document);
        assert_eq!(value.map(|value| value.data_type()), Some(signal.data_type), "{}", signal.name);
        assert!(names.insert((&signal.name, signal.origin == Origin::Standard)), "{} twice", signal.name);
    }
}

#[test]
fn charge_current_is_positive_in_vss() {
    let mut document = document();
    assert_eq!(value(&document, "CurrentCurrent"), Some(Value::Float(-12.5)));
    let Some(Value::Float(power_w)) = value(&document, "CurrentPower") else { panic!("no power") };
    assert!(power_w < -180.0, "a discharge takes power out of the battery: {power_w}");
    assert_eq!(value(&document, "CurrentSensor.Offset"), Some(Value::Float(0.034)));
    assert_eq!(
        value(&document, "Cells.Current")
            .map(|value| matches!(value, Value::Floats(all) if all.iter().all(|a| *a < 0.0))),
        Some(true)
    );
    document.pack.values.set(Quantity::Current, Some(0.0));
    let Some(Value::Float(rest_a)) = value(&document, "CurrentCurrent") else { panic!("no current") };
    assert!(rest_a.is_sign_positive(), "-0 A");
}

#[test]
fn unknown_cell_hides_values_over_all_cells() {
    let mut document = document();
    document.cells[2].values.set(Quantity::Voltage, None::<f64>);
    for name in
        ["CellVoltage.CellVoltages", "CellVoltage.Min", "CellVoltage.IdMin", "CellVoltage.Max", "CellVoltage.IdMax"]
    {
        assert_eq!(value(&document, name), None, "{name}");
    }
    assert!(value(&document, "Temperature.CellTemperature").is_some());
    document.cells[1].values.set(Quantity::Temperature, None::<f64>);
    for name in ["Temperature.CellTemperature", "Temperature.Average", "Temperature.Min"] {
        assert_eq!(value(&document, name), None, "{name}");
    }
}

#[test]
fn missing_cell_hides_array() {
    let mut document = document();
    document.cells.remove(1);
    for signal in all().filter(|signal| matches!(signal.data_type, DataType::Floats | DataType::Flags)) {
        assert_eq!(signal.value(&document), None, "{}", signal.name);
    }
    document.cells.clear();
    assert_eq!(value(&document, "Cells.Capacity"), None);
}

#[test]
fn extreme_cell_is_first_of_equal_voltage() {
    let mut document = document();
    for (cell, voltage_v) in document.cells.iter_mut().zip([3.5, 3.25, 3.75, 3.25]) {
        cell.values.set(Quantity::Voltage, Some(voltage_v));
    }
    assert_eq!(value(&document, "CellVoltage.Min"), Some(Value::Float(3.25)));
    assert_eq!(value(&document, "CellVoltage.IdMin"), Some(Value::Uint16(1)));
    assert_eq!(value(&document, "CellVoltage.Max"), Some(Value::Float(3.75)));
    assert_eq!(value(&document, "CellVoltage.IdMax"), Some(Value::Uint16(2)));
}

#[test]
fn empty_error_codes_need_every_threshold_evaluated() {
    let mut document = document();
    assert_eq!(value(&document, "ErrorCodes"), Some(Value::Texts(vec!["capacity_low:severe:cell0".into()])));
    let unknown = parse(include_bytes!("../../../../tests/kuksa/status.json")).unwrap().alarms.list[0];
    document.alarms.list.clear();
    document.alarms.raised = 0;
    document.alarms.highest_severity = None;
    assert_eq!(value(&document, "ErrorCodes"), Some(Value::Texts(Vec::new())));
    assert_eq!(value(&document, "Alarms.HighestSeverity"), Some(Value::Text("none".into())));
    document.alarms.unknown = vec![packwatch_host::control::protocol::UnknownAlarms {
        rule: unknown.rule,
        severity: unknown.severity,
        alarms: 1,
    }];
    assert_eq!(value(&document, "ErrorCodes"), None);
    assert_eq!(value(&document, "Alarms.HighestSeverity"), None);
    document.alarms.unknown.clear();
    document.alarms.thresholds = 0;
    assert_eq!(value(&document, "ErrorCodes"), None, "no thresholds");
}

#[test]
fn missing_estimates_never_look_healthy() {
    let mut document = document();
    document.findings.clear();
    assert_eq!(value(&document, "Findings"), Some(Value::Texts(Vec::new())));
    document.pack.values.set(Quantity::Soc, None::<f64>);
    assert_eq!(value(&document, "Findings"), None);
    document.pack.values.set(Quantity::Current, None::<f64>);
    assert_eq!(value(&document, "CurrentSensor.IsFrozen"), None);
    assert_eq!(value(&document, "CurrentPower"), None);
}
