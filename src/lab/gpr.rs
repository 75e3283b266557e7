//! Gaussian process regression on files: tables in, cross-validation, trained models, predictions, forecasts, pictures.
//!
//! [`Table`] reads columns of CSV files; [`cross_validate`] makes the paper's experiment; [`Trained`] is a model with the
//! names of its columns, saved and loaded; [`forecast`] predicts rows to come from rows that were, without inputs of the
//! future. The arithmetic is [`crate::regress`]. Nothing here prints.

pub mod forecast;
mod pictures;
mod table;
mod trained;

use std::io::Write as _;
use std::path::Path;
use std::time::Instant;

pub use pictures::{write_cross_validation, write_forecast};
pub use table::{Missing, PartColumn, Table, Wanted};
pub use trained::{Trained, write_predictions};

use crate::io::result_file::ResultFile;
use crate::regress::{self, Folds, GprSettings, PredictionScore, ProgressCallback, TrainingRows};

/// Why there is no regression.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct GprError(pub String);

impl From<regress::RegressionError> for GprError {
    fn from(fault: regress::RegressionError) -> Self {
        Self(fault.to_string())
    }
}

impl From<csv::Error> for GprError {
    fn from(error: csv::Error) -> Self {
        Self(error.to_string())
    }
}

/// Cross-validation of one kernel.
#[derive(Debug, Clone)]
pub struct Validated {
    /// The kernel, as text.
    pub kernel: String,
    /// Predictions of all rows, and the folds.
    pub folds: Folds,
    /// Errors over all rows.
    pub score: PredictionScore,
    /// Time of the whole experiment with this kernel, s.
    pub seconds: f64,
    /// Most memory the process held meanwhile, KiB; `None` where the system does not say.
    pub peak_kib: Option<u64>,
}

/// Inputs (all columns but the last, row after row) and targets (the last).
pub fn split(table: &Table) -> (Vec<f64>, Vec<f64>) {
    let width = table.width();
    let inputs = table.values.chunks_exact(width).flat_map(|row| row[..width - 1].iter().copied()).collect();
    (inputs, table.column(width - 1).collect())
}

/// Cross-validates one kernel on a table whose last column is the output.
///
/// # Errors
/// Too few rows for the folds, settings out of range, or the watcher gave up.
pub fn cross_validate(
    table: &Table,
    settings: &GprSettings,
    folds: usize,
    watcher: &mut ProgressCallback<'_>,
) -> Result<Validated, GprError> {
    let (inputs, targets) = split(table);
    let rows = TrainingRows { inputs: &inputs, dimensions: table.width() - 1, targets: &targets, lines: &table.lines };
    forget_peak();
    let begin = Instant::now();
    let folds = regress::cross_validate(&rows, settings, folds, &|| begin.elapsed().as_secs_f64(), watcher)?;
    let score = regress::score(&folds.predictions, &targets);
    let seconds = begin.elapsed().as_secs_f64();
    Ok(Validated { kernel: settings.kernel.to_string(), folds, score, seconds, peak_kib: peak_kib() })
}

/// Writes what the cross-validation predicted for every row, by kernel.
///
/// # Errors
/// The file cannot be written.
pub fn write_validated(path: &Path, table: &Table, all: &[Validated]) -> Result<(), GprError> {
    let output = &table.names[table.width() - 1];
    let mut out = csv::Writer::from_writer(create(path)?);
    let own = ["kernel", "file", "line", "fold"].map(str::to_owned);
    let named = ["mean", "std", "low_95", "high_95"].map(|word| table::derived(output, word));
    out.write_record(own.iter().chain([output]).chain(&named))?;
    for validated in all {
        for (row, p) in validated.folds.predictions.iter().enumerate() {
            let truth = table.row(row)[table.width() - 1];
            let numbers = [truth, p.mean, p.measurement_variance.sqrt(), p.low_95, p.high_95];
            let file = table.file_of(row).display().to_string();
            let fold = (validated.folds.fold_of_row[row] + 1).to_string();
            let own = [validated.kernel.clone(), file, table.lines[row].to_string(), fold];
            out.write_record(own.into_iter().chain(numbers.map(|number| number.to_string())))?;
        }
    }
    finish(out)
}

fn create(path: &Path) -> Result<ResultFile, GprError> {
    ResultFile::create(path).map_err(|error| GprError(error.to_string()))
}

fn finish(out: csv::Writer<ResultFile>) -> Result<(), GprError> {
    let file = out.into_inner().map_err(|error| GprError(error.error().to_string()))?;
    file.finish().map_err(|error| GprError(error.to_string()))
}

/// Writes a text as a whole or not at all.
fn write_text(path: &Path, text: &str) -> Result<(), GprError> {
    let mut file = create(path)?;
    file.write_all(text.as_bytes()).map_err(|error| GprError(error.to_string()))?;
    file.finish().map_err(|error| GprError(error.to_string()))
}

/// Sets the kernel's note of the most memory held back to what is held now, so that the next peak is its own. Where that
/// cannot be done the peaks are those since the start of the process: still true as a bound.
fn forget_peak() {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// The most memory the process held, KiB: VmHWM of /proc/self/status.
pub fn peak_kib() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?.trim().strip_suffix("kB")?.trim().parse().ok()
}
