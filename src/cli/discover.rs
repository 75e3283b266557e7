//! `packwatch discover`: finds the signals of the traction battery in a log.
//!
//! Exit code 1: a file cannot be read, or the log has no frames. Finding nothing is no failure: the page says so.

use std::path::PathBuf;
use std::sync::atomic::Ordering;

use serde_json::json;

use super::Failure;
use super::import::read;
use super::output::{failure, print, print_json, table, unless_closed};
use super::replay::Bar;
use crate::can::dbc::Database;
use crate::io::csv_log::CsvOptions;
use crate::io::log::{LogOptions, LogSource, Record};
use crate::lab::discover::{Candidate, Discoverer, Discovery, Quantity};
use crate::lab::import::obdb::ObdbSettings;
use crate::replay::ReplayProgress;

/// Candidates shown of a quantity.
const SHOWN: usize = 3;
/// Records between two looks at the clock.
const REPORT_EVERY: u64 = 4096;
/// Version of the JSON document.
const VERSION: u32 = 1;

/// Arguments of `discover`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Signals of the DBC files and of the OBDb signal set that are in the log are ranked by name, unit, range and behaviour. Answers to \
diagnostic requests that no definition describes are searched for rows of cell voltages, pack voltage, current and temperatures; their \
scales are guesses from plausible values. A log of a drive shows more than one of a car at rest.")]
pub(crate) struct Args {
    /// Log: a journal or a candump log, also .gz or .zst; - is standard input
    #[arg(value_name = "LOG")]
    log: PathBuf,
    /// DBC file; repeat it for several
    #[arg(long = "dbc", value_name = "FILE.dbc")]
    dbc: Vec<PathBuf>,
    /// OBDb signal set of the car model: its diagnostic answers
    #[arg(long, value_name = "FILE.json")]
    obdb: Option<PathBuf>,
    /// Model year, for the OBDb signal set
    #[arg(long, value_name = "YEAR", requires = "obdb", value_parser = clap::value_parser!(i64).range(1980..=2100))]
    year: Option<i64>,
    /// Print all candidates as one JSON document
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let mut discoverer = Discoverer::default();
    for file in &args.dbc {
        discoverer.add_database(database(file)?);
    }
    if let Some(file) = &args.obdb {
        let source = file.display().to_string();
        let settings = ObdbSettings { source, year: args.year, name: None };
        discoverer.add_obdb(&read(file)?, &settings).map_err(failure)?;
    }
    let interfaces = feed(args, &mut discoverer)?;
    let discovery = discoverer.finish(&interfaces);
    if discovery.frames == 0 {
        return Err(Failure::new(format!("{}: has no frames, must be a log of frames", args.log.display())));
    }
    match args.json {
        true => unless_closed(print_json(&json!({ "version": VERSION, "discovery": discovery }))),
        false => print(&page(&discovery)),
    }
}

fn database(file: &std::path::Path) -> Result<Database, Failure> {
    let fault = |error: &dyn std::fmt::Display| Failure::new(format!("{}: {error}", file.display()));
    let bytes = std::fs::read(file).map_err(|error| fault(&format!("cannot be read: {error}")))?;
    Database::parse_bytes(&bytes).map_err(|error| fault(&error))
}

/// Passes every frame on; returns the names of the interfaces.
fn feed(args: &Args, discoverer: &mut Discoverer) -> Result<Vec<String>, Failure> {
    let csv = CsvOptions { columns: Vec::new(), charge_positive: false, start_times: None, cells: 1, pack_total: true };
    let encode_row = Box::new(|_: &[_], _: &mut Vec<_>| 0);
    let options = LogOptions { interfaces: Vec::new(), strict: false, csv, encode_row };
    let mut source = LogSource::new([args.log.clone()], options);
    source.adopt_foreign();
    let bar = Bar::new(std::slice::from_ref(&args.log));
    let mut records = 0_u64;
    while let Some(record) = source.next_record().map_err(failure)? {
        if let Record::Frame { time, bus, frame } = &record {
            discoverer.handle(*time, *bus, frame);
        }
        records += 1;
        if records.is_multiple_of(REPORT_EVERY) {
            let bytes = source.read_bytes().load(Ordering::Relaxed);
            let times_real_time = discoverer.seconds() / bar.seconds();
            bar.show(ReplayProgress { bytes, frames: discoverer.frames(), times_real_time });
        }
    }
    bar.clear();
    let counts = source.counts();
    if let Some(first) = &counts.first_bad_line {
        eprintln!("{} of {} lines cannot be read, first {first}", counts.bad_lines, counts.lines);
    }
    Ok(source.interfaces().to_vec())
}

fn page(discovery: &Discovery) -> String {
    let Discovery { frames, seconds, signals, answers, .. } = discovery;
    let mut text = format!(
        "{frames} frames in {seconds:.1} s; {signals} signals with values, {answers} kinds of diagnostic answers\n"
    );
    if discovery.ignored_frames > 0 {
        text += &format!("{} frames ignored: too many identifiers\n", discovery.ignored_frames);
    }
    for quantity in Quantity::ALL {
        text += &format!("\n{}\n", quantity.name());
        let found = discovery.candidates.iter().filter(|candidate| candidate.quantity == quantity);
        let rows: Vec<Vec<String>> = found.take(SHOWN).map(row).collect();
        text += &match rows.is_empty() {
            true => "  no candidate\n".to_owned(),
            false => table(&["  ", "signal", "interface", "values", "reason"], rows, 5),
        };
    }
    text
}

fn row(candidate: &Candidate) -> Vec<String> {
    let unit = candidate.quantity.unit();
    let (low, high) = (number(candidate.low), number(candidate.high));
    let count = if candidate.signals > 1 { format!("{} of ", candidate.signals) } else { String::new() };
    let values = if low == high { format!("{count}{low} {unit}") } else { format!("{count}{low} to {high} {unit}") };
    let rank = format!("  {}", candidate.rank);
    vec![rank, candidate.signal.clone(), candidate.interface.clone(), values, candidate.reasons.join("; ")]
}

/// At most three decimals.
fn number(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
