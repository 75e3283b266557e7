//! `packwatch history`: lists the stored history as a table, JSON or CSV, and verifies its hash chain.

use std::path::PathBuf;

use serde_json::{Value, json};

use super::common::numbers::{NamedValue, cell_number, integer, one_of};
use super::common::output::print;
use crate::io::result_file::ResultFile;
use crate::io::stamp;
use crate::quantity::Timestamp;
use crate::store::{self, HistoryEntry, HistoryQuery, HistoryReader, HistoryTable, NotedHead};
use packwatch_host::failure::Failure;

const VERSION: u32 = 1;
/// Number of rows that are listed by default. They fill a few screens.
const LISTED: u32 = 100;

/// Arguments of `history`.
#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = false, subcommand_negates_reqs = true)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: Option<HistoryCommand>,
    /// Folder of state and history [default: $STATE_DIRECTORY, else /var/lib/packwatch, else the user's folder that `packwatch run` uses]
    #[arg(long, value_name = "DIR", global = true)]
    state: Option<PathBuf>,
    #[command(flatten)]
    wanted: RowArgs,
    /// Print JSON (cells from 0, times in ns since 1970)
    #[arg(long)]
    json: bool,
    /// Print at most this many rows, the latest; 0 prints all
    #[arg(long, value_name = "N", default_value_t = LISTED, value_parser = integer::<u32>(0, u32::MAX))]
    limit: u32,
}

#[derive(Debug, clap::Subcommand)]
enum HistoryCommand {
    /// Write the rows as CSV
    Export(ExportArgs),
    /// Verify the hash chain over all rows; reports the first changed segment (the rows of a day)
    Verify(VerifyArgs),
}

#[derive(Debug, clap::Args)]
struct ExportArgs {
    #[command(flatten)]
    wanted: RowArgs,
    /// File to write; - writes standard output
    #[arg(short, long, value_name = "FILE.csv", default_value = "-")]
    out: PathBuf,
}

#[derive(Debug, clap::Args)]
struct VerifyArgs {
    /// Number of rows and hash that the daemon logged earlier ("end of the history's chain"). Verification fails if the
    /// history was rewritten since then
    #[arg(long, value_name = "ROWS:HASH")]
    noted: Vec<NotedHead>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Selection of rows.
#[derive(Debug, clap::Args)]
struct RowArgs {
    /// Select rows of these kinds [default: all]
    #[arg(long, value_name = "KIND", value_parser = one_of(&KINDS), value_delimiter = ',')]
    kind: Vec<HistoryTable>,
    /// Select rows of this cell, counted from 1
    #[arg(long, value_name = "N", value_parser = cell_number)]
    cell: Option<u16>,
    /// Select rows from this time on: 2026-04-02T13:08:17 (UTC) or seconds since 1970
    #[arg(long, value_name = "WHEN", value_parser = when)]
    since: Option<Timestamp>,
    /// Select rows up to this time
    #[arg(long, value_name = "WHEN", value_parser = when)]
    until: Option<Timestamp>,
}

const KINDS: [NamedValue<HistoryTable>; 8] = [
    ("half-cycle", HistoryTable::HalfCycle, "Charges and discharges"),
    ("capacity", HistoryTable::Capacity, "Learned capacities"),
    ("loss-modes", HistoryTable::LossModes, "Lost lithium and active material of cells"),
    ("remaining-life", HistoryTable::RemainingLife, "Remaining life of the cell that reaches its end of life first"),
    ("outlook", HistoryTable::Outlook, "Energy and power of the pack"),
    ("model", HistoryTable::Model, "Changes of the cell model learned on board"),
    ("alarm", HistoryTable::Alarm, "Alarms"),
    ("reset", HistoryTable::Reset, "Resets, pack replacements, damaged files"),
];

impl RowArgs {
    fn check(&self) -> Result<(), Failure> {
        match (self.since, self.until) {
            (Some(since), Some(until)) if since > until => {
                Err(Failure::new("--since is later than --until, so no row can be selected; exchange them"))
            }
            _ => Ok(()),
        }
    }

    fn filter(&self, limit: Option<u32>) -> HistoryQuery {
        HistoryQuery {
            kinds: self.kind.clone(),
            cell: self.cell.map(|number| number - 1),
            since_ns: self.since.map(Timestamp::nanos),
            until_ns: self.until.map(Timestamp::nanos),
            limit,
        }
    }
}

fn when(text: &str) -> Result<Timestamp, String> {
    stamp::parse_stamp(text)
        .ok_or_else(|| "must be seconds since 1970, or a time such as 2026-04-02T13:08:17".to_owned())
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let wanted = if let Some(HistoryCommand::Export(export)) = &args.what { &export.wanted } else { &args.wanted };
    wanted.check()?;
    let folder = args.state.clone().unwrap_or_else(store::standard_folder);
    let reader = HistoryReader::open(&folder).map_err(Failure::new)?;
    match &args.what {
        None => list(&reader, args)?,
        Some(HistoryCommand::Export(export)) => self::export(&reader, export)?,
        Some(HistoryCommand::Verify(verify)) => self::verify(&reader, verify)?,
    }
    match reader.damage() {
        None => Ok(()),
        Some(damage) => Err(Failure::new(format!("{damage}; \"packwatch history verify\" checks all rows"))),
    }
}

fn list(reader: &HistoryReader, args: &Args) -> Result<(), Failure> {
    let entries =
        reader.entries(&args.wanted.filter(Some(args.limit).filter(|&limit| limit > 0))).map_err(Failure::new)?;
    let vehicle = reader.vehicle().map_err(Failure::new)?;
    if args.json {
        let rows: Vec<Value> = entries.iter().map(document).collect();
        return print(&format!("{}\n", json!({ "version": VERSION, "vehicle": vehicle, "rows": rows })));
    }
    let of = if vehicle.is_stated() { format!("{vehicle}\n") } else { String::new() };
    if entries.is_empty() {
        return print(&format!("{of}no rows\n"));
    }
    let head = of + &format!("{:<26}  {:>4}  {:<14}  {:>4}  {}\n", "time (UTC)", "pack", "kind", "cell", "what");
    print(&entries.iter().fold(head, |text, entry| text + &line(entry)))
}

fn line(entry: &HistoryEntry) -> String {
    let time = stamp::format_utc(Timestamp::from_nanos(entry.wall_ns));
    // Tables count cells from 1.
    let cell =
        entry.values.first().and_then(Value::as_u64).map_or_else(|| "pack".to_owned(), |cell| (cell + 1).to_string());
    format!("{time:<26}  {:>4}  {:<14}  {cell:>4}  {}\n", entry.pack, entry.kind.name(), describe(entry))
}

fn describe(entry: &HistoryEntry) -> String {
    let value = |name: &str| {
        let column = entry.kind.columns().iter().position(|column| *column == name);
        column.and_then(|column| entry.values.get(column)).unwrap_or(&Value::Null)
    };
    let words = match entry.kind {
        HistoryTable::HalfCycle => {
            "{mode} {charge_ah:3} Ah, swing {swing%1} +/- {swing_std%1} %, {duration_s:0} s, {mean_current_a:2} A, \
             {mean_temperature_c:1} C"
        }
        HistoryTable::Capacity => {
            "{capacity_ah:3} +/- {capacity_std_ah:3} Ah, usable {usable_capacity_ah:3} +/- {usable_capacity_std_ah:3} Ah, \
             resistance {resistance_ratio:2} +/- {resistance_ratio_std:2}, measured {measured_ah:3} +/- {measured_std_ah:3} Ah"
        }
        HistoryTable::LossModes => {
            "lithium {lli%1} +/- {lli_std%1} %, negative electrode {lam_ne%1} +/- {lam_ne_std%1} %, positive electrode \
             {lam_pe%1} +/- {lam_pe_std%1} %"
        }
        HistoryTable::RemainingLife if value("cycles").is_null() => "no longer known",
        HistoryTable::RemainingLife => {
            "{cycles:0} cycles ({cycles_low:0} to {cycles_high:0}), {days:0} days ({days_low:0} to {days_high:0})"
        }
        HistoryTable::Outlook => {
            "{remaining_energy_wh:1} +/- {remaining_energy_std_wh:1} Wh, to full {energy_to_full_wh:1} +/- \
             {energy_to_full_std_wh:1} Wh, energy SOH {energy_soh%1} +/- {energy_soh_std%1} %, 10 s: discharge \
             {discharge_power_10s_w:0} +/- {discharge_power_10s_std_w:0} W, charge {charge_power_10s_w:0} +/- \
             {charge_power_10s_std_w:0} W"
        }
        HistoryTable::Model => {
            let back = if value("taken_back").as_i64() == Some(1) { ", the previous model applies again" } else { "" };
            let better = value("chemistry").as_str().map(|name| format!(", {name} fits better")).unwrap_or_default();
            let words = match value("capacity_ah").is_null() {
                true => "{state}",
                false => "{state}, {capacity_ah:3} +/- {capacity_std_ah:3} Ah, residuals {residual_v:4} V",
            };
            return filled(words, &value) + &better + back;
        }
        HistoryTable::Alarm => {
            "{rule} {severity} {change}, value {value:4}, threshold {threshold:4}, raised {occurrences:0} times"
        }
        HistoryTable::Reset => {
            let learned =
                value("capacity_ah").as_f64().map(|ah| format!(", capacity was {ah:.3} Ah")).unwrap_or_default();
            let detail = value("detail").as_str().map(|detail| format!(": {detail}")).unwrap_or_default();
            return format!("{}{learned}{detail}", value("reason").as_str().unwrap_or(""));
        }
    };
    filled(words, &value)
}

/// Fills in the fields of a template: `{name:2}` is a number with two decimals, `{name%1}` a percentage with one
/// decimal, `{name}` a string.
fn filled<'v>(words: &str, value: &impl Fn(&str) -> &'v Value) -> String {
    let mut parts = words.split('{');
    let mut text = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let (field, after) = part.split_once('}').unwrap_or((part, ""));
        let name = field.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches([':', '%']);
        let digits = field.rsplit([':', '%']).next().and_then(|digits| digits.parse::<usize>().ok());
        let factor = if field.contains('%') { 100.0 } else { 1.0 };
        text += &match (digits, value(name).as_f64()) {
            (Some(digits), Some(number)) => format!("{:.digits$}", factor * number),
            (Some(_), None) => "-".to_owned(),
            (None, _) => value(name).as_str().unwrap_or("").to_owned(),
        };
        text += after;
    }
    text
}

fn document(entry: &HistoryEntry) -> Value {
    let mut row = json!({
        "kind": entry.kind.name(),
        "seq": entry.seq,
        "wall_ns": entry.wall_ns,
        "time_ns": entry.time_ns,
        "boot": entry.boot,
        "pack": entry.pack,
    });
    entry.kind.columns().iter().zip(&entry.values).for_each(|(column, value)| row[*column] = value.clone());
    row
}

/// Columns that every row of a CSV has.
const OWN_COLUMNS: [&str; 7] = ["kind", "seq", "wall_ns", "utc", "time_ns", "boot", "pack"];

fn export(reader: &HistoryReader, args: &ExportArgs) -> Result<(), Failure> {
    // The errors of a result file already contain its name.
    let fail = |error: &dyn std::fmt::Display| Failure::new(error.to_string());
    let filter = args.wanted.filter(None);
    let kinds: Vec<HistoryTable> = filter.wanted_kinds().collect();
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

/// Whether the reader has closed the pipe.
fn is_broken_pipe(error: &csv::Error) -> bool {
    matches!(error.kind(), csv::ErrorKind::Io(error) if error.kind() == std::io::ErrorKind::BrokenPipe)
}

fn record(entry: &HistoryEntry, columns: &[&str]) -> Vec<String> {
    let own = [
        entry.kind.name().to_owned(),
        entry.seq.to_string(),
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

fn verify(reader: &HistoryReader, args: &VerifyArgs) -> Result<(), Failure> {
    let verdict = reader.verify().map_err(Failure::new)?;
    if args.json {
        print(&format!("{}\n", json!({ "version": VERSION, "verdict": verdict })))?;
    }
    for noted in &args.noted {
        if let Some(contradiction) = reader.contradiction(noted).map_err(Failure::new)? {
            return Err(Failure::new(contradiction));
        }
    }
    match &verdict.broken {
        None if args.json => Ok(()),
        None => {
            let deleted = match verdict.deleted_rows {
                0 => String::new(),
                rows => format!(" ({rows} deleted because of the limits on rows and age)"),
            };
            print(&format!("{} rows{deleted}, none changed; hash of the last row: {}\n", verdict.rows, verdict.head))
        }
        Some(broken) => Err(Failure::new(format!(
            "{}: expected hash {}, found {}; the {} rows before them are intact",
            broken, broken.expected, broken.found, verdict.good_rows
        ))),
    }
}
