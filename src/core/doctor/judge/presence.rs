//! Signals that are configured and do not come, and the number of cells.

use std::collections::BTreeMap;

use super::super::plan::SignalPlan;
use super::super::report::{Finding, Topic};
use super::super::series::Series;
use super::{Judge, Kind, words};
use crate::can::CanId;
use crate::quantity::{BusIndex, Channel};

/// Why there is no value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Absence {
    Message,
    Page,
    NotAvailable,
    NotFinite,
    Short,
    /// Cells only: always the same code far below any voltage.
    Zero,
}

pub(super) fn judge(judge: &mut Judge<'_>) {
    let silent: Vec<(&SignalPlan, Absence)> = judge
        .plan
        .signals
        .iter()
        .zip(&judge.doctor.series)
        .filter(|(signal, _)| !judge.explained.contains(&(signal.binding.bus, signal.binding.id)))
        .filter_map(|(signal, series)| Some((signal, absence(judge, signal, series)?)))
        .collect();
    let silent = fewer_cells(judge, silent);
    tell(judge, &silent);
    more_cells(judge);
    present(judge);
}

fn absence(judge: &Judge<'_>, signal: &SignalPlan, series: &Series) -> Option<Absence> {
    let is_cell = matches!(signal.binding.channel, Channel::CellVoltage(_));
    if series.count() == 0 {
        return Some(match series {
            _ if series.frames == 0 => Absence::Message,
            _ if series.not_available > 0 => Absence::NotAvailable,
            _ if series.not_finite > 0 => Absence::NotFinite,
            _ if series.short > 0 => Absence::Short,
            _ => Absence::Page,
        });
    }
    // Packs with fewer cells than their DBC fill the rest with zeros.
    let is_still = series.extent.changes == 0 && series.count() > 1;
    let usual = judge.cell_voltage()?.abs();
    let is_absent = is_cell && judge.plan.cells > 1 && series.extent.last.abs() < 0.05 * usual;
    // And a whole pack that is switched off, or another message of that identifier.
    let is_dead = Kind::of(signal.binding.channel) == Kind::Voltage && usual == 0.0 && series.extent.last == 0.0;
    (is_still && (is_absent || is_dead)).then_some(Absence::Zero)
}

/// When exactly the last cells are silent, the pack has fewer; or the last module is dead, which looks the same where
/// there is no message or no value at all: then it is told as silent, too.
fn fewer_cells<'d>(judge: &mut Judge<'d>, silent: Vec<(&'d SignalPlan, Absence)>) -> Vec<(&'d SignalPlan, Absence)> {
    let number = |signal: &SignalPlan| match signal.binding.channel {
        Channel::CellVoltage(cell) => Some(cell.0),
        _ => None,
    };
    let mut absent: Vec<u16> = silent.iter().filter_map(|(signal, _)| number(signal)).collect();
    absent.sort_unstable();
    let configured = u16::try_from(judge.of(Kind::Voltage).len()).unwrap_or(u16::MAX);
    let Some(&first) = absent.first() else { return silent };
    let is_tail = absent.iter().copied().eq(first..configured);
    if judge.plan.is_pack_total || !is_tail || first == 0 || configured < 2 {
        return silent;
    }
    let how = silent.iter().find(|(signal, _)| number(signal).is_some()).map_or(Absence::Message, |(_, how)| *how);
    let may_be_dead = matches!(how, Absence::Message | Absence::NotAvailable);
    let configures = format!("{first} cells, {configured} are configured");
    let finding = if may_be_dead {
        Finding::warning(Topic::CellCount, format!("the pack may have {configures}"))
    } else {
        Finding::error(Topic::CellCount, format!("the pack has {configures}"))
    };
    let finding = finding
        .seen(format!("cells 1-{first} have data; cells {}-{configured}: {}", first + 1, phrase(how)))
        .why("exactly the last ones are missing: the DBC serves a larger pack too")
        .change("pack", "cells", first.to_string())
        .advice("or the last module does not report: count the cells before changing this");
    judge.report.add(finding);
    if may_be_dead {
        return silent;
    }
    silent.into_iter().filter(|(signal, _)| number(signal).is_none()).collect()
}

fn phrase(absence: Absence) -> &'static str {
    match absence {
        Absence::Message => "their message never came",
        Absence::Page => "their multiplexer page never came",
        Absence::NotAvailable => "always \"signal not available\"",
        Absence::NotFinite => "never a number",
        Absence::Short => "their frames are too short",
        Absence::Zero => "always the same code near zero",
    }
}

/// One finding per message and reason.
fn tell(judge: &mut Judge<'_>, silent: &[(&SignalPlan, Absence)]) {
    let mut groups: BTreeMap<(BusIndex, &str, Absence), Vec<&SignalPlan>> = BTreeMap::new();
    for (signal, how) in silent {
        groups.entry((signal.binding.bus, signal.message.as_str(), *how)).or_default().push(signal);
    }
    for ((bus, message, how), signals) in groups {
        let channels: Vec<Channel> = signals.iter().map(|signal| signal.binding.channel).collect();
        let what = words::channels(&channels);
        let (id, interface) = (signals[0].binding.id, judge.interface(bus));
        let is_reported = channels.iter().all(|channel| Kind::of(*channel) == Kind::Reported);
        let title = format!("{what}: configured, never seen");
        let finding =
            if is_reported { Finding::warning(Topic::Silent, title) } else { Finding::error(Topic::Silent, title) };
        let seen = match how {
            Absence::Message => {
                format!("{message} ({id}) did not come on {interface} in {}", words::seconds(judge.doctor.seconds()))
            }
            Absence::Page => format!("{message} ({id}) came, but never with the page of {what}"),
            Absence::NotAvailable => format!("{message} ({id}) came, and always said \"signal not available\""),
            Absence::NotFinite => format!("{message} ({id}) came, and never held a number"),
            Absence::Short => {
                let longest =
                    judge.doctor.buses.get(bus.index()).and_then(|b| b.ids.get(&id)).map_or(0, |seen| seen.len);
                let needed = signals.iter().map(|s| s.binding.plan.bytes_needed()).max().unwrap_or(0);
                format!("{message} ({id}) has {longest} bytes, {needed} are needed")
            }
            Absence::Zero => format!("{message} ({id}) came, and always holds zero there"),
        };
        let (why, advice) = match how {
            Absence::Message => (
                "other messages of this bus came, so the bus is right and the identifier or the sender is not",
                "compare the identifier with candump; some senders speak only while driving or charging",
            ),
            Absence::Page => {
                ("the multiplexor never took the code the DBC gives", "compare the DBC's multiplexor with candump")
            }
            Absence::NotAvailable => (
                "the sender knows the signal and has no value",
                "switch the pack on, or name the signal that is used on this vehicle",
            ),
            Absence::NotFinite => ("the bits are no float", "compare the DBC's value type with its makers'"),
            Absence::Short => ("the frame ends before the signal", "the DBC is of another version of this sender"),
            Absence::Zero if judge.cell_voltage() == Some(0.0) => {
                judge.is_mixed_up = true;
                match others_with(judge, bus, id) {
                    Some(_) => (
                        "another bus has this identifier too, and the same number may be another message on each",
                        "try the other interface",
                    ),
                    None => (
                        "the pack is switched off, or this is another message",
                        "close the contactors; compare with candump",
                    ),
                }
            }
            Absence::Zero => ("no cell is there", "compare with the pack's own list of cells"),
        };
        let finding = finding.seen(seen).why(why);
        let finding = match others_with(judge, bus, id).filter(|_| how == Absence::Zero) {
            Some(other) => finding.change(&signals[0].table, "interface", format!("{other:?}")),
            None => finding.change(&signals[0].table, "signal", "the signal that is on the bus"),
        };
        judge.report.add(finding.advice(advice));
    }
}

/// Another interface on which the identifier came.
fn others_with(judge: &Judge<'_>, bus: BusIndex, id: CanId) -> Option<String> {
    let others = judge.doctor.buses.iter().enumerate().filter(|(index, _)| *index != bus.index());
    others.into_iter().find(|(_, other)| other.ids.contains_key(&id)).map(|(_, other)| other.name.clone())
}

/// Signals of further cells that carry data.
fn more_cells(judge: &mut Judge<'_>) {
    let Some(usual) = judge.cell_voltage() else { return };
    let plan = judge.plan;
    let alive = plan
        .more_cells
        .iter()
        .zip(&judge.doctor.more_cells)
        .filter(|(_, series)| series.values.median().is_some_and(|v| (v - usual).abs() < 0.15 * usual.abs()));
    let alive: Vec<&SignalPlan> = alive.map(|(signal, _)| signal).collect();
    if alive.is_empty() || plan.is_pack_total {
        return;
    }
    let count = usize::from(plan.cells) + alive.len();
    let names: Vec<&str> = alive.iter().take(3).map(|signal| signal.name.as_str()).collect();
    let more = if alive.len() > names.len() { ", ..." } else { "" };
    let finding =
        Finding::error(Topic::CellCount, format!("the pack has {count} cells, {} are configured", plan.cells))
            .seen(format!("{}{more} carry {} V too, as the others do", names.join(", "), words::number(usual)))
            .why("the DBC's pattern goes on, and what is there looks like cells")
            .change("pack", "cells", count.to_string());
    judge.report.add(finding);
}

/// What came as it should.
fn present(judge: &mut Judge<'_>) {
    for kind in [Kind::Current, Kind::Voltage, Kind::Temperature, Kind::Reported] {
        let all = judge.of(kind);
        let here: Vec<_> = all.iter().filter(|(_, series)| series.count() > 0).collect();
        if here.is_empty() {
            continue;
        }
        let period_s = super::super::link::median(here.iter().filter_map(|(_, series)| series.period_s()));
        let every = period_s.map_or(String::new(), |s| format!(" every {}", words::seconds(s)));
        let what = match kind {
            Kind::Current => "pack current".to_owned(),
            Kind::Voltage if judge.plan.is_pack_total => "pack voltage".to_owned(),
            Kind::Voltage => format!("{} of {} cell voltages", here.len(), all.len()),
            Kind::Temperature => format!("{} of {} temperatures", here.len(), all.len()),
            Kind::Reported => "what the pack reports of itself".to_owned(),
        };
        let low = here.iter().map(|(_, s)| s.extent.min).fold(f64::INFINITY, f64::min);
        let high = here.iter().map(|(_, s)| s.extent.max).fold(f64::NEG_INFINITY, f64::max);
        let unit = match kind {
            Kind::Current => " A (positive = discharge)",
            Kind::Voltage => " V",
            Kind::Temperature => " degrees C",
            Kind::Reported => "",
        };
        judge.report.fine.push(format!("{what}{every}, {} to {}{unit}", words::number(low), words::number(high)));
    }
}
