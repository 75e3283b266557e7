//! Implements the Python function `fit`, which fits a cell model to measured files.

use std::path::PathBuf;
use std::time::Instant;

use packwatch_host::io::csv_log::CsvOptions;
use packwatch_lab::fit::{self as lab_fit, FitOutcome, FitProgress, FitRequest};
use pyo3::prelude::*;

use crate::arguments::{List, of_json};
use crate::background_task::{self, Progress};
use crate::cell_model::write;
use crate::error::of_library;

/// A fitted model.
#[pyclass(frozen, module = "packwatch")]
pub(crate) struct Fit {
    request: FitRequest,
    outcome: FitOutcome,
    seconds: f64,
}

#[pymethods]
impl Fit {
    /// Returns the text of the cell model file, as `fit --out` writes it.
    fn text(&self) -> String {
        lab_fit::text(&self.request, &self.outcome)
    }

    /// Writes the cell model file atomically.
    fn write(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| write(&path, &self.text()))
    }

    /// The document of `fit --json`, as a dictionary.
    #[getter]
    fn document<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        of_json(py, &lab_fit::document(&self.outcome, self.seconds).to_string())
    }

    #[getter]
    fn capacity_ah(&self) -> f64 {
        self.outcome.capacity_ah
    }

    /// Root of the mean squared residual (V).
    #[getter]
    fn rmse_v(&self) -> f64 {
        self.outcome.fit.total.rmse_v
    }

    #[getter]
    fn notes(&self) -> Vec<String> {
        self.outcome.notes.clone()
    }

    /// Statements on the accuracy of the model, as `fit` prints them at the end.
    #[getter]
    fn verdict(&self) -> Vec<String> {
        self.outcome.verdict.clone()
    }

    fn __repr__(&self) -> String {
        format!("<packwatch.Fit {:?}, {:.1} mV>", self.request.name, 1e3 * self.rmse_v())
    }
}

/// Fits a cell model to measured files.
#[pyfunction]
#[pyo3(signature = (files, name, *, ocv=None, capacity_ah=None, rated_ah=None, voltage_min_v=None, voltage_max_v=None,
                    ageing_shift=None, branches=None, tau_s=None, temperatures_c=None, soc_nodes=None, first_cycles=None,
                    progress=false))]
#[expect(clippy::too_many_arguments, reason = "keyword arguments of Python")]
pub(crate) fn fit(
    py: Python<'_>,
    files: List<PathBuf>,
    name: String,
    ocv: Option<List<PathBuf>>,
    capacity_ah: Option<f64>,
    rated_ah: Option<f64>,
    voltage_min_v: Option<f64>,
    voltage_max_v: Option<f64>,
    ageing_shift: Option<f64>,
    branches: Option<usize>,
    tau_s: Option<Vec<f64>>,
    temperatures_c: Option<Vec<f64>>,
    soc_nodes: Option<Vec<f64>>,
    first_cycles: Option<usize>,
    progress: bool,
) -> PyResult<Fit> {
    let request = FitRequest {
        table: CsvOptions::default(),
        name,
        capacity_ah,
        rated_ah,
        voltage_min_v,
        voltage_max_v,
        ageing_shift,
        ocv: ocv.map_or_else(Vec::new, |tests| tests.0),
        branches,
        tau_s,
        temperature_c: temperatures_c,
        soc: soc_nodes,
        first_cycles,
        files: files.0,
    };
    let begin = Instant::now();
    let shown = Progress { is_shown: progress, total: None, unit: "step" };
    let outcome = background_task::run(py, shown, |work| {
        // One step of the progress is a file that was read, or one pass of the fit.
        lab_fit::run(&request, |progress: FitProgress| match progress {
            FitProgress::Read(..) | FitProgress::Pass(..) => work.advance(1),
        })
    })?;
    let outcome = outcome.map_err(of_library)?;
    Ok(Fit { request, outcome, seconds: begin.elapsed().as_secs_f64() })
}
