//! Output of `gpr`: progress, tables, JSON.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::Path;

use indicatif::ProgressBar;
use serde_json::{Map, Value, json};

use crate::cli::common::output::{print_json, write_table};
use crate::cli::common::progress::progress_bar;
use crate::lab::gpr::{ColumnTable, CrossValidation, TrainedModel, peak_kib};
use crate::regress::{FitProgress, Fold, Form, GprSettings, Hyperparameter, Jitter, PredictionScore};

pub(super) const VERSION: u32 = 1;
/// Number of progress steps per fit.
const TICKS: usize = 100;

/// Creates a progress bar over a number of fits.
pub(super) fn fit_bar(fits: usize) -> ProgressBar {
    progress_bar((fits * TICKS) as u64, "{bar:32} {percent} % {msg}, {elapsed}, eta {eta}")
}

/// Shows one step of a hyperparameter search. `before` is the number of fits that were finished before the fits with
/// this kernel.
pub(super) fn show_step(bar: &ProgressBar, what: &str, before: usize, p: FitProgress) -> ControlFlow<()> {
    let part = (p.search - 1) * p.max_iterations + p.iteration;
    let whole = (p.searches * p.max_iterations).max(1);
    let done = (before + p.fold - 1) * TICKS + (part * TICKS / whole).min(TICKS - 1);
    bar.set_position(done as u64);
    bar.set_message(format!("{what}, fold {} of {}, step {}", p.fold, p.folds, p.iteration));
    ControlFlow::Continue(())
}

/// Sets the number of finished fits.
pub(super) fn show_fits(bar: &ProgressBar, fits: usize, what: &str) {
    bar.set_position((fits * TICKS) as u64);
    bar.set_message(what.to_owned());
}

pub(super) fn form(form: Form) -> String {
    match form {
        Form::Exact => "exact".to_owned(),
        Form::Nearest { neighbours } => format!("nearest, {neighbours} neighbours"),
    }
}

fn form_note(of: Form, default_form: bool) -> String {
    let why = if default_form { " (chosen by the number of rows; --form overrides it)" } else { "" };
    format!("form {}{why}", form(of))
}

fn basis(settings: &GprSettings) -> String {
    format!("{:?}", settings.basis).to_lowercase()
}

pub(super) fn mebibytes(kib: Option<u64>) -> String {
    kib.map_or_else(|| "-".to_owned(), |kib| format!("{:.0}", kib as f64 / 1024.0))
}

pub(super) fn skipped(out: &mut impl Write, table: &ColumnTable) -> io::Result<()> {
    if table.skipped > 0 {
        writeln!(out, "{} rows left out: a value is missing", table.skipped)?;
    }
    Ok(())
}

fn hyperparameters(all: &[Hyperparameter]) -> Map<String, Value> {
    all.iter().map(|h| (h.name.clone(), json!(h.value))).collect()
}

/// Errors of predictions as JSON.
pub(super) fn score_json(s: &PredictionScore) -> Value {
    json!({
        "rmse": s.rmse, "mean_absolute_error": s.mean_absolute_error, "coverage_95": s.coverage_95,
        "mean_width_95": s.mean_width_95,
    })
}

/// Formats a number with four significant digits, but at most nine decimals.
pub(super) fn short(value: f64) -> String {
    let digits = (3.0 - value.abs().max(1e-12).log10().floor()).clamp(0.0, 9.0) as usize;
    format!("{value:.digits$}")
}

pub(super) struct CvReport<'a> {
    pub(super) table: &'a ColumnTable,
    pub(super) settings: &'a GprSettings,
    pub(super) folds: usize,
    pub(super) all: &'a [CrossValidation],
    pub(super) default_form: bool,
}

fn total(validated: &CrossValidation, of: impl Fn(&Fold) -> f64) -> f64 {
    validated.folds.folds.iter().map(of).sum()
}

/// Over all folds: the number of matrices to whose diagonal a small value (jitter) was added so that they could be
/// factorised, and the largest such value.
fn jitter(validated: &CrossValidation) -> Jitter {
    validated.folds.folds.iter().fold(Jitter::default(), |all, fold| Jitter {
        matrices: all.matrices + fold.jitter.matrices,
        largest: all.largest.max(fold.jitter.largest),
    })
}

impl CvReport<'_> {
    fn inputs(&self) -> &[String] {
        &self.table.names[..self.table.width() - 1]
    }

    fn output(&self) -> &str {
        &self.table.names[self.table.width() - 1]
    }

    pub(super) fn table(&self, seconds: f64) -> io::Result<()> {
        let mut out = io::stdout().lock();
        let (rows, inputs, output) = (self.table.len(), self.inputs().join(", "), self.output());
        writeln!(out, "{output} from {inputs}: {rows} rows, {} folds, seed {}", self.folds, self.settings.seed)?;
        let (form, basis, threads) =
            (form_note(self.settings.form, self.default_form), basis(self.settings), self.settings.threads);
        writeln!(out, "{form}; {basis} basis; {threads} threads")?;
        skipped(&mut out, self.table)?;
        writeln!(
            out,
            "errors in the unit of {output}; inside: held-out rows inside the 95 % interval, width: its mean\n"
        )?;
        let heads =
            ["kernel", "RMSE", "mean abs.", "inside", "width", "training s", "predicting s", "peak MiB", "rows"];
        let line = |validated: &CrossValidation| {
            let s = &validated.score;
            vec![
                validated.kernel.clone(),
                short(s.rmse),
                short(s.mean_absolute_error),
                format!("{:.2} %", 100.0 * s.coverage_95),
                short(s.mean_width_95),
                format!("{:.1}", total(validated, |fold| fold.fit_s)),
                format!("{:.1}", total(validated, |fold| fold.predict_s)),
                mebibytes(validated.peak_kib),
                validated.folds.predictions.len().to_string(),
            ]
        };
        write_table(&mut out, &heads, self.all.iter().map(line), 1)?;
        for validated in self.all {
            let jitter = jitter(validated);
            if jitter.matrices > 0 {
                let (kernel, count, most) = (&validated.kernel, jitter.matrices, jitter.largest);
                writeln!(out, "{kernel}: jitter on {count} matrices, at most {most:e} of the signal variance")?;
            }
        }
        writeln!(out, "\n{seconds:.1} s in all")
    }

    pub(super) fn json(&self, seconds: f64) -> io::Result<()> {
        let fold = |fold: &Fold| {
            json!({
                "held_out": fold.held_out, "training_s": fold.fit_s, "prediction_s": fold.predict_s,
                "log_marginal_likelihood": fold.log_marginal_likelihood,
                "interval_factor": fold.interval_factor, "hyperparameters": hyperparameters(&fold.hyperparameters),
            })
        };
        let kernel = |validated: &CrossValidation| {
            let s = &validated.score;
            json!({
                "kernel": validated.kernel, "rmse": s.rmse, "mean_absolute_error": s.mean_absolute_error,
                "coverage_95": s.coverage_95, "gaussian_coverage_95": s.gaussian_coverage_95,
                "mean_width_95": s.mean_width_95, "training_s": total(validated, |fold| fold.fit_s),
                "prediction_s": total(validated, |fold| fold.predict_s), "seconds": validated.seconds,
                "peak_memory_kib": validated.peak_kib, "jitter": jitter(validated),
                "folds": validated.folds.folds.iter().map(fold).collect::<Vec<_>>(),
            })
        };
        print_json(&json!({
            "version": VERSION, "output": self.output(), "inputs": self.inputs(), "rows": self.table.len(),
            "skipped": self.table.skipped, "folds": self.folds, "seed": self.settings.seed,
            "form": form(self.settings.form), "basis": basis(self.settings), "threads": self.settings.threads,
            "seconds": seconds, "kernels": self.all.iter().map(kernel).collect::<Vec<_>>(),
        }))
    }
}

pub(super) struct TrainReport<'a> {
    pub(super) trained: &'a TrainedModel,
    pub(super) table: &'a ColumnTable,
    pub(super) seconds: f64,
    pub(super) default_form: bool,
}

impl TrainReport<'_> {
    pub(super) fn table(&self, path: &Path) -> io::Result<()> {
        let mut out = io::stdout().lock();
        let (trained, model) = (self.trained, &self.trained.model);
        writeln!(out, "{} from {}: {} rows", trained.output, trained.inputs.join(", "), model.rows())?;
        writeln!(out, "{}; {:?} basis", form_note(model.spec.form, self.default_form), model.spec.basis)?;
        skipped(&mut out, self.table)?;
        for h in model.hyperparameters() {
            writeln!(out, "  {:<40} {}", h.name, short(h.value))?;
        }
        if model.outcome.jitter.matrices > 0 {
            let jitter = model.outcome.jitter;
            writeln!(
                out,
                "jitter on {} matrices, at most {:e} of the signal variance",
                jitter.matrices, jitter.largest
            )?;
        }
        let (steps, likelihood) = (model.outcome.iterations, model.log_marginal_likelihood());
        let peak = mebibytes(peak_kib());
        writeln!(
            out,
            "log marginal likelihood {likelihood:.1} after {steps} steps, {:.1} s, peak {peak} MiB",
            self.seconds
        )?;
        writeln!(out, "written to {}", path.display())
    }

    pub(super) fn json(&self) -> io::Result<()> {
        let (trained, model) = (self.trained, &self.trained.model);
        print_json(&json!({
            "version": VERSION, "output": trained.output, "inputs": trained.inputs, "rows": model.rows(),
            "skipped": self.table.skipped, "kernel": model.spec.kernel.to_string(), "form": form(model.spec.form),
            "basis": format!("{:?}", model.spec.basis).to_lowercase(),
            "hyperparameters": hyperparameters(&model.hyperparameters()),
            "log_marginal_likelihood": model.log_marginal_likelihood(), "steps": model.outcome.iterations,
            "interval_factor": model.interval_factor(), "jitter": model.outcome.jitter,
            "seconds": self.seconds, "peak_memory_kib": peak_kib(),
        }))
    }
}

/// Report on predictions of a saved model.
pub(super) struct PredictReport<'a> {
    pub(super) trained: &'a TrainedModel,
    pub(super) table: &'a ColumnTable,
    pub(super) known: usize,
    pub(super) score: Option<PredictionScore>,
}

impl PredictReport<'_> {
    /// Prints a summary. If the rows go to standard output, the summary goes to standard error.
    pub(super) fn text(&self, to_stderr: bool) -> io::Result<()> {
        let mut text = Vec::new();
        let (rows, output) = (self.table.len(), &self.trained.output);
        writeln!(text, "{rows} rows of {output} predicted, {} of them known", self.known)?;
        skipped(&mut text, self.table)?;
        if let Some(s) = &self.score {
            let (rmse, mean, inside, width) =
                (short(s.rmse), short(s.mean_absolute_error), 100.0 * s.coverage_95, short(s.mean_width_95));
            writeln!(
                text,
                "RMSE {rmse}, mean absolute error {mean}, {inside:.2} % inside the 95 % interval, its mean width {width}"
            )?;
        }
        if to_stderr { io::stderr().write_all(&text) } else { io::stdout().write_all(&text) }
    }

    pub(super) fn json(&self) -> io::Result<()> {
        print_json(&json!({
            "version": VERSION, "output": self.trained.output, "rows": self.table.len(), "known": self.known,
            "skipped": self.table.skipped, "score": self.score.as_ref().map(score_json),
        }))
    }
}
