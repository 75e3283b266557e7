//! Builds the published documents: `info`, `spec_data`, a sample of the history, an event.
//!
//! Input: the daemon's status. Output: JSON. The same status gives the same bytes. Unknown values are `null`.

use packwatch_host::alarm::Rule;
use packwatch_host::monitor::CellView;
use packwatch_host::quantity::Timestamp;
use packwatch_host::quantity::catalogue::{CellValues, Part, Quantity};
use packwatch_host::status::document::{AlarmStatus, StatusDocument};
use packwatch_host::status::event_words::words;
use serde_json::{Map, Value, json};

use super::entity::{entities, published, stamp};

/// Values of the pack: every entity, and `alarms` with the state of each rule that has a threshold.
pub fn info(document: &StatusDocument) -> Value {
    let mut info: Map<_, _> =
        entities().iter().map(|entity| (entity.key.to_string(), entity.value(document))).collect();
    let alarms = document.alarms.rules.iter().map(|&rule| (rule.name().to_owned(), alarm(&document.alarms, rule)));
    info.insert("alarms".to_owned(), alarms.collect::<Map<_, _>>().into());
    info.into()
}

/// Whether an alarm of the rule is raised. If at least one alarm is unknown and no other alarm is raised, the result is
/// `null`.
fn alarm(alarms: &AlarmStatus, rule: Rule) -> Value {
    let is_raised = alarms.list.iter().any(|alarm| alarm.rule == rule && alarm.state.is_raised());
    let is_known = alarms.omitted == 0 && alarms.unknown.iter().all(|unknown| unknown.rule != rule);
    if is_raised || is_known { is_raised.into() } else { Value::Null }
}

/// Values of the cells: voltages in mV, whether each cell is trusted, and every quantity of a cell with an MQTT key. If
/// a quantity has a standard deviation, the standard deviation is published too.
pub fn spec_data(document: &StatusDocument) -> Value {
    let each = |of: &dyn Fn(&CellView) -> Value| document.cells.iter().map(of).collect::<Value>();
    let millivolts = |cell: &CellView| whole(cell.values.mean(Quantity::Voltage).map(|volts| volts * 1000.0));
    let mut data = Map::new();
    data.insert("time".to_owned(), stamp(document.wall_time).into());
    data.insert("cell_voltages_mv".to_owned(), each(&millivolts));
    data.insert("cell_trusted".to_owned(), each(&|cell| cell.trusted.into()));
    for (row, it) in CellValues::rows() {
        let Some(key) = it.mqtt_key else { continue };
        for (part, _) in row.parts() {
            let ending = if part == Part::Std { "_std" } else { "" };
            let value = |cell: &CellView| published(row.quantity, part, cell.values.part(row.quantity, part));
            data.insert(format!("{key}{ending}"), each(&value));
        }
    }
    data.into()
}

/// One sample of the history: the contents of `info` and `spec_data`.
pub fn sample(document: &StatusDocument) -> Value {
    json!({ "time": stamp(document.wall_time), "info": info(document), "spec_data": spec_data(document) })
}

/// An event of the daemon, with Battery-Emulator's keys `event_type`, `severity` and `message`. The event's time is
/// converted to the computer's clock.
pub fn event(document: &StatusDocument, event: &Value) -> Value {
    let text = |key: &str| event.get(key).and_then(Value::as_str);
    let name = text("event").unwrap_or("unknown");
    let ago_s = event.get("time").and_then(Value::as_i64).map(|time| document.time.since(Timestamp::from_nanos(time)));
    let time = ago_s.map(|ago_s| stamp(document.wall_time.plus_secs(-ago_s)));
    json!({
        "time": time,
        "event_type": text("rule").filter(|_| name == "alarm").unwrap_or(name),
        "severity": text("severity").unwrap_or("info"),
        "message": words(event, document),
        "data": event,
    })
}

/// Rounds to a whole number; `null` if the value is unknown or not finite.
fn whole(value: Option<f64>) -> Value {
    #[expect(clippy::cast_possible_truncation, reason = "voltages in mV are far within the range; `as` saturates")]
    value.filter(|value| value.is_finite()).map_or(Value::Null, |value| Value::from(value.round() as i64))
}

#[cfg(test)]
mod tests;
