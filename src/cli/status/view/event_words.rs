//! Describes an event of the status document for the live view: names without underscores, values with unit and
//! standard deviation, cells counted from 1, interfaces by name.

use serde_json::{Map, Value};

use crate::cell_faults::CellFault;
use crate::status::document::StatusDocument;

/// Units by suffix of the key.
const UNITS: [(&str, &str); 5] = [("_ah", " Ah"), ("_a", " A"), ("_v", " V"), ("_s", " s"), ("_c", " °C")];
/// Display names of abbreviated keys.
const NAMES: [(&str, &str); 5] = [
    ("lli", "lithium lost"),
    ("lam_ne", "negative electrode lost"),
    ("lam_pe", "positive electrode lost"),
    ("mean_nis", "innovations over expected"),
    ("what", ""),
];
/// Keys whose value is an index, which counts from 0 in the document.
const NUMBERED: [&str; 4] = ["cell", "cell_voltage", "temperature", "sensor"];

/// Formats the event without its time.
pub(super) fn words(event: &Map<String, Value>, document: &StatusDocument) -> String {
    let name = event.get("event").and_then(Value::as_str).unwrap_or("?").replace('_', " ");
    if let Some(finding) = finding(event) {
        return format!("{name}: {finding}");
    }
    let keys = event.iter().filter(|(key, _)| !matches!(key.as_str(), "time" | "event"));
    let parts: Vec<String> = keys.filter_map(|(key, value)| part(event, key, value, document)).collect();
    if parts.is_empty() { name } else { format!("{name}: {}", parts.join(", ")) }
}

/// Returns the finding that an event reports.
fn finding(event: &Map<String, Value>) -> Option<CellFault> {
    if event.get("event")? != "finding" {
        return None;
    }
    let keys = event.iter().filter(|(key, _)| !matches!(key.as_str(), "time" | "event"));
    let keys = keys.map(|(key, value)| (key.clone(), value.clone())).collect();
    serde_json::from_value(Value::Object(keys)).ok()
}

/// Formats a key with its value; `None` = the value is shown with another key.
fn part(event: &Map<String, Value>, key: &str, value: &Value, document: &StatusDocument) -> Option<String> {
    let (stem, unit) = UNITS.iter().find_map(|(end, unit)| Some((key.strip_suffix(end)?, *unit))).unwrap_or((key, ""));
    let end = &key[stem.len()..];
    if let Some(mean) = stem.strip_suffix("_std") {
        // The standard deviation is shown after the mean.
        return (!event.contains_key(&format!("{mean}{end}")))
            .then(|| format!("{} {}", named(stem), shown(key, value, document) + unit));
    }
    let std = event.get(&format!("{stem}_std{end}")).and_then(Value::as_f64);
    let std = std.map_or_else(String::new, |std| format!(" ± {}", number(std)));
    let name = named(stem);
    Some(match value {
        Value::Null => format!("{name} unknown"),
        Value::Bool(is_so) => {
            if *is_so {
                name
            } else {
                format!("not {name}")
            }
        }
        Value::Object(_) if name.is_empty() => shown(key, value, document),
        value => format!("{name} {}{std}{unit}", shown(key, value, document)).trim_start().to_owned(),
    })
}

fn named(key: &str) -> String {
    let known = NAMES.iter().find(|(name, _)| *name == key);
    known.map_or_else(|| key.replace('_', " "), |(_, words)| (*words).to_owned())
}

fn shown(key: &str, value: &Value, document: &StatusDocument) -> String {
    match value {
        Value::String(word) => word.replace('_', " "),
        Value::Number(index) if key == "bus" => {
            let interface = index.as_u64().and_then(|index| document.interfaces.get(usize::try_from(index).ok()?));
            interface.map_or_else(|| index.to_string(), |interface| interface.name.clone())
        }
        // The screen counts from 1.
        Value::Number(index) if NUMBERED.contains(&key) => (index.as_u64().unwrap_or(0) + 1).to_string(),
        Value::Number(it) if it.is_f64() => number(it.as_f64().unwrap_or(f64::NAN)),
        Value::Object(keys) => {
            let parts: Vec<String> = keys.iter().filter_map(|(key, value)| part(keys, key, value, document)).collect();
            parts.join(", ")
        }
        Value::Array(values) => values.iter().map(|value| shown(key, value, document)).collect::<Vec<_>>().join(" "),
        other => other.to_string(),
    }
}

/// Formats with at most four decimals, without trailing zeros and without "-0".
fn number(value: f64) -> String {
    let digits = format!("{value:.4}");
    let digits = digits.trim_end_matches('0').trim_end_matches('.');
    if digits == "-0" { "0".to_owned() } else { digits.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::status::sample::sample;

    fn said(event: &Value) -> String {
        words(event.as_object().expect("an object"), &sample(2))
    }

    #[test]
    fn event_words_contain_no_raw_keys() {
        let capacity = serde_json::json!({ "time": 1, "event": "capacity", "cell": 2, "measured_ah": null,
            "capacity_ah": 2.41, "capacity_std_ah": 0.02, "resistance_ratio": -0.00001, "resistance_ratio_std": 0.1 });
        assert_eq!(
            said(&capacity),
            "capacity: capacity 2.41 ± 0.02 Ah, cell 3, measured unknown, resistance ratio 0 ± 0.1"
        );
        let bad =
            serde_json::json!({ "event": "signal_bad", "channel": { "cell_voltage": 72 }, "fault": "out_of_range" });
        assert_eq!(said(&bad), "signal bad: channel cell voltage 73, fault out of range");
        let finding = serde_json::json!({ "time": 1, "event": "finding", "kind": "leak", "cells": [6, 6], "since": 1_700_000_000_000_000_000_u64,
            "reported": 1_700_000_000_000_000_000_u64, "probability": 1.0, "size": { "mean": 0.1, "variance": 1e-6 } });
        assert_eq!(said(&finding), "finding: cell 7: loses charge by itself, 10.00 ± 0.10 % of its capacity a day");
        let trust = serde_json::json!({ "event": "trust", "cell": 0, "trusted": false, "mean_nis": 3.25 });
        assert_eq!(said(&trust), "trust: cell 1, innovations over expected 3.25, not trusted");
        let bus = serde_json::json!({ "event": "bus", "bus": 0, "what": { "dropped": { "frames": 3 } } });
        assert!(
            said(&bus).starts_with(&format!("bus: bus {}, dropped frames 3", sample(2).interfaces[0].name)),
            "{}",
            said(&bus)
        );
        assert_eq!(said(&serde_json::json!({ "event": "store", "works": false })), "store: not works");
    }
}
