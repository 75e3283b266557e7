//! Implements the Python function `rul`, which forecasts the remaining useful life from measured capacity histories.

use std::path::PathBuf;

use packwatch_host::io::paths::{check_distinct, short_names};
use packwatch_lab::error::LabError;
use packwatch_lab::rul::{self as lab_rul, History, Threshold};
use pyo3::prelude::*;

use crate::arguments::{List, of_json};
use crate::background_task::{self, BackgroundTask, Progress};
use crate::error::{data, of_library};

/// An end of life: Ah, or a string such as "70 %".
#[derive(FromPyObject)]
pub(crate) enum EndOfLife {
    AmpereHours(f64),
    Text(String),
}

/// Forecasts the remaining life at the end of each history. With `at`, forecasts it at these fractions of the life
/// instead, and scores the forecasts.
#[pyfunction]
#[pyo3(signature = (files, end_of_life, *, at=None, alpha=0.2))]
pub(crate) fn rul<'py>(
    py: Python<'py>,
    files: List<PathBuf>,
    end_of_life: List<EndOfLife>,
    at: Option<Vec<f64>>,
    alpha: f64,
) -> PyResult<Bound<'py, PyAny>> {
    let files = files.0;
    let thresholds = end_of_life.0.into_iter().map(EndOfLife::threshold).collect::<PyResult<Vec<Threshold>>>()?;
    if let Some(part) = at.iter().flatten().chain([&alpha]).find(|part| !(**part > 0.0 && **part < 1.0)) {
        return Err(data(format!("at or alpha = {part}, must be above 0 and below 1")));
    }
    for (name, is_empty) in [
        ("files", files.is_empty()),
        ("end_of_life", thresholds.is_empty()),
        ("at", at.as_ref().is_some_and(Vec::is_empty)),
    ] {
        if is_empty {
            return Err(data(format!("no {name}, must be one or more")));
        }
    }
    check_distinct(&files).map_err(data)?;
    let document =
        background_task::run(py, Progress::hidden(), |work| document(&files, &thresholds, at.as_deref(), alpha, work))?;
    let document = document.map_err(of_library)?;
    of_json(py, &document)
}

/// Builds the document with the forecasts. Without `at`, they start at the end of each history. With `at`, they start
/// at these fractions of the life and are scored.
fn document(
    files: &[PathBuf],
    thresholds: &[Threshold],
    at: Option<&[f64]>,
    alpha: f64,
    work: &BackgroundTask,
) -> Result<String, LabError> {
    let progress = || work.advance(1);
    let (mut now, mut scored) = (Vec::new(), Vec::new());
    for (path, name) in files.iter().zip(short_names(files)) {
        let history = History::read(path)?;
        for &end in thresholds {
            progress();
            match at {
                None => now.push(lab_rul::now(&history, &name, end)),
                Some(at) => scored.push(lab_rul::score(&history, &name, end, at, alpha, &progress)),
            }
        }
    }
    if at.is_none() { lab_rul::now_json(&now) } else { lab_rul::scored_json(&scored, alpha) }
}

impl EndOfLife {
    fn threshold(self) -> PyResult<Threshold> {
        let text = match self {
            Self::AmpereHours(ah) => ah.to_string(),
            Self::Text(text) => text,
        };
        text.parse().map_err(|what| data(format!("end_of_life {text:?}: {what}")))
    }
}
