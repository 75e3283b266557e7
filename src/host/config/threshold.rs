//! Thresholds of alarms as they are written: `2.08`, `"80 %"`, `{ set = ..., clear = ... }`, and `when`.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::setting::{Setting, ValueFault, ValueRange};
use crate::alarm::Comparison;

/// A value to compare with: in the rule's unit, or relative.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Level {
    /// In the rule's unit.
    Absolute(f64),
    /// A part of what a new cell has, from a text like "80 %".
    Relative(f64),
}

/// `2.08`, `"80 %"`, or `{ set = ..., clear = ... }` with either.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Threshold {
    pub set: Level,
    /// `None` = by the hysteresis.
    pub clear: Option<Level>,
}

impl Level {
    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
        let DeValue::String(text) = value.get_ref() else {
            return f64::read(value, allowed).map(Self::Absolute);
        };
        let percent = text.trim().strip_suffix('%').and_then(|number| number.trim().parse::<f64>().ok());
        match percent {
            None => Err(ValueFault::Type(value.span())),
            Some(percent) if (0.0..=1000.0).contains(&percent) => Ok(Self::Relative(percent / 100.0)),
            Some(_) => Err(ValueFault::Range(value.span())),
        }
    }
}

impl Setting for Threshold {
    const KIND: &'static str = "a number, a text like \"80 %\", or { set = ..., clear = ... } of these";

    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
        let DeValue::Table(table) = value.get_ref() else {
            return Level::read(value, allowed).map(|set| Self { set, clear: None });
        };
        if table.iter().any(|(key, _)| !matches!(key.get_ref().as_ref(), "set" | "clear")) {
            return Err(ValueFault::Type(value.span()));
        }
        let set = table.get("set").ok_or_else(|| ValueFault::Type(value.span()))?;
        let clear = table.get("clear").map(|clear| Level::read(clear, allowed)).transpose()?;
        Ok(Self { set: Level::read(set, allowed)?, clear })
    }
}

impl Setting for Comparison {
    const KIND: &'static str = "\"mean\", or { probability = ... } above 0 and below 1";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        match value.get_ref() {
            DeValue::String(text) if text.as_ref() == "mean" => Ok(Self::Mean),
            DeValue::Table(table) if table.len() == 1 => {
                probability(table).ok_or_else(|| ValueFault::Type(value.span()))
            }
            _ => Err(ValueFault::Type(value.span())),
        }
    }
}

fn probability(table: &DeTable<'_>) -> Option<Comparison> {
    let level = f64::read(table.get("probability")?, &ValueRange::Any).ok()?;
    (level > 0.0 && level < 1.0).then_some(Comparison::Probability(level))
}
