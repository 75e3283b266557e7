//! Formats channel names, and numbers with no more digits than are significant.

use crate::quantity::Channel;

/// Maximum number of ranges that are listed.
const MAX_NAMED: usize = 6;

/// Formats a number with about four digits.
pub(super) fn number(value: f64) -> String {
    if !value.is_finite() {
        return "unknown".to_owned();
    }
    // Avoids "-0".
    let value = if value.abs() < 5e-6 { 0.0 } else { value };
    let size = value.abs();
    let digits = match size {
        _ if size >= 1000.0 || size == 0.0 => 0,
        _ if size >= 100.0 => 1,
        _ if size >= 10.0 => 2,
        _ if size >= 1.0 => 3,
        _ if size >= 0.1 => 4,
        _ => 5,
    };
    let text = format!("{value:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// Formats a number in thousandths: V in mV, ohm in mOhm.
pub(super) fn milli(value: f64) -> String {
    number(1000.0 * value)
}

/// A fraction in whole per cent.
pub(super) fn percent(fraction: f64) -> f64 {
    (100.0 * fraction).round()
}

/// Formats a number for the configuration: with a decimal point, rounded to ten digits.
pub(super) fn toml(value: f64) -> String {
    let rounded: f64 = format!("{value:.9e}").parse().unwrap_or(value);
    format!("{rounded:?}")
}

/// Formats a time: `100 ms`, `2.5 s`. Three digits suffice, because periods jitter.
pub(super) fn seconds(value: f64) -> String {
    let three_digits = |value: f64| number(format!("{value:.2e}").parse().unwrap_or(value));
    if value < 0.9995 {
        format!("{} ms", three_digits(1000.0 * value))
    } else if value < 7200.0 {
        format!("{} s", three_digits(value))
    } else {
        format!("{} h", number(value / 3600.0))
    }
}

/// Formats ascending numbers as ranges: `1-3, 7`.
pub(super) fn ranges(numbers: &[usize]) -> String {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for &number in numbers {
        match runs.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => runs.push((number, number)),
        }
    }
    let named = runs.iter().take(MAX_NAMED).map(|(a, b)| if a == b { a.to_string() } else { format!("{a}-{b}") });
    let more = (runs.len() > MAX_NAMED).then(|| "...".to_owned());
    named.chain(more).collect::<Vec<_>>().join(", ")
}

/// Name of a channel; cells and sensors count from 1.
pub(super) fn channel(channel: Channel) -> String {
    match channel {
        Channel::Current => "pack current".to_owned(),
        Channel::Temperature(sensor) => format!("temperature {}", sensor.0 + 1),
        Channel::PackVoltage => "pack voltage".to_owned(),
        Channel::CellVoltage(cell) => format!("cell {}", cell.0 + 1),
        Channel::ReportedSoc => "reported SOC".to_owned(),
        Channel::ReportedSoh => "reported SOH".to_owned(),
        Channel::Balancing(cell) => format!("balancing of cell {}", cell.0 + 1),
        Channel::SupplyVoltage => "supply voltage".to_owned(),
        Channel::PackIdentity => "pack identity".to_owned(),
        Channel::CurrentDirection => "direction of the current".to_owned(),
        Channel::Contactor => "contactors".to_owned(),
    }
}

/// Names of several channels; cells and sensors as ranges.
pub(super) fn channels(all: &[Channel]) -> String {
    let (mut texts, mut cells, mut sensors, mut bled) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for one in all {
        match one {
            Channel::CellVoltage(cell) => cells.push(usize::from(cell.0) + 1),
            Channel::Temperature(sensor) => sensors.push(usize::from(sensor.0) + 1),
            Channel::Balancing(cell) => bled.push(usize::from(cell.0) + 1),
            other => texts.push(channel(*other)),
        }
    }
    for (name, numbers) in [("cell", cells), ("temperature", sensors), ("balancing of cell", bled)] {
        if !numbers.is_empty() {
            texts.push(format!("{name}{} {}", if numbers.len() == 1 { "" } else { "s" }, ranges(&numbers)));
        }
    }
    texts.join(", ")
}

/// Formats a count: `1 frame`, `2 frames`.
pub(super) fn count(n: u64, noun: &str) -> String {
    format!("{n} {noun}{}", if n == 1 { "" } else { "s" })
}
