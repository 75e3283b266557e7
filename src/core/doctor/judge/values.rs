//! Units and layouts: values that no pack can have, and what would make them possible.

use super::super::plan::SignalPlan;
use super::super::report::{Finding, Topic};
use super::super::series::{Alternative, LayoutVariant, Series};
use super::places::unit_of;
use super::{Judge, Kind, MAX_C_RATE, electrical, words};

/// Factors a unit may slip by.
const SLIPS: [f64; 6] = [1e-3, 1e-2, 1e-1, 10.0, 100.0, 1000.0];
/// A temperature beyond this is looked at, degrees C.
const HOT_C: f64 = 60.0;
const COLD_C: f64 = -40.0;

pub(super) fn judge(judge: &mut Judge<'_>) {
    if judge.is_mixed_up {
        return;
    }
    voltages(judge);
    current(judge);
    temperatures(judge);
}

type Seen<'d> = (&'d SignalPlan, &'d Series);

/// Share of the signals for which a way to read them otherwise is `good`, and the first such way.
fn otherwise<'d>(
    all: &[Seen<'d>],
    good: impl Fn(&Series, &Alternative) -> bool,
) -> Option<(Seen<'d>, &'d Alternative)> {
    for how in [LayoutVariant::ByteOrder, LayoutVariant::Sign, LayoutVariant::Both] {
        let of = |series: &'d Series| series.alternatives.iter().find(|other| other.how == how);
        let fits =
            |(_, series): &&Seen<'d>| of(series).is_some_and(|other| other.extent.count > 0 && good(series, other));
        let alive = all.iter().filter(|(_, series)| series.count() > 0).count();
        let fitting: Vec<&Seen<'d>> = all.iter().filter(fits).collect();
        if alive > 0 && 4 * fitting.len() >= 3 * alive {
            let first = *fitting[0];
            return of(first.1).map(|other| (first, other));
        }
    }
    None
}

/// Whether the other reading runs smoothly where the configured one jumps about.
fn is_smoother(signal: &SignalPlan, series: &Series, other: &Alternative) -> bool {
    let layout = &signal.layout;
    if layout.length_bits < 12 || series.extent.changes < 10 {
        return false;
    }
    let width = (layout.factor * signal.binding.scale).abs() * f64::from(layout.length_bits).exp2();
    let (here, there) = (&series.extent, &other.extent);
    here.step() > 0.02 * width && there.step() * 8.0 < here.step() && there.range() < 0.25 * width
}

fn layout_finding(all: &[Seen<'_>], (signal, series): Seen<'_>, other: &Alternative, what: &str) -> Finding {
    let title = match other.how {
        LayoutVariant::ByteOrder => format!("{what}: wrong byte order in the DBC"),
        LayoutVariant::Sign => format!("{what}: signed and unsigned exchanged in the DBC"),
        LayoutVariant::Both => format!("{what}: wrong byte order and sign of the number in the DBC"),
    };
    let (here, there) = (&series.extent, &other.extent);
    let span = |extent: &super::super::series::Extent| {
        format!(
            "{} to {} in steps of {}",
            words::number(extent.min),
            words::number(extent.max),
            words::number(extent.step())
        )
    };
    let layout = &other.layout;
    let sign = match layout.value_type {
        crate::can::signal::ValueType::Signed => "-",
        _ => "+",
    };
    let many = if all.len() > 1 { format!(" (and {} like it)", all.len() - 1) } else { String::new() };
    Finding::error(Topic::Layout, title)
        .seen(format!("{} reads {}; read the other way {}", signal.name, span(here), span(there)))
        .why("a pack's values do not jump about, and with the other reading they do not")
        .advice(format!(
            "in the DBC: {}{many} : {}|{}{}{sign}",
            signal.name,
            layout.start_bit,
            layout.length_bits,
            words::order(layout.byte_order).get(..2).unwrap_or("@1"),
        ))
}

fn voltages(judge: &mut Judge<'_>) {
    let all = judge.of(Kind::Voltage);
    let Some(middle) = judge.cell_voltage() else { return };
    let (low, high) = judge.voltage_band();
    let cells = if judge.plan.is_pack_total { f64::from(judge.plan.cells.max(1)) } else { 1.0 };
    let what = if judge.plan.is_pack_total { "pack voltage" } else { "cell voltages" };
    let is_plausible = (low..=high).contains(&middle);
    let smoother = otherwise(&all, |series, other| {
        let found = all.iter().find(|(_, s)| std::ptr::eq(*s, series));
        let in_band = low * cells <= other.extent.mean() && other.extent.mean() <= high * cells;
        let is_steady =
            other.extent.range() < 0.5 * (high - low) * cells + 1e-9 || in_band && other.extent.range() < high * cells;
        found.is_some_and(|(signal, _)| is_smoother(signal, series, other)) && is_steady
            || !is_plausible && in_band && is_steady
    });
    if let Some((seen, other)) = smoother {
        judge.is_mixed_up = true;
        return judge.report.add(layout_finding(&all, seen, other, what));
    }
    if is_plausible {
        return;
    }
    let Some((signal, _)) = all.first().copied() else { return };
    let seen = format!(
        "{what}: the middle reads {} V{}",
        words::number(middle),
        if judge.plan.is_pack_total { " a cell" } else { "" }
    );
    let band = format!("a cell of this model has {} to {} V", words::number(low), words::number(high));
    let factor = SLIPS.into_iter().find(|factor| (low..=high).contains(&(middle * factor)));
    if let Some(factor) = factor {
        judge.voltage_factor = factor;
        let finding = Finding::error(Topic::Unit, format!("{what}: off by a factor of {}", slip(factor)))
            .seen(seen)
            .why(format!("{band}; times {} it is {} V", words::number(factor), words::number(middle * factor)))
            .change(&signal.table, "scale", words::toml(signal.scale * factor));
        return judge.report.add(finding);
    }
    if judge.plan.is_pack_total && middle > 0.0 {
        return pack_count(judge, middle * cells);
    }
    judge.is_mixed_up = true;
    let finding = Finding::error(Topic::CellModel, "cell voltages do not belong to this cell model")
        .seen(seen)
        .why(format!("{band}, and no factor of ten helps"))
        .change("pack", "cell_model", "the model of the cell that is in the pack")
        .advice("or the signal is not a cell voltage");
    judge.report.add(finding);
}

/// `1000`, whichever way.
fn slip(factor: f64) -> String {
    words::number(if factor < 1.0 { 1.0 / factor } else { factor })
}

/// A total voltage that so many cells cannot make.
fn pack_count(judge: &mut Judge<'_>, total_v: f64) {
    judge.is_mixed_up = true;
    let (min_v, max_v) = judge.plan.model.as_ref().map_or((2.8, 4.2), |m| (m.voltage_min_v, m.voltage_max_v));
    let (fewest, most) = ((total_v / max_v).ceil(), (total_v / min_v).floor());
    let finding = Finding::error(Topic::CellCount, format!("{} cells cannot make this pack voltage", judge.plan.cells))
        .seen(format!(
            "{} V in all: {} V a cell",
            words::number(total_v),
            words::number(total_v / f64::from(judge.plan.cells.max(1)))
        ))
        .why(format!("cells of this model have {min_v} to {max_v} V: it must be {fewest} to {most} of them"))
        .change("pack", "cells", format!("{fewest} to {most}, as the pack's makers say"));
    judge.report.add(finding);
}

fn current(judge: &mut Judge<'_>) {
    let Some((signal, series)) = judge.current().filter(|(_, series)| series.count() > 0) else { return };
    let limit_a = MAX_C_RATE * judge.pack_ah();
    let all = [(signal, series)];
    let largest =
        series.values.quantile(0.02).unwrap_or(0.0).abs().max(series.values.quantile(0.98).unwrap_or(0.0).abs());
    let other = otherwise(&all, |series, other| {
        let most = other.extent.min.abs().max(other.extent.max.abs());
        let is_calmer = other.extent.range() < 0.1 * series.extent.range().max(largest);
        is_smoother(signal, series, other) && most < limit_a || largest > limit_a && most < 0.5 * limit_a && is_calmer
    });
    if let Some((seen, other)) = other {
        judge.is_mixed_up = true;
        return judge.report.add(layout_finding(&all, seen, other, "pack current"));
    }
    let written = unit_of(&signal.unit).filter(|(_, factor, _)| *factor != 1.0 && signal.scale == 1.0);
    if largest <= limit_a && written.is_none() {
        return;
    }
    let c_rate = largest / judge.pack_ah();
    let factor = match written {
        Some((_, factor, _)) => factor,
        None => electrical::factor_by_steps(judge).filter(|factor| *factor < 1.0).unwrap_or_else(|| {
            let mut smaller = SLIPS.into_iter().rev().filter(|factor| *factor < 1.0);
            smaller.find(|factor| c_rate * factor <= 3.0).unwrap_or(1e-3)
        }),
    };
    judge.current_factor = factor;
    let why = match written {
        Some(_) => format!("the DBC's unit is {:?}, and the configuration does not convert it", signal.unit),
        None => format!("that is {} times the pack's capacity in an hour", words::number(c_rate)),
    };
    let finding =
        match written {
            Some(_) => Finding::error(Topic::Unit, format!("pack current: off by a factor of {}", slip(factor)))
                .change(&signal.table, "scale", words::toml(signal.scale * factor)),
            None => electrical::slip_or_other_cell(judge, signal, factor, false),
        };
    judge.report.add(finding.seen(format!("{} reads up to {} A", signal.name, words::number(largest))).why(why));
}

/// What a temperature could be meant as: factor, offset, in words.
const MEANINGS: [(f64, f64, &str); 6] = [
    (1.0, -273.15, "kelvin"),
    (5.0 / 9.0, -160.0 / 9.0, "Fahrenheit"),
    (0.1, 0.0, "tenths of a degree"),
    (0.01, 0.0, "hundredths of a degree"),
    (1.0, -40.0, "an offset of 40 too much"),
    (1.0, 273.15, "kelvin taken off twice"),
];

fn temperatures(judge: &mut Judge<'_>) {
    let all = judge.of(Kind::Temperature);
    let medians: Vec<f64> = all.iter().filter_map(|(_, series)| series.values.median()).collect();
    let Some(middle) = super::super::link::median(medians.into_iter()) else { return };
    let ambient_c = judge.plan.ambient_c;
    let is_plausible = (COLD_C..=HOT_C).contains(&middle);
    let other = otherwise(&all, |series, other| {
        let found = all.iter().find(|(_, s)| std::ptr::eq(*s, series));
        let is_near = (other.extent.mean() - ambient_c).abs() < 45.0 && other.extent.range() < 40.0;
        is_near && (found.is_some_and(|(signal, _)| is_smoother(signal, series, other)) || !is_plausible)
    });
    let meaning = MEANINGS
        .into_iter()
        .map(|(factor, offset, word)| (factor, offset, word, middle * factor + offset))
        .filter(|(.., meant)| (COLD_C..=HOT_C).contains(meant))
        .min_by(|a, b| (a.3 - ambient_c).abs().total_cmp(&(b.3 - ambient_c).abs()));
    // A plain slip of the unit explains more than bits in another order, unless the values jump about.
    let is_steady = all.iter().all(|(_, series)| series.extent.range() < 60.0);
    if let Some((seen, other)) = other.filter(|_| meaning.is_none() || !is_steady) {
        return judge.report.add(layout_finding(&all, seen, other, "temperatures"));
    }
    if let Some(finding) = unconverted(&all, middle) {
        return judge.report.add(finding);
    }
    if is_plausible {
        return;
    }
    let Some((first, _)) = all.first().copied() else { return };
    let seen = format!("the middle sensor reads {} degrees C", words::number(middle));
    let Some((factor, offset, word, meant)) = meaning else {
        let finding = Finding::error(Topic::Unit, "temperatures no pack has").seen(seen);
        let finding =
            finding.why("no usual unit makes a temperature of it").change(&first.table, "signal", "a temperature");
        return judge.report.add(finding);
    };
    let title = format!("temperatures: {word}?");
    let is_possible = (HOT_C..90.0).contains(&middle);
    let finding = if is_possible { Finding::warning(Topic::Unit, title) } else { Finding::error(Topic::Unit, title) };
    let mut finding = finding.seen(seen).why(format!(
        "{}as {word} it is {} degrees C, near the {} of pack.ambient_c",
        if is_possible { "so hot a pack would be in danger; " } else { "no pack has that; " },
        words::number(meant),
        words::number(ambient_c)
    ));
    for (signal, _) in &all {
        if factor != 1.0 {
            finding = finding.change(&signal.table, "scale", words::toml(signal.scale * factor));
        }
        if offset != 0.0 || signal.offset != 0.0 && factor != 1.0 {
            finding = finding.change(&signal.table, "offset", words::toml(signal.offset * factor + offset));
        }
    }
    judge.report.add(finding);
}

/// Temperatures whose unit in the DBC is another, and nobody converts them: 50 degrees F pass for a warm day.
fn unconverted(all: &[Seen<'_>], middle: f64) -> Option<Finding> {
    let written = |signal: &SignalPlan| {
        let (kind, factor, offset) = unit_of(&signal.unit)?;
        let is_meant = kind == "temperature" && (COLD_C..=HOT_C).contains(&(middle * factor + offset));
        let is_plain = (signal.scale, signal.offset) == (1.0, 0.0);
        (is_meant && is_plain && (factor, offset) != (1.0, 0.0)).then_some((factor, offset))
    };
    let found: Vec<_> = all.iter().filter_map(|(signal, _)| Some((*signal, written(signal)?))).collect();
    let &(first, (factor, offset)) = found.first()?;
    let finding = Finding::error(Topic::Unit, format!("temperatures: the DBC's unit is {:?}", first.unit))
        .seen(format!("the middle sensor reads {} degrees C", words::number(middle)))
        .why(format!(
            "the configuration does not convert it; it is {} degrees C",
            words::number(middle * factor + offset)
        ));
    Some(found.into_iter().fold(finding, |finding, (signal, (factor, offset))| {
        let finding = if factor == 1.0 { finding } else { finding.change(&signal.table, "scale", words::toml(factor)) };
        finding.change(&signal.table, "offset", words::toml(offset))
    }))
}

/// Share of implausible readings that is more than a disturbance.
const MANY: f64 = 0.01;

/// Readings the service will refuse although nothing else is wrong: limits too tight, or disturbances.
pub(super) fn refused(judge: &mut Judge<'_>) {
    if judge.is_mixed_up || judge.report.has(&[Topic::Unit, Topic::Layout, Topic::Cell, Topic::CellCount]) {
        return;
    }
    for (kind, table, what) in [
        (Kind::Current, "limits.current", "currents"),
        (Kind::Voltage, "limits.voltage", "voltages"),
        (Kind::Temperature, "limits.temperature", "temperatures"),
    ] {
        let all = judge.of(kind);
        let (implausible, count) = all.iter().fold((0, 0), |(a, b), (_, s)| (a + s.implausible, b + s.count()));
        if implausible == 0 {
            continue;
        }
        let low = all.iter().map(|(_, s)| s.extent.min).fold(f64::INFINITY, f64::min);
        let high = all.iter().map(|(_, s)| s.extent.max).fold(f64::NEG_INFINITY, f64::max);
        let limits = judge.plan.limits[usize::from(kind != Kind::Current) + usize::from(kind == Kind::Temperature)];
        let cells = if kind == Kind::Voltage && judge.plan.is_pack_total { f64::from(judge.plan.cells) } else { 1.0 };
        let share = implausible as f64 / count.max(1) as f64;
        let title = format!("{what} outside the limits");
        let finding =
            if share > MANY { Finding::warning(Topic::Range, title) } else { Finding::note(Topic::Range, title) };
        let mut finding = finding
            .seen(format!(
                "{} of {count} readings: {} to {}, allowed {} to {}",
                implausible,
                words::number(low / cells),
                words::number(high / cells),
                words::number(limits.0),
                words::number(limits.1)
            ))
            .why(if share > MANY {
                "so many are no disturbance: the limit is too tight, and they move no estimate"
            } else {
                "a few are disturbances; they move no estimate"
            });
        if kind == Kind::Current && share > MANY {
            if high > limits.1 {
                finding = finding.change(table, "max_discharge_a", words::toml((1.2 * high).ceil()));
            }
            if low < limits.0 {
                finding = finding.change(table, "max_charge_a", words::toml((-1.2 * low).ceil()));
            }
        }
        judge.report.add(finding);
    }
}
