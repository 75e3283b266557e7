//! Figures for people: no more digits than they carry.

use crate::can::signal::ByteOrder;
use crate::quantity::Channel;

/// Most numbers named one by one.
const MAX_NAMED: usize = 6;

/// About four digits.
pub(in crate::doctor) fn number(value: f64) -> String {
    if !value.is_finite() {
        return "unknown".to_owned();
    }
    // No minus before nothing.
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

/// A value for the configuration: a float with its point, without the dust of arithmetic.
pub(in crate::doctor) fn toml(value: f64) -> String {
    let rounded: f64 = format!("{value:.9e}").parse().unwrap_or(value);
    format!("{rounded:?}")
}

/// Rounded to three digits: a period jitters.
fn three_digits(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

/// `100 ms`, `2.5 s`.
pub(in crate::doctor) fn seconds(value: f64) -> String {
    if value < 0.9995 {
        format!("{} ms", number(three_digits(1000.0 * value)))
    } else if value < 7200.0 {
        format!("{} s", number(three_digits(value)))
    } else {
        format!("{} h", number(value / 3600.0))
    }
}

/// `1-3, 7` of rising numbers.
pub(in crate::doctor) fn ranges(numbers: &[usize]) -> String {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for &number in numbers {
        match runs.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => runs.push((number, number)),
        }
    }
    let mut words: Vec<String> =
        runs.iter().take(MAX_NAMED).map(|(a, b)| if a == b { a.to_string() } else { format!("{a}-{b}") }).collect();
    if runs.len() > MAX_NAMED {
        words.push("...".to_owned());
    }
    words.join(", ")
}

/// What a channel is (cells and sensors from 1).
pub(in crate::doctor) fn channel(channel: Channel) -> String {
    match channel {
        Channel::Current => "pack current".to_owned(),
        Channel::Temperature(sensor) => format!("temperature {}", sensor.0 + 1),
        Channel::PackVoltage => "pack voltage".to_owned(),
        Channel::CellVoltage(cell) => format!("cell {}", cell.0 + 1),
        Channel::ReportedSoc => "reported SOC".to_owned(),
        Channel::ReportedSoh => "reported SOH".to_owned(),
        Channel::PackIdentity => "pack identity".to_owned(),
    }
}

/// Several channels in few words.
pub(in crate::doctor) fn channels(all: &[Channel]) -> String {
    let cells: Vec<usize> = all
        .iter()
        .filter_map(|c| if let Channel::CellVoltage(cell) = c { Some(usize::from(cell.0) + 1) } else { None })
        .collect();
    let sensors: Vec<usize> = all
        .iter()
        .filter_map(|c| if let Channel::Temperature(sensor) = c { Some(usize::from(sensor.0) + 1) } else { None })
        .collect();
    let mut words: Vec<String> = all
        .iter()
        .filter(|c| !matches!(c, Channel::CellVoltage(_) | Channel::Temperature(_)))
        .map(|c| channel(*c))
        .collect();
    let many = |one: &str, numbers: &[usize]| match numbers {
        [number] => format!("{one} {number}"),
        _ => format!("{one}s {}", ranges(numbers)),
    };
    if !cells.is_empty() {
        words.push(many("cell", &cells));
    }
    if !sensors.is_empty() {
        words.push(many("temperature", &sensors));
    }
    words.join(", ")
}

/// The byte order in the words of a DBC.
pub(in crate::doctor) fn order(order: ByteOrder) -> &'static str {
    match order {
        ByteOrder::LittleEndian => "@1 (little-endian)",
        ByteOrder::BigEndian => "@0 (big-endian)",
    }
}

/// `1 frame`, `2 frames`.
pub(in crate::doctor) fn count(n: u64, one: &str) -> String {
    if n == 1 { format!("1 {one}") } else { format!("{n} {one}s") }
}
