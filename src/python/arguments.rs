//! Handles arguments that several functions share: paths, and the source of a configuration.

use std::path::{Path, PathBuf};

use packwatch_host::config::{self, Config, ConfigFiles};
use packwatch_lab::single_cell::{CellSource, LabelKeys};
use pyo3::conversion::FromPyObjectOwned;
use pyo3::prelude::*;

use crate::error;

/// An argument: a single value or a list of values.
pub(crate) struct List<T>(pub(crate) Vec<T>);

impl<'py, T: FromPyObjectOwned<'py>> FromPyObject<'_, 'py> for List<T> {
    type Error = PyErr;

    fn extract(value: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        value.extract().map(|one| Self(vec![one])).or_else(|_| value.extract().map(Self))
    }
}

pub(crate) fn of_json<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("json")?.call_method1("loads", (text,))
}

/// Loads a configuration from text. The files that it names are relative to `folder`.
pub(crate) fn of_text(text: &str, folder: &Path) -> PyResult<Config> {
    let main = folder.join("configuration.toml");
    let read = |file: &Path| if file == main { Ok(text.as_bytes().to_vec()) } else { std::fs::read(file) };
    config::load_with(&ConfigFiles::alone(&main), &read).map_err(error::config)
}

/// Checks the arguments that give the configuration of a single cell, and combines them.
pub(crate) fn cell_source(
    config: Option<PathBuf>,
    cell: Option<PathBuf>,
    label: (Option<String>, Option<f64>, Option<f64>, Option<f64>),
) -> PyResult<CellSource> {
    let (chemistry, rated_ah, voltage_min_v, voltage_max_v) = label;
    if chemistry.is_some() && (config.is_some() || cell.is_some()) {
        return Err(error::data("chemistry cannot be given with config or cell; give one of them"));
    }
    let label = [("rated_ah", rated_ah), ("voltage_min_v", voltage_min_v), ("voltage_max_v", voltage_max_v)];
    if chemistry.is_none()
        && let Some((name, _)) = label.iter().find(|(_, value)| value.is_some())
    {
        return Err(error::data(format!("{name} needs chemistry")));
    }
    let label = chemistry.map(|chemistry| LabelKeys { chemistry, rated_ah, voltage_min_v, voltage_max_v });
    Ok(CellSource { config, cell, label })
}

/// Total size of files, bytes; unreadable files count as 0.
pub(crate) fn bytes(files: &[PathBuf]) -> u64 {
    files.iter().filter_map(|path| std::fs::metadata(path).ok()).map(|found| found.len()).sum()
}
