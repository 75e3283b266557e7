//! Applies Gaussian process regression to files: tables, cross-validation, trained models, predictions, forecasts,
//! pictures.
//!
//! [`ColumnTable`] reads columns of CSV files. [`cross_validate`] cross-validates one kernel on a table.
//! [`TrainedModel`] is a model with the names of its columns that can be saved and loaded. [`forecast`] predicts future
//! rows from past rows, without future inputs. The arithmetic is in [`crate::regress`].

pub mod forecast;
mod pictures;
mod table;
mod trained;

use std::path::Path;
use std::time::Instant;

use crate::error::LabError;
use crate::io::result_file::ResultFile;
use crate::regress::{self, Folds, GprSettings, Prediction, PredictionScore, ProgressCallback, TrainingRows};

pub use pictures::{write_cross_validation, write_forecast};
pub use table::{ColumnSelection, ColumnTable, MissingPolicy, PartColumn};
pub use trained::{TrainedModel, write_predictions};

/// Result of the cross-validation of one kernel.
#[derive(Debug, Clone)]
pub struct CrossValidation {
    /// The kernel, as text.
    pub kernel: String,
    /// Predictions of all rows, and the folds.
    pub folds: Folds,
    /// Errors over all rows.
    pub score: PredictionScore,
    /// Duration of the cross-validation (s).
    pub seconds: f64,
    /// Peak memory of the process during the cross-validation (KiB); `None` = the system does not report it.
    pub peak_kib: Option<u64>,
}

/// Returns the inputs (all columns except the last, row by row) and the targets (the last column).
pub fn split(table: &ColumnTable) -> (Vec<f64>, Vec<f64>) {
    let width = table.width();
    let inputs = table.values.chunks_exact(width).flat_map(|row| row[..width - 1].iter().copied()).collect();
    (inputs, table.column(width - 1).collect())
}

/// Cross-validates one kernel on a table whose last column is the output.
///
/// # Errors
/// There are too few rows for the folds, a setting is out of range, or the watcher stopped the work.
pub fn cross_validate(
    table: &ColumnTable,
    settings: &GprSettings,
    folds: usize,
    watcher: &mut ProgressCallback<'_>,
) -> Result<CrossValidation, LabError> {
    let (inputs, targets) = split(table);
    let rows = TrainingRows { inputs: &inputs, dimensions: table.width() - 1, targets: &targets, lines: &table.lines };
    reset_peak();
    let begin = Instant::now();
    let folds = regress::cross_validate(&rows, settings, folds, &|| begin.elapsed().as_secs_f64(), watcher)?;
    let score = regress::score(&folds.predictions, &targets);
    let seconds = begin.elapsed().as_secs_f64();
    Ok(CrossValidation { kernel: settings.kernel.to_string(), folds, score, seconds, peak_kib: peak_kib() })
}

/// Writes the cross-validated prediction of every row for each kernel.
///
/// # Errors
/// The file cannot be written.
pub fn write_validated(path: &Path, table: &ColumnTable, all: &[CrossValidation]) -> Result<(), LabError> {
    let output = &table.names[table.width() - 1];
    let own = ["kernel", "file", "line", "fold"].map(str::to_owned);
    let named = ["mean", "std", "low_95", "high_95"].map(|word| table::derived(output, word));
    let rows = all.iter().flat_map(|validated| (0..table.len()).map(move |row| (validated, row)));
    let rows = rows.map(|(validated, row)| {
        let file = table.file_of(row).display().to_string();
        let fold = (validated.folds.fold_of_row[row] + 1).to_string();
        let truth = table.row(row)[table.width() - 1].to_string();
        let own = [validated.kernel.clone(), file, table.lines[row].to_string(), fold, truth];
        own.into_iter().chain(interval(&validated.folds.predictions[row])).collect()
    });
    write_csv(path, own.into_iter().chain([output.clone()]).chain(named).collect(), rows)
}

/// Writes a CSV file. If writing fails, no partial file is left.
fn write_csv(path: &Path, heads: Vec<String>, rows: impl Iterator<Item = Vec<String>>) -> Result<(), LabError> {
    let mut out = csv::Writer::from_writer(ResultFile::create(path)?);
    out.write_record(heads)?;
    for row in rows {
        out.write_record(row)?;
    }
    let file = out.into_inner().map_err(|error| LabError::Data(error.error().to_string()))?;
    Ok(file.finish()?)
}

fn interval(p: &Prediction) -> [String; 4] {
    [p.mean, p.measurement_variance.sqrt(), p.low_95, p.high_95].map(|number| number.to_string())
}

/// Resets the recorded peak memory, so that the next peak belongs to the next kernel. If this fails, the peaks are
/// upper bounds because they cover the time since the process started.
fn reset_peak() {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Returns the peak memory of the process in KiB (VmHWM of /proc/self/status).
pub fn peak_kib() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?.trim().strip_suffix("kB")?.trim().parse().ok()
}
