//! Checks units and layouts: finds impossible values and the unit or layout that would make them plausible.

use super::context::{Judge, MAX_C_RATE, SignalSeries, error, find};
use super::electrical;
use super::text::{channels, number, percent, toml};
use super::unit::unit_of;
use crate::can::signal::{ByteOrder, ValueType};
use crate::cell::Chemistry;
use crate::quantity::Channel;
use crate::wiring::evidence::layout::{AlternativeReading, LAYOUT_FAULTS};
use crate::wiring::evidence::{Extent, STEADY_A, Series};
use crate::wiring::plan::{Kind, SignalPlan};
use crate::wiring::report::{Severity, Topic};

/// Factors by which a unit may be off.
const UNIT_FACTORS: [f64; 6] = [1e-3, 1e-2, 1e-1, 10.0, 100.0, 1000.0];
/// Plausible temperatures (degrees C).
const PLAUSIBLE_C: std::ops::RangeInclusive<f64> = -40.0..=60.0;
/// Possible temperatures of a pack, even on fire or in extreme cold (degrees C).
const POSSIBLE_C: std::ops::RangeInclusive<f64> = -60.0..=120.0;
/// Single disturbances can make up to this share of the readings implausible. A larger share has another cause.
const MANY: f64 = 0.01;

pub(super) fn check(judge: &mut Judge<'_>) {
    if !judge.is_mixed_up {
        voltages(judge);
        current(judge);
    }
    if !judge.has(&[Topic::Swapped]) {
        temperatures(judge);
    }
}

type BetterLayout<'d> = (SignalSeries<'d>, &'d AlternativeReading);

/// The first alternative layout that fits at least three quarters of the signals, with the first signal that it fits.
fn better_layout<'d>(
    all: &[SignalSeries<'d>],
    fits: impl Fn(SignalSeries<'d>, &AlternativeReading) -> bool,
) -> Option<BetterLayout<'d>> {
    let alive = all.iter().filter(|(_, series)| series.count() > 0 || series.unusable.short > 0).count();
    LAYOUT_FAULTS.into_iter().find_map(|fault| {
        let alternative = |(signal, series): SignalSeries<'d>| {
            let other = series.alternatives.iter().find(|other| other.fault == fault)?;
            (other.extent.count > 0 && fits((signal, series), other)).then_some(((signal, series), other))
        };
        let fitting: Vec<_> = all.iter().filter_map(|signal| alternative(*signal)).collect();
        (alive > 0 && 4 * fitting.len() >= 3 * alive).then(|| fitting[0])
    })
}

/// Whether the values of the alternative layout are smooth, while the values of the configured layout jump.
fn is_smoother((signal, series): SignalSeries<'_>, other: &AlternativeReading) -> bool {
    let layout = &signal.layout;
    if layout.length_bits < 12 || series.extent.changes < 10 {
        return false;
    }
    let width = (layout.factor * signal.binding.scale).abs() * f64::from(layout.length_bits).exp2();
    let (here, there) = (&series.extent, &other.extent);
    here.step() > 0.02 * width && there.step() * 8.0 < here.step() && there.range() < 0.25 * width
}

fn wrong_layout(
    judge: &mut Judge<'_>,
    all: &[SignalSeries<'_>],
    ((signal, series), other): BetterLayout<'_>,
    what: &str,
) {
    judge.wrong_layouts.push(Kind::of(signal.binding.channel));
    let span = |extent: &Extent| {
        format!("{} to {} in steps of {}", number(extent.min), number(extent.max), number(extent.step()))
    };
    let (name, here, there, layout) = (&signal.name, span(&series.extent), span(&other.extent), &other.layout);
    let order = if layout.byte_order == ByteOrder::LittleEndian { "@1" } else { "@0" };
    let sign = if layout.value_type == ValueType::Signed { "-" } else { "+" };
    let others = if all.len() > 1 { format!(" (and {} others)", all.len() - 1) } else { String::new() };
    error(judge, Topic::Layout, format!("{what}: {} in the DBC", other.fault))
        .seen(format!("{name} reads {here}; with the other layout {there}"))
        .why("a pack's values do not jump like this; with the other layout they are smooth")
        .advice(format!("in the DBC: {name}{others} : {}|{}{order}{sign}", layout.start_bit, layout.length_bits));
}

fn voltages(judge: &mut Judge<'_>) {
    let all = judge.signals(Kind::Voltage);
    let (Some(median_v), Some((signal, _))) = (judge.cell_voltage(), all.first().copied()) else { return };
    let (low, high) = judge.voltage_band();
    let cells = judge.cells_per_reading();
    let (what, per) = if judge.plan.pack.is_total { ("pack voltage", " per cell") } else { ("cell voltages", "") };
    let is_plausible = (low..=high).contains(&median_v);
    if let Some(better) = better_voltages(judge, &all) {
        judge.is_mixed_up = true;
        return wrong_layout(judge, &all, better, what);
    }
    if is_plausible {
        return;
    }
    let seen = format!("{what}: the median reading is {} V{per}", number(median_v));
    let band = format!("a cell of this model has {} to {} V", number(low), number(high));
    let factor = UNIT_FACTORS.into_iter().find(|factor| (low..=high).contains(&(median_v * factor)));
    if let Some(factor) = factor {
        judge.voltage_factor = factor;
        let (by, volts) = (number(factor), number(median_v * factor));
        error(judge, Topic::Unit, format!("{what}: off by a factor of {}", above_one(factor)))
            .seen(seen)
            .why(format!("{band}; multiplied by {by}, the reading is {volts} V"))
            .change(&signal.table, "scale", toml(signal.scale * factor));
    } else if judge.plan.pack.is_total && median_v > 0.0 {
        judge.is_mixed_up = true;
        pack_count(judge, median_v * cells);
    } else {
        judge.is_mixed_up = true;
        let (key, text) = judge.plan.pack.model_change();
        error(judge, Topic::CellModel, "the cell voltages do not fit the cell model")
            .seen(seen)
            .why(format!("{band}, and no power of ten corrects the reading"))
            .change("pack", key, text)
            .advice("another possible cause: the signal is not a cell voltage");
    }
}

/// The alternative layout that makes the voltages plausible or smooth, if the configured layout does not.
fn better_voltages<'d>(judge: &Judge<'d>, all: &[SignalSeries<'d>]) -> Option<BetterLayout<'d>> {
    let (low, high) = judge.voltage_band();
    let cells = judge.cells_per_reading();
    let is_plausible = judge.cell_voltage().is_some_and(|median_v| (low..=high).contains(&median_v));
    better_layout(all, |signal, other| {
        let extent = &other.extent;
        let in_band = low * cells <= extent.mean() && extent.mean() <= high * cells;
        let is_steady = extent.range() < 0.5 * (high - low) * cells + 1e-9 || in_band && extent.range() < high * cells;
        let is_unread = signal.1.count() == 0;
        is_steady && (is_smoother(signal, other) || (!is_plausible || is_unread) && in_band)
    })
}

fn better_temperatures<'d>(judge: &Judge<'d>, all: &[SignalSeries<'d>]) -> Option<BetterLayout<'d>> {
    let ambient_c = judge.plan.pack.ambient_c;
    let median_c = judge.median_of(Kind::Temperature, |series| series.values.median());
    let is_plausible = median_c.is_some_and(|median_c| PLAUSIBLE_C.contains(&median_c));
    better_layout(all, |signal, other| {
        let is_near = (other.extent.mean() - ambient_c).abs() < 45.0 && other.extent.range() < 40.0;
        is_near && (is_smoother(signal, other) || !is_plausible || signal.1.count() == 0)
    })
}

/// Whether the frames are too short for the signals of a kind only because the layout in the DBC is wrong.
pub(super) fn is_short_by_layout(judge: &Judge<'_>, kind: Kind) -> bool {
    let all = judge.signals(kind);
    match kind {
        Kind::Voltage => better_voltages(judge, &all).is_some(),
        Kind::Temperature => better_temperatures(judge, &all).is_some(),
        Kind::Current | Kind::Reported => false,
    }
}

/// The factor or its reciprocal, whichever is above 1.
fn above_one(factor: f64) -> String {
    number(if factor < 1.0 { 1.0 / factor } else { factor })
}

/// Reports a total voltage that is impossible with the configured number of cells.
fn pack_count(judge: &mut Judge<'_>, total_v: f64) {
    let plan = judge.plan;
    let pack = &plan.pack;
    let (min_v, max_v) = pack.model.as_ref().map_or((2.8, 4.2), |m| (m.voltage_min_v, m.voltage_max_v));
    let (fewest, most) = ((total_v / max_v).ceil(), (total_v / min_v).floor());
    let cell_v = total_v / f64::from(pack.cells.max(1));
    let (total, per_cell) = (number(total_v), number(cell_v));
    let other = pack.label.map(|label| other_chemistries(label.chemistry, cell_v)).filter(|names| !names.is_empty());
    let finding = error(judge, Topic::CellCount, format!("{} cells cannot have this pack voltage", pack.cells))
        .seen(format!("{total} V in total: {per_cell} V per cell"))
        .why(format!("cells of this model have {min_v} to {max_v} V: {fewest} to {most} cells are possible"))
        .change("pack", "cells", format!("{fewest} to {most}, the number in the pack's documentation"));
    if let Some(names) = other {
        finding.advice(format!("another possible cause: pack.chemistry is wrong; {per_cell} V per cell fits {names}"));
    }
}

/// Names of the other chemistries whose cells can have this voltage.
fn other_chemistries(configured: Chemistry, cell_v: f64) -> String {
    let fits = |chemistry: Chemistry| {
        let (low, high) = chemistry.usual_voltages_v();
        chemistry != configured && (low..=high).contains(&cell_v)
    };
    let names = Chemistry::ALL.into_iter().filter(|(chemistry, _)| fits(*chemistry)).map(|(_, name)| name);
    names.collect::<Vec<_>>().join(", ")
}

fn current(judge: &mut Judge<'_>) {
    let Some((signal, series)) = judge.current().filter(|(_, series)| series.count() > 0) else { return };
    let limit_a = MAX_C_RATE * judge.pack_ah();
    let all = [(signal, series)];
    if missing_offset(judge, &all[0]) {
        return;
    }
    let largest_a = series.values.bulk().map_or(0.0, |(low, high)| low.abs().max(high.abs()));
    let better = better_layout(&all, |signal, other| {
        let most = other.extent.min.abs().max(other.extent.max.abs());
        let is_calmer = other.extent.range() < 0.1 * series.extent.range().max(largest_a);
        is_smoother(signal, other) && most < limit_a || largest_a > limit_a && most < 0.5 * limit_a && is_calmer
    });
    if let Some(better) = better {
        judge.is_mixed_up = true;
        return wrong_layout(judge, &all, better, "pack current");
    }
    let unit = unit_of(&signal.unit).map(|(_, factor, _)| factor).filter(|f| *f != 1.0 && signal.scale == 1.0);
    let c_rate = largest_a / judge.pack_ah();
    let finding = if let Some(factor) = unit {
        judge.current_factor = factor;
        error(judge, Topic::Unit, format!("pack current: off by a factor of {}", above_one(factor)))
            .why(format!("the DBC's unit is {:?}, and the configuration does not convert it", signal.unit))
            .change(&signal.table, "scale", toml(signal.scale * factor))
    } else if largest_a > limit_a {
        let factor = electrical::factor_by_steps(judge).filter(|factor| *factor < 1.0).unwrap_or_else(|| {
            let mut smaller = UNIT_FACTORS.into_iter().rev().filter(|factor| *factor < 1.0);
            smaller.find(|factor| c_rate * factor <= 3.0).unwrap_or(1e-3)
        });
        judge.current_factor = factor;
        electrical::wrong_unit_or_cell(judge, signal, factor, Severity::Error)
            .why(format!("the current is {} times the pack's capacity per hour", number(c_rate)))
    } else {
        return;
    };
    finding.seen(format!("{} reads up to {} A", signal.name, number(largest_a)));
}

/// Reports a current that never comes near zero because its offset is missing.
fn missing_offset(judge: &mut Judge<'_>, (signal, series): &SignalSeries<'_>) -> bool {
    let (sign, factor) = (signal.binding.scale.signum(), (signal.layout.factor * signal.scale).abs());
    let on_bus =
        Series::of(series.values.kept().iter().zip(0_u32..).map(|(value, n)| (f64::from(n), Ok(sign * value))));
    let (low, high) = (on_bus.extent.min, on_bus.extent.max);
    // The code for 0 A lies among the values, because a pack rests, or is both charged and discharged. If the code lies
    // outside the values, a wrong factor is more likely than a missing offset.
    let is_among = |zero: &f64| *zero != 0.0 && (low..=high).contains(&(zero * factor));
    let Some(zero) = on_bus.zero_code(factor).filter(|zero| low > STEADY_A && is_among(zero)) else { return false };
    judge.is_mixed_up = true;
    let offset_a = signal.offset - zero * factor;
    error(judge, Topic::Unit, "the current never comes near zero: an offset is missing")
        .seen(format!("{} reads {} to {} A", signal.name, number(low), number(high)))
        .why(format!("no pack has such a current all the time; the code {} probably means 0 A", number(zero)))
        .change(&signal.table, "offset", toml(offset_a));
    true
}

/// Common wrong units of a temperature: factor, offset, name.
const TEMPERATURE_UNITS: [(f64, f64, &str); 6] = [
    (1.0, -273.15, "kelvin"),
    (5.0 / 9.0, -160.0 / 9.0, "Fahrenheit"),
    (0.1, 0.0, "tenths of a degree"),
    (0.01, 0.0, "hundredths of a degree"),
    (1.0, -40.0, "an offset of 40 too much"),
    (1.0, 273.15, "kelvin subtracted twice"),
];

fn temperatures(judge: &mut Judge<'_>) {
    let all = judge.signals(Kind::Temperature);
    let Some(median_c) = judge.median_of(Kind::Temperature, |series| series.values.median()) else { return };
    let ambient_c = judge.plan.pack.ambient_c;
    let is_plausible = PLAUSIBLE_C.contains(&median_c);
    let impossible: Vec<_> = all.iter().filter(|(_, series)| is_impossible(series)).copied().collect();
    let unit = TEMPERATURE_UNITS
        .into_iter()
        .map(|(factor, offset, name)| (factor, offset, name, median_c * factor + offset))
        .filter(|(.., converted_c)| PLAUSIBLE_C.contains(converted_c))
        .min_by(|a, b| (a.3 - ambient_c).abs().total_cmp(&(b.3 - ambient_c).abs()));
    // A wrong unit is more likely than a wrong layout, unless the values jump.
    let is_steady = all.iter().all(|(_, series)| series.extent.range() < 60.0);
    if let Some(better) = better_temperatures(judge, &all).filter(|_| unit.is_none() || !is_steady) {
        wrong_layout(judge, &all, better, "temperatures");
    } else if !impossible.is_empty() && (is_plausible || 4 * impossible.len() < 3 * all.len()) {
        impossible_sensors(judge, &impossible, all.len());
    } else if unconverted(judge, &all, median_c).is_none() && !is_plausible {
        wrong_temperature(judge, &all, median_c, unit);
    }
}

pub(super) fn is_impossible(series: &Series) -> bool {
    series.values.share(|c| !POSSIBLE_C.contains(&c)) > MANY
}

/// Reports impossible readings that a wrong unit cannot explain, because other readings or other sensors are plausible.
fn impossible_sensors(judge: &mut Judge<'_>, sensors: &[SignalSeries<'_>], all: usize) {
    let list: Vec<Channel> = sensors.iter().map(|(signal, _)| signal.binding.channel).collect();
    let (signal, series) = sensors[0];
    let (low, high) = (number(series.extent.min), number(series.extent.max));
    let share = percent(series.values.share(|c| !POSSIBLE_C.contains(&c)));
    let others = if sensors.len() < all { "the other sensors are plausible" } else { "other readings are plausible" };
    let finding = error(judge, Topic::Cell, format!("{}: impossible temperature", channels(&list)))
        .seen(format!("{} reads {low} to {high} degrees C; {share} % of its readings are impossible", signal.name))
        .why(format!(
            "{others}: no sensor is there, a wire is broken, or a code for \"not available\" is not configured"
        ));
    for (signal, _) in sensors {
        finding.change(&signal.table, "signal", "the signal of an existing sensor");
    }
}

fn wrong_temperature(
    judge: &mut Judge<'_>,
    all: &[SignalSeries<'_>],
    median_c: f64,
    unit: Option<(f64, f64, &str, f64)>,
) {
    let seen = format!("the median sensor reads {} degrees C", number(median_c));
    let Some((factor, offset, name, converted_c)) = unit else {
        error(judge, Topic::Unit, "temperatures are impossible for a pack")
            .seen(seen)
            .why("no common unit makes it a plausible temperature")
            .change(&all[0].0.table, "signal", "a temperature");
        return;
    };
    // 60 to 90 degrees C are possible if the pack is in danger.
    let (severity, hint) = match (60.0..90.0).contains(&median_c) {
        true => (Severity::Warning, "a pack this hot would be in danger"),
        false => (Severity::Error, "impossible for a pack"),
    };
    let (converted, ambient) = (number(converted_c), number(judge.plan.pack.ambient_c));
    let finding = find(judge, severity, Topic::Unit, format!("temperatures: {name}?"))
        .seen(seen)
        .why(format!("{hint}; corrected for {name}, it is {converted} degrees C, near pack.ambient_c ({ambient})"));
    for (signal, _) in all {
        if factor != 1.0 {
            finding.change(&signal.table, "scale", toml(signal.scale * factor));
        }
        if offset != 0.0 || signal.offset != 0.0 && factor != 1.0 {
            finding.change(&signal.table, "offset", toml(signal.offset * factor + offset));
        }
    }
}

/// Reports temperatures that the configuration does not convert from the unit in the DBC. Without this check, 50
/// degrees Fahrenheit would pass as 50 degrees Celsius.
fn unconverted(judge: &mut Judge<'_>, all: &[SignalSeries<'_>], median_c: f64) -> Option<()> {
    let conversion = |signal: &SignalPlan| {
        let (kind, factor, offset) = unit_of(&signal.unit)?;
        let is_plausible = kind == Kind::Temperature && PLAUSIBLE_C.contains(&(median_c * factor + offset));
        let is_plain = (signal.scale, signal.offset) == (1.0, 0.0);
        (is_plausible && is_plain && (factor, offset) != (1.0, 0.0)).then_some((factor, offset))
    };
    let found: Vec<_> = all.iter().filter_map(|(signal, _)| Some((*signal, conversion(signal)?))).collect();
    let &(first, (factor, offset)) = found.first()?;
    let (read, converted) = (number(median_c), number(median_c * factor + offset));
    let finding = error(judge, Topic::Unit, format!("temperatures: the DBC's unit is {:?}", first.unit))
        .seen(format!("the median sensor reads {read} degrees C"))
        .why(format!("the configuration does not convert it; it is {converted} degrees C"));
    for (signal, (factor, offset)) in found {
        if factor != 1.0 {
            finding.change(&signal.table, "scale", toml(factor));
        }
        finding.change(&signal.table, "offset", toml(offset));
    }
    Some(())
}

/// Reports readings outside the configured limits if no other finding explains them. Either the limits are too tight
/// or the readings are disturbed. The daemon will reject these readings.
pub(super) fn check_limits(judge: &mut Judge<'_>) {
    if judge.is_mixed_up || judge.has(&[Topic::Unit, Topic::Layout, Topic::Cell, Topic::CellCount]) {
        return;
    }
    let [current, voltage, temperature] = judge.plan.limits;
    for (kind, table, what, limits, cells) in [
        (Kind::Current, "limits.current", "currents", current, 1.0),
        (Kind::Voltage, "limits.voltage", "voltages", voltage, judge.cells_per_reading()),
        (Kind::Temperature, "limits.temperature", "temperatures", temperature, 1.0),
    ] {
        let all = judge.signals(kind);
        let (implausible, count) = all.iter().fold((0, 0), |(a, b), (_, s)| (a + s.implausible, b + s.count()));
        if implausible == 0 {
            continue;
        }
        let low = all.iter().map(|(_, s)| s.extent.min).fold(f64::INFINITY, f64::min);
        let high = all.iter().map(|(_, s)| s.extent.max).fold(f64::NEG_INFINITY, f64::max);
        let is_many = implausible as f64 / count.max(1) as f64 > MANY;
        let (severity, why) = match is_many {
            true => (Severity::Warning, "disturbances are rarer, so the limit is too tight; estimates ignore them"),
            false => (Severity::Note, "single readings are disturbances; estimates ignore them"),
        };
        let [from, to, lowest, highest] = [low / cells, high / cells, limits.0, limits.1].map(number);
        let finding = find(judge, severity, Topic::Range, format!("{what} outside the limits"))
            .seen(format!("{implausible} of {count} readings: {from} to {to}, allowed {lowest} to {highest}"))
            .why(why);
        if kind == Kind::Current && is_many && high > limits.1 {
            finding.change(table, "max_discharge_a", toml((1.2 * high).ceil()));
        }
        if kind == Kind::Current && is_many && low < limits.0 {
            finding.change(table, "max_charge_a", toml((-1.2 * low).ceil()));
        }
    }
}
