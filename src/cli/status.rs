//! `packwatch status`: what the running daemon knows, as a table, as its own JSON, as metrics, or live on the screen.

#[cfg(test)]
#[path = "../host/status/sample.rs"]
mod sample;
mod table;
mod view;

use std::fmt::Write as _;
use std::path::PathBuf;

use super::Failure;
use super::control_args::print;
use crate::status::client::{StatusClient, parse};
use crate::status::document::Document;
use crate::status::metrics::openmetrics;

/// Exit code when no daemon tells its status.
const EXIT_UNREACHABLE: u8 = 3;
/// Exit code when an alarm is raised.
const EXIT_ALARM: u8 = 4;

/// Arguments of `status`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Exit codes: 0 no alarm is raised, 3 no daemon tells its status, 4 an alarm is raised, 1 any \
    other failure, 2 wrong usage. With --watch: 0 when it is left.")]
pub(crate) struct Args {
    /// Every cell; otherwise, of more than 16, only what they have in common and those that stand out
    #[arg(long)]
    cells: bool,
    /// The daemon's document as it is, a line of JSON (cells from 0, times in ns since 1970)
    #[arg(long, conflicts_with_all = ["cells", "prometheus", "watch"])]
    json: bool,
    /// Metrics, as OpenMetrics text (see `packwatch exporter`)
    #[arg(long, conflicts_with_all = ["cells", "watch"])]
    prometheus: bool,
    /// Full screen, live: q leaves, tab changes the page, arrows move
    #[arg(short, long, conflicts_with = "cells")]
    watch: bool,
    /// Status socket of the daemon (default: where `packwatch run` makes it)
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
}

/// Runs the command.
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
        // Said by the output itself.
        return Err(Failure { message: String::new(), code: EXIT_ALARM });
    }
    Ok(())
}

/// A cell's number as people count, from 1.
fn number(cell: u16) -> u32 {
    u32::from(cell) + 1
}

/// A value with its unit, or a dash.
fn shown(value: Option<f64>, decimals: usize, unit: &str) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}{unit}"))
}

/// A fraction as percent, or a dash.
fn percent(value: Option<f64>) -> String {
    shown(value.map(|value| 100.0 * value), 1, " %")
}

/// A value and its standard deviation.
fn with_std(value: Option<f64>, std: Option<f64>, decimals: usize, unit: &str) -> String {
    match (value, std) {
        (Some(value), Some(std)) => format!("{value:.decimals$} ± {std:.decimals$}{unit}"),
        (value, _) => shown(value, decimals, unit),
    }
}

/// How long, in the largest units that say something.
fn duration(seconds: f64) -> String {
    // Saturates; negative times are none.
    let seconds = seconds.max(0.0) as u64;
    let (days, hours, minutes) = (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60);
    match (days, hours, minutes) {
        (0, 0, 0) => format!("{seconds} s"),
        (0, 0, minutes) => format!("{minutes} min {} s", seconds % 60),
        (0, hours, minutes) => format!("{hours} h {minutes} min"),
        (days, hours, _) => format!("{days} d {hours} h"),
    }
}

/// A word of a document's enumeration, as in its JSON.
fn word(value: impl serde::Serialize) -> String {
    match serde_json::to_value(value) {
        Ok(serde_json::Value::String(word)) => word,
        _ => "?".to_owned(),
    }
}

/// What becomes of what is learned, in a line.
fn store(document: &Document) -> String {
    let Some(store) = &document.store else { return "none".to_owned() };
    let works = match store.works {
        None => "not tried yet",
        Some(true) => "works",
        Some(false) => "CANNOT BE WRITTEN",
    };
    let mut text = format!("{works}, {} commits", store.commits);
    if let Some(bytes) = store.file_bytes {
        let _ = write!(text, ", {:.1} MB", bytes as f64 / 1e6);
    }
    for (count, what) in [(store.failures, "failed"), (store.late, "told before they were stored")] {
        if count > 0 {
            let _ = write!(text, ", {count} {what}");
        }
    }
    text
}

/// The configuration in a few characters: its name and the beginning of its fingerprint.
fn config(document: &Document) -> String {
    let file = |config: &crate::status::document::ConfigFile| {
        format!("{} ({})", config.path, config.sha256.get(..8).unwrap_or_default())
    };
    document.config.as_ref().map_or_else(|| "-".to_owned(), file)
}
