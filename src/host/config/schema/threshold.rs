//! Reads thresholds of alarms (`2.08`, `"80 %"`, `{ set = ..., clear = ... }`) and the key `when`.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::key::{Setting, ValueFault, ValueRange, in_range, typed};
use crate::alarm::Comparison;

/// A threshold value: absolute, or relative to a new cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Level {
    Absolute(f64),
    /// A fraction of a new cell's value, from a string like "80 %".
    Relative(f64),
}

/// A threshold as written: `2.08`, `"80 %"`, or `{ set = ..., clear = ... }` with such values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Threshold {
    pub set: Level,
    /// Value at which the alarm clears; `None` = computed from the hysteresis.
    pub clear: Option<Level>,
}

impl Level {
    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
        let DeValue::String(text) = value.get_ref() else {
            return f64::read(value, allowed).map(Self::Absolute);
        };
        let percent = text.trim().strip_suffix('%').and_then(|number| number.trim().parse::<f64>().ok());
        let percent = typed(value, percent)?;
        in_range(value, (0.0..=1000.0).contains(&percent).then_some(Self::Relative(percent / 100.0)))
    }
}

impl Setting for Threshold {
    const KIND: &'static str = "a number, a string like \"80 %\", or { set = ..., clear = ... } of these";

    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
        let DeValue::Table(table) = value.get_ref() else {
            return Level::read(value, allowed).map(|set| Self { set, clear: None });
        };
        let has_others = table.iter().any(|(key, _)| !matches!(key.get_ref().as_ref(), "set" | "clear"));
        let set = typed(value, table.get("set").filter(|_| !has_others))?;
        let clear = table.get("clear").map(|clear| Level::read(clear, allowed)).transpose()?;
        Ok(Self { set: Level::read(set, allowed)?, clear })
    }
}

impl Setting for Comparison {
    const KIND: &'static str = "\"mean\", or { probability = ... } above 0 and below 1";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        let comparison = match value.get_ref() {
            DeValue::String(text) => (text.as_ref() == "mean").then_some(Self::Mean),
            DeValue::Table(table) => probability(table),
            _ => None,
        };
        typed(value, comparison)
    }
}

fn probability(table: &DeTable<'_>) -> Option<Comparison> {
    let level = table.get("probability").filter(|_| table.len() == 1)?;
    let level = f64::read(level, &ValueRange::Any).ok()?;
    (level > 0.0 && level < 1.0).then_some(Comparison::Probability(level))
}
