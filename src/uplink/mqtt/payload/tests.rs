//! Tests the published documents: signs, units, and null for unknown values.

use super::*;

fn document() -> StatusDocument {
    serde_json::from_str(include_str!("../../tests/data/status.json")).unwrap()
}

#[test]
fn published_soc_is_percent_and_charge_positive() {
    let mut document = document();
    document.cells.truncate(1);
    let info = info(&document);
    for (key, value) in [
        ("SOC", json!(63.2)),
        ("SOC_std", json!(1.2)),
        ("state_of_health", json!(92.8)),
        ("battery_current", json!(-12.5)),
        // The pack has 7.3 V and discharges with 12.5 A.
        ("stat_batt_power", json!(-91.0)),
        ("charging_state", json!("Discharging")),
        ("battery_current_offset", json!(0.034)),
        ("cell_max_voltage", json!(3.6)),
        ("cell_voltage_delta", json!(0.0)),
        ("min_cell_number", json!(1)),
        ("limiting_cell", json!(1)),
        ("time", json!("2027-01-15T08:00:00.000Z")),
        ("validity", json!("valid")),
        ("event_level", json!("severe")),
        ("lithium_loss_std", json!(1.2)),
    ] {
        assert_eq!(info[key], value, "{key}");
    }
}

#[test]
fn unknown_values_are_null() {
    let mut document = document();
    let pack: Map<_, _> = serde_json::to_value(document.pack).unwrap().as_object().unwrap().clone();
    let without = |(key, value): (String, Value)| {
        let is_number = value.is_number() || key == "moved";
        (key, if is_number { Value::Null } else { value })
    };
    document.pack = serde_json::from_value(pack.into_iter().map(without).collect::<Map<_, _>>().into()).unwrap();
    document.cells.remove(0);
    let info = info(&document);
    let known = [
        "alarms",
        "alarms_raised",
        "charging_state",
        "event_level",
        "late_ticks",
        "software_version",
        "time",
        "uptime",
        "validity",
    ];
    for (key, value) in info.as_object().unwrap() {
        assert_eq!(!value.is_null(), known.contains(&key.as_str()), "{key} = {value}");
    }
    let cells = spec_data(&document);
    for (key, value) in cells.as_object().unwrap().iter().filter(|(key, _)| *key != "time") {
        assert_eq!(value, &json!([null]), "{key}");
    }
}

#[test]
fn event_level_none_needs_every_threshold_evaluated() {
    let mut document = document();
    let of = |document: &StatusDocument| info(document)["event_level"].clone();
    let unknown = std::mem::take(&mut document.alarms.unknown);
    (document.alarms.raised, document.alarms.highest_severity, document.alarms.thresholds) = (0, None, 2);
    assert_eq!(of(&document), json!("none"));
    let rule = document.alarms.list[0].rule;
    document.alarms.unknown = unknown;
    document.alarms.unknown.push(packwatch_host::control::protocol::UnknownAlarms {
        rule,
        severity: packwatch_host::alarm::Severity::Warning,
        alarms: 1,
    });
    assert_eq!(of(&document), Value::Null);
    document.alarms.highest_severity = Some(packwatch_host::alarm::Severity::Severe);
    assert_eq!(of(&document), json!("severe"));
    (document.alarms.highest_severity, document.alarms.thresholds) = (None, 0);
    document.alarms.unknown.clear();
    assert_eq!(of(&document), Value::Null, "no thresholds");
}

#[test]
fn omitted_alarm_is_not_published_as_healthy() {
    let mut document = document();
    let of = |document: &StatusDocument, rule: &str| info(document)["alarms"][rule].clone();
    assert_eq!(of(&document, "soc_low"), json!(false));
    // The list had no room for all alarms.
    document.alarms.omitted = 1;
    assert_eq!((of(&document, "soc_low"), of(&document, "capacity_low")), (Value::Null, json!(true)));
    // Rules without thresholds have no state.
    assert_eq!(info(&document)["alarms"].get("cell_leak"), None);
}

#[test]
fn alarm_event_has_rule_severity_and_wall_time() {
    let mut document = document();
    document.wall_time = document.time.plus_secs(100.0);
    let raised = json!({
        "time": document.time.plus_secs(-5.0).nanos(), "event": "alarm", "rule": "capacity_low", "cell": 2, "change": "raised",
        "state": "active", "active": true, "severity": "warning", "value": 2.412_345, "probability": null, "threshold": 2.5,
    });
    let event = event(&document, &raised);
    assert_eq!(event["time"], "2027-01-15T08:01:35.000Z");
    assert_eq!((&event["event_type"], &event["severity"]), (&json!("capacity_low"), &json!("warning")));
    assert_eq!(event["message"], "capacity low raised: cell 3, severity warning, threshold 2.500 Ah, value 2.412 Ah");
    assert_eq!(event["data"], raised);
}
