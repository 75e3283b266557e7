//! `packwatch discover`: finds the signals of the traction battery in a log.
//!
//! The exit code is 1 if a file cannot be read, the log has no frames, or the configuration cannot be written. If no
//! signals are found, the output says so; without `--write`, the exit code is 0.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use serde_json::json;

use super::common::files::{database, named_from, read};
use super::common::numbers::integer;
use super::common::output::{failure, print, print_json, table, unless_closed};
use super::common::progress::Bar;
use crate::config::{self, ConfigFaults};
use crate::io::csv_log::CsvOptions;
use crate::io::log::{LogOptions, LogSource};
use crate::io::result_file::{ResultFile, check_place};
use crate::lab::discover::{Candidate, Discoverer, Discovery, PackSettings, PositiveDirection};
use crate::lab::error::LabError;
use crate::lab::import::obdb::ObdbSettings;
use crate::monitor::RecordKind;
use crate::replay::ReplayProgress;
use crate::wiring::evidence::PackQuantity;
use packwatch_host::failure::Failure;

/// Arguments of `discover`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Ranks the signals of the DBC files and the OBDb signal set that occur in the log, by name, unit, range and behaviour. Diagnostic answers \
without a definition are searched for series of cell voltages, pack voltage, current and temperatures; their scales are guesses from \
plausible values. A log of a drive shows more than a log of a parked car.")]
pub(crate) struct Args {
    /// Journal or candump log, also .gz or .zst; - reads standard input
    #[arg(value_name = "LOG")]
    log: PathBuf,
    /// DBC file; repeat for several
    #[arg(long = "dbc", value_name = "FILE.dbc")]
    dbc: Vec<PathBuf>,
    /// OBDb signal set of the car model, which describes its diagnostic answers
    #[arg(long, value_name = "FILE.json")]
    obdb: Option<PathBuf>,
    /// Model year, selects commands of the OBDb signal set
    #[arg(long, value_name = "YEAR", requires = "obdb", value_parser = integer::<i64>(1980, 2100))]
    year: Option<i64>,
    /// Print all candidates as JSON
    #[arg(long)]
    json: bool,
    /// Write a configuration with the best candidates, and PACK.dbc with the fields that no DBC describes; replaces existing files
    #[arg(long, value_name = "PACK.toml", requires = "model")]
    write: Option<PathBuf>,
    /// Cell model for the written configuration
    #[arg(long, value_name = "CELL.toml")]
    model: Option<PathBuf>,
    /// Cells in series for the written configuration; needed if the log has only the pack voltage
    #[arg(long, value_name = "N", requires = "write", value_parser = integer::<u16>(1, 1024))]
    cells: Option<u16>,
    /// Meaning of a positive current for the written configuration; needed if the log does not show it
    #[arg(long, value_enum, requires = "write")]
    positive: Option<Positive>,
}

/// Sign of the current.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Positive {
    /// Positive current charges the pack
    Charge,
    /// Positive current discharges the pack
    Discharge,
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
    let interfaces = feed(std::slice::from_ref(&args.log), &mut discoverer)?;
    let discovery = discoverer.finish(&interfaces);
    if discovery.frames == 0 {
        return Err(Failure::new(format!(
            "{}: has no CAN frames; give a journal or a candump log",
            args.log.display()
        )));
    }
    match args.json {
        true => unless_closed(print_json(&json!({ "version": 1, "discovery": discovery })))?,
        false => print(&(page(&discovery) + no_definitions(args, &discovery)))?,
    }
    match (&args.write, &args.model) {
        (Some(file), Some(model)) => write(args, &discoverer, &discovery, file, model),
        _ => Ok(()),
    }
}

/// If the configuration is valid, writes it, and a DBC with the fields that no given DBC describes.
fn write(
    args: &Args,
    discoverer: &Discoverer,
    discovery: &Discovery,
    file: &Path,
    model: &Path,
) -> Result<(), Failure> {
    let inputs = args.dbc.iter().chain([&args.log]).chain(&args.obdb).chain(&args.model);
    check_place(file, inputs).map_err(Failure::new)?;
    let settings = PackSettings {
        source: args.log.display().to_string(),
        databases: args.dbc.iter().map(|dbc| named_from(file, dbc)).collect::<Result<_, _>>()?,
        own_database: named_from(file, &file.with_extension("dbc"))?,
        cell_model: named_from(file, model)?,
        cells: args.cells,
        positive: args.positive.map(|positive| match positive {
            Positive::Charge => PositiveDirection::Charge,
            Positive::Discharge => PositiveDirection::Discharge,
        }),
    };
    let failed =
        |why: &str, what: &str| Failure::new(format!("{}: not written, because {why}:\n{what}", file.display()));
    let open = |error: LabError| failed("the log leaves questions open", &error.to_string());
    let pack = discoverer.configuration(discovery, &settings).map_err(open)?;
    let own = file.with_extension("dbc");
    let read = |path: &Path| match &pack.database {
        _ if path == file => Ok(pack.text.clone().into_bytes()),
        Some(database) if path == own => Ok(database.clone().into_bytes()),
        _ => std::fs::read(path),
    };
    let files = config::ConfigFiles { main: file.to_owned(), drop_ins: Vec::new() };
    let invalid = |faults: ConfigFaults| failed("the configuration would be invalid", &faults.0.join("\n"));
    config::load_with(&files, &read).map_err(invalid)?;
    if let Some(database) = &pack.database {
        check_place(&own, args.dbc.iter().chain([&args.log])).map_err(Failure::new)?;
        write_whole(&own, database)?;
        eprintln!("{} written: fields that no DBC describes", own.display());
    }
    write_whole(file, &pack.text)?;
    eprintln!("{} written; please check what the log does not show:", file.display());
    pack.open.iter().for_each(|question| eprintln!("  {question}"));
    Ok(())
}

fn write_whole(file: &Path, text: &str) -> Result<(), Failure> {
    let written = ResultFile::create(file).and_then(|mut out| {
        out.write_all(text.as_bytes())?;
        out.finish()
    });
    written.map_err(failure)
}

/// Passes every frame of the logs to the discoverer; returns the names of the interfaces.
fn feed(logs: &[PathBuf], discoverer: &mut Discoverer) -> Result<Vec<String>, Failure> {
    let csv = CsvOptions { columns: Vec::new(), charge_positive: false, start_times: None, cells: 1, pack_total: true };
    let encode_row = Box::new(|_: &[_], _: &mut Vec<_>| 0);
    let options = LogOptions { interfaces: Vec::new(), channels: Vec::new(), strict: false, csv, encode_row };
    let mut source = LogSource::new(logs.to_vec(), options);
    source.adopt_foreign();
    let bar = Bar::new(logs);
    let mut records = 0_u64;
    while let Some(record) = source.next_record().map_err(failure)? {
        if let RecordKind::Frame { bus, frame } = &record.kind {
            discoverer.handle(record.time, *bus, frame);
        }
        records += 1;
        if records.is_multiple_of(4096) {
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
    for remark in &discovery.remarks {
        text += &format!("{remark}\n");
    }
    for quantity in PackQuantity::ALL {
        text += &format!("\n{}\n", quantity.name());
        let found = discovery.candidates.iter().filter(|candidate| candidate.quantity == quantity);
        let rows: Vec<Vec<String>> = found.take(3).map(row).collect();
        text += &match rows.is_empty() {
            true => "  no candidates\n".to_owned(),
            false => table(&["  ", "signal", "interface", "values", "reason"], rows, 5),
        };
    }
    text
}

/// If nothing was found and no DBC file was given, advises to give one; otherwise empty.
fn no_definitions(args: &Args, discovery: &Discovery) -> &'static str {
    if !discovery.candidates.is_empty() || !args.dbc.is_empty() {
        return "";
    }
    "\nWithout a DBC file, only diagnostic answers can be searched; the log has none with plausible values. Give the DBC file \
     of the vehicle with --dbc FILE.dbc.\n"
}

fn row(candidate: &Candidate) -> Vec<String> {
    let unit = candidate.quantity.unit();
    let (low, high) = (number(candidate.low), number(candidate.high));
    let count = if candidate.signals > 1 { format!("{} of ", candidate.signals) } else { String::new() };
    let values = if low == high { format!("{count}{low} {unit}") } else { format!("{count}{low} to {high} {unit}") };
    let rank = format!("  {}", candidate.rank);
    vec![rank, candidate.signal.clone(), candidate.interface.clone(), values, candidate.reasons.join("; ")]
}

/// Formats a number with at most three decimals.
fn number(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
