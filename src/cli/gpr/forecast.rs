//! `packwatch gpr forecast`: forecasts future rows from past rows.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Instant;

use serde_json::{Value, json};

use super::args::{FileArgs, GRAMMAR, ModelArgs};
use super::report::{VERSION, fit_bar, form, mebibytes, score_json, short, show_fits, skipped};
use super::{ColumnSelection, ColumnTable, PartColumn, read};
use crate::cli::common::numbers::{percent, whole};
use crate::cli::common::output::{create_folder, failure, print_json, unless_closed, write_table};
use crate::lab::gpr::forecast::{
    self, ForecastPlan, HorizonForecast, MAX_LAGS, MAX_STEPS, OutputForecast, RowSpacing, TableForecast, horizons,
};
use crate::lab::gpr::{self, peak_kib};
use crate::regress::Kernel;
use packwatch_host::failure::Failure;

/// Arguments of `gpr forecast`.
#[derive(Debug, clap::Args)]
#[command(after_help = GRAMMAR)]
pub(super) struct ForecastArgs {
    #[command(flatten)]
    files: FileArgs,
    /// Columns to forecast
    #[arg(long, value_name = "COLUMN,..", value_delimiter = ',', required = true)]
    outputs: Vec<String>,
    /// Additional columns whose past is used; their future is not needed
    #[arg(long, value_name = "COLUMN,..", value_delimiter = ',')]
    inputs: Vec<String>,
    /// Number of values of each column that a forecast uses: the last ones before the origin
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = whole::<1, MAX_LAGS>)]
    lags: usize,
    /// Rows to forecast ahead. Up to 10: every horizon from 1 to N; more: 10 horizons, spaced geometrically
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = whole::<1, MAX_STEPS>)]
    steps: usize,
    /// Rows known at the origin, percent; forecasts are scored on later rows. 100 forecasts the unknown future
    #[arg(long, value_name = "PERCENT", default_value_t = 70.0, value_parser = percent)]
    origin: f64,
    /// Use only every N-th row of each part
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = whole::<1, 1_000_000>)]
    every: usize,
    /// Column whose value separates unrelated parts; none disables the separation [default: cycle, segment or ref, if there is such a
    /// column]
    #[arg(long, value_name = "COLUMN")]
    part: Option<String>,
    /// Covariance function
    #[arg(long, value_name = "KERNEL", default_value = "exponential")]
    kernel: Kernel,
    /// Maximum number of past rows that each forecast learns from, evenly selected
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = whole::<20, 20_000>)]
    rows: usize,
    #[command(flatten)]
    model: ModelArgs,
    /// Write every forecast to this file
    #[arg(long, value_name = "FILE.csv")]
    predictions: Option<PathBuf>,
    /// Write SVG plots into this folder: the fan at the origin, error and coverage over the horizon
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A forecast with its plan.
struct ForecastReport<'a> {
    table: &'a ColumnTable,
    plan: &'a ForecastPlan,
    forecast: &'a TableForecast,
    steps: Option<RowSpacing>,
    seconds: f64,
}

pub(super) fn run(args: &ForecastArgs) -> Result<(), Failure> {
    let begin = Instant::now();
    args.plots.iter().try_for_each(|folder| create_folder(folder))?;
    args.predictions.iter().try_for_each(|path| args.files.check_result(path))?;
    let table = args.table()?;
    let settings = args.model.settings(&args.kernel, args.rows.min(table.len()));
    let (outputs, origin) = (args.outputs.len(), args.origin / 100.0);
    let plan = ForecastPlan { outputs, lags: args.lags, steps: args.steps, origin, rows: args.rows, settings };
    let bar = fit_bar(outputs * horizons(args.steps).len());
    let mut done = |fits, _| show_fits(&bar, fits, "forecasts");
    let made = forecast::run(&table, &plan, &mut |_| ControlFlow::Continue(()), &mut done);
    bar.finish_and_clear();
    let made = made.map_err(failure)?;
    if let Some(path) = &args.predictions {
        forecast::write(path, &table, &made).map_err(failure)?;
    }
    if let Some(folder) = &args.plots {
        gpr::write_forecast(folder, &table, &made).map_err(failure)?;
    }
    let steps = if table.has[0] { RowSpacing::of(&table, table.width() - 1) } else { None };
    let seconds = begin.elapsed().as_secs_f64();
    let shown = ForecastReport { table: &table, plan: &plan, forecast: &made, steps, seconds };
    unless_closed(if args.json { shown.json() } else { shown.table() })
}

impl ForecastArgs {
    /// Reads outputs, inputs and, if present, the time.
    fn table(&self) -> Result<ColumnTable, Failure> {
        let columns: Vec<String> = self.outputs.iter().chain(&self.inputs).cloned().collect();
        let time = ["time".to_owned()];
        let wanted = ColumnSelection { columns: &columns, optional: &time, missing: self.files.missing() };
        let part = match self.part.as_deref() {
            None => PartColumn::Default,
            Some("none") => PartColumn::None,
            Some(name) => PartColumn::Named(name.to_owned()),
        };
        Ok(read(&self.files.files, &wanted, &part)?.every(self.every))
    }
}

impl ForecastReport<'_> {
    fn table(&self) -> io::Result<()> {
        let mut out = io::stdout().lock();
        self.head(&mut out)?;
        for output in &self.forecast.outputs {
            writeln!(out, "\n{}", output.name)?;
            let judged = output.horizons.iter().any(|horizon| horizon.score.is_some());
            if judged {
                judged_table(&mut out, output)?
            } else {
                future_table(&mut out, output)?
            }
            for horizon in output.horizons.iter().filter(|h| h.jitter.matrices > 0) {
                let (steps, largest) = (horizon.steps, horizon.jitter.largest);
                writeln!(out, "{steps} ahead: jitter, at most {largest:e} of the signal variance")?;
            }
        }
        writeln!(out, "\n{:.1} s in all, peak {} MiB", self.seconds, mebibytes(peak_kib()))
    }

    fn head(&self, out: &mut impl Write) -> io::Result<()> {
        let (table, plan, forecast) = (self.table, self.plan, self.forecast);
        let columns = table.names[..table.width() - table.has.len()].join(", ");
        writeln!(out, "{} rows in {} parts; {} lags of {columns}", table.len(), table.parts.len(), plan.lags)?;
        let (kernel, basis) = (&plan.settings.kernel, format!("{:?}", plan.settings.basis).to_lowercase());
        writeln!(out, "{kernel}, {basis} basis, form {}, a process for every horizon", form(plan.settings.form))?;
        writeln!(out, "origin: {} rows are known; forecast from {}", forecast.origin, table.place(forecast.from))?;
        skipped(out, table)?;
        match self.steps {
            Some(steps) if steps.even() => writeln!(out, "a row ahead is {} of {}", short(steps.median), self.time()),
            Some(steps) => {
                let (median, low, high) = (short(steps.median), short(steps.range.0), short(steps.range.1));
                writeln!(
                    out,
                    "note: rows are unevenly spaced: {} advances by {median} (5 to 95 %: {low} to {high}); a step is one row",
                    self.time()
                )
            }
            None => Ok(()),
        }
    }

    fn time(&self) -> &str {
        self.table.names.last().map_or("", String::as_str)
    }

    fn json(&self) -> io::Result<()> {
        let (table, plan, forecast) = (self.table, self.plan, self.forecast);
        let output = |output: &OutputForecast| json!({ "name": output.name, "horizons": output.horizons.iter().map(horizon_json).collect::<Vec<_>>() });
        let steps =
            self.steps.map(|s| json!({ "median": s.median, "p5": s.range.0, "p95": s.range.1, "even": s.even() }));
        print_json(&json!({
            "version": VERSION, "rows": table.len(), "parts": table.parts.len(), "skipped": table.skipped,
            "columns": table.names[..table.width() - table.has.len()], "lags": plan.lags, "steps": plan.steps,
            "kernel": plan.settings.kernel.to_string(), "form": form(plan.settings.form), "seed": plan.settings.seed,
            "origin_rows": forecast.origin, "from": table.place(forecast.from), "time_step": steps,
            "outputs": forecast.outputs.iter().map(output).collect::<Vec<_>>(), "seconds": self.seconds,
            "peak_memory_kib": peak_kib(),
        }))
    }
}

/// Prints the errors of scored forecasts.
fn judged_table(out: &mut impl Write, output: &OutputForecast) -> io::Result<()> {
    let heads =
        ["ahead", "forecasts", "RMSE", "persistence", "ratio", "mean abs.", "inside 95 %", "width", "trained on"];
    let line = |horizon: &HorizonForecast| {
        let cells = horizon.score.zip(horizon.persistence_rmse).map(|(s, persistence)| {
            [
                short(s.rmse),
                short(persistence),
                format!("{:.2}", s.rmse / persistence),
                short(s.mean_absolute_error),
                format!("{:.1} %", 100.0 * s.coverage_95),
                short(s.mean_width_95),
            ]
        });
        let own = [horizon.steps.to_string(), horizon.held_out.len().to_string()];
        own.into_iter()
            .chain(cells.unwrap_or_else(|| ["-"; 6].map(str::to_owned)))
            .chain([horizon.trained.to_string()])
            .collect()
    };
    write_table(out, &heads, output.horizons.iter().map(line), 0)
}

/// Prints forecasts without measured values.
fn future_table(out: &mut impl Write, output: &OutputForecast) -> io::Result<()> {
    let heads = ["ahead", "mean", "std", "low 95 %", "high 95 %", "trained on"];
    let line = |horizon: &HorizonForecast| {
        let p = &horizon.at_origin;
        let numbers = [p.mean, p.measurement_variance.sqrt(), p.low_95, p.high_95].map(short);
        let own = [horizon.steps.to_string()];
        own.into_iter().chain(numbers).chain([horizon.trained.to_string()]).collect()
    };
    write_table(out, &heads, output.horizons.iter().map(line), 0)
}

fn horizon_json(horizon: &HorizonForecast) -> Value {
    let p = &horizon.at_origin;
    let score = horizon.score.as_ref().map(|score| {
        let mut score = score_json(score);
        score["persistence_rmse"] = json!(horizon.persistence_rmse);
        score
    });
    json!({
        "steps": horizon.steps, "trained": horizon.trained, "calibrated": horizon.calibrated,
        "interval_factor": horizon.factor, "seconds": horizon.fit_s, "jitter": horizon.jitter,
        "at_origin": {
            "mean": p.mean, "std": p.measurement_variance.sqrt(), "low_95": p.low_95, "high_95": p.high_95,
        },
        "forecasts": horizon.held_out.len(), "score": score,
    })
}
