//! `rul`: remaining useful life of measured capacity histories.

use packwatch_host::io::paths::{check_distinct, short_names};
use packwatch_lab::error::LabError;
use packwatch_lab::rul::{self as lab_rul, History, Threshold};
use pyo3::prelude::*;

use crate::arguments::Paths;
use crate::error::{data, of_library};
use crate::work::{self, Progress};

/// An end of life: Ah, or a text like "70 %".
#[derive(FromPyObject)]
pub(crate) enum End {
    AmpereHours(f64),
    Text(String),
}

/// One or several.
#[derive(FromPyObject)]
pub(crate) enum Ends {
    One(End),
    Several(Vec<End>),
}

/// Forecasts the remaining life at the end of histories, or at parts of the life.
#[pyfunction]
#[pyo3(signature = (files, end_of_life, *, at=None, alpha=0.2))]
pub(crate) fn rul<'py>(
    py: Python<'py>,
    files: Paths,
    end_of_life: Ends,
    at: Option<Vec<f64>>,
    alpha: f64,
) -> PyResult<Bound<'py, PyAny>> {
    let (files, at) = (files.list(), at.unwrap_or_default());
    let ends = match end_of_life {
        Ends::One(end) => vec![end],
        Ends::Several(ends) => ends,
    };
    let thresholds = ends.into_iter().map(End::threshold).collect::<PyResult<Vec<Threshold>>>()?;
    if let Some(part) = at.iter().chain([&alpha]).find(|part| !(**part > 0.0 && **part < 1.0)) {
        return Err(data(format!("at and alpha: found {part}, must be above 0 and below 1")));
    }
    check_distinct(&files).map_err(data)?;
    let document =
        work::run(py, Progress { is_shown: false, total: None, unit: "" }, |_| -> Result<String, LabError> {
            let mut histories = Vec::new();
            for (path, name) in files.iter().zip(short_names(&files)) {
                histories.push((History::read(path)?, name));
            }
            let all =
                histories.iter().flat_map(|(history, name)| thresholds.iter().map(move |end| (history, name, *end)));
            if at.is_empty() {
                return lab_rul::now_json(
                    &all.map(|(history, name, end)| lab_rul::now(history, name, end)).collect::<Vec<_>>(),
                );
            }
            let scored: Vec<_> =
                all.map(|(history, name, end)| lab_rul::score(history, name, end, &at, alpha)).collect();
            lab_rul::scored_json(&scored, alpha)
        })?;
    let document = document.map_err(of_library)?;
    py.import("json")?.call_method1("loads", (document,))
}

impl End {
    fn threshold(self) -> PyResult<Threshold> {
        let text = match self {
            Self::AmpereHours(ah) => ah.to_string(),
            Self::Text(text) => text,
        };
        text.parse().map_err(|what| data(format!("end_of_life {text:?}: {what}")))
    }
}
