//! Runs long work without holding the interpreter's lock. Shows a tqdm progress bar if tqdm is installed, and stops on
//! Ctrl-C.
//!
//! The work runs on its own thread and reports its progress. The calling thread shows the progress and checks for
//! Python signals. After Ctrl-C, the next progress report ends the work by unwinding its stack, so that half-written
//! files are removed.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Time between two checks for signals and progress.
const PERIOD: Duration = Duration::from_millis(100);

/// Payload of the panic after Ctrl-C.
struct Interrupted;

/// Progress of the work, and whether it must stop.
#[derive(Debug, Default)]
pub(crate) struct BackgroundTask {
    done: AtomicU64,
    must_end: AtomicBool,
}

impl BackgroundTask {
    /// Adds to the progress. After Ctrl-C, this function does not return but unwinds the stack.
    pub(crate) fn advance(&self, amount: u64) {
        self.done.fetch_add(amount, Ordering::Relaxed);
        if self.must_end.load(Ordering::Relaxed) {
            resume_unwind(Box::new(Interrupted));
        }
    }
}

/// The progress bar to show.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Progress<'a> {
    pub(crate) is_shown: bool,
    /// Total amount of work; `None` = unknown.
    pub(crate) total: Option<u64>,
    /// Unit of the amount.
    pub(crate) unit: &'a str,
}

impl Progress<'_> {
    /// A progress bar that is not shown.
    pub(crate) fn hidden() -> Self {
        Self { is_shown: false, total: None, unit: "" }
    }
}

/// Runs work on its own thread.
pub(crate) fn run<T: Send>(
    py: Python<'_>,
    progress: Progress<'_>,
    work: impl FnOnce(&BackgroundTask) -> T + Send,
) -> PyResult<T> {
    let bar = if progress.is_shown { Bar::new(py, progress)? } else { None };
    let (state, bar) = (BackgroundTask::default(), bar.as_ref());
    let (result, interrupt) = py.detach(|| {
        std::thread::scope(|scope| {
            let (ended, end) = sync_channel::<()>(1);
            let worker = scope.spawn(|| {
                let result = catch_unwind(AssertUnwindSafe(|| work(&state)));
                drop(ended);
                result
            });
            let mut interrupt = None;
            while end.recv_timeout(PERIOD) == Err(RecvTimeoutError::Timeout) && interrupt.is_none() {
                interrupt = Python::attach(|py| look(py, bar, &state)).err();
                state.must_end.store(interrupt.is_some(), Ordering::Relaxed);
            }
            (worker.join().unwrap_or_else(Err), interrupt)
        })
    });
    if let Some(bar) = bar {
        bar.close(py, &state)?;
    }
    match (result, interrupt) {
        (_, Some(interrupt)) => Err(interrupt),
        (Ok(result), None) => Ok(result),
        (Err(panic), None) => resume_unwind(panic),
    }
}

fn look(py: Python<'_>, bar: Option<&Bar>, state: &BackgroundTask) -> PyResult<()> {
    py.check_signals()?;
    bar.map_or(Ok(()), |bar| bar.show(py, state))
}

struct Bar {
    bar: Py<PyAny>,
    shown: AtomicU64,
}

impl Bar {
    /// Creates a bar; `None` if tqdm is not installed.
    fn new(py: Python<'_>, progress: Progress<'_>) -> PyResult<Option<Self>> {
        let Ok(tqdm) = py.import("tqdm.auto") else { return Ok(None) };
        let options = PyDict::new(py);
        options.set_item("total", progress.total)?;
        options.set_item("unit", progress.unit)?;
        options.set_item("unit_scale", true)?;
        let bar = tqdm.getattr("tqdm")?.call((), Some(&options))?.unbind();
        Ok(Some(Self { bar, shown: AtomicU64::new(0) }))
    }

    fn show(&self, py: Python<'_>, state: &BackgroundTask) -> PyResult<()> {
        let done = state.done.load(Ordering::Relaxed);
        let more = done - self.shown.swap(done, Ordering::Relaxed).min(done);
        self.bar.call_method1(py, "update", (more,)).map(drop)
    }

    fn close(&self, py: Python<'_>, state: &BackgroundTask) -> PyResult<()> {
        self.show(py, state)?;
        self.bar.call_method0(py, "close").map(drop)
    }
}
