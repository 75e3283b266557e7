//! Implements the Python function `replay`, which replays logs through the monitor, like the command `replay`, and
//! returns tables.

use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};

use packwatch_host::config::{self, Config};
use packwatch_host::io::log::LogSource;
use packwatch_host::monitor::{Monitor, Outputs as CoreOutputs};
use packwatch_host::replay::{self as host_replay, LogReading, ReplayError, ReplaySettings, Sinks};
use pyo3::exceptions::PyBrokenPipeError;
use pyo3::prelude::*;

use crate::arguments::{List, bytes, of_json};
use crate::background_task::{self, BackgroundTask, Progress};
use crate::error::{self, data};
use crate::outputs::{Columns, Outputs, Wanted};

/// Results of a replay.
#[pyclass(frozen, module = "packwatch")]
pub(crate) struct Replay {
    /// Tables of the estimates, events and frames.
    #[pyo3(get)]
    outputs: Py<Outputs>,
    /// The summary of `replay --json`.
    json: String,
}

#[pymethods]
impl Replay {
    /// Returns the summary as JSON text, as `replay --json` prints it.
    fn json(&self) -> &str {
        &self.json
    }

    /// The summary as a dictionary.
    #[getter]
    fn summary<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        of_json(py, &self.json)
    }

    #[getter]
    fn estimates(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.outputs.getattr(py, "estimates")
    }

    #[getter]
    fn events(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.outputs.getattr(py, "events")
    }

    #[getter]
    fn frames(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.outputs.getattr(py, "frames")
    }
}

/// Replays logs as one continuous recording.
#[pyfunction]
#[pyo3(signature = (config, logs, *, columns=None, csv_sign=None, start_times=None, strict=false, sleep_gap_s=None,
                    estimates_period_s=0.0, progress=false))]
#[expect(clippy::too_many_arguments, reason = "keyword arguments of Python")]
pub(crate) fn replay(
    py: Python<'_>,
    config: PathBuf,
    logs: List<PathBuf>,
    columns: Option<std::collections::BTreeMap<String, String>>,
    csv_sign: Option<&str>,
    start_times: Option<PathBuf>,
    strict: bool,
    sleep_gap_s: Option<f64>,
    estimates_period_s: Option<f64>,
    progress: bool,
) -> PyResult<Replay> {
    let charge_positive = match csv_sign {
        None => None,
        Some("discharge") => Some(false),
        Some("charge") => Some(true),
        Some(other) => return Err(data(format!("csv_sign {other:?}, must be discharge or charge"))),
    };
    check_sleep_gap(sleep_gap_s)?;
    let wanted = Wanted::new(estimates_period_s)?;
    let columns = columns.unwrap_or_default().into_iter().collect();
    let reading = LogReading { strict, channels: Vec::new(), columns, charge_positive, start_times };
    let logs = logs.0;
    if logs.is_empty() {
        return Err(data("no logs, must be one or more"));
    }
    let config = py.detach(|| config::load(&config)).map_err(error::config)?;
    let sleep_gap_s = sleep_gap_s.unwrap_or_else(|| host_replay::sleep_gap_s(&config.monitor));
    let progress = Progress { is_shown: progress, total: Some(bytes(&logs)), unit: "B" };
    let result = background_task::run(py, progress, |work| run(&config, &logs, &reading, (sleep_gap_s, wanted), work))?;
    let (mut outputs, json) = result.map_err(replay_error)?;
    let outputs = outputs.finish(py, &config.interface_names())?;
    Ok(Replay { outputs: Py::new(py, outputs)?, json })
}

/// Checks a sleep gap (s); `None` = the configuration decides.
///
/// # Errors
/// `DataError` unless the gap is above 0.
pub(crate) fn check_sleep_gap(sleep_gap_s: Option<f64>) -> PyResult<()> {
    match sleep_gap_s {
        Some(gap_s) if gap_s.is_nan() || gap_s <= 0.0 => Err(data(format!("sleep_gap_s = {gap_s}, must be above 0"))),
        _ => Ok(()),
    }
}

fn run(
    config: &Config,
    logs: &[PathBuf],
    reading: &LogReading,
    (sleep_gap_s, wanted): (f64, Wanted),
    work: &BackgroundTask,
) -> Result<(Columns, String), ReplayError> {
    let columns = Arc::new(Mutex::new(Columns::default()));
    let sink = Arc::clone(&columns);
    let take = move |out: &CoreOutputs| sink.lock().unwrap_or_else(PoisonError::into_inner).add(wanted, out);
    let sinks = Sinks { outputs: Some(Box::new(take)), ..Sinks::default() };
    let mut source = LogSource::new(logs.to_vec(), reading.options(config));
    let settings = ReplaySettings::plain(sleep_gap_s, config.interface_names());
    let mut reported = 0;
    let mut report = |bytes: u64| {
        work.advance(bytes.saturating_sub(reported));
        reported = bytes;
    };
    let monitor = Monitor::new(config.monitor.clone());
    let (summary, _) = host_replay::run(&mut source, monitor, sinks, settings, &mut |progress| report(progress.bytes))?;
    report(source.read_bytes().load(Ordering::Relaxed));
    let json = serde_json::to_string_pretty(&summary).map_err(std::io::Error::from)? + "\n";
    let columns = std::mem::take(&mut *columns.lock().unwrap_or_else(PoisonError::into_inner));
    Ok((columns, json))
}

fn replay_error(failure: ReplayError) -> PyErr {
    match failure {
        ReplayError::Write(error) if error.kind() == std::io::ErrorKind::BrokenPipe => {
            PyBrokenPipeError::new_err(error.to_string())
        }
        ReplayError::Write(error) => error::file(error),
        ReplayError::Log(error) => error::of_library(error),
        failure => data(failure),
    }
}
