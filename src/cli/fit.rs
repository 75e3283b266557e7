//! `packwatch fit`: fits a cell model to measured data.
//!
//! Prints a table of the files with their residuals, then notes, a verdict, and the result of the fit. The model file
//! gets its final name only when it is complete.

mod report;

use std::path::{Path, PathBuf};
use std::time::Instant;

use super::common::label::{LabelArgs, one_of_chemistries};
use super::common::logs::{InputArgs, log_options, print_tables, table_options};
use super::common::numbers::{finite, integer};
use super::common::output::{failure, print, unless_closed};
use super::common::progress::progress_bar;
use crate::config;
use crate::lab;
use crate::lab::fit::logs::LogRequest;
use crate::lab::fit::{self, FitProgress, FitRequest, MAX_SOC_NODES};
use packwatch_host::failure::Failure;

/// Arguments of `fit`.
#[derive(Debug, clap::Args)]
#[command(override_usage = "packwatch fit [OPTIONS] --name <NAME> --out <MODEL.toml> <FILE>...\n       \
    packwatch fit --log [OPTIONS] --config <FILE.toml> --out <MODEL.toml> <FILE>...\n       \
    packwatch fit --log [OPTIONS] --chemistry <CHEMISTRY> --rated <AH> --out <MODEL.toml> <FILE>...")]
pub(crate) struct Args {
    /// Measured files of a cell: CSV (.gz, .zst) with the columns time_s, current_a (positive = discharge), voltage_v,
    /// and optionally temperature_c, discharged_ah, cycle and type. Each file starts with a full cell. With --log: logs of a pack
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Fit to logs of a pack, read as by `replay`; they may start at any SOC. The fit starts from the cell model of --config,
    /// or from --chemistry and --rated, and changes the model where the logs contradict it. A state folder cannot be
    /// used, because it contains no voltages and currents
    #[arg(long, requires = "start", conflicts_with_all = ["capacity", "ageing_shift", "ocv", "first_cycles", "GridArgs"])]
    log: bool,
    /// Cell model file to write
    #[arg(short, long, value_name = "MODEL.toml")]
    out: PathBuf,
    /// Name of the cell in the cell model file; required without --log [default with --log: name of the configured
    /// model]
    #[arg(long, required_unless_present = "log")]
    name: Option<String>,
    /// Capacity that defines SOC (Ah) [default: from the slow test nearest 25 degrees C, else the deepest discharge]
    #[arg(long, value_name = "AH", value_parser = finite)]
    capacity: Option<f64>,
    /// Capacity on the label (Ah) [default: --capacity]
    #[arg(long, value_name = "AH", value_parser = finite)]
    rated: Option<f64>,
    /// How the open-circuit curve changes as the cell loses capacity: with 0, it shrinks evenly; with 1, it shifts as
    /// if only lithium were lost. Data of a new cell do not show this [default: from the electrodes found in the slow
    /// test; without them 0.5 for an ageing cell, else 0]
    #[arg(long, value_name = "SHARE", value_parser = finite)]
    ageing_shift: Option<f64>,
    /// Lowest voltage under load [default: where discharges end, pulses excluded]
    #[arg(long, value_name = "VOLTS", value_parser = finite)]
    voltage_min: Option<f64>,
    /// Highest voltage under charge [default: where charges end, pulses excluded]
    #[arg(long, value_name = "VOLTS", value_parser = finite)]
    voltage_max: Option<f64>,
    /// Slow test (about C/20) that starts with a full cell and gives the open-circuit curve; repeat for several
    /// temperatures
    #[arg(long, value_name = "FILE")]
    ocv: Vec<PathBuf>,
    #[command(flatten)]
    grid: GridArgs,
    /// Fit only the first cycles of an ageing cell: the parts whose number in the column cycle is at most this number.
    /// SOC is anchored at full charges and at the knees of discharges
    #[arg(long, value_name = "N", value_parser = integer::<usize>(0, usize::MAX), conflicts_with_all = ["ocv", "capacity"])]
    first_cycles: Option<usize>,
    /// Write a plot of the residuals
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    // The fields with a heading are last, because a heading applies to every option that follows.
    #[command(flatten)]
    start: StartArgs,
    #[command(flatten)]
    input: InputArgs,
}

/// Start of a fit to logs.
#[derive(Debug, clap::Args)]
#[group(id = "start")]
#[command(next_help_heading = "Logs (with --log)")]
struct StartArgs {
    /// Configuration file of the pack; the fit starts from its cell model
    #[arg(short, long, value_name = "FILE.toml", requires = "log")]
    config: Option<PathBuf>,
    /// Chemistry on the label, for logs of a single cell; needs --rated. Add --voltage-min and --voltage-max if they are
    /// not typical of the chemistry
    #[arg(long, value_parser = one_of_chemistries(), requires_all = ["log", "rated"], conflicts_with = "config")]
    chemistry: Option<String>,
}

/// Size and breakpoints of the model.
#[derive(Debug, clap::Args)]
struct GridArgs {
    /// Number of RC branches (a resistor and a capacitor), 1 to 3 [default: 2, for an ageing cell 1]
    #[arg(long, value_name = "N", value_parser = integer::<usize>(0, usize::MAX))]
    branches: Option<usize>,
    /// Initial time constants of the RC branches (s), ascending, for example 10,100
    #[arg(long, value_name = "SECONDS,..", value_delimiter = ',', value_parser = finite)]
    tau: Option<Vec<f64>>,
    /// Temperatures of the model's tables (degrees C), ascending [default: from the data]
    #[arg(long, value_name = "CELSIUS,..", value_delimiter = ',', value_parser = finite, allow_negative_numbers = true)]
    temperatures: Option<Vec<f64>>,
    /// SOC of the model's tables: how many values (evenly spaced), or an ascending list from 0 to 1 [default: 15 to 31 values
    /// with a slow test, denser where its curve bends; 25 for an ageing cell; else 24, denser at both ends]
    #[arg(long, value_name = "N|SOC,..", value_parser = soc_nodes)]
    soc_nodes: Option<SocNodes>,
}

/// SOC breakpoints; the request validates them.
#[derive(Debug, Clone)]
struct SocNodes(Vec<f64>);

fn soc_nodes(text: &str) -> Result<SocNodes, String> {
    if let Ok(count) = text.parse::<u16>() {
        let is_allowed = (2..=MAX_SOC_NODES).contains(&usize::from(count));
        let last = count.checked_sub(1).filter(|_| is_allowed).ok_or(format!("must be 2 to {MAX_SOC_NODES} nodes"))?;
        return Ok(SocNodes((0..count).map(|k| f64::from(k) / f64::from(last)).collect()));
    }
    text.split(',').map(finite).collect::<Result<_, _>>().map(SocNodes)
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let begin = Instant::now();
    let mut request = request(args);
    request.check().map_err(failure)?;
    let bar = progress_bar(None, "{spinner} {elapsed_precise} {msg}");
    let result = if args.log {
        fit_logs(args, &mut request, |progress| report::show(&bar, progress))
    } else {
        fit::run(&request, |progress| report::show(&bar, progress)).map_err(failure)
    };
    bar.finish_and_clear();
    let outcome = result?;
    print_tables(&outcome.tables);
    lab::write_file(&args.out, fit::text(&request, &outcome).as_bytes()).map_err(failure)?;
    if let Some(path) = &args.plot {
        fit::write_plot(path, &outcome).map_err(failure)?;
    }
    let seconds = begin.elapsed().as_secs_f64();
    if args.json {
        return print(&format!("{}\n", fit::document(&outcome, seconds)));
    }
    unless_closed(report::table(&outcome, seconds, &args.out))
}

/// Fits to logs. If no name is given, the name comes from the configuration. The rated capacity always comes from the
/// configuration.
fn fit_logs(
    args: &Args,
    request: &mut FitRequest,
    progress: impl FnMut(FitProgress),
) -> Result<fit::FitOutcome, Failure> {
    let label = LabelArgs {
        chemistry: args.start.chemistry.clone(),
        rated: args.rated,
        voltage_min: args.voltage_min,
        voltage_max: args.voltage_max,
    };
    let config = match (label.keys(), &args.start.config) {
        (Some(keys), _) => keys.configuration()?,
        (None, path) => config::load(path.as_deref().unwrap_or(Path::new("")))?,
    };
    let model = &config.monitor.model;
    request.name = args.name.clone().unwrap_or_else(|| model.name.clone());
    request.rated_ah = Some(model.rated_capacity_ah);
    let logs = LogRequest {
        monitor: &config.monitor,
        interfaces: config.interface_names(),
        sleep_gap_s: args.input.sleep_gap_s(&config.monitor),
        options: &|| log_options(&args.input, &config),
        logs: args.files.clone(),
    };
    fit::logs::run(&logs, progress).map_err(failure)
}

fn request(args: &Args) -> FitRequest {
    FitRequest {
        name: args.name.clone().unwrap_or_default(),
        capacity_ah: args.capacity,
        rated_ah: args.rated,
        voltage_min_v: args.voltage_min,
        voltage_max_v: args.voltage_max,
        ageing_shift: args.ageing_shift,
        ocv: args.ocv.clone(),
        branches: args.grid.branches,
        tau_s: args.grid.tau.clone(),
        temperature_c: args.grid.temperatures.clone(),
        soc: args.grid.soc_nodes.as_ref().map(|nodes| nodes.0.clone()),
        first_cycles: args.first_cycles,
        table: table_options(&args.input),
        files: args.files.clone(),
    }
}
