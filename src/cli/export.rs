//! `packwatch export`: writes estimates, half-cycles and alarms of many logs as Parquet or CSV.

use std::io::{self, Write};
use std::path::PathBuf;

use serde_json::json;

use super::common::many_logs::LogArgs;
use super::common::numbers::{NamedValue, one_of, within};
use super::common::output::{failure, print_json, unless_closed, write_table};
use crate::config::{self, Config};
use crate::lab::fleet::LogAccess;
use crate::lab::fleet::export::{self, ExportResult, ExportSettings, TableFormat};
use packwatch_host::failure::Failure;

const VERSION: u32 = 1;

const FORMATS: [NamedValue<TableFormat>; 2] = [
    ("parquet", TableFormat::Parquet, "Apache Parquet, compressed with Snappy"),
    ("csv", TableFormat::Csv, "CSV with a heading"),
];

/// Arguments of `export`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Writes DIR/NAME/estimates, half_cycles, outlook, alarms and use_record (.parquet or .csv) and about.json for each log. To query all logs: \
    select log, cell, min(capacity_ah) from 'DIR/*/half_cycles.parquet' group by log, cell. Existing tables are replaced when the \
    new ones are complete. If a log fails, its tables are not replaced, the other logs continue, and the exit code is 1. Sections of a \
    CSV get their times from --start-times, else from NAME_cycles.csv next to the CSV."
)]
pub(crate) struct Args {
    /// Print the columns with types and units as Markdown
    #[arg(long, exclusive = true)]
    columns_page: bool,
    /// Configuration file
    #[arg(short, long, value_name = "FILE", required_unless_present = "columns_page")]
    config: Option<PathBuf>,
    /// Format of the tables
    #[arg(long, value_parser = one_of(&FORMATS), default_value = "parquet")]
    format: TableFormat,
    /// Folder for the results, with a folder per log; created if needed
    #[arg(short, long, value_name = "DIR", required_unless_present = "columns_page")]
    out: Option<PathBuf>,
    /// Export at most one estimate per cell in this period, the first; 0 exports all
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0, value_parser = period)]
    period: f64,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    logs: LogArgs,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if args.columns_page {
        return unless_closed(io::stdout().write_all(export::reference().as_bytes()));
    }
    args.logs.check()?;
    let (Some(config), Some(out)) = (&args.config, &args.out) else {
        return Err(Failure::new("give --config FILE and --out DIR"));
    };
    let config = config::load(config)?;
    let open = |config: &Config, logs: &[PathBuf]| args.logs.open(config, logs);
    let settings = ExportSettings {
        access: LogAccess { open: &open, sleep_gap_s: args.logs.sleep_gap_s() },
        format: args.format,
        out: out.clone(),
        period_s: Some(args.period),
        jobs: args.logs.threads(),
        reading: String::new(),
    };
    let bar = args.logs.bar(1);
    let results = export::run(&config, &args.logs.logs, &settings, &|bytes| bar.inc(bytes));
    bar.finish_and_clear();
    let (good, failed): (Vec<_>, Vec<_>) = results.map_err(failure)?.into_iter().partition(Result::is_ok);
    let good: Vec<ExportResult> = good.into_iter().flatten().collect();
    let failed: Vec<String> = failed.into_iter().filter_map(Result::err).map(|error| error.to_string()).collect();
    unless_closed(match args.json {
        true => print_json(&json!({ "version": VERSION, "logs": good, "failed": failed })),
        false => table(&good),
    })?;
    if failed.is_empty() { Ok(()) } else { Err(Failure::new(failed.join("\n"))) }
}

fn table(good: &[ExportResult]) -> io::Result<()> {
    if good.is_empty() {
        return Ok(());
    }
    let row = |exported: &ExportResult| {
        let rows = |table: &str| exported.rows.get(table).copied().unwrap_or(0).to_string();
        vec![
            exported.log.display().to_string(),
            exported.folder.display().to_string(),
            format!("{:.2}", exported.days),
            rows("estimates"),
            rows("half_cycles"),
            rows("alarms"),
        ]
    };
    let mut text = Vec::new();
    let heads = ["log", "folder", "days", "estimates", "half-cycles", "alarms"];
    write_table(&mut text, &heads, good.iter().map(row), 2)?;
    for exported in good {
        exported.notes.iter().try_for_each(|note| writeln!(text, "note: {}: {note}", exported.log.display()))?;
    }
    io::stdout().write_all(&text)
}

fn period(text: &str) -> Result<f64, String> {
    within(text, |value| (0.0..=1e6).contains(&value), "0 to 1e6 s")
}
