//! Finds swapped signals from the units in the DBC and from the values; for example, a voltage configured as current.

use super::context::{Judge, MAX_C_RATE, SignalSeries, error, find, warning};
use super::text::{channel, channels, number};
use super::unit::unit_of;
use super::values::is_impossible;
use crate::quantity::Channel;
use crate::wiring::evidence::Series;
use crate::wiring::plan::{Kind, SignalPlan};
use crate::wiring::report::{Severity, Topic};

/// Plausible temperatures of a pack in use (degrees C).
const PLAUSIBLE_C: (f64, f64) = (-45.0, 95.0);

pub(super) fn check(judge: &mut Judge<'_>) {
    if !by_unit(judge) && !pack_voltage_as_current(judge) {
        by_values(judge);
    }
}

pub(super) fn check_odd(judge: &mut Judge<'_>) {
    odd_cells(judge);
    odd_sensors(judge);
    other_parts(judge);
}

/// Finds temperatures whose names say that they belong to the controller's electronics or to another device. If the
/// DBC has no temperature of the cells, there may be no better sensor, so the finding is a note.
fn other_parts(judge: &mut Judge<'_>) {
    let sensors = judge.signals(Kind::Temperature);
    let wrong: Vec<&SignalPlan> =
        sensors.iter().map(|sensor| sensor.0).filter(|s| s.label().is_of_other_part()).collect();
    let Some(first) = wrong.first() else { return };
    let others = judge.plan.unconfigured.iter().zip(&judge.observed.unconfigured);
    let others = others.filter(|(other, series)| {
        matches!(other.binding.channel, Channel::Temperature(_))
            && other.binding.bus == first.binding.bus
            && series.count() > 0
    });
    let better = others.map(|(other, _)| other.name.clone()).next();
    let severity = if better.is_some() { Severity::Warning } else { Severity::Note };
    let list: Vec<Channel> = wrong.iter().map(|signal| signal.binding.channel).collect();
    let title = format!("{}: not a temperature of the cells, according to its name", channels(&list));
    let finding = find(judge, severity, Topic::Cell, title)
        .seen(format!("{} is configured as a temperature of the cells", first.name))
        .why("electronics (MOSFETs, boards, resistors) and other devices are warmer or colder than the cells");
    if let Some(better) = better {
        finding.change(&first.table, "signal", format!("{better:?}"));
    }
}

/// Configured signals whose unit belongs to another kind of quantity, with that kind.
fn misfits<'d>(judge: &Judge<'d>) -> Vec<(&'d SignalPlan, Kind)> {
    let units = judge.plan.signals.iter().filter_map(|signal| Some((signal, unit_of(&signal.unit)?.0)));
    let is_misfit = |(signal, unit): &(&SignalPlan, Kind)| {
        let kind = Kind::of(signal.binding.channel);
        kind != Kind::Reported && *unit != kind
    };
    units.filter(is_misfit).collect()
}

fn by_unit(judge: &mut Judge<'_>) -> bool {
    let misfits = misfits(judge);
    let mut reported: Vec<&str> = Vec::new();
    for (signal, unit) in &misfits {
        if reported.contains(&signal.table.as_str()) {
            continue;
        }
        reported.push(&signal.table);
        let kind = Kind::of(signal.binding.channel);
        judge.is_mixed_up |= kind != Kind::Temperature;
        let is_partner = |(other, other_unit): &&(&SignalPlan, Kind)| {
            Kind::of(other.binding.channel) == *unit && *other_unit == kind
        };
        let name = channel(signal.binding.channel);
        let (title, proposed) = match misfits.iter().find(is_partner) {
            Some((other, _)) => {
                (format!("{name} and {} are exchanged", channel(other.binding.channel)), format!("{:?}", other.name))
            }
            None => (format!("{name} is read from a {}", unit.name()), format!("a signal that is a {}", kind.name())),
        };
        error(judge, Topic::Swapped, title)
            .seen(format!("{} has the unit {:?} in the DBC", signal.name, signal.unit))
            .why(format!("a {} is not measured in this unit", kind.name()))
            .change(&signal.table, "signal", proposed);
    }
    !misfits.is_empty()
}

/// Finds a signal that is configured as the current but has the value of the sum of the cell voltages.
fn pack_voltage_as_current(judge: &mut Judge<'_>) -> bool {
    let (Some((signal, series)), Some(cell_v)) = (judge.current(), judge.cell_voltage()) else { return false };
    let (Some(median), Some((from, to))) = (series.values.median(), series.values.bulk()) else { return false };
    let (low, high) = judge.voltage_band();
    let cells = f64::from(judge.plan.pack.cells);
    let is_sum = cells >= 4.0
        && (low..=high).contains(&cell_v)
        && (median.abs() / cells / cell_v - 1.0).abs() < 0.03
        && (to - from).abs() < 0.3 * median.abs();
    if is_sum {
        judge.is_mixed_up = true;
        let (sum, cell) = (number(median.abs()), number(cell_v));
        error(judge, Topic::Swapped, "pack current is read from the pack's voltage")
            .seen(format!("{} reads {sum}, the sum of {cells} cells of {cell} V", signal.name))
            .why("a current changes and crosses zero; these values are the sum of the cell voltages")
            .change(&signal.table, "signal", "the signal of the current");
    }
    is_sum
}

/// Whether a signal's values are plausible as a voltage, a temperature or a current.
struct Fit {
    voltage: bool,
    temperature: bool,
    current: bool,
}

fn fit(judge: &Judge<'_>, series: &Series) -> Option<Fit> {
    let (low, high) = series.values.bulk()?;
    // If a voltage is configured as the current, the configured sign of the current may have made it negative.
    let (low, high) = if high <= 0.0 { (-high, -low) } else { (low, high) };
    let (band, cells) = (judge.voltage_band(), judge.cells_per_reading());
    let is_slow = series.changes.median().unwrap_or(0.0) < 1.0 && high - low < 40.0;
    Some(Fit {
        voltage: low / cells >= band.0 && high / cells <= band.1,
        temperature: is_slow && low >= PLAUSIBLE_C.0 && high <= PLAUSIBLE_C.1,
        current: low.abs().max(high.abs()) <= MAX_C_RATE * judge.pack_ah(),
    })
}

/// Finds exchanged signals among current, voltage and temperature, if the pack has a single voltage signal. Two
/// signals are exchanged if the values of each are plausible only for the other quantity.
fn by_values(judge: &mut Judge<'_>) {
    let voltages = judge.signals(Kind::Voltage);
    let (Some(current), [voltage]) = (judge.current(), voltages.as_slice()) else { return };
    let (Some(c), Some(v)) = (fit(judge, current.1), fit(judge, voltage.1)) else { return };
    let temperatures = judge.signals(Kind::Temperature);
    let temperature = temperatures.into_iter().find(|(_, series)| series.count() > 0);
    let temperature = temperature.and_then(|signal| Some((signal, fit(judge, signal.1)?)));
    let (a, b) = match temperature {
        _ if !v.voltage && c.voltage && v.current => (current, *voltage),
        Some((warm, t)) if !v.voltage && t.voltage && v.temperature => (warm, *voltage),
        Some((warm, t)) if v.voltage && t.current && c.temperature && is_current_like(warm.1, current.1) => {
            (warm, current)
        }
        _ => return,
    };
    judge.is_mixed_up = true;
    let extent = |(signal, series): SignalSeries<'_>| {
        format!("{} reads {} to {}", signal.name, number(series.extent.min), number(series.extent.max))
    };
    let names = [a, b].map(|(signal, _)| channel(signal.binding.channel));
    error(judge, Topic::Swapped, format!("{} are exchanged", names.join(" and ")))
        .seen(format!("{}; {}", extent(a), extent(b)))
        .why("each signal's values are plausible only for the other quantity")
        .change(&a.0.table, "signal", format!("{:?}", b.0.name))
        .change(&b.0.table, "signal", format!("{:?}", a.0.name));
}

/// Whether the temperature jumps as only a current does, while the current stays at a value that is plausible for a
/// temperature.
fn is_current_like(temperature: &Series, current: &Series) -> bool {
    let level = current.values.median().unwrap_or(0.0).abs();
    temperature.jumps >= 3 && current.jumps == 0 && (5.0..=60.0).contains(&level)
}

fn odd_cells(judge: &mut Judge<'_>) {
    let voltages = judge.signals(Kind::Voltage);
    let Some(median_v) = judge.cell_voltage().filter(|_| voltages.len() >= 4) else { return };
    let median_c = judge.median_of(Kind::Temperature, |series| series.values.median()).unwrap_or(f64::NAN);
    for (signal, series) in &voltages {
        let Some(value) = series.values.median() else { continue };
        let is_zero = series.extent.changes == 0 && value.abs() < 0.05 * median_v.abs();
        if is_zero || (value - median_v).abs() <= 0.12 * median_v.abs() {
            continue;
        }
        let is_temperature = (value - median_c).abs() < 8.0 && median_v > 1.0 && median_v < 6.0;
        let hint = if is_temperature { "; it looks like a temperature" } else { "" };
        let (name, value, others) = (channel(signal.binding.channel), number(value), number(median_v));
        error(judge, Topic::Cell, format!("{name} is unlike the other cells"))
            .seen(format!("{} reads {value} V, the others {others} V{hint}", signal.name))
            .why("cells in series do not differ this much: wrong signal, broken wire, or dead cell")
            .change(&signal.table, "signal", "a pattern that gives each cell its own signal")
            .advice("measure the cell; compare the signal in the DBC with the sender's documentation");
    }
}

fn odd_sensors(judge: &mut Judge<'_>) {
    let sensors = judge.signals(Kind::Temperature);
    // The module `values` reports the sensors with impossible values.
    let possible = |series: &Series| series.values.median().filter(|_| !is_impossible(series));
    let median_c = judge.median_of(Kind::Temperature, possible);
    let Some(median_c) = median_c.filter(|_| sensors.len() >= 4 && judge.cell_voltage().is_some()) else { return };
    for (signal, series) in sensors {
        let (Some(value), Channel::Temperature(sensor)) = (series.values.median(), signal.binding.channel) else {
            continue;
        };
        if (value - median_c).abs() <= 30.0 || is_impossible(series) {
            continue;
        }
        let still = if series.extent.changes == 0 { " and never changes" } else { "" };
        let (value, others) = (number(value), number(median_c));
        let title = format!("temperature {} is unlike the other sensors", sensor.0 + 1);
        warning(judge, Topic::Cell, title)
            .seen(format!("{} reads {value} degrees C{still}, the others {others}", signal.name))
            .why("temperatures within a pack do not differ this much: missing sensor, broken wire, or wrong unit")
            .change(&signal.table, "signal", "the signal of an existing sensor");
    }
}
