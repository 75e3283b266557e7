//! Arguments of `score`.

use std::path::PathBuf;

use crate::cli::common::label::LabelArgs;
use crate::cli::common::logs::{CsvSign, charge_positive, column};
use crate::cli::common::numbers::{NamedValue, above_0, above_0_to, finite, fraction, integer, one_of, within};
use crate::io::csv_log::CsvOptions;
use crate::lab::score::{ScoreRequest, Start};
use crate::lab::single_cell::CellSource;

/// Start of the estimator within a file.
const STARTS: [NamedValue<Start>; 2] = [
    ("full", Start::Full, "At the first row of the file"),
    ("middle", Start::Middle, "Where --remove has been discharged; earlier rows are skipped"),
];

/// Error of the initial SOC, percentage points; `None` if no initial SOC is given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct InitialSocError(pub(crate) Option<f64>);

/// Arguments of `score`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "The true SOC is 1 - discharged_ah / C, from the cycler's own counter, with one C for all files \
    (--truth-capacity). Each value of an option with several values adds cases: each file runs in every combination. \
    Statistics count every sample after --settle once.",
    override_usage = "packwatch score [OPTIONS] --cell <MODEL.toml> <FILE>...\n       \
    packwatch score [OPTIONS] --chemistry <CHEMISTRY> --rated <AH> <FILE>...\n       \
    packwatch score [OPTIONS] --config <FILE.toml> <FILE>..."
)]
pub(crate) struct Args {
    /// Measured files: CSV (.gz, .zst) with time_s, current_a (positive = discharge), voltage_v, temperature_c, discharged_ah
    #[arg(required = true, value_name = "FILE")]
    pub(crate) files: Vec<PathBuf>,
    /// Configuration of one cell with the input signals of measured.dbc [default: a built-in one with default estimator keys]
    #[arg(short, long, value_name = "FILE.toml", required_unless_present_any = ["cell", "chemistry"])]
    pub(crate) config: Option<PathBuf>,
    /// Cell model to use instead of the configured one
    #[arg(long, value_name = "MODEL.toml")]
    pub(crate) cell: Option<PathBuf>,
    /// Measured files to replay first, in this order, without a score; each scored file starts from the state learned
    /// there
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with = "cycles")]
    pub(crate) learn: Vec<PathBuf>,
    /// Name a column, as for `replay`
    #[arg(long = "column", value_name = "ROLE=NAME", value_parser = column)]
    pub(crate) columns: Vec<(String, String)>,
    /// Direction of positive current, as for `replay`
    #[arg(long, value_enum)]
    pub(crate) csv_sign: Option<CsvSign>,
    #[command(flatten)]
    pub(crate) label: LabelArgs,
    #[command(flatten)]
    pub(crate) starts: StartArgs,
    #[command(flatten)]
    pub(crate) statistics: StatisticsArgs,
    #[command(flatten)]
    pub(crate) life: LifeArgs,
    #[command(flatten)]
    pub(crate) output: OutputArgs,
}

/// Initial values of the estimator.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Starts")]
pub(crate) struct StartArgs {
    /// Start of the estimator within each file
    #[arg(long, value_parser = one_of(&STARTS), value_delimiter = ',', default_value = "full")]
    pub(crate) start: Vec<Start>,
    /// With --start middle: fraction of the full charge that is discharged before the start
    #[arg(long, value_name = "FRACTION", default_value_t = 0.3, value_parser = fraction)]
    pub(crate) remove: f64,
    /// Error of the initial SOC given to the estimator (points); -20 is 20 points below the truth. With none, no SOC is given and
    /// the estimator starts from its first voltage
    #[arg(long = "told", value_name = "POINTS", value_delimiter = ',', default_value = "none", value_parser = initial_soc_error,
          allow_hyphen_values = true)]
    pub(crate) soc_error: Vec<InitialSocError>,
    /// Standard deviation of the initial SOC (points) [default: the size of the error, at least 5]
    #[arg(long, value_name = "POINTS", value_parser = above_0_to(100.0, ""))]
    pub(crate) soc_std: Option<f64>,
    /// Error of the initial capacity, percent of the model's capacity
    #[arg(long, value_name = "PERCENT", value_delimiter = ',', default_value = "0", value_parser = capacity_error,
          allow_hyphen_values = true)]
    pub(crate) capacity_error: Vec<f64>,
    /// Standard deviation of the initial capacity, percent of the model's capacity [default: from the configuration]
    #[arg(long, value_name = "PERCENT", value_parser = above_0_to(100.0, ""))]
    pub(crate) capacity_std: Option<f64>,
    /// Offset added to every current reading (A)
    #[arg(long, value_name = "AMPERES", value_delimiter = ',', default_value = "0", value_parser = finite,
          allow_hyphen_values = true)]
    pub(crate) current_offset: Vec<f64>,
}

/// Truth and statistics.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Truth and statistics")]
pub(crate) struct StatisticsArgs {
    /// Time after the start that is left out of the statistics: 600, 600s, 10min or 1h
    #[arg(long, value_name = "TIME", default_value = "10min", value_parser = duration)]
    pub(crate) settle: f64,
    /// Charge from full to empty that defines the true SOC (Ah) [default: capacity_ah of the cell model]
    #[arg(long, value_name = "AH", value_parser = above_0)]
    pub(crate) truth_capacity: Option<f64>,
    /// Count a gap longer than this as sleep of the recorder (s)
    #[arg(long, value_name = "SECONDS", default_value_t = 90.0, value_parser = above_0)]
    pub(crate) sleep_gap: f64,
}

/// Lives of cells.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Cell lives")]
pub(crate) struct LifeArgs {
    /// Table of published capacities (cycle, type, start, capacity_ah_source), one per file in the same order. The
    /// charge delivered while the voltage is held at the end of a discharge is subtracted
    #[arg(long, value_name = "TABLE.csv")]
    pub(crate) cycles: Vec<PathBuf>,
    /// Load at which the published capacities were measured, in A, degrees C and V: 2,24,2.7 [default: [usable] of the configuration]
    #[arg(long, value_name = "CURRENT,TEMPERATURE,CUTOFF", value_parser = load)]
    pub(crate) load: Option<[f64; 3]>,
    /// Report the first discharge with a capacity below this (Ah)
    #[arg(long, value_name = "AH", default_value_t = 1.4, value_parser = above_0)]
    pub(crate) threshold: f64,
    /// Discharges to leave out before the capacity statistics start
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = integer::<usize>(0, usize::MAX))]
    pub(crate) skip_cycles: usize,
    /// Use only a random window of each half-cycle. The window contains a fraction of MIN to MAX of the half-cycle's
    /// charge, for example 0.4,0.7
    #[arg(long, value_name = "MIN,MAX", value_parser = window)]
    pub(crate) window: Option<(f64, f64)>,
    /// Seeds of the random windows
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "1", value_parser = integer::<u64>(0, u64::MAX))]
    pub(crate) seed: Vec<u64>,
}

/// Output.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Output")]
pub(crate) struct OutputArgs {
    /// Print the scores as JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Write an SVG plot per file and case into this folder
    #[arg(long, value_name = "DIR")]
    pub(crate) plot: Option<PathBuf>,
}

impl Args {
    pub(super) fn request(&self) -> ScoreRequest {
        let Self { files, config, cell, learn, columns, csv_sign, label, starts, statistics, life, output } = self;
        let charge_positive = charge_positive(*csv_sign);
        ScoreRequest {
            files: files.clone(),
            source: CellSource { config: config.clone(), cell: cell.clone(), label: label.keys() },
            learn: learn.clone(),
            table: CsvOptions { columns: columns.clone(), charge_positive, ..CsvOptions::default() },
            start: starts.start.clone(),
            remove: starts.remove,
            soc_error_points: starts.soc_error.iter().map(|error| error.0).collect(),
            soc_std_points: starts.soc_std,
            capacity_error_percent: starts.capacity_error.clone(),
            capacity_std_percent: starts.capacity_std,
            current_offset_a: starts.current_offset.clone(),
            settle_s: statistics.settle,
            truth_capacity_ah: statistics.truth_capacity,
            sleep_gap_s: statistics.sleep_gap,
            cycles: life.cycles.clone(),
            load: life.load,
            threshold_ah: life.threshold,
            skip_cycles: life.skip_cycles,
            window: life.window,
            seeds: life.seed.clone(),
            plots: output.plot.clone(),
        }
    }
}

fn initial_soc_error(text: &str) -> Result<InitialSocError, String> {
    if text == "none" {
        return Ok(InitialSocError(None));
    }
    let points = within(text, |points| points.abs() <= 100.0, "-100 to 100 points, or none")?;
    Ok(InitialSocError(Some(points)))
}

fn capacity_error(text: &str) -> Result<f64, String> {
    within(text, |value| value > -100.0 && value <= 100.0, "above -100 and at most 100")
}

/// Parses a duration such as `600`, `600s`, `10min` or `1h`, and returns seconds.
fn duration(text: &str) -> Result<f64, String> {
    let units = [("min", 60.0), ("h", 3600.0), ("s", 1.0)];
    let text = text.trim();
    let (digits, unit) =
        units.iter().find_map(|(unit, seconds)| Some((text.strip_suffix(unit)?, *seconds))).unwrap_or((text, 1.0));
    let value = within(digits, |value| value >= 0.0, "0 or more, for example 600, 600s, 10min or 1h")?;
    Ok(value * unit)
}

fn window(text: &str) -> Result<(f64, f64), String> {
    let expected = "must be two fractions above 0 and at most 1, the smaller first, for example 0.4,0.7";
    let (least, most) = text.split_once(',').ok_or(expected)?;
    let (least, most) = (finite(least).map_err(|_| expected)?, finite(most).map_err(|_| expected)?);
    if least > 0.0 && least <= most && most <= 1.0 { Ok((least, most)) } else { Err(expected.to_owned()) }
}

fn load(text: &str) -> Result<[f64; 3], String> {
    let values: Option<Vec<f64>> = text.split(',').map(|part| finite(part).ok()).collect();
    let load: Option<[f64; 3]> = values.and_then(|values| values.try_into().ok());
    let load = load.filter(|[current_a, _, cutoff_v]| *current_a > 0.0 && *cutoff_v > 0.0);
    load.ok_or_else(|| "must be amperes above 0, degrees C and volts above 0, for example 2,24,2.7".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn duration_accepts_units() {
        assert_eq!(duration("10min"), Ok(600.0));
        assert_eq!((duration("90"), duration("90 s"), duration("0.5h")), (Ok(90.0), Ok(90.0), Ok(1800.0)));
        assert!(duration("-1s").is_err() && duration("soon").is_err() && duration("min").is_err());
    }

    #[test]
    fn files_and_cell_alone_give_default_request() {
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            args: Args,
        }
        let line = <Line as clap::Parser>::try_parse_from(["score", "a.csv", "--cell", "m.toml"]);
        let source = CellSource { cell: Some("m.toml".into()), ..CellSource::default() };
        let expected = ScoreRequest { files: vec!["a.csv".into()], source, ..ScoreRequest::default() };
        assert_eq!(line.map(|line| line.args.request()).map_err(|error| error.to_string()), Ok(expected));
    }

    #[test]
    fn invalid_lists_and_ranges_are_rejected() {
        assert_eq!(window("0.4,0.7"), Ok((0.4, 0.7)));
        assert!(["0.7,0.4", "0,0.5", "0.5", "0.5,1.1"].iter().all(|text| window(text).is_err()));
        assert_eq!(load("2,-10,2.7"), Ok([2.0, -10.0, 2.7]));
        assert!(["2,24", "0,24,2.7", "2,24,2.7,1", "a,b,c"].iter().all(|text| load(text).is_err()));
        assert_eq!(initial_soc_error("none"), Ok(InitialSocError(None)));
        assert_eq!(initial_soc_error("-20"), Ok(InitialSocError(Some(-20.0))));
        assert!(initial_soc_error("-101").is_err() && initial_soc_error("NaN").is_err());
        assert!(fraction("1").is_err() && capacity_error("-100").is_err());
    }
}
