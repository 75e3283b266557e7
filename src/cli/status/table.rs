//! The table of `packwatch status`. All functions are pure: they convert a document to text.

use std::fmt::Write as _;

use super::{config, duration, in_brackets, large, mean, number, shown, soc_band, store, with_std, word};
use crate::cli::common::alarms::{AlarmGroup, grouped};
use crate::cli::common::output;
use crate::io::stamp;
use crate::monitor::{CellView, ModelState, PackView};
use crate::quantity::catalogue::{Estimate, PackValues, Quantity};
use crate::status::counters::LATENCY_BOUNDS_S;
use crate::status::document::{Intruder, IntruderKind, StatusDocument};

/// Maximum number of cells that are listed without `--cells`, so that the table fits a screen.
const MAX_LISTED: usize = 16;
/// A cell can be an outlier only if its distance from the median exceeds this many times the median of all distances.
const OUTLYING: f64 = 3.0;
const MAX_OUTLIERS: usize = 8;
const MOST_FOUND: usize = 8;

/// Formats the document as a table; `all` lists every cell.
pub(super) fn table(document: &StatusDocument, all: bool) -> String {
    let mut text = String::new();
    head(&mut text, document);
    pack(&mut text, document);
    interfaces(&mut text, document);
    alarms(&mut text, document);
    cells(&mut text, &document.cells, all);
    text
}

fn head(text: &mut String, document: &StatusDocument) {
    let _ = writeln!(
        text,
        "packwatch {}, process {}, up {}, {}, configuration {}",
        document.program_version,
        document.pid,
        duration(document.uptime_s),
        stamp::format_utc(document.wall_time),
        config(document),
    );
    if document.vehicle.is_stated() {
        let _ = writeln!(text, "vehicle    {}", document.vehicle);
    }
}

fn pack(text: &mut String, document: &StatusDocument) {
    let pack = &document.pack;
    if let Some(since) = document.asleep_since {
        let asleep = duration(document.time.since(since));
        let _ = writeln!(text, "asleep     for {asleep}: the buses are silent at rest; inputs do not count as missing");
    }
    for Intruder { interface, id, kind } in &document.intruders {
        let what = match kind {
            IntruderKind::SecondSender => "has a second sender: its values cannot be trusted",
            IntruderKind::OwnIdentifier => "is an identifier of packwatch, but another node sends it",
        };
        let _ = writeln!(text, "intruder   {interface} {id} {what}");
    }
    if document.current_frozen {
        let _ = writeln!(text, "current    frozen: its reading does not change, but the voltages show a changing load");
    }
    for found in document.findings.iter().take(MOST_FOUND) {
        let _ = writeln!(text, "found      {found}, for {}", duration(document.time.since(found.since)));
    }
    if let more @ 1.. = document.findings.len().saturating_sub(MOST_FOUND) {
        let _ = writeln!(text, "           and {more} more: `packwatch status --json` lists all");
    }
    let _ = writeln!(
        text,
        "pack       {}: SOC {}{}, {}, {}, {}, at most {}",
        word(pack.validity),
        mean(&pack.values, Quantity::Soc, 1),
        soc_band(pack).map(|band| format!(" ({band})")).unwrap_or_default(),
        word(pack.mode),
        mean(&pack.values, Quantity::Voltage, 2),
        mean(&pack.values, Quantity::Current, 2),
        mean(&pack.values, Quantity::TemperatureMax, 1),
    );
    let _ = writeln!(text, "energy     {}", energy(&pack.values));
    if pack.values.get(Quantity::DischargePower10s).is_some() {
        let [discharge, charge] = [Quantity::DischargePower10s, Quantity::ChargePower10s];
        let (discharge, charge) = (large(&pack.values, discharge), large(&pack.values, charge));
        let [drawn, charged] = [0, 1].map(|k| in_brackets(pack.power_limiting_cells.map(|cells| cells[k])));
        let _ = writeln!(text, "power      for 10 s: discharge {discharge}{drawn}, charge {charge}{charged}");
    }
    let _ = writeln!(
        text,
        "health     capacity {}{}, SOH {}, usable {}, recharge period {}, with the reference charger {}",
        with_std(&pack.values, Quantity::Capacity, 3),
        in_brackets(pack.weakest_cell),
        mean(&pack.values, Quantity::Soh, 1),
        with_std(&pack.values, Quantity::UsableCapacity, 3),
        mean(&pack.values, Quantity::RechargePeriod, 0),
        with_std(&pack.values, Quantity::NormalisedRechargePeriod, 0),
    );
    if pack.values.get(Quantity::CurrentOffset).is_some() {
        let offset = with_std(&pack.values, Quantity::CurrentOffset, 3);
        let _ = writeln!(text, "offset     current sensor {offset} (reading minus true current)");
    }
    if let Some(state) = pack.model_state.filter(|state| *state != ModelState::Given) {
        let better = pack.model_fits_better.map_or_else(String::new, |it| format!(": {} fits better", it.name()));
        let _ = writeln!(text, "model      {}{better}", word(state));
    }
    let _ = writeln!(text, "losses     {}", losses(&pack.values));
    let _ = writeln!(text, "life       {}", remaining(pack));
    let [events, fast, high_soc] = [Quantity::LimitEvents, Quantity::FastCharges, Quantity::HighSocTime];
    let count = |quantity| shown(pack.values.mean(quantity), 0, "");
    let high_soc = pack.values.mean(high_soc).map_or_else(|| "-".to_owned(), duration);
    let _ = writeln!(
        text,
        "use        events beyond limits {}, fast charges {}, at rest above 80 % {high_soc}",
        count(events),
        count(fast)
    );
}

fn energy(values: &PackValues) -> String {
    let mut text = format!(
        "remaining {}, to full {}",
        large(values, Quantity::RemainingEnergy),
        large(values, Quantity::EnergyToFull),
    );
    for (what, quantity) in
        [("empty", Quantity::TimeToEmpty), ("full", Quantity::TimeToFull), ("the target", Quantity::TimeToTarget)]
    {
        if let Some(Estimate { mean, std }) = values.get(quantity) {
            let std = std.map_or_else(String::new, |std| format!(" ± {}", duration(std)));
            let _ = write!(text, ", {}{std} to {what}", duration(mean));
        }
    }
    text
}

fn losses(values: &PackValues) -> String {
    if values.get(Quantity::LithiumLoss).is_none() {
        return "unknown".to_owned();
    }
    format!(
        "lithium {}, negative electrode {}, positive electrode {}",
        with_std(values, Quantity::LithiumLoss, 1),
        with_std(values, Quantity::NegativeLoss, 1),
        with_std(values, Quantity::PositiveLoss, 1),
    )
}

fn remaining(pack: &PackView) -> String {
    let quantities = [Quantity::RemainingCycles, Quantity::RemainingCyclesLow, Quantity::RemainingCyclesHigh];
    let [Some(cycles), Some(low), Some(high)] = quantities.map(|quantity| pack.values.mean(quantity)) else {
        return "unknown".to_owned();
    };
    let (cell, days) = (in_brackets(pack.shortest_lived_cell), mean(&pack.values, Quantity::RemainingDays, 0));
    format!("{cycles:.0} equivalent full cycles (90 %: {low:.0} to {high:.0}){cell}, {days} at the recent use")
}

fn interfaces(text: &mut String, document: &StatusDocument) {
    for it in &document.interfaces {
        let lost = it.link.kernel_dropped + it.link.queue_dropped + it.link.malformed;
        let unsent = it.link.send_queue_full + it.link.send_failed;
        let _ = writeln!(
            text,
            "interface  {} {}: {} frames in, {lost} lost, {} out, {unsent} not sent, {} errors, {} bus-off, {} reconnects",
            it.name,
            word(it.state),
            it.received.frames,
            it.link.sent,
            it.received.error_frames,
            it.received.bus_offs,
            it.reconnects,
        );
    }
    let (readings, service) = (&document.counters.readings, &document.counters.service);
    let rejected: u64 = readings.rejected().iter().map(|(_, count)| count).sum();
    let latency = &document.latency;
    let slowest = match latency.quantile_s(0.99) {
        None if latency.frames > 0 => format!("more than {} s", LATENCY_BOUNDS_S[LATENCY_BOUNDS_S.len() - 1]),
        seconds => shown(seconds.map(|seconds| 1e3 * seconds), 2, " ms"),
    };
    let _ = writeln!(
        text,
        "counted    {} readings used, {rejected} rejected; {} late ticks; 99 % of frames processed within {slowest}",
        readings.accepted, service.missed_deadlines,
    );
    let _ = writeln!(text, "store      {}", store(document));
    if let Some(commands) = &document.commands {
        let _ = writeln!(text, "commands   {} {}: {}", commands.interface, commands.id, commands.words());
    }
    if let Some(poll) = document.poll {
        let _ = writeln!(text, "requests   {}", poll.words());
    }
    for controller in &document.controllers {
        let _ = writeln!(text, "answers    {} {}: {}", controller.interface, controller.id, controller.words());
    }
}

fn alarms(text: &mut String, document: &StatusDocument) {
    let alarms = &document.alarms;
    let unknown = match alarms.unknown.len() {
        0 => String::new(),
        count => format!(", {count} unknown"),
    };
    let _ = writeln!(text, "alarms     {} raised of {} thresholds{unknown}", alarms.raised, alarms.thresholds);
    for alarm in grouped(&alarms.list) {
        let _ = writeln!(text, "           {}", alarm_line(&alarm));
    }
    if alarms.omitted > 0 {
        let _ = writeln!(text, "           and {} more", alarms.omitted);
    }
}

/// Formats an alarm, or an alarm that many cells share, in a line.
pub(super) fn alarm_line(group: &AlarmGroup) -> String {
    let alarm = &group.alarm;
    let value = alarm.value.map_or_else(|| "unknown".to_owned(), |value| alarm.rule.with_unit(value));
    let probability =
        alarm.probability.map_or_else(String::new, |probability| format!(", {:.0} % sure", 100.0 * probability));
    let owner = group.owner();
    format!(
        "{} {} {owner} {}: {value}, threshold {}{probability}{}",
        alarm.severity.name(),
        alarm.rule.name(),
        word(alarm.state),
        alarm.rule.with_unit(alarm.threshold),
        if alarm.is_acknowledged { ", acknowledged" } else { "" },
    )
}

const HEAD: [&str; 7] = ["cell", "voltage", "temp.", "SOC", "capacity", "resistance", "trusted"];

fn cells(text: &mut String, cells: &[CellView], all: bool) {
    let is_short = cells.len() > MAX_LISTED && !all;
    let listed: Vec<&CellView> = if is_short { outliers(cells) } else { cells.iter().collect() };
    if is_short {
        spread(text, cells);
        if listed.is_empty() {
            text.push_str("no outliers (--cells lists all)\n");
            return;
        }
        text.push_str("outliers (--cells lists all):\n");
    }
    text.push_str(&output::table(&HEAD, listed.into_iter().map(row), 0));
}

fn row(cell: &CellView) -> Vec<String> {
    vec![
        number(cell.cell).to_string(),
        mean(&cell.values, Quantity::Voltage, 3),
        mean(&cell.values, Quantity::Temperature, 1),
        with_std(&cell.values, Quantity::Soc, 1),
        with_std(&cell.values, Quantity::Capacity, 3),
        with_std(&cell.values, Quantity::ResistanceRatio, 2),
        match cell.trusted {
            None => "-",
            Some(true) => "yes",
            Some(false) => "NO",
        }
        .to_owned(),
    ]
}

/// A quantity that is compared between cells: name, quantity, decimals, and two limits. An outlier's distance from the
/// median exceeds both limits. The first limit is in the quantity's unit, the second is relative to the median. The
/// limits cover sensor errors and the spread of equal cells.
type Comparison = (&'static str, Quantity, usize, f64, f64);

const COMPARISONS: [Comparison; 5] = [
    ("voltage", Quantity::Voltage, 3, 0.010, 0.0),
    ("SOC", Quantity::Soc, 1, 0.01, 0.0),
    ("temp.", Quantity::Temperature, 1, 2.0, 0.0),
    ("capacity", Quantity::Capacity, 3, 0.0, 0.01),
    ("resistance", Quantity::ResistanceRatio, 2, 0.05, 0.0),
];

/// Prints the smallest and largest value of every quantity, with their cells.
fn spread(text: &mut String, cells: &[CellView]) {
    for (name, quantity, decimals, ..) in COMPARISONS {
        let known = || cells.iter().filter_map(|cell| Some((cell, cell.values.mean(quantity)?)));
        let least = known().min_by(|a, b| a.1.total_cmp(&b.1));
        let greatest = known().rev().max_by(|a, b| a.1.total_cmp(&b.1));
        let end = |cell: &CellView| format!("{} (cell {})", mean(&cell.values, quantity, decimals), number(cell.cell));
        let _ = match least.zip(greatest) {
            Some(((least, _), (greatest, _))) => writeln!(
                text,
                "{name:<10} {} to {}, known for {} of {}",
                end(least),
                end(greatest),
                known().count(),
                cells.len()
            ),
            None => writeln!(text, "{name:<10} unknown for all {}", cells.len()),
        };
    }
}

/// Cells whose estimate is not trusted, cells with an unknown value, and cells far from the median of a quantity.
/// Sorted by cell number.
fn outliers(cells: &[CellView]) -> Vec<&CellView> {
    let mut ranked: Vec<(f64, &CellView)> = cells.iter().map(|cell| (0.0, cell)).collect();
    for (_, quantity, _, floor, relative_floor) in COMPARISONS {
        let of = |cell: &CellView| cell.values.mean(quantity);
        let mut known: Vec<f64> = cells.iter().filter_map(of).collect();
        known.sort_by(f64::total_cmp);
        let Some(&median) = known.get(known.len() / 2) else { continue };
        let mut distances: Vec<f64> = known.iter().map(|value| (value - median).abs()).collect();
        distances.sort_by(f64::total_cmp);
        // If a distance divided by `typical` exceeds `OUTLYING`, the distance exceeds both the floor and `OUTLYING`
        // times the median distance.
        let floor = floor.max(relative_floor * median.abs());
        let typical = distances[distances.len() / 2].max(floor / OUTLYING);
        for (rank, cell) in &mut ranked {
            // A cell with an unknown value has the highest rank.
            *rank = rank.max(of(cell).map_or(f64::MAX, |value| (value - median).abs() / typical));
        }
    }
    for (rank, cell) in &mut ranked {
        *rank = if cell.trusted == Some(false) { f64::MAX } else { *rank };
    }
    // The sort is stable: if more cells of equal rank are found than are listed, the lowest cell numbers are listed.
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut found: Vec<&CellView> =
        ranked.into_iter().filter(|(rank, _)| *rank > OUTLYING).take(MAX_OUTLIERS).map(|(_, cell)| cell).collect();
    found.sort_by_key(|cell| cell.cell);
    found
}

#[cfg(test)]
mod tests;
