//! `packwatch status`: shows the status of the running daemon as a table, JSON, metrics, or a live screen.

#[cfg(test)]
#[path = "../host/status/tests/sample.rs"]
mod sample;
mod table;
mod view;

use std::fmt::Write as _;
use std::path::PathBuf;

use super::common::output::{print, word};
use crate::monitor::PackView;
use crate::quantity::CellIndex;
use crate::quantity::catalogue::{Estimate, PackValues, Quantity, Unit, Values};
use crate::status::client::{StatusClient, parse};
use crate::status::document::StatusDocument;
use crate::status::metrics::openmetrics;
use packwatch_host::failure::Failure;

/// Exit code if no daemon reports its status.
const EXIT_UNREACHABLE: u8 = 3;
/// Exit code if an alarm is raised.
const EXIT_ALARM: u8 = 4;

/// Arguments of `status`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit codes: 0 no alarm is raised; 1 other failure; 2 wrong usage; 3 no daemon reports its status; 4 an \
    alarm is raised. With --watch: 0 after quitting."
)]
pub(crate) struct Args {
    /// List every cell; without it, a pack of more than 16 cells shows their range and the outliers
    #[arg(long)]
    cells: bool,
    /// Print the status document as a line of JSON (cells from 0, times in ns since 1970)
    #[arg(long, conflicts_with_all = ["cells", "prometheus", "watch"])]
    json: bool,
    /// Print metrics as OpenMetrics text (see `packwatch exporter`)
    #[arg(long, conflicts_with_all = ["cells", "watch"])]
    prometheus: bool,
    /// Show a live screen: q quits, tab changes the page, arrow keys move
    #[arg(short, long, conflicts_with = "cells")]
    watch: bool,
    /// Status socket of the daemon [default: where `packwatch run` creates it]
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let client = StatusClient::new(args.socket.as_deref());
    if args.watch {
        return view::run(&client.path).map_err(Failure::new);
    }
    let line = client.line().map_err(|message| Failure { message, code: EXIT_UNREACHABLE })?;
    let document = parse(&line).map_err(Failure::new)?;
    let raised = document.alarms.raised;
    if args.json {
        print(&String::from_utf8_lossy(&line))?;
    } else if args.prometheus {
        print(&openmetrics(Some(document)))?;
    } else {
        print(&table::table(&document, args.cells))?;
    }
    if raised > 0 {
        // The output already shows the alarm.
        return Err(Failure { message: String::new(), code: EXIT_ALARM });
    }
    Ok(())
}

/// A cell's number, from 1.
fn number(cell: CellIndex) -> u32 {
    u32::from(cell.0) + 1
}

/// Returns ` (cell 3)`, or nothing.
fn in_brackets(cell: Option<CellIndex>) -> String {
    cell.map_or_else(String::new, |cell| format!(" (cell {})", number(cell)))
}

/// Formats a number with its unit; an unknown number becomes a dash.
fn shown(value: Option<f64>, decimals: usize, unit: &str) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}{unit}"))
}

/// Formats a value, with its standard deviation if this is known. An unknown value becomes a dash.
fn with_std<const IS_PACK: bool>(values: &Values<IS_PACK>, quantity: Quantity, decimals: usize) -> String {
    let (unit, factor) = screen_unit(quantity.row().unit);
    match values.get(quantity) {
        Some(Estimate { mean, std: Some(std) }) => {
            format!("{:.decimals$} ± {:.decimals$}{unit}", factor * mean, factor * std)
        }
        value => shown(value.map(|value| factor * value.mean), decimals, unit),
    }
}

/// Formats an energy or a power with its standard deviation; from 1000 on in kWh or kW.
fn large(values: &PackValues, quantity: Quantity) -> String {
    let (unit, _) = screen_unit(quantity.row().unit);
    match values.get(quantity) {
        Some(Estimate { mean, std: Some(std) }) if mean >= 1000.0 => {
            format!("{:.1} ± {:.1} k{}", mean / 1000.0, std / 1000.0, unit.trim())
        }
        _ => with_std(values, quantity, 1),
    }
}

/// Formats a value without its standard deviation; an unknown value becomes a dash.
fn mean<const IS_PACK: bool>(values: &Values<IS_PACK>, quantity: Quantity, decimals: usize) -> String {
    let (unit, factor) = screen_unit(quantity.row().unit);
    shown(values.mean(quantity).map(|mean| factor * mean), decimals, unit)
}

/// The unit shown on the screen, and the factor that converts to this unit.
const fn screen_unit(unit: Unit) -> (&'static str, f64) {
    match unit {
        Unit::Level | Unit::Fraction => (" %", 100.0),
        Unit::Ratio | Unit::Count => ("", 1.0),
        Unit::Volts => (" V", 1.0),
        Unit::Amperes => (" A", 1.0),
        Unit::Celsius => (" °C", 1.0),
        Unit::AmpereHours => (" Ah", 1.0),
        Unit::WattHours => (" Wh", 1.0),
        Unit::Watts => (" W", 1.0),
        Unit::Seconds => (" s", 1.0),
        Unit::Days => (" days", 1.0),
        Unit::Cycles => (" cycles", 1.0),
    }
}

/// Returns `95 %: 60.8 to 65.6 %`; `None` if the state of charge is unknown.
fn soc_band(pack: &PackView) -> Option<String> {
    let [low, high] = [Quantity::SocLow, Quantity::SocHigh].map(|edge| pack.values.mean(edge));
    Some(format!("95 %: {:.1} to {:.1} %", 100.0 * low?, 100.0 * high?))
}

/// Formats a duration in its two largest units.
fn duration(seconds: f64) -> String {
    // The cast saturates; negative times become 0.
    let seconds = seconds.max(0.0) as u64;
    let (days, hours, minutes) = (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60);
    match (days, hours, minutes) {
        (0, 0, 0) => format!("{seconds} s"),
        (0, 0, minutes) => format!("{minutes} min {} s", seconds % 60),
        (0, hours, minutes) => format!("{hours} h {minutes} min"),
        (days, hours, _) => format!("{days} d {hours} h"),
    }
}

fn store(document: &StatusDocument) -> String {
    let Some(store) = &document.store else { return "none".to_owned() };
    let works = match store.works {
        None => "not written yet",
        Some(true) => "works",
        Some(false) => "CANNOT BE WRITTEN",
    };
    let mut text = format!("{works}, {} commits", store.commits);
    if let Some(bytes) = store.file_bytes {
        let _ = write!(text, ", {:.1} MB", bytes as f64 / 1e6);
    }
    for (count, what) in [(store.failures, "failed"), (store.late, "announced before they were stored")] {
        if count > 0 {
            let _ = write!(text, ", {count} {what}");
        }
    }
    text
}

/// Describes the configuration: its path, the number of drop-ins, and the start of its hash.
fn config(document: &StatusDocument) -> String {
    let file = |config: &crate::status::document::ConfigFile| {
        let drop_ins = match config.drop_ins.len() {
            0 => String::new(),
            1 => " with 1 drop-in".to_owned(),
            number => format!(" with {number} drop-ins"),
        };
        format!("{}{drop_ins} ({})", config.path, config.sha256.get(..8).unwrap_or_default())
    };
    document.config.as_ref().map_or_else(|| "-".to_owned(), file)
}
