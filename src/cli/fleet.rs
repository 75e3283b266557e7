//! `packwatch fleet`: replays the vehicles of a fleet and merges their tables. The fleet can be split into shards that
//! run on different machines.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use indicatif::HumanBytes;
use serde_json::json;

use super::common::label::one_of_chemistries;
use super::common::logs::InputArgs;
use super::common::many_logs;
use super::common::numbers::{above_0, integer, within};
use super::common::output::{check_distinct, failure, print, print_json, unless_closed};
use super::common::progress::progress_bar;
use crate::cell::{FleetPrior, Label, OwnModel};
use crate::config::{self, Config};
use crate::io::result_file::ResultFile;
use crate::lab::error::LabError;
use crate::lab::fleet::LogAccess;
use crate::lab::fleet::export::merge::{MergeSummary, merge};
use crate::lab::fleet::export::{ExportSettings, TableFormat};
use crate::lab::fleet::prior::combine;
use crate::lab::fleet::vehicle::{Vehicle, VehicleRecord};
use crate::lab::fleet::vehicles::{self, Outcome, Shard};
use packwatch_host::failure::Failure;

const VERSION: u32 = 1;

/// Arguments of `fleet`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: FleetCommand,
}

#[derive(Debug, clap::Subcommand)]
enum FleetCommand {
    /// Write a manifest: the list of vehicles and their logs
    Plan(PlanArgs),
    /// Replay the vehicles of a manifest, or a shard of them
    Run(RunArgs),
    /// Merge the tables of all shards
    Merge(MergeArgs),
    /// Combine what the vehicles have learned about their cells into a prior for the next vehicle
    Prior(PriorArgs),
}

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Each line of the manifest is a JSON document with vehicle (its name), bytes (size of its logs), logs and optionally config, the \
    configuration of this vehicle."
)]
struct PlanArgs {
    /// Log of one vehicle, or folder with the logs of one vehicle, read in the order of their names
    #[arg(required = true, value_name = "LOG|DIR")]
    logs: Vec<PathBuf>,
    /// Manifest to write; - writes standard output
    #[arg(short, long, value_name = "MANIFEST", default_value = "-")]
    out: PathBuf,
}

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Writes DIR/VEHICLE/half_cycles.parquet, alarms.parquet, use_record.parquet, with --estimates estimates.parquet, and last vehicle.json. Vehicles that have \
    vehicle.json are not replayed again, so a stopped run can be continued. If a vehicle fails, the run reports it and continues; the next run tries \
    it again. The exit code is 0 if every vehicle was replayed, 1 if a vehicle failed."
)]
struct RunArgs {
    /// Manifest to read
    #[arg(value_name = "MANIFEST")]
    manifest: PathBuf,
    /// Configuration of vehicles without their own
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Folder for the results, with a folder per vehicle; created if needed
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
    /// Shard to replay: I of N shards of similar size
    #[arg(long, value_name = "I/N", default_value = "1/1")]
    shard: Shard,
    /// Also write estimates, at most one per cell in this period (s); 0 writes all
    #[arg(long, value_name = "SECONDS", value_parser = period)]
    estimates: Option<f64>,
    /// Number of threads [default: one per core]
    #[arg(short, long, value_name = "N", value_parser = integer::<u16>(1, 1024))]
    jobs: Option<u16>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    input: InputArgs,
}

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Writes vehicles.parquet, half_cycles.parquet, alarms.parquet, use_record.parquet and, if exported, estimates.parquet. Each vehicle has its own row group, \
    sorted by name. The bytes do not depend on the shards or their order."
)]
struct MergeArgs {
    /// Folders written by `fleet run`
    #[arg(required = true, value_name = "DIR")]
    folders: Vec<PathBuf>,
    /// Folder for the merged tables; created if needed
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
    /// Manifest; fail if one of its vehicles is missing
    #[arg(long, value_name = "MANIFEST")]
    manifest: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Vehicles take part if their configuration describes the cells by a label (pack.chemistry and pack.rated_capacity_ah) and if their \
    logs sufficed to learn a model. A further vehicle with the same label starts from the prior with pack.prior = \"FILE\". The same fleet gives the \
    same bytes."
)]
struct PriorArgs {
    /// Folder written by `fleet merge`
    #[arg(value_name = "DIR")]
    tables: PathBuf,
    /// Prior to write; - writes standard output
    #[arg(short, long, value_name = "FILE", default_value = "-")]
    out: PathBuf,
    /// Use only vehicles with this chemistry
    #[arg(long, value_parser = one_of_chemistries())]
    chemistry: Option<String>,
    /// Use only vehicles with this rated capacity of a cell (Ah)
    #[arg(long, value_name = "AH", value_parser = above_0)]
    rated: Option<f64>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.command {
        FleetCommand::Plan(args) => plan(args),
        FleetCommand::Run(args) => replay(args),
        FleetCommand::Merge(args) => merge_runs(args),
        FleetCommand::Prior(args) => write_prior(args),
    }
}

fn plan(args: &PlanArgs) -> Result<(), Failure> {
    check_distinct(&args.logs)?;
    let vehicles = vehicles::plan(&args.logs).map_err(failure)?;
    let text = vehicles::manifest(&vehicles).map_err(failure)?;
    if args.out == Path::new("-") {
        return print(&text);
    }
    write_result(&args.out, text.as_bytes())?;
    let bytes: u64 = vehicles.iter().map(|vehicle| vehicle.bytes).sum();
    print(&format!("{}: {} vehicles, {}\n", args.out.display(), vehicles.len(), HumanBytes(bytes)))
}

fn replay(args: &RunArgs) -> Result<(), Failure> {
    let all = vehicles::read_manifest(&args.manifest).map_err(failure)?;
    if args.input.start_times.is_some() && all.len() > 1 {
        let text = "--start-times dates one vehicle, but the manifest has several; place NAME_cycles.csv next to each log instead";
        return Err(Failure::new(text));
    }
    let chosen = args.shard.choose(&all);
    let usual = config::load(&args.config)?;
    let config_of = |vehicle: &Vehicle| match &vehicle.config {
        None => Ok(usual.clone()),
        Some(path) => config::load(path).map_err(|faults| LabError::Data(faults.0.join("; "))),
    };
    let open = |config: &Config, found: &[PathBuf]| many_logs::open(&args.input, config, found);
    let settings = ExportSettings {
        access: LogAccess { open: &open, sleep_gap_s: args.input.sleep_gap },
        format: TableFormat::Parquet,
        out: args.out.clone(),
        period_s: args.estimates,
        jobs: args.jobs.map(usize::from),
        reading: format!("{:?}", args.input),
    };
    let bar = progress_bar(
        chosen.iter().map(|vehicle| vehicle.bytes).sum::<u64>(),
        "{bar:32} {bytes}/{total_bytes} eta {eta}",
    );
    let outcomes = vehicles::run(&chosen, &config_of, &settings, &|bytes| bar.inc(bytes));
    bar.finish_and_clear();
    let outcomes = outcomes.map_err(failure)?;
    unless_closed(if args.json { print_json(&document(&outcomes)) } else { summary(&outcomes, args.shard) })?;
    match outcomes.iter().filter(|outcome| matches!(outcome, Outcome::Failed(_))).count() {
        0 => Ok(()),
        failed => Err(Failure::new(format!("{failed} of {} vehicles failed", outcomes.len()))),
    }
}

fn document(outcomes: &[Outcome]) -> serde_json::Value {
    let vehicles = outcomes.iter().map(|outcome| {
        let (word, record) = named(outcome);
        json!({ "outcome": word, "record": record })
    });
    json!({ "version": VERSION, "vehicles": vehicles.collect::<Vec<_>>() })
}

/// Returns the outcome's name in JSON and the vehicle's record.
fn named(outcome: &Outcome) -> (&'static str, &VehicleRecord) {
    match outcome {
        Outcome::Replayed(record) => ("replayed", record),
        Outcome::Complete(record) => ("complete", record),
        Outcome::Failed(record) => ("failed", record),
    }
}

fn summary(outcomes: &[Outcome], shard: Shard) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let (mut replayed, mut complete, mut failed, mut days) = (0, 0, 0, 0.0);
    for outcome in outcomes {
        let (_, record) = named(outcome);
        match outcome {
            Outcome::Replayed(_) => replayed += 1,
            Outcome::Complete(_) => complete += 1,
            Outcome::Failed(_) => failed += 1,
        }
        days += record.days;
        let name = &record.line.vehicle;
        record.error.iter().try_for_each(|error| writeln!(out, "failed: {name}: {error}"))?;
        record.notes.iter().try_for_each(|note| writeln!(out, "note: {name}: {note}"))?;
    }
    let Shard { number, of } = shard;
    writeln!(
        out,
        "shard {number} of {of}: {replayed} vehicles replayed, {complete} already complete, {failed} failed; {days:.1} days in total"
    )
}

fn merge_runs(args: &MergeArgs) -> Result<(), Failure> {
    let wanted =
        args.manifest.as_ref().map(|manifest| vehicles::read_manifest(manifest)).transpose().map_err(failure)?;
    let merged = merge(&args.folders, wanted.as_deref(), &args.out).map_err(failure)?;
    if args.json {
        return unless_closed(print_json(&json!({ "version": VERSION, "merged": merged })));
    }
    let MergeSummary { vehicles, failed, rows } = &merged;
    let mut text: String = failed.iter().map(|(name, error)| format!("failed: {name}: {error}\n")).collect();
    let rows: Vec<String> = rows.iter().map(|(table, rows)| format!("{table} {rows} rows")).collect();
    text += &format!("{vehicles} vehicles, {} failed; {}\n", failed.len(), rows.join(", "));
    print(&text)
}

fn write_prior(args: &PriorArgs) -> Result<(), Failure> {
    let is_wanted = |label: &Label| {
        args.chemistry.as_ref().is_none_or(|name| name == label.chemistry.name())
            && args.rated.is_none_or(|rated_ah| rated_ah == label.rated_ah)
    };
    let prior = combine(&args.tables, is_wanted).map_err(failure)?;
    let text =
        toml::to_string(&prior).map_err(|error| Failure::new(format!("the prior cannot be written: {error}")))?;
    if args.out == Path::new("-") {
        return print(&text);
    }
    write_result(&args.out, text.as_bytes())?;
    let FleetPrior { label, vehicles, mean: OwnModel { capacity, .. }, .. } = &prior;
    print(&format!(
        "{}: {vehicles} vehicles, {label}; capacity {:.3} ± {:.3} Ah\n",
        args.out.display(),
        capacity.mean,
        capacity.std()
    ))
}

fn write_result(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    let write = || {
        let mut file = ResultFile::create(path)?;
        file.write_all(bytes)?;
        file.finish()
    };
    write().map_err(failure)
}

fn period(text: &str) -> Result<f64, String> {
    within(text, |value| (0.0..=1e6).contains(&value), "0 to 1e6 s")
}
