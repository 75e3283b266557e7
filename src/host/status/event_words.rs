//! Describes an event of the status document for people: names without underscores, values with unit and standard
//! deviation, cells counted from 1, interfaces by name, states in words.

use serde_json::{Map, Value};

use crate::alarm::Rule;
use crate::can::CanId;
use crate::cell_faults::CellFault;
use crate::status::document::StatusDocument;

/// Units by suffix of the key.
const UNITS: [(&str, &str); 7] =
    [("_per_s", " per s"), ("_ah", " Ah"), ("_a", " A"), ("_v", " V"), ("_s", " s"), ("_c", " °C"), ("seconds", " s")];
/// Events whose text depends on a boolean key: name, key, text if true, text if false.
const STATES: [(&str, &str, &str, &str); 9] = [
    ("bus_asleep", "asleep", "buses asleep", "buses awake"),
    ("flood", "active", "frame rate too high, dropping frames", "frame rate normal again"),
    ("model", "is_taken_back", "cell model reverted, the previous one was better", "cell model"),
    ("own_identifier", "active", "another node sends our identifiers", "no other node sends our identifiers"),
    ("protection", "usable", "protected message usable again", "protected message fails its check"),
    ("second_sender", "active", "second sender", "second sender stopped"),
    ("store", "works", "files can be written", "a file cannot be written"),
    ("test", "running", "alarm test started", "alarm test ended"),
    ("trust", "trusted", "estimate trusted again", "estimate untrusted"),
];
/// Keys that are shown for an alarm after its rule and its change.
const OF_ALARM: [&str; 4] = ["cell", "severity", "threshold", "value"];
/// Keys whose numbers are hexadecimal.
const HEXADECIMAL: [&str; 6] = ["against", "class", "code", "identifier", "service", "to"];
/// Display names of keys.
const NAMES: [(&str, &str); 15] = [
    ("bus", ""),
    ("bus_event", ""),
    ("channel", ""),
    ("command", ""),
    ("chemistry", "better chemistry"),
    ("id", "message"),
    ("intact", "intact frame"),
    ("missed", ""),
    ("node_event", ""),
    ("poll", ""),
    ("lli", "lithium lost"),
    ("lam_ne", "negative electrode lost"),
    ("lam_pe", "positive electrode lost"),
    ("mean_nis", "innovations over expected"),
    ("what", ""),
];
/// Keys whose value is an index, which counts from 0 in the document.
const NUMBERED: [&str; 4] = ["cell", "cell_voltage", "temperature", "sensor"];

/// Formats the event without its time.
pub fn words(event: &Value, document: &StatusDocument) -> String {
    let Value::Object(event) = event else { return event.to_string() };
    let text = |key: &str| event.get(key).and_then(Value::as_str).unwrap_or("unknown");
    let name = text("event");
    if let Some(finding) = finding(event) {
        return format!("{name}: {finding}");
    }
    let state = STATES.iter().find(|(event, ..)| *event == name);
    let (name, hidden) = match (name, state) {
        ("alarm", _) => (format!("{} {}", text("rule"), text("change")), ""),
        ("bus", _) => ("interface".to_owned(), ""),
        ("j1939", _) => ("J1939 node".to_owned(), ""),
        ("poll", _) => ("diagnostic requests".to_owned(), ""),
        (_, Some((_, key, yes, no))) => {
            ((if event.get(*key) == Some(&true.into()) { *yes } else { *no }).to_owned(), *key)
        }
        _ => (name.to_owned(), ""),
    };
    let name = name.replace('_', " ");
    let is_shown = |key: &str| match event.get("change") {
        Some(_) => OF_ALARM.contains(&key),
        None => !["time", "event", hidden].contains(&key),
    };
    let keys = event.iter().filter(|(key, _)| is_shown(key));
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
    let rule = event.get("rule").filter(|_| ["threshold", "value"].contains(&key));
    if let (Some(rule), Some(value)) = (rule, value.as_f64()) {
        let rule: Option<Rule> = serde_json::from_value(rule.clone()).ok();
        return Some(format!("{name} {}", rule.map_or_else(|| number(value), |rule| rule.with_unit(value))));
    }
    Some(match value {
        // If one of these keys is null, nothing is unknown. For example, an event without a cell is about the whole
        // pack.
        Value::Null if ["cell", "chemistry", "seconds"].contains(&key) => return None,
        Value::Null => format!("{name} unknown"),
        Value::Bool(is_so) => {
            if *is_so {
                name
            } else {
                format!("not {name}")
            }
        }
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
        Value::Number(it) if HEXADECIMAL.contains(&key) => {
            it.as_u64().map_or_else(|| it.to_string(), |it| format!("{it:02X}"))
        }
        // The index counts from 0, but people count from 1.
        Value::Number(index) if NUMBERED.contains(&key) => (index.as_u64().unwrap_or(0) + 1).to_string(),
        Value::Number(it) if it.is_f64() => number(it.as_f64().unwrap_or(f64::NAN)),
        Value::Object(_) if key == "id" => {
            serde_json::from_value::<CanId>(value.clone()).map_or_else(|_| value.to_string(), |id| id.to_string())
        }
        Value::Object(keys) => {
            // A selector that is null selects everything, so it is not shown.
            let known = keys.iter().filter(|(_, value)| !value.is_null());
            let parts: Vec<String> = known.filter_map(|(key, value)| part(keys, key, value, document)).collect();
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
#[path = "tests/event_words.rs"]
mod tests;
