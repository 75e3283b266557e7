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
use super::common::output::{failure, note, print, print_json, table, unless_closed};
use super::common::progress::Bar;
use crate::config::{self, ConfigFaults};
use crate::io::csv_log::CsvOptions;
use crate::io::log::{LogCounts, LogOptions, LogSource};
use crate::io::result_file::{ResultFile, check_place};
use crate::lab::discover::{
    Candidate, Discoverer, Discovery, PackConfiguration, PackLabel, PackSettings, PositiveDirection,
};
use crate::lab::error::LabError;
use crate::lab::import::obdb::ObdbSettings;
use crate::monitor::RecordKind;
use crate::replay::ReplayProgress;
use crate::wiring::evidence::PackQuantity;
use packwatch_host::bounded_file;
use packwatch_host::failure::Failure;

/// Arguments of `discover`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Ranks the signals of the DBC files and the OBDb signal set that occur in the log, by name, unit, range and behaviour. Diagnostic answers \
without a definition are searched for series of cell voltages, pack voltage, current and temperatures; their scales are guesses from \
plausible values. A log of a drive shows more than a log of a parked car.")]
pub(crate) struct Args {
    /// CAN log in any known format, also .gz or .zst; - reads standard input
    #[arg(value_name = "LOG")]
    log: PathBuf,
    #[command(flatten)]
    known: Known,
    /// Print all candidates as JSON
    #[arg(long)]
    json: bool,
    /// Write a configuration with the best candidates, and PACK.dbc with the fields that no DBC describes; replaces existing files
    #[arg(long, value_name = "PACK.toml")]
    write: Option<PathBuf>,
}

/// What the user knows about the battery.
#[derive(Debug, clap::Args)]
pub(crate) struct Known {
    /// DBC file; repeat for several
    #[arg(long = "dbc", value_name = "FILE.dbc")]
    pub(crate) dbc: Vec<PathBuf>,
    /// OBDb signal set of the car model, which describes its diagnostic answers
    #[arg(long, value_name = "FILE.json")]
    pub(crate) obdb: Option<PathBuf>,
    /// Model year, selects commands of the OBDb signal set
    #[arg(long, value_name = "YEAR", requires = "obdb", value_parser = integer::<i64>(1980, 2100))]
    year: Option<i64>,
    /// What the pack's label says, every part optional: chemistry, capacity, cells in series, such as nmc:64Ah:98s. Decides
    /// scales of undescribed fields; in a configuration, also describes the cell if --model is not given
    #[arg(long, value_name = "LABEL")]
    pub(crate) label: Option<PackLabel>,
    /// Cell model for the configuration
    #[arg(long, value_name = "CELL.toml")]
    pub(crate) model: Option<PathBuf>,
    /// Meaning of a positive current; needed if the log does not show it
    #[arg(long, value_enum)]
    pub(crate) positive: Option<Positive>,
}

/// Sign of the current.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Positive {
    /// Positive current charges the pack
    Charge,
    /// Positive current discharges the pack
    Discharge,
}

impl Known {
    /// Whether an option describes the battery itself. (DBC files and signal sets describe only its frames.)
    pub(crate) fn has_answers(&self) -> bool {
        self.label.is_some() || self.model.is_some() || self.positive.is_some()
    }
}

/// Result of a search, and the discoverer that made it.
pub(crate) struct Search {
    discoverer: Discoverer,
    pub(crate) discovery: Discovery,
    pub(crate) counts: LogCounts,
    interfaces: Vec<String>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let search = search(std::slice::from_ref(&args.log), &args.known, Vec::new())?;
    let discovery = &search.discovery;
    match args.json {
        true => unless_closed(print_json(&json!({ "version": 1, "discovery": discovery })))?,
        false => print(&(page(discovery) + no_definitions(&args.known, discovery)))?,
    }
    let Some(file) = &args.write else { return Ok(()) };
    check_place(file, inputs(std::slice::from_ref(&args.log), &args.known)).map_err(Failure::new)?;
    let failed = |questions: LabError| {
        Failure::new(format!("{}: not written, because the log leaves questions open:\n{questions}", file.display()))
    };
    let pack = search.configuration(&args.log, &args.known, file)?.map_err(failed)?;
    if let Some(own) = save(&pack, file, inputs(std::slice::from_ref(&args.log), &args.known))? {
        note(format_args!("{} written: fields that no DBC describes", own.display()));
    }
    note(format_args!("{} written; please check what the log does not show:", file.display()));
    pack.open.iter().for_each(|question| note(format_args!("  {question}")));
    Ok(())
}

pub(crate) fn inputs<'a>(logs: &'a [PathBuf], known: &'a Known) -> impl Iterator<Item = &'a PathBuf> + Clone {
    logs.iter().chain(&known.dbc).chain(&known.obdb).chain(&known.model)
}

/// Searches logs for the signals of the battery. `channels` maps channels of the logs to interfaces.
pub(crate) fn search(logs: &[PathBuf], known: &Known, channels: Vec<(String, String)>) -> Result<Search, Failure> {
    let mut discoverer = Discoverer::default();
    for file in &known.dbc {
        discoverer.add_database(database(file)?);
    }
    if let Some(file) = &known.obdb {
        let source = file.display().to_string();
        let settings = ObdbSettings { source, year: known.year, name: None };
        discoverer.add_obdb(&read(file)?, &settings).map_err(failure)?;
    }
    discoverer.set_label(known.label.unwrap_or_default());
    let (counts, interfaces) = feed(logs, channels, &mut discoverer)?;
    let discovery = discoverer.finish(&interfaces);
    if discovery.frames == 0 {
        let names: Vec<_> = logs.iter().map(|log| log.display().to_string()).collect();
        let names = names.join(", ");
        return Err(Failure::new(match counts.tables.is_empty() {
            true => format!("{names}: no CAN frames; give a journal or a CAN log"),
            false => format!("{names}: a table has no CAN frames; `packwatch look`, `report` and `score` read tables"),
        }));
    }
    Ok(Search { discoverer, discovery, counts, interfaces })
}

impl Search {
    pub(crate) fn interfaces(&self) -> &[String] {
        &self.interfaces
    }

    /// The configuration to be saved as `file`. The inner error states what neither the log nor the user has specified.
    pub(crate) fn configuration(
        &self,
        log: &Path,
        known: &Known,
        file: &Path,
    ) -> Result<Result<PackConfiguration, LabError>, Failure> {
        let settings = PackSettings {
            source: log.display().to_string(),
            databases: known.dbc.iter().map(|dbc| named_from(file, dbc)).collect::<Result<_, _>>()?,
            own_database: named_from(file, &file.with_extension("dbc"))?,
            cell_model: known.model.as_ref().map(|model| named_from(file, model)).transpose()?,
            positive: known.positive.map(|positive| match positive {
                Positive::Charge => PositiveDirection::Charge,
                Positive::Discharge => PositiveDirection::Discharge,
            }),
        };
        Ok(self.discoverer.configuration(&self.discovery, &settings))
    }
}

/// If a configuration is valid, writes it, and a DBC with the fields that no given DBC describes. Returns the path of
/// the DBC, if any.
pub(crate) fn save<'a>(
    pack: &PackConfiguration,
    file: &Path,
    inputs: impl Iterator<Item = &'a PathBuf>,
) -> Result<Option<PathBuf>, Failure> {
    let own = pack.database.as_ref().map(|text| (file.with_extension("dbc"), text));
    let read = |path: &Path| match &own {
        _ if path == file => Ok(pack.text.clone().into_bytes()),
        Some((own, text)) if path == own => Ok(text.as_bytes().to_vec()),
        _ => bounded_file::read(path),
    };
    let files = config::ConfigFiles { main: file.to_owned(), drop_ins: Vec::new() };
    config::load_with(&files, &read).map_err(|faults: ConfigFaults| {
        let what = faults.0.join("\n");
        Failure::new(format!("{}: not written, because the configuration would be invalid:\n{what}", file.display()))
    })?;
    if let Some((own, text)) = &own {
        check_place(own, inputs).map_err(Failure::new)?;
        write_whole(own, text)?;
    }
    write_whole(file, &pack.text)?;
    Ok(own.map(|(own, _)| own))
}

fn write_whole(file: &Path, text: &str) -> Result<(), Failure> {
    let written = ResultFile::create(file).and_then(|mut out| {
        out.write_all(text.as_bytes())?;
        out.finish()
    });
    written.map_err(failure)
}

/// Passes every frame of the logs to the discoverer; returns the counts and the names of the interfaces.
fn feed(
    logs: &[PathBuf],
    channels: Vec<(String, String)>,
    discoverer: &mut Discoverer,
) -> Result<(LogCounts, Vec<String>), Failure> {
    let csv = CsvOptions { cells: 1, series: 1, pack_total: true, ..CsvOptions::default() };
    let encode_row = Box::new(|_: &[_], _: &mut Vec<_>| 0);
    let options = LogOptions { interfaces: Vec::new(), channels, strict: false, csv, encode_row };
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
        note(format_args!("{} of {} lines cannot be read, first {first}", counts.bad_lines, counts.lines));
    }
    Ok((counts.clone(), source.interfaces().to_vec()))
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
fn no_definitions(known: &Known, discovery: &Discovery) -> &'static str {
    if !discovery.candidates.is_empty() || !known.dbc.is_empty() {
        return "";
    }
    "\nWithout a DBC file, only diagnostic answers can be searched; the log has none with plausible values. Give the DBC file \
     of the vehicle with --dbc FILE.dbc.\n"
}

fn row(candidate: &Candidate) -> Vec<String> {
    let rank = format!("  {}", candidate.rank);
    let reasons = candidate.reasons.join("; ");
    vec![rank, candidate.signal.clone(), candidate.interface.clone(), values(candidate), reasons]
}

/// Number of signals of a candidate and range of their values in the log: "16 of 3.188 to 3.392 V" for 16 signals.
pub(crate) fn values(candidate: &Candidate) -> String {
    let unit = candidate.quantity.unit();
    let (low, high) = (number(candidate.low), number(candidate.high));
    let count = if candidate.signals > 1 { format!("{} of ", candidate.signals) } else { String::new() };
    if low == high { format!("{count}{low} {unit}") } else { format!("{count}{low} to {high} {unit}") }
}

/// Formats a number with at most three decimals.
fn number(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
