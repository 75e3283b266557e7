//! Implements the Python function `score`, which compares estimates with the truth of measured files.

use std::path::PathBuf;

use packwatch_lab::score::{ScoreReport, ScoreRequest, Start};
use pyo3::prelude::*;

use crate::arguments::{List, bytes, cell_source, of_json};
use crate::background_task::{self, Progress};
use crate::error::{data, of_library, of_request};

/// Scores of the estimates, one per file and case. A case states the row, the SOC and the capacity with which the
/// estimator starts.
#[pyclass(frozen, module = "packwatch")]
pub(crate) struct Score(ScoreReport);

#[pymethods]
impl Score {
    /// Returns the document of `score --json`, including the final line feed.
    fn json(&self) -> PyResult<String> {
        self.0.json().map_err(data)
    }

    /// Returns the tables of `score`.
    fn table(&self) -> String {
        self.0.table()
    }

    /// The document as a dictionary.
    #[getter]
    fn document<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        of_json(py, &self.json()?)
    }

    /// One dictionary per file and case.
    #[getter]
    fn scores<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.document(py)?.get_item("scores")
    }

    fn __str__(&self) -> String {
        self.table()
    }
}

/// Replays measured files and compares the estimates with the truth.
#[pyfunction]
#[pyo3(signature = (files, *, config=None, cell=None, chemistry=None, rated_ah=None, voltage_min_v=None, voltage_max_v=None,
                    learn=None, start=None, remove=None, soc_error_points=None, soc_std_points=None,
                    capacity_error_percent=None, capacity_std_percent=None, current_offset_a=None, settle_s=None,
                    truth_capacity_ah=None, sleep_gap_s=None, cycles=None, load=None, threshold_ah=None, skip_cycles=None,
                    window=None, seeds=None, plots=None, progress=false))]
#[expect(clippy::too_many_arguments, reason = "keyword arguments of Python")]
pub(crate) fn score(
    py: Python<'_>,
    files: List<PathBuf>,
    config: Option<PathBuf>,
    cell: Option<PathBuf>,
    chemistry: Option<String>,
    rated_ah: Option<f64>,
    voltage_min_v: Option<f64>,
    voltage_max_v: Option<f64>,
    learn: Option<List<PathBuf>>,
    start: Option<List<String>>,
    remove: Option<f64>,
    soc_error_points: Option<List<Option<f64>>>,
    soc_std_points: Option<f64>,
    capacity_error_percent: Option<List<f64>>,
    capacity_std_percent: Option<f64>,
    current_offset_a: Option<List<f64>>,
    settle_s: Option<f64>,
    truth_capacity_ah: Option<f64>,
    sleep_gap_s: Option<f64>,
    cycles: Option<List<PathBuf>>,
    load: Option<[f64; 3]>,
    threshold_ah: Option<f64>,
    skip_cycles: Option<usize>,
    window: Option<(f64, f64)>,
    seeds: Option<Vec<u64>>,
    plots: Option<PathBuf>,
    progress: bool,
) -> PyResult<Score> {
    if seeds.is_some() && window.is_none() {
        return Err(data("seeds needs window"));
    }
    let usual = ScoreRequest::default();
    let request = ScoreRequest {
        files: files.0,
        source: cell_source(config, cell, (chemistry, rated_ah, voltage_min_v, voltage_max_v))?,
        learn: learn.map_or_else(Vec::new, |files| files.0),
        start: start.map_or(Ok(usual.start), |names| names.0.into_iter().map(self::start).collect())?,
        remove: remove.unwrap_or(usual.remove),
        soc_error_points: soc_error_points.map_or(usual.soc_error_points, |points| points.0),
        soc_std_points,
        capacity_error_percent: capacity_error_percent.map_or(usual.capacity_error_percent, |percent| percent.0),
        capacity_std_percent,
        current_offset_a: current_offset_a.map_or(usual.current_offset_a, |ampere| ampere.0),
        settle_s: settle_s.unwrap_or(usual.settle_s),
        truth_capacity_ah,
        table: usual.table,
        sleep_gap_s: sleep_gap_s.unwrap_or(usual.sleep_gap_s),
        cycles: cycles.map_or_else(Vec::new, |tables| tables.0),
        load,
        threshold_ah: threshold_ah.unwrap_or(usual.threshold_ah),
        skip_cycles: skip_cycles.unwrap_or(usual.skip_cycles),
        window,
        seeds: seeds.unwrap_or(usual.seeds),
        plots,
    };
    run(py, &request, progress)
}

fn run(py: Python<'_>, request: &ScoreRequest, is_shown: bool) -> PyResult<Score> {
    let sizes: Vec<f64> = request.files.iter().map(|path| bytes(std::slice::from_ref(path)) as f64).collect();
    let prepared = background_task::run(py, Progress::hidden(), |work| request.prepare(&|| work.advance(1)))?;
    let prepared = prepared.map_err(of_request)?;
    let progress = Progress { is_shown, total: Some(bytes(&request.files)), unit: "B" };
    let report = background_task::run(py, progress, |work| {
        prepared.run(&|file, part| work.advance((part * sizes.get(file).copied().unwrap_or(0.0)).round() as u64))
    })?;
    report.map(Score).map_err(of_library)
}

fn start(name: String) -> PyResult<Start> {
    match name.as_str() {
        "full" => Ok(Start::Full),
        "middle" => Ok(Start::Middle),
        other => Err(data(format!("start {other:?}, must be full or middle"))),
    }
}
