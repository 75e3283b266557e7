//! Implements the Python class `GaussianProcess`: regression on arrays. The class reads and writes the model files of
//! `packwatch gpr`.

use std::ops::ControlFlow;
use std::path::PathBuf;

use packwatch_lab::gpr::TrainedModel;
use packwatch_regress::{Basis, FitProgress, GprSettings, Kernel, ProgressCallback, TrainingRows, fit};
use pyo3::prelude::*;

use crate::arrays::{self, check_rows};
use crate::background_task::{self, Progress};
use crate::error::{data, of_library};
use crate::table::{Table, reals};

/// A fitted process.
#[pyclass(frozen, module = "packwatch")]
pub(crate) struct GaussianProcess(TrainedModel);

#[pymethods]
impl GaussianProcess {
    /// Fits a process to rows.
    #[staticmethod]
    #[pyo3(signature = (inputs, output, *, kernel="exponential", basis="constant", ard=false, restarts=0, max_iterations=60, seed=1,
                        names=None, output_name="output", threads=None, progress=false))]
    #[expect(clippy::too_many_arguments, reason = "keyword arguments of Python")]
    fn fit(
        py: Python<'_>,
        inputs: &Bound<'_, PyAny>,
        output: &Bound<'_, PyAny>,
        kernel: &str,
        basis: &str,
        ard: bool,
        restarts: usize,
        max_iterations: usize,
        seed: u64,
        names: Option<Vec<String>>,
        output_name: &str,
        threads: Option<usize>,
        progress: bool,
    ) -> PyResult<Self> {
        let inputs = arrays::reals("inputs", inputs)?;
        let targets = arrays::column("output", output)?;
        check_rows("output", targets.rows, "inputs", inputs.rows)?;
        check_known("inputs", &inputs)?;
        check_known("output", &targets)?;
        let names = names.unwrap_or_else(|| (1..=inputs.columns).map(|number| format!("x{number}")).collect());
        if names.len() != inputs.columns {
            return Err(data(format!(
                "names has {} names, inputs has {} columns; give one name per column",
                names.len(),
                inputs.columns
            )));
        }
        let kernel: Kernel = kernel.parse().map_err(data)?;
        let settings = GprSettings {
            basis: basis_named(basis)?,
            ard,
            restarts,
            max_iterations,
            seed,
            threads: thread_count(threads),
            ..GprSettings::new(kernel, inputs.rows)
        };
        let lines: Vec<u64> = (0..inputs.rows as u64).collect();
        let rows = TrainingRows {
            inputs: &inputs.values,
            dimensions: inputs.columns,
            targets: &targets.values,
            lines: &lines,
        };
        let shown = Progress { is_shown: progress, total: None, unit: "step" };
        let model = background_task::run(py, shown, |work| {
            let mut watcher = |_: FitProgress| {
                work.advance(1);
                ControlFlow::Continue(())
            };
            fit(&rows, &settings, &mut watcher as &mut ProgressCallback<'_>)
        })?;
        Ok(Self(TrainedModel { output: output_name.to_owned(), inputs: names, model: model.map_err(data)? }))
    }

    /// Loads a model written by `gpr train` or `save`.
    #[staticmethod]
    #[pyo3(signature = (path, *, threads=None))]
    fn load(py: Python<'_>, path: PathBuf, threads: Option<usize>) -> PyResult<Self> {
        let loaded = py.detach(|| TrainedModel::load(&path, thread_count(threads)));
        loaded.map(Self).map_err(of_library)
    }

    /// Writes the model atomically, including its training rows.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| self.0.save(&path)).map_err(of_library)
    }

    /// Predicts the output for each row of inputs. Returns the columns `mean`, `std`, `low_95` and `high_95`. `std` is
    /// the standard deviation of a new measurement, including noise. 95 % of new measurements are between `low_95` and
    /// `high_95`.
    fn predict(&self, py: Python<'_>, inputs: &Bound<'_, PyAny>) -> PyResult<Table> {
        let inputs = arrays::reals("inputs", inputs)?;
        check_known("inputs", &inputs)?;
        if inputs.columns != self.0.inputs.len() {
            let (found, allowed) = (inputs.columns, self.0.inputs.len());
            return Err(data(format!("inputs has {found} columns, must have {allowed} as in the model")));
        }
        let predictions = py.detach(|| self.0.model.predict(&inputs.values)).map_err(data)?;
        Table::new(vec![
            ("mean", reals(predictions.iter().map(|one| one.mean).collect())),
            ("std", reals(predictions.iter().map(|one| one.measurement_variance.sqrt()).collect())),
            ("low_95", reals(predictions.iter().map(|one| one.low_95).collect())),
            ("high_95", reals(predictions.iter().map(|one| one.high_95).collect())),
        ])
    }

    /// Names of the inputs.
    #[getter]
    fn inputs(&self) -> Vec<String> {
        self.0.inputs.clone()
    }

    /// Name of the output.
    #[getter]
    fn output(&self) -> &str {
        &self.0.output
    }

    #[getter]
    fn log_marginal_likelihood(&self) -> f64 {
        self.0.model.log_marginal_likelihood()
    }

    /// Hyperparameters by name.
    #[getter]
    fn hyperparameters(&self) -> Vec<(String, f64)> {
        self.0.model.hyperparameters().into_iter().map(|one| (one.name, one.value)).collect()
    }
}

fn check_known(name: &str, values: &arrays::Reals) -> PyResult<()> {
    match values.values.iter().position(|value| !value.is_finite()) {
        Some(at) => {
            let (row, found) = (at / values.columns.max(1), values.values[at]);
            Err(data(format!("{name}[{row}] contains {found}, must be finite numbers")))
        }
        None => Ok(()),
    }
}

fn basis_named(name: &str) -> PyResult<Basis> {
    match name {
        "zero" => Ok(Basis::Zero),
        "constant" => Ok(Basis::Constant),
        "linear" => Ok(Basis::Linear),
        other => Err(data(format!("basis {other:?}, must be zero, constant or linear"))),
    }
}

fn thread_count(given: Option<usize>) -> usize {
    given.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from)).clamp(1, 1024)
}
