//! Argument parsers for numbers and named values. Each error says what is allowed.

use std::fmt::Display;
use std::str::FromStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use crate::monitor::Downtime;
use crate::quantity::MAX_CELLS;

/// A name, its value, and its line in the help.
pub(crate) type NamedValue<T> = (&'static str, T, &'static str);

/// Returns a parser that accepts the names of these values, and shows the names in the help.
pub(crate) fn one_of<T: Copy + Send + Sync + 'static>(
    all: &'static [NamedValue<T>],
) -> impl TypedValueParser<Value = T> {
    let names = all.iter().map(|(name, _, help)| PossibleValue::new(*name).help(*help));
    let find = |name: String| all.iter().find(|known| known.0 == name).map(|known| known.1).ok_or("unknown name");
    PossibleValuesParser::new(names).try_map(find)
}

pub(crate) fn finite(text: &str) -> Result<f64, String> {
    within(text, |_| true, "a finite number")
}

/// Parses a finite number that `is_allowed` accepts. `allowed` describes the accepted numbers in the error.
pub(crate) fn within(text: &str, is_allowed: impl Fn(f64) -> bool, allowed: &str) -> Result<f64, String> {
    let value = text.trim().parse::<f64>().ok().filter(|value| value.is_finite() && is_allowed(*value));
    value.ok_or_else(|| format!("must be {allowed}"))
}

/// Parses a number from `low` to `high`. The error states `what` and then this range.
pub(crate) fn between(low: f64, high: f64, what: &'static str) -> impl Fn(&str) -> Result<f64, String> + Clone {
    move |text| within(text, |value| (low..=high).contains(&value), &format!("{what}{low} to {high}"))
}

/// Parses a number above 0 and at most `high`. The error states `what` and then this range.
pub(crate) fn above_0_to(high: f64, what: &'static str) -> impl Fn(&str) -> Result<f64, String> + Clone {
    move |text| within(text, |value| value > 0.0 && value <= high, &format!("{what}above 0, at most {high}"))
}

/// Parses a whole number from `LOW` to `HIGH`.
pub(crate) fn whole<const LOW: usize, const HIGH: usize>(text: &str) -> Result<usize, String> {
    let number = text.trim().parse::<usize>().ok().filter(|number| (LOW..=HIGH).contains(number));
    number.ok_or_else(|| format!("must be a whole number from {LOW} to {HIGH}"))
}

/// Parses a whole number of any integer type, from `low` to `high`.
pub(crate) fn integer<T>(low: T, high: T) -> impl Fn(&str) -> Result<T, String> + Clone
where
    T: FromStr + PartialOrd + Display + Copy,
{
    move |text| {
        let number = text.trim().parse::<T>().ok().filter(|number| (low..=high).contains(number));
        number.ok_or_else(|| format!("must be a whole number from {low} to {high}"))
    }
}

/// Parses the number of a cell, counted from 1.
pub(crate) fn cell_number(text: &str) -> Result<u16, String> {
    let number = text.parse::<u16>().ok().filter(|number| (1..=MAX_CELLS).contains(&usize::from(*number)));
    number.ok_or_else(|| format!("must be a cell number, 1 to {MAX_CELLS}"))
}

/// Longest duration that an option accepts (s): ten years.
pub(crate) const MAX_SECONDS: f64 = 315_576_000.0;

/// Parses the age of a stored state: seconds, or `unknown`.
pub(crate) fn away(text: &str) -> Result<Downtime, String> {
    match text {
        "unknown" => Ok(Downtime::Unknown),
        _ => between(0.0, MAX_SECONDS, "seconds, ")(text)
            .map(Downtime::Seconds)
            .map_err(|must| format!("{must}, or unknown")),
    }
}

/// Parses a size in bytes: a whole number, optionally followed by B, KiB, MiB or GiB.
pub(crate) fn bytes(text: &str) -> Result<u64, String> {
    let units = [("KiB", 10), ("MiB", 20), ("GiB", 30), ("B", 0)];
    let unit = units.into_iter().find_map(|(unit, shift)| Some((text.strip_suffix(unit)?, shift)));
    let (number, shift) = unit.unwrap_or((text, 0));
    let size = number.trim_end().parse::<u64>().ok().and_then(|number| number.checked_mul(1 << shift));
    size.ok_or_else(|| "must be a whole number of bytes, or one with KiB, MiB or GiB, for example 64MiB".to_owned())
}

/// Parses a number above 0, which may be infinite.
pub(crate) fn positive(text: &str) -> Result<f64, String> {
    let value = text.trim().parse::<f64>().ok().filter(|value| *value > 0.0);
    value.ok_or_else(|| "must be a number above 0".to_owned())
}

/// Parses a finite number above 0.
pub(crate) fn above_0(text: &str) -> Result<f64, String> {
    within(text, |value| value > 0.0, "a finite number above 0")
}

/// Parses a number between 0 and 1, excluding both.
pub(crate) fn fraction(text: &str) -> Result<f64, String> {
    within(text, |value| value > 0.0 && value < 1.0, "above 0 and below 1")
}

/// Parses a number from 0 to 1.
pub(crate) fn share(text: &str) -> Result<f64, String> {
    within(text, |value| (0.0..=1.0).contains(&value), "0 to 1")
}

/// Parses a percentage above 0 and at most 100. A percent sign may follow.
pub(crate) fn percent(text: &str) -> Result<f64, String> {
    let digits = text.trim().trim_end_matches('%');
    within(digits, |value| value > 0.0 && value <= 100.0, "a percentage above 0, at most 100")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn size_accepts_binary_units_only() {
        let sizes = ["4096", "64MiB", "2 GiB", "1KiB", "7B"].map(|text| bytes(text).expect("a size"));
        assert_eq!(sizes, [4096, 64 << 20, 2 << 30, 1024, 7]);
        for text in ["", "MiB", "1.5GiB", "-1", "2GB", "99999999999999GiB"] {
            assert!(bytes(text).is_err(), "{text}");
        }
    }
}
