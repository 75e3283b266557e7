//! Finds configured signals without a value, and checks the number of cells.

use std::collections::BTreeMap;

use super::context::{Judge, error, find};
use super::text::{channels, number, seconds};
use super::values;
use crate::can::CanId;
use crate::quantity::{BusIndex, Channel};
use crate::wiring::evidence::Series;
use crate::wiring::plan::{Kind, SignalPlan};
use crate::wiring::report::{Severity, Topic};

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Absence {
    Message,
    Page,
    NotAvailable,
    NotFinite,
    Short,
    /// The direction of a current that is sent as a magnitude is missing.
    Direction,
    /// The value is constant and far below a cell voltage (voltages only).
    Zero,
}

type Absent<'d> = (&'d SignalPlan, Absence);

pub(super) fn check(judge: &mut Judge<'_>) {
    let all = judge.plan.signals.iter().zip(&judge.observed.series);
    let unexplained = all.filter(|(s, _)| !judge.explained.contains(&(s.binding.bus, s.binding.id)));
    let absent = unexplained.filter_map(|(signal, series)| Some((signal, absence(judge, signal, series)?)));
    let is_explained = |(signal, absence): &Absent<'_>| {
        *absence == Absence::Short && values::is_short_by_layout(judge, Kind::of(signal.binding.channel))
    };
    let absent = absent.filter(|absent| !is_explained(absent)).collect();
    let absent = fewer_cells(judge, absent);
    silent(judge, &absent);
    more_cells(judge);
    present(judge);
}

fn absence(judge: &Judge<'_>, signal: &SignalPlan, series: &Series) -> Option<Absence> {
    if series.count() == 0 {
        let is_magnitude = signal.binding.channel == Channel::Current && judge.plan.has_direction();
        let is_on_bus = judge.bus(signal.binding.bus).is_some_and(|bus| bus.ids.contains_key(&signal.binding.id));
        return Some(match series.unusable {
            // A current that is sent as a magnitude is not read while its direction is missing.
            _ if series.frames == 0 && is_magnitude && is_on_bus => Absence::Direction,
            _ if series.frames == 0 => Absence::Message,
            unusable if unusable.not_available > 0 => Absence::NotAvailable,
            unusable if unusable.not_finite > 0 => Absence::NotFinite,
            unusable if unusable.short > 0 => Absence::Short,
            _ => Absence::Page,
        });
    }
    let last = series.extent.last;
    let is_still = series.extent.changes == 0 && series.count() > 1;
    let median_v = judge.cell_voltage()?.abs();
    // If a pack has fewer cells than its DBC describes, the signals of the missing cells are often zero.
    let is_cell = matches!(signal.binding.channel, Channel::CellVoltage(_));
    let is_unused = is_cell && judge.plan.pack.cells > 1 && last.abs() < 0.05 * median_v;
    // Either the pack is switched off, or the identifier belongs to another message.
    let is_dead = Kind::of(signal.binding.channel) == Kind::Voltage && median_v == 0.0 && last == 0.0;
    (is_still && (is_unused || is_dead)).then_some(Absence::Zero)
}

fn cell_number(signal: &SignalPlan) -> Option<u16> {
    if let Channel::CellVoltage(cell) = signal.binding.channel { Some(cell.0) } else { None }
}

/// If exactly the last cells are absent, reports that too many cells are configured. Returns the absent signals that
/// are still to be reported. The last module may have failed if its message was not received or its values are "not
/// available". The absent cells are then also returned.
fn fewer_cells<'d>(judge: &mut Judge<'d>, absent: Vec<Absent<'d>>) -> Vec<Absent<'d>> {
    let mut cells: Vec<u16> = absent.iter().filter_map(|(signal, _)| cell_number(signal)).collect();
    cells.sort_unstable();
    let configured = u16::try_from(judge.signals(Kind::Voltage).len()).unwrap_or(u16::MAX);
    let Some(&first) = cells.first() else { return absent };
    let is_tail = cells.iter().copied().eq(first..configured);
    if judge.plan.pack.is_total || !is_tail || first == 0 || configured < 2 {
        return absent;
    }
    let reason = absent.iter().find(|(signal, _)| cell_number(signal).is_some()).map_or(Absence::Message, |(_, a)| *a);
    let may_be_dead = matches!(reason, Absence::Message | Absence::NotAvailable);
    let counts = format!("{first} cells, {configured} are configured");
    let (severity, has) = if may_be_dead { (Severity::Warning, "may have") } else { (Severity::Error, "has") };
    let (next, reason) = (first + 1, reason_for_cells(reason));
    find(judge, severity, Topic::CellCount, format!("the pack {has} {counts}"))
        .seen(format!("cells 1-{first} have data; cells {next}-{configured}: {reason}"))
        .why("exactly the last cells are missing, so the DBC probably also describes a larger pack")
        .change("pack", "cells", first.to_string())
        .advice("count the cells before you change this, because the last module may have failed");
    absent.into_iter().filter(|(signal, _)| may_be_dead || cell_number(signal).is_none()).collect()
}

fn reason_for_cells(absence: Absence) -> &'static str {
    match absence {
        Absence::Message => "their message was never received",
        Absence::Page => "their multiplexer page was never received",
        Absence::NotAvailable => "always \"signal not available\"",
        Absence::NotFinite => "never a valid number",
        Absence::Short => "their frames are too short",
        Absence::Direction => "their direction is missing",
        Absence::Zero => "always the same value near zero",
    }
}

/// Reports absent signals. Signals of the same message that are absent for the same reason share one finding.
fn silent(judge: &mut Judge<'_>, absent: &[Absent<'_>]) {
    let mut groups: BTreeMap<(BusIndex, &str, Absence), Vec<&SignalPlan>> = BTreeMap::new();
    for (signal, absence) in absent {
        groups.entry((signal.binding.bus, signal.message.as_str(), *absence)).or_default().push(signal);
    }
    for ((bus, message, absence), signals) in groups {
        let list: Vec<Channel> = signals.iter().map(|signal| signal.binding.channel).collect();
        let is_reported = list.iter().all(|channel| Kind::of(*channel) == Kind::Reported);
        let severity = if is_reported { Severity::Warning } else { Severity::Error };
        let (id, what) = (signals[0].binding.id, channels(&list));
        judge.is_mixed_up |= absence == Absence::Zero && judge.cell_voltage() == Some(0.0);
        let (why, advice) = cause(judge, bus, id, absence);
        let evidence = evidence(judge, absence, &signals, &what);
        let other = judge.other_bus(bus, id).filter(|_| absence == Absence::Zero);
        let (key, proposed) = match other {
            Some(other) => ("interface", format!("{:?}", other.name)),
            None => ("signal", "the signal that is on the bus".to_owned()),
        };
        find(judge, severity, Topic::Silent, format!("{what}: configured, never received"))
            .seen(format!("{message} ({id}) {evidence}"))
            .why(why)
            .change(&signals[0].table, key, proposed)
            .advice(advice);
    }
}

fn evidence(judge: &Judge<'_>, absence: Absence, signals: &[&SignalPlan], what: &str) -> String {
    let (bus, id) = (signals[0].binding.bus, signals[0].binding.id);
    match absence {
        Absence::Message => {
            format!("was not received on {} in {}", judge.interface(bus), seconds(judge.observed.seconds()))
        }
        Absence::Page => format!("was received, but never with the page of {what}"),
        Absence::NotAvailable => "was received, but always with the code for \"signal not available\"".to_owned(),
        Absence::NotFinite => "was received, but never with a valid number".to_owned(),
        Absence::Short => {
            let longest = judge.bus(bus).and_then(|bus| bus.ids.get(&id)).map_or(0, |stats| stats.len);
            let needed = signals.iter().map(|s| s.binding.plan.bytes_needed()).max().unwrap_or(0);
            format!("has {longest} bytes, {needed} are needed")
        }
        Absence::Direction => "was received, but never with the direction of the current".to_owned(),
        Absence::Zero => "was received, but this signal is always zero".to_owned(),
    }
}

fn cause(judge: &Judge<'_>, bus: BusIndex, id: CanId, absence: Absence) -> (&'static str, &'static str) {
    match absence {
        Absence::Message => (
            "other messages of this bus were received: the identifier is wrong, or the sender is silent",
            "compare the identifier with candump; some senders send only while driving or charging",
        ),
        Absence::Page => {
            ("the multiplexor never had the value in the DBC", "compare the DBC's multiplexor with candump")
        }
        Absence::NotAvailable => (
            "the sender knows the signal but has no value",
            "switch the pack on, or configure the signal that this vehicle uses",
        ),
        Absence::NotFinite => {
            ("the bits are not a valid float", "compare the DBC's value type with the sender's documentation")
        }
        Absence::Direction => (
            "the current is configured with `sign`, and its direction signal has no value",
            "configure the signal that carries the direction, or remove `sign` if the current is signed",
        ),
        Absence::Short => ("the frame ends before the signal", "the DBC belongs to another version of this sender"),
        Absence::Zero if judge.cell_voltage() != Some(0.0) => {
            ("there is no cell at this position", "compare with the pack's own list of cells")
        }
        Absence::Zero if judge.other_bus(bus, id).is_some() => (
            "another bus also carries this identifier; each bus may use it for a different message",
            "try the other interface",
        ),
        Absence::Zero => {
            ("the pack is switched off, or this is another message", "close the contactors; compare with candump")
        }
    }
}

/// Finds signals of `plan.more_cells` that carry cell voltages. If there are any, the pack has more cells than
/// configured.
fn more_cells(judge: &mut Judge<'_>) {
    let Some(median_v) = judge.cell_voltage() else { return };
    let plan = judge.plan;
    let is_alike =
        |series: &Series| series.values.median().is_some_and(|v| (v - median_v).abs() < 0.15 * median_v.abs());
    let further = plan.more_cells.iter().zip(&judge.observed.more_cells).filter(|(_, series)| is_alike(series));
    let further: Vec<&str> = further.map(|(signal, _)| signal.name.as_str()).collect();
    if further.is_empty() || plan.pack.is_total {
        return;
    }
    let (cells, configured) = (usize::from(plan.pack.cells) + further.len(), plan.pack.cells);
    let names = further[..further.len().min(3)].join(", ");
    let more = if further.len() > 3 { ", ..." } else { "" };
    let title = format!("the pack has {cells} cells, {configured} are configured");
    error(judge, Topic::CellCount, title)
        .seen(format!("{names}{more} also carry {} V, as the other cells do", number(median_v)))
        .why("the pattern of names continues in the DBC, and these signals carry cell voltages")
        .change("pack", "cells", cells.to_string());
}

fn present(judge: &mut Judge<'_>) {
    for kind in [Kind::Current, Kind::Voltage, Kind::Temperature, Kind::Reported] {
        let all = judge.signals(kind);
        // Balancing bits have no range to show.
        let values = all.iter().filter(|(signal, _)| !matches!(signal.binding.channel, Channel::Balancing(_)));
        let present: Vec<&Series> = values.map(|(_, series)| *series).filter(|s| s.count() > 0).collect();
        if present.is_empty() {
            continue;
        }
        let counts = format!("{} of {}", present.len(), all.len());
        let (what, unit) = match kind {
            Kind::Current => ("pack current".to_owned(), " A (positive = discharge)"),
            Kind::Voltage if judge.plan.pack.is_total => ("pack voltage".to_owned(), " V"),
            Kind::Voltage => (format!("{counts} cell voltages"), " V"),
            Kind::Temperature => (format!("{counts} temperatures"), " degrees C"),
            Kind::Reported => ("values reported by the pack".to_owned(), ""),
        };
        let period_s = judge.median_of(kind, Series::period_s);
        let every = period_s.map_or(String::new(), |s| format!(" every {}", seconds(s)));
        let low = number(present.iter().map(|s| s.extent.min).fold(f64::INFINITY, f64::min));
        let high = number(present.iter().map(|s| s.extent.max).fold(f64::NEG_INFINITY, f64::max));
        judge.fine(format!("{what}{every}, {low} to {high}{unit}"));
    }
}
