//! Formats times, durations, values of alarm rules, and alarms.

use super::data::{AlarmRecord, Data};
use super::limits::rule;
use crate::alarm::Unit;
use crate::io::stamp::format_utc;
use crate::quantity::Timestamp;

fn about(name: &str) -> &str {
    rule(name).map_or(name, |rule| rule.spec().about)
}

fn unit(name: &str) -> &'static str {
    rule(name).map_or("", |rule| rule.spec().unit.symbol())
}

pub(super) fn without_minus_zero(digits: String) -> String {
    let is_zero = digits.bytes().all(|byte| matches!(byte, b'-' | b'+' | b'0' | b'.'));
    if is_zero { digits.trim_start_matches(['-', '+']).to_owned() } else { digits }
}

/// Formats a duration in the largest unit in which it is at least 2: `90 s`, `45.0 min`, `6.0 h`, `3 days`. Below 2 s,
/// the unit is s.
pub(super) fn length(seconds: f64) -> String {
    match seconds {
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.1} min", s / 60.0),
        s if s < 172_800.0 => format!("{:.1} h", s / 3600.0),
        s => format!("{:.0} days", s / 86_400.0),
    }
}

/// Formats a rule's value with its unit, without trailing zeros.
pub(super) fn amount(value: f64, rule: &str) -> String {
    let (value, unit) = match self::rule(rule).map(|rule| rule.spec().unit) {
        Some(Unit::FractionPerDay) => (100.0 * value, "%/d"),
        _ => (value, unit(rule)),
    };
    let digits = without_minus_zero(format!("{value:.3}"));
    let digits = digits.trim_end_matches('0').trim_end_matches('.');
    format!("{digits} {}", unit.replace("degrees C", "\u{b0}C")).trim_end().to_owned()
}

/// Formats an alarm, for example "a cell's usable capacity was 1.38 Ah, limit 1.4 Ah (cell 3)". `verb` is "is" or
/// "was".
pub(super) fn alarm_text(row: &AlarmRecord, verb: &str) -> String {
    let amount = |value: f64| amount(value, &row.rule);
    let value = row.value.map_or_else(|| "unknown".to_owned(), amount);
    let limit = row.threshold.map_or_else(|| "unknown".to_owned(), amount);
    let cell = row.cell.map_or_else(String::new, |cell| format!(" (cell {})", cell + 1));
    format!("{} {verb} {value}, limit {limit}{cell}", about(&row.rule))
}

pub(super) fn capitalised(text: &str) -> String {
    let mut rest = text.chars();
    rest.next().map_or_else(String::new, |first| first.to_uppercase().chain(rest).collect())
}

/// Formats a time as a date or, in an undated record, as the time since its start.
pub(super) fn moment(data: &Data, time_s: f64) -> String {
    if data.is_dated() {
        format_utc(Timestamp::from_secs(time_s)).replace('T', " ").replace('Z', " UTC")
    } else {
        let after_s = data.ends_s().map_or(0.0, |(first_s, _)| time_s - first_s);
        format!("{} after the start of the record", length(after_s))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_suitable_units_and_zero_has_no_sign() {
        assert_eq!([42.0, 600.0, 36_000.0, 1e6].map(length), ["42 s", "10.0 min", "10.0 h", "12 days"]);
        assert_eq!(amount(-0.0001, "capacity_low"), "0 Ah");
        assert_eq!(without_minus_zero("-0.000".to_owned()), "0.000");
        assert_eq!(without_minus_zero("-0.010".to_owned()), "-0.010");
    }
}
