//! `packwatch history`: what the store has kept, as a table, JSON or CSV, and whether its chain is whole.

use std::path::PathBuf;

use serde_json::{Map, Value, json};

use super::Failure;
use super::control_args::print;
use crate::io::result_file::ResultFile;
use crate::io::stamp;
use crate::quantity::{MAX_CELLS, Timestamp};
use crate::store::{self, Entry, Filter, Kind, Reader};

/// Version of the JSON document.
const VERSION: u32 = 1;
/// Rows listed when nobody says how many: a few screens.
const LISTED: u32 = 100;

/// Arguments of `history`.
#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = false, subcommand_negates_reqs = true)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: Option<What>,
    /// Folder of state and history (default: $STATE_DIRECTORY, else /var/lib/packwatch)
    #[arg(long, value_name = "DIR", global = true)]
    state: Option<PathBuf>,
    #[command(flatten)]
    wanted: Wanted,
    /// Print one JSON document (cells from 0, times in ns since 1970)
    #[arg(long)]
    json: bool,
    /// Print at most so many rows, the latest; 0 = all
    #[arg(long, value_name = "N", default_value_t = LISTED)]
    limit: u32,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    /// Write rows as CSV
    Export(ExportArgs),
    /// Check the hash chain over capacities, remaining lives, alarms and resets; names the first row that is not as it was written
    Verify(VerifyArgs),
}

#[derive(Debug, clap::Args)]
struct ExportArgs {
    #[command(flatten)]
    wanted: Wanted,
    /// Where to; - is standard output
    #[arg(short, long, value_name = "FILE.csv", default_value = "-")]
    out: PathBuf,
}

#[derive(Debug, clap::Args)]
struct VerifyArgs {
    /// Print one JSON document
    #[arg(long)]
    json: bool,
}

/// Which rows are wanted.
#[derive(Debug, clap::Args)]
struct Wanted {
    /// Rows of these kinds (default: all)
    #[arg(long, value_name = "KIND", value_enum, value_delimiter = ',')]
    kind: Vec<KindName>,
    /// Rows of this cell, counted from 1
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=MAX_CELLS as i64))]
    cell: Option<u16>,
    /// Rows from this wall-clock time on, as 2026-04-02T13:08:17 (UTC) or seconds since 1970
    #[arg(long, value_name = "WHEN", value_parser = when)]
    since: Option<Timestamp>,
    /// Rows up to this wall-clock time
    #[arg(long, value_name = "WHEN", value_parser = when)]
    until: Option<Timestamp>,
}

/// A kind of row, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum KindName {
    /// Charges and discharges
    HalfCycle,
    /// Capacities learned
    Capacity,
    /// What remained of the life of the cell whose life ends first
    RemainingLife,
    /// Alarms
    Alarm,
    /// Resets, other packs, damages
    Reset,
}

impl From<KindName> for Kind {
    fn from(name: KindName) -> Self {
        match name {
            KindName::HalfCycle => Self::HalfCycle,
            KindName::Capacity => Self::Capacity,
            KindName::RemainingLife => Self::RemainingLife,
            KindName::Alarm => Self::Alarm,
            KindName::Reset => Self::Reset,
        }
    }
}

impl Wanted {
    fn filter(&self, limit: Option<u32>) -> Filter {
        Filter {
            kinds: self.kind.iter().map(|&name| name.into()).collect(),
            cell: self.cell.map(|number| number - 1),
            since_ns: self.since.map(Timestamp::nanos),
            until_ns: self.until.map(Timestamp::nanos),
            limit,
        }
    }
}

fn when(text: &str) -> Result<Timestamp, String> {
    stamp::parse_stamp(text).ok_or_else(|| "must be seconds or like 2026-04-02T13:08:17".to_owned())
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let folder = args.state.clone().unwrap_or_else(|| store::standard_folder().0);
    let reader = Reader::open(&folder).map_err(Failure::new)?;
    match &args.what {
        None => list(&reader, args),
        Some(What::Export(export)) => self::export(&reader, export),
        Some(What::Verify(verify)) => self::verify(&reader, verify),
    }
}

fn list(reader: &Reader, args: &Args) -> Result<(), Failure> {
    let entries =
        reader.entries(&args.wanted.filter(Some(args.limit).filter(|&limit| limit > 0))).map_err(Failure::new)?;
    if args.json {
        let rows: Vec<Value> = entries.iter().map(document).collect();
        return print(&format!("{}\n", json!({ "version": VERSION, "rows": rows })));
    }
    if entries.is_empty() {
        return print("no rows\n");
    }
    let head = format!("{:<26}  {:>4}  {:<14}  {:>4}  {}\n", "time (UTC)", "pack", "kind", "cell", "what");
    print(&entries.iter().fold(head, |text, entry| text + &line(entry)))
}

fn line(entry: &Entry) -> String {
    let time = stamp::format_utc(Timestamp::from_nanos(entry.wall_ns));
    // Cells count from 1 for people.
    let cell =
        entry.values.first().and_then(Value::as_u64).map_or_else(|| "pack".to_owned(), |cell| (cell + 1).to_string());
    format!("{time:<26}  {:>4}  {:<14}  {cell:>4}  {}\n", entry.pack, entry.kind.name(), words(entry))
}

/// The values of a row for people.
fn words(entry: &Entry) -> String {
    let value = |name: &str| {
        let column = entry.kind.columns().iter().position(|column| *column == name);
        column.and_then(|column| entry.values.get(column)).unwrap_or(&Value::Null)
    };
    let number = |name: &str, factor: f64, digits: usize| match value(name).as_f64() {
        Some(number) => format!("{:.digits$}", factor * number),
        None => "-".to_owned(),
    };
    let text = |name: &str| value(name).as_str().unwrap_or("").to_owned();
    match entry.kind {
        Kind::HalfCycle => format!(
            "{} {} Ah, swing {} +/- {} %, {} s, {} A, {} C",
            text("mode"),
            number("charge_ah", 1.0, 3),
            number("swing", 100.0, 1),
            number("swing_std", 100.0, 1),
            number("duration_s", 1.0, 0),
            number("mean_current_a", 1.0, 2),
            number("mean_temperature_c", 1.0, 1)
        ),
        Kind::Capacity => format!(
            "{} +/- {} Ah, usable {} +/- {} Ah, resistance {} +/- {}, this one said {} +/- {} Ah",
            number("capacity_ah", 1.0, 3),
            number("capacity_std_ah", 1.0, 3),
            number("usable_capacity_ah", 1.0, 3),
            number("usable_capacity_std_ah", 1.0, 3),
            number("resistance_ratio", 1.0, 2),
            number("resistance_ratio_std", 1.0, 2),
            number("measured_ah", 1.0, 3),
            number("measured_std_ah", 1.0, 3)
        ),
        Kind::RemainingLife if value("cycles").is_null() => "not known any longer".to_owned(),
        Kind::RemainingLife => format!(
            "{} cycles ({} to {}), {} days ({} to {})",
            number("cycles", 1.0, 0),
            number("cycles_low", 1.0, 0),
            number("cycles_high", 1.0, 0),
            number("days", 1.0, 0),
            number("days_low", 1.0, 0),
            number("days_high", 1.0, 0)
        ),
        Kind::Alarm => format!(
            "{} {} {}, value {}, threshold {}, raised {} times",
            text("rule"),
            text("severity"),
            text("change"),
            number("value", 1.0, 4),
            number("threshold", 1.0, 4),
            number("occurrences", 1.0, 0)
        ),
        Kind::Reset => {
            let learned =
                value("capacity_ah").as_f64().map(|ah| format!(", capacity was {ah:.3} Ah")).unwrap_or_default();
            let detail = value("detail").as_str().map(|detail| format!(": {detail}")).unwrap_or_default();
            format!("{}{learned}{detail}", text("reason"))
        }
    }
}

fn document(entry: &Entry) -> Value {
    let own = json!({
        "kind": entry.kind.name(),
        "seq": entry.seq,
        "wall_ns": entry.wall_ns,
        "time_ns": entry.time_ns,
        "boot": entry.boot,
        "pack": entry.pack,
    });
    let mut keys = if let Value::Object(keys) = own { keys } else { Map::new() };
    let columns = entry.kind.columns().iter().map(|column| (*column).to_owned());
    keys.extend(columns.zip(entry.values.iter().cloned()));
    Value::Object(keys)
}

/// Columns every row has in a CSV.
const OWN_COLUMNS: [&str; 7] = ["kind", "seq", "wall_ns", "utc", "time_ns", "boot", "pack"];

fn export(reader: &Reader, args: &ExportArgs) -> Result<(), Failure> {
    let fail = |error: &dyn std::fmt::Display| Failure::new(format!("{}: {error}", args.out.display()));
    let filter = args.wanted.filter(None);
    let kinds: Vec<Kind> = filter.wanted_kinds().collect();
    let mut columns: Vec<&str> = Vec::new();
    for column in kinds.iter().flat_map(|kind| kind.columns()) {
        if !columns.contains(column) {
            columns.push(column);
        }
    }
    let mut out = csv::Writer::from_writer(ResultFile::create(&args.out).map_err(|error| fail(&error))?);
    out.write_record(OWN_COLUMNS.iter().chain(&columns)).map_err(|error| fail(&error))?;
    for kind in kinds {
        let mut failed = None;
        let read = reader.for_each(kind, &filter, &mut |entry| {
            if failed.is_none() {
                failed = out.write_record(record(&entry, &columns)).err();
            }
        });
        read.map_err(Failure::new)?;
        if let Some(error) = failed {
            return if is_broken_pipe(&error) { Ok(()) } else { Err(fail(&error)) };
        }
    }
    let file = out.into_inner().map_err(|error| fail(error.error()))?;
    file.finish().map_err(|error| fail(&error))
}

/// The reader of our output has seen enough.
fn is_broken_pipe(error: &csv::Error) -> bool {
    matches!(error.kind(), csv::ErrorKind::Io(error) if error.kind() == std::io::ErrorKind::BrokenPipe)
}

fn record(entry: &Entry, columns: &[&str]) -> Vec<String> {
    let own = [
        entry.kind.name().to_owned(),
        entry.seq.map(|seq| seq.to_string()).unwrap_or_default(),
        entry.wall_ns.to_string(),
        stamp::format_utc(Timestamp::from_nanos(entry.wall_ns)),
        entry.time_ns.to_string(),
        entry.boot.clone(),
        entry.pack.to_string(),
    ];
    let value = |name: &&str| {
        let column = entry.kind.columns().iter().position(|column| column == name);
        match column.and_then(|column| entry.values.get(column)) {
            None | Some(Value::Null) => String::new(),
            Some(Value::String(text)) => text.clone(),
            Some(value) => value.to_string(),
        }
    };
    own.into_iter().chain(columns.iter().map(value)).collect()
}

fn verify(reader: &Reader, args: &VerifyArgs) -> Result<(), Failure> {
    let verdict = reader.verify().map_err(Failure::new)?;
    if args.json {
        print(&format!("{}\n", json!({ "version": VERSION, "verdict": verdict })))?;
    }
    match &verdict.broken {
        None if args.json => Ok(()),
        None => {
            print(&format!("{} rows, all as they were written; the last has the hash {}\n", verdict.rows, verdict.head))
        }
        Some(broken) => {
            let place = if broken.table.is_empty() { String::new() } else { format!(" ({})", broken.table) };
            Err(Failure::new(format!(
                "row {}{place} is not as it was written: expected {}, found {}; {} rows before it are good",
                broken.row, broken.expected, broken.found, verdict.good_rows
            )))
        }
    }
}
