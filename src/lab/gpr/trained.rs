//! Defines a regression model that stores the names of its columns.
//!
//! The file has one line of JSON with the names of the columns, followed by the two lines of [`Model`], which have a
//! checksum.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{ColumnTable, interval, split, table, write_csv};

use crate::error::LabError;
use crate::io::json::json_fault;
use crate::regress::{GprSettings, Model, Prediction, ProgressCallback, TrainingRows, fit};
use packwatch_host::bounded_file;

const FORMAT: &str = "packwatch gpr";
/// Version of the format. Other versions are rejected.
const VERSION: u32 = 1;
/// Maximum size of a file (bytes). The largest model is smaller.
const MAX_BYTES: u64 = 1 << 32;

/// A fitted model and the names of its columns.
#[derive(Debug)]
pub struct TrainedModel {
    /// Column that is predicted.
    pub output: String,
    /// Columns from which the output is predicted, in the order of the model.
    pub inputs: Vec<String>,
    /// The Gaussian process.
    pub model: Model,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelHeader {
    format: String,
    version: u32,
    output: String,
    inputs: Vec<String>,
}

impl TrainedModel {
    /// Fits a model to a table whose last column is the output.
    ///
    /// # Errors
    /// There are too few rows, a setting is out of range, a matrix is not positive definite, or the watcher stopped the
    /// work.
    pub fn fit(
        table: &ColumnTable,
        settings: &GprSettings,
        watcher: &mut ProgressCallback<'_>,
    ) -> Result<Self, LabError> {
        let (inputs, targets) = split(table);
        let width = table.width();
        let rows = TrainingRows { inputs: &inputs, dimensions: width - 1, targets: &targets, lines: &table.lines };
        let model = fit(&rows, settings, watcher)?;
        Ok(Self { output: table.names[width - 1].clone(), inputs: table.names[..width - 1].to_vec(), model })
    }

    /// Writes the model.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), LabError> {
        let names = ModelHeader {
            format: FORMAT.to_owned(),
            version: VERSION,
            output: self.output.clone(),
            inputs: self.inputs.clone(),
        };
        let names = serde_json::to_string(&names)?;
        Ok(crate::write_file(path, format!("{names}\n{}", self.model.save()?).as_bytes())?)
    }

    /// Reads a model. Its predictions use `threads` threads.
    ///
    /// # Errors
    /// The file cannot be read, is not a model of this kind, is damaged, or has another version.
    pub fn load(path: &Path, threads: usize) -> Result<Self, LabError> {
        let fail = |what: String| LabError::Data(format!("{}: {what}", path.display()));
        let unread =
            |error: std::io::Error| LabError::of_io(format!("{}: cannot be read: {error}", path.display()), &error);
        let bytes = bounded_file::read_up_to(path, MAX_BYTES).map_err(unread)?;
        let text = String::from_utf8(bytes).map_err(|error| unread(std::io::Error::other(error)))?;
        let (first, rest) = text
            .split_once('\n')
            .ok_or_else(|| fail("has one line, must have three: not a model file of `packwatch gpr train`".into()))?;
        let names: ModelHeader = serde_json::from_str(first).map_err(|error| {
            fail(format!("line 1: not a model file of `packwatch gpr train`: {}", json_fault(&error)))
        })?;
        if names.format != FORMAT || names.version != VERSION {
            let found = (&names.format, names.version);
            return Err(fail(format!("line 1: found {found:?}, must be {:?}", (FORMAT, VERSION))));
        }
        let model = Model::load(rest, threads).map_err(|fault| fail(format!("from line 2 on: {fault}")))?;
        if model.spec.dimensions != names.inputs.len() {
            let (found, allowed) = (names.inputs.len(), model.spec.dimensions);
            return Err(fail(format!("line 1: {found} inputs, must be {allowed} like in the model")));
        }
        Ok(Self { output: names.output, inputs: names.inputs, model })
    }

    /// Predicts every row of a table whose first columns are the inputs.
    ///
    /// # Errors
    /// A covariance matrix is not positive definite.
    pub fn predict(&self, table: &ColumnTable) -> Result<Vec<Prediction>, LabError> {
        let d = self.inputs.len();
        let inputs: Vec<f64> = table.values.chunks_exact(table.width()).flat_map(|row| &row[..d]).copied().collect();
        Ok(self.model.predict(&inputs)?)
    }
}

/// Writes predictions of the rows of a table. The last column is the output; NaN = unknown.
///
/// # Errors
/// The file cannot be written.
pub fn write_predictions(
    path: &Path,
    trained: &TrainedModel,
    table: &ColumnTable,
    predictions: &[Prediction],
) -> Result<(), LabError> {
    let output = &trained.output;
    let named = ["mean", "std", "low_95", "high_95"].map(|word| table::derived(output, word));
    let heads = ["file".to_owned(), "line".to_owned()].into_iter().chain(trained.inputs.clone());
    let rows = predictions.iter().enumerate().map(|(row, prediction)| {
        let own = [table.file_of(row).display().to_string(), table.lines[row].to_string()];
        let known = table.row(row).iter().map(|value| if value.is_nan() { String::new() } else { value.to_string() });
        own.into_iter().chain(known).chain(interval(prediction)).collect()
    });
    write_csv(path, heads.chain([output.clone()]).chain(named).collect(), rows)
}
