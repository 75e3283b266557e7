//! `packwatch gpr`: Gaussian process regression on CSV files: cross-validate, train, predict, forecast.

mod args;
mod forecast;
mod report;

use std::path::{Path, PathBuf};
use std::time::Instant;

use super::common::numbers::whole;
use super::common::output::{create_folder, failure, unless_closed};
use crate::lab::gpr::{self, ColumnSelection, ColumnTable, PartColumn, TrainedModel};
use crate::regress::{Kernel, score};
use args::{FileArgs, ModelArgs};
use packwatch_host::failure::Failure;

/// Arguments of `gpr`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: GprCommand,
}

#[derive(Debug, clap::Subcommand)]
enum GprCommand {
    /// Cross-validate: predict every row from a model fitted without it, and report the errors
    Cv(Box<CvArgs>),
    /// Fit a model to all rows and save it
    Train(Box<TrainArgs>),
    /// Predict rows with a saved model
    Predict(PredictArgs),
    /// Forecast future rows from past rows, without future inputs
    Forecast(Box<forecast::ForecastArgs>),
}

/// Arguments of `gpr cv`.
#[derive(Debug, clap::Args)]
#[command(after_help = args::GRAMMAR)]
struct CvArgs {
    #[command(flatten)]
    files: FileArgs,
    #[command(flatten)]
    columns: ColumnArgs,
    /// Covariance functions, separated by commas; each is validated separately
    #[arg(
        long,
        value_name = "KERNEL,..",
        value_delimiter = ',',
        default_value = "exponential,squared_exponential,matern52,rational_quadratic"
    )]
    kernel: Vec<Kernel>,
    /// Number of random folds; each is predicted from the others
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = whole::<2, 1000>)]
    folds: usize,
    #[command(flatten)]
    model: ModelArgs,
    /// Write the prediction of every row to this file
    #[arg(long, value_name = "FILE.csv")]
    predictions: Option<PathBuf>,
    /// Write SVG plots into this folder: predicted against measured, consecutive rows with their intervals, and errors
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Arguments of `gpr train`.
#[derive(Debug, clap::Args)]
#[command(after_help = args::GRAMMAR)]
struct TrainArgs {
    #[command(flatten)]
    files: FileArgs,
    #[command(flatten)]
    columns: ColumnArgs,
    /// Covariance function
    #[arg(long, value_name = "KERNEL", default_value = "exponential")]
    kernel: Kernel,
    #[command(flatten)]
    model: ModelArgs,
    /// Model file to write; contains the training rows
    #[arg(short, long, value_name = "MODEL.json")]
    out: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Arguments of `gpr predict`.
#[derive(Debug, clap::Args)]
struct PredictArgs {
    /// Model file written by `gpr train`
    #[arg(value_name = "MODEL.json")]
    model: PathBuf,
    #[command(flatten)]
    files: FileArgs,
    /// File to write: CSV with file, line, inputs, the output where known, its predicted mean and standard deviation, and the ends of
    /// the 95 % interval; - writes standard output and prints the summary on standard error
    #[arg(short, long, value_name = "FILE.csv", default_value = "-")]
    out: PathBuf,
    /// Number of threads [default: one per core]
    #[arg(long, value_name = "N", value_parser = whole::<1, 1024>)]
    threads: Option<usize>,
    /// Print the errors as JSON
    #[arg(long)]
    json: bool,
}

/// The predicted column and its input columns.
#[derive(Debug, clap::Args)]
struct ColumnArgs {
    /// Column to predict. The unit may be omitted: voltage finds voltage_v
    #[arg(long, value_name = "COLUMN")]
    output: String,
    /// Columns to predict from
    #[arg(long, value_name = "COLUMN,..", value_delimiter = ',', required = true)]
    inputs: Vec<String>,
}

impl ColumnArgs {
    /// Reads the columns: first the inputs, then the output.
    fn table(&self, files: &FileArgs) -> Result<ColumnTable, Failure> {
        let columns: Vec<String> = self.inputs.iter().chain([&self.output]).cloned().collect();
        let wanted = ColumnSelection { columns: &columns, optional: &[], missing: files.missing() };
        read(&files.files, &wanted, &PartColumn::None)
    }
}

/// Reads files. Rejects a column that is given twice, because it could predict itself.
fn read(files: &[PathBuf], wanted: &ColumnSelection<'_>, part: &PartColumn) -> Result<ColumnTable, Failure> {
    let table = ColumnTable::read(files, wanted, part).map_err(failure)?;
    let names = &table.names[..wanted.columns.len()];
    if let Some((_, twice)) = names.iter().enumerate().find(|(at, name)| names[..*at].contains(name)) {
        return Err(Failure::new(format!(
            "column {twice} is given twice; give each column once, as an input or as the output"
        )));
    }
    Ok(table)
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.what {
        GprCommand::Cv(args) => cv(args),
        GprCommand::Train(args) => train(args),
        GprCommand::Predict(args) => predict(args),
        GprCommand::Forecast(args) => forecast::run(args),
    }
}

fn cv(args: &CvArgs) -> Result<(), Failure> {
    let begin = Instant::now();
    args.plots.iter().try_for_each(|folder| create_folder(folder))?;
    args.predictions.iter().try_for_each(|path| args.files.check_result(path))?;
    let table = args.columns.table(&args.files)?;
    let bar = report::fit_bar(args.kernel.len() * args.folds);
    let mut all = Vec::new();
    for (k, kernel) in args.kernel.iter().enumerate() {
        let settings = args.model.settings(kernel, table.len());
        let mut watcher = |progress| report::show_step(&bar, &kernel.to_string(), k * args.folds, progress);
        all.push(
            gpr::cross_validate(&table, &settings, args.folds, &mut watcher)
                .map_err(|error| args.files.fault(error))?,
        );
    }
    bar.finish_and_clear();
    if let Some(path) = &args.predictions {
        gpr::write_validated(path, &table, &all).map_err(failure)?;
    }
    if let Some(folder) = &args.plots {
        gpr::write_cross_validation(folder, &table, &all).map_err(failure)?;
    }
    let settings = args.model.settings(&args.kernel[0], table.len());
    let shown = report::CvReport {
        table: &table,
        settings: &settings,
        folds: args.folds,
        all: &all,
        default_form: args.model.by_rows(),
    };
    let seconds = begin.elapsed().as_secs_f64();
    unless_closed(if args.json { shown.json(seconds) } else { shown.table(seconds) })
}

fn train(args: &TrainArgs) -> Result<(), Failure> {
    let begin = Instant::now();
    args.files.check_result(&args.out)?;
    let table = args.columns.table(&args.files)?;
    let settings = args.model.settings(&args.kernel, table.len());
    let bar = report::fit_bar(1);
    let mut watcher = |progress| report::show_step(&bar, &args.kernel.to_string(), 0, progress);
    let trained = TrainedModel::fit(&table, &settings, &mut watcher).map_err(|error| args.files.fault(error))?;
    bar.finish_and_clear();
    let seconds = begin.elapsed().as_secs_f64();
    trained.save(&args.out).map_err(failure)?;
    let shown = report::TrainReport { trained: &trained, table: &table, seconds, default_form: args.model.by_rows() };
    unless_closed(if args.json { shown.json() } else { shown.table(&args.out) })
}

fn predict(args: &PredictArgs) -> Result<(), Failure> {
    let to_stdout = args.out == Path::new("-");
    if args.json && to_stdout {
        return Err(Failure::new("--json and the predictions cannot both go to standard output; add --out FILE.csv"));
    }
    args.files.check_result(&args.out)?;
    let trained = TrainedModel::load(&args.model, args::threads(args.threads)).map_err(failure)?;
    let output = [trained.output.clone()];
    let wanted = ColumnSelection { columns: &trained.inputs, optional: &output, missing: args.files.missing() };
    let table = ColumnTable::read(&args.files.files, &wanted, &PartColumn::None).map_err(failure)?;
    let predictions = trained.predict(&table).map_err(failure)?;
    match gpr::write_predictions(&args.out, &trained, &table, &predictions) {
        // If the reader has closed the output early, this is not an error.
        Err(error) if to_stdout && error.to_string().contains("Broken pipe") => return Ok(()),
        written => written.map_err(failure)?,
    }
    let known = |row: &usize| !table.row(*row)[trained.inputs.len()].is_nan();
    let rows: Vec<usize> = (0..table.len()).filter(known).collect();
    let truth: Vec<f64> = rows.iter().map(|row| table.row(*row)[trained.inputs.len()]).collect();
    let judged: Vec<_> = rows.iter().map(|row| predictions[*row]).collect();
    let score = (!rows.is_empty()).then(|| score(&judged, &truth));
    let shown = report::PredictReport { trained: &trained, table: &table, known: rows.len(), score };
    if args.json {
        return unless_closed(shown.json());
    }
    unless_closed(shown.text(to_stdout))
}
