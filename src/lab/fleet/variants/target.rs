//! Finds what the key of a `--set` option refers to, and sets its value in a configuration.

use toml::{Table, Value};

use super::{Choice, VariantGrid};
use crate::alarm::Rule;

/// Severities in keys, the mildest first.
const SEVERITIES: [&str; 3] = ["info", "warning", "severe"];
/// Other keys of an `[[alarm]]` table that `--set` can replace.
const ALARM_KEYS: [&str; 8] =
    ["when", "probability", "hysteresis", "debounce_s", "debounce_events", "latched", "spn", "fmi"];

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Target {
    /// A threshold of a rule, with its severity and either `set` or `clear`.
    Threshold { rule: Rule, severity: &'static str, part: &'static str },
    /// Another key of all `[[alarm]]` tables of a rule.
    Alarm { rule: Rule, key: &'static str },
    /// Any other key: its parts. If a part has a number in brackets, the number is included.
    Key(Vec<(String, Option<usize>)>),
}

/// Finds what the choices (the `--set` options) refer to. Adds their rules to `grid`.
pub(super) fn targets(grid: &mut VariantGrid, root: &Table, choices: &[Choice]) -> Result<Vec<Target>, String> {
    let mut targets: Vec<Target> = Vec::new();
    for choice in choices {
        let target =
            Target::of(&choice.key, root, &mut grid.notes).map_err(|what| format!("--set {}: {what}", choice.key))?;
        if targets.contains(&target) {
            return Err(format!("--set {}: set twice", choice.key));
        }
        match target {
            Target::Threshold { rule, .. } | Target::Alarm { rule, .. } if !grid.rules.contains(&rule) => {
                grid.rules.push(rule)
            }
            Target::Threshold { .. } | Target::Alarm { .. } => {}
            Target::Key(_) => grid.other_keys = true,
        }
        targets.push(target);
    }
    Ok(targets)
}

impl Target {
    fn of(key: &str, root: &Table, notes: &mut Vec<String>) -> Result<Self, String> {
        let (first, rest) = key.split_once('.').unwrap_or((key, ""));
        let Some(rule) = Rule::ALL.into_iter().find(|rule| rule.name() == first) else {
            return Self::key(key);
        };
        let (name, part) = rest.split_once('.').unwrap_or((rest, "set"));
        let part = ["set", "clear"].into_iter().find(|known| *known == part);
        let severity = match name {
            "threshold" => Some(gravest(root, rule)?),
            _ => SEVERITIES.into_iter().find(|known| *known == name),
        };
        match (severity, part, ALARM_KEYS.into_iter().find(|known| *known == rest)) {
            (Some(severity), Some(part), _) => {
                if name == "threshold" {
                    notes.push(format!("{first}.threshold is {first}.{severity}"));
                }
                Ok(Self::Threshold { rule, severity, part })
            }
            (_, _, Some(key)) => Ok(Self::Alarm { rule, key }),
            _ => Err(format!(
                "found {rest:?} after the rule, must be threshold, {} (also with .set or .clear), {}",
                SEVERITIES.join(", "),
                ALARM_KEYS.join(", ")
            )),
        }
    }

    fn key(key: &str) -> Result<Self, String> {
        let part = |part: &str| match part.split_once('[') {
            None => Ok((part.to_owned(), None)),
            Some((name, number)) => {
                let number = number.strip_suffix(']').and_then(|number| number.parse::<usize>().ok());
                let number = number.filter(|number| *number > 0);
                number
                    .map(|number| (name.to_owned(), Some(number)))
                    .ok_or_else(|| format!("{part}, must be NAME[n] from 1"))
            }
        };
        let parts: Result<Vec<_>, String> = key.split('.').map(part).collect();
        let parts = parts?;
        if parts.len() < 2 {
            return Err("must be TABLE.KEY or RULE.KEY".to_owned());
        }
        Ok(Self::Key(parts))
    }

    pub(super) fn set(&self, root: &mut Table, value: &Value) -> Result<(), String> {
        match self {
            Self::Threshold { rule, severity, part } => set_threshold(root, *rule, severity, part, value),
            Self::Alarm { rule, key } => {
                let (key, value) = match *key {
                    "probability" => {
                        ("when", Value::Table(Table::from_iter([("probability".to_owned(), value.clone())])))
                    }
                    key => (key, value.clone()),
                };
                let mut alarms = alarms_of(root, *rule).peekable();
                if alarms.peek().is_none() {
                    return Err(format!("no [[alarm]] of {}", rule.name()));
                }
                alarms.for_each(|alarm| drop(alarm.insert(key.to_owned(), value.clone())));
                Ok(())
            }
            Self::Key(parts) => set_key(root, parts, value),
        }
    }
}

/// Adds rule names to a fault about an unknown table, because the key may be a misspelt rule.
pub(super) fn name_rules(fault: String, targets: &[Target]) -> String {
    let unknown = targets.iter().find_map(|target| match target {
        Target::Key(parts) => {
            parts.first().filter(|(name, _)| fault.starts_with(&format!("{name} is not a known key")))
        }
        Target::Threshold { .. } | Target::Alarm { .. } => None,
    });
    let Some((name, _)) = unknown else { return fault };
    let rules: Vec<&str> = Rule::ALL.into_iter().map(Rule::name).collect();
    let near = rules.iter().map(|rule| (strsim::jaro_winkler(name, rule), rule));
    let best = near.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(similarity, _)| *similarity > 0.8);
    let meant = best.map(|(_, rule)| format!(", did you mean {rule}")).unwrap_or_default();
    format!("{name} is not a table of the configuration or a rule{meant} (rules: {})", rules.join(", "))
}

fn alarms_of(root: &mut Table, rule: Rule) -> impl Iterator<Item = &mut Table> {
    let alarms = root.get_mut("alarm").and_then(Value::as_array_mut).into_iter().flatten();
    alarms.filter(move |alarm| rule_of(alarm) == Some(rule.name())).filter_map(Value::as_table_mut)
}

fn gravest(root: &Table, rule: Rule) -> Result<&'static str, String> {
    let alarms = root.get("alarm").and_then(Value::as_array).into_iter().flatten();
    let of_rule: Vec<&Value> = alarms.filter(|alarm| rule_of(alarm) == Some(rule.name())).collect();
    let has = |severity: &&str| of_rule.iter().any(|alarm| alarm.get(severity).is_some());
    SEVERITIES.into_iter().rev().find(has).ok_or_else(|| {
        format!("the configuration has no alarm of {}: use {0}.info, {0}.warning or {0}.severe", rule.name())
    })
}

fn set_threshold(root: &mut Table, rule: Rule, severity: &str, part: &str, value: &Value) -> Result<(), String> {
    let has = |alarm: &Table| alarm.contains_key(severity);
    let place = alarms_of(root, rule).position(|alarm| has(alarm)).unwrap_or(0);
    if alarms_of(root, rule).next().is_none() {
        let alarms = root.entry("alarm").or_insert_with(|| Value::Array(Vec::new()));
        let alarms = alarms.as_array_mut().ok_or("alarm must be tables [[alarm]]")?;
        let new = Table::from_iter([("rule".to_owned(), Value::String(rule.name().to_owned()))]);
        alarms.push(Value::Table(new));
    }
    let Some(alarm) = alarms_of(root, rule).nth(place) else { return Err(format!("no [[alarm]] of {}", rule.name())) };
    match (alarm.get_mut(severity), part) {
        // If the alarm has a pair `set` and `clear`, only the chosen one of these values is replaced.
        (Some(Value::Table(both)), part) => {
            both.insert(part.to_owned(), value.clone());
        }
        (_, "set") => {
            alarm.insert(severity.to_owned(), value.clone());
        }
        (None, _) => {
            return Err(format!("{0}.{severity} is not set: set {0}.{severity} before its clear value", rule.name()));
        }
        (Some(set), part) => {
            let both = [("set".to_owned(), set.clone()), (part.to_owned(), value.clone())];
            *set = Value::Table(Table::from_iter(both));
        }
    }
    Ok(())
}

fn set_key(root: &mut Table, parts: &[(String, Option<usize>)], value: &Value) -> Result<(), String> {
    let Some(((last, None), above)) = parts.split_last() else { return Err("must end in a key".to_owned()) };
    let mut table = root;
    for (name, number) in above {
        let next = match number {
            None => table.entry(name.as_str()).or_insert_with(|| Value::Table(Table::new())),
            Some(number) => {
                let items = table.get_mut(name.as_str()).and_then(Value::as_array_mut);
                let count = items.as_ref().map_or(0, |items| items.len());
                items
                    .and_then(|items| items.get_mut(*number - 1))
                    .ok_or_else(|| format!("{name}[{number}]: the configuration has {count} of them"))?
            }
        };
        table = next.as_table_mut().ok_or_else(|| format!("{name} is not a single table: write {name}[n].{last}"))?;
    }
    table.insert(last.clone(), value.clone());
    Ok(())
}

pub(super) fn rule_of(alarm: &Value) -> Option<&str> {
    alarm.get("rule")?.as_str()
}
