//! Implements the Python class `CellModel`: open-circuit voltage and resistances of a cell, from a file or from a label
//! (chemistry, rated capacity and voltage limits).

use std::path::{Path, PathBuf};

use packwatch_host::cell::{CellModel as CoreModel, Chemistry, Label};
use packwatch_host::config::cell_model::{self, SourcedModel};
use packwatch_host::config::of_label;
use pyo3::prelude::*;

use crate::arrays;
use crate::error::{config, data, file};
use crate::table::{Table, reals};

/// A voltage is accepted if it corresponds to an SOC in this range. A cell may be charged or discharged a little beyond
/// its limits.
const OCV_SOC: std::ops::RangeInclusive<f64> = -0.1..=1.1;

/// A cell model.
#[pyclass(frozen, module = "packwatch")]
pub(crate) struct CellModel(SourcedModel);

impl CellModel {
    fn model(&self) -> &CoreModel {
        &self.0.model
    }
}

#[pymethods]
impl CellModel {
    /// Reads a cell model file.
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        py.detach(|| cell_model::load_sourced(&path)).map(Self).map_err(|faults| match path.exists() {
            true => config(faults),
            false => file(faults),
        })
    }

    /// Returns the model of a cell from its label alone.
    #[staticmethod]
    #[pyo3(signature = (chemistry, rated_ah, *, voltage_min_v=None, voltage_max_v=None))]
    fn of_label(
        chemistry: &str,
        rated_ah: f64,
        voltage_min_v: Option<f64>,
        voltage_max_v: Option<f64>,
    ) -> PyResult<Self> {
        let names = Chemistry::ALL.map(|(_, name)| name).join(", ");
        let known = Chemistry::ALL.into_iter().find(|(_, name)| *name == chemistry);
        let (chemistry, _) = known.ok_or_else(|| data(format!("chemistry {chemistry:?}, must be one of {names}")))?;
        if !rated_ah.is_finite() || rated_ah <= 0.0 {
            return Err(data(format!("rated_ah = {rated_ah}, must be a finite number above 0")));
        }
        let usual = Label::usual(chemistry, rated_ah);
        let label = Label {
            voltage_min_v: voltage_min_v.unwrap_or(usual.voltage_min_v),
            voltage_max_v: voltage_max_v.unwrap_or(usual.voltage_max_v),
            ..usual
        };
        of_label(&label).map(Self).ok_or_else(|| {
            let (low, high) = chemistry.usual_voltages_v();
            let Label { voltage_min_v, voltage_max_v, .. } = label;
            let name = chemistry.name();
            data(format!(
                "{voltage_min_v} to {voltage_max_v} V is not a plausible range for {name} (typical: {low} to {high} V)"
            ))
        })
    }

    #[getter]
    fn name(&self) -> &str {
        &self.model().name
    }

    #[getter]
    fn capacity_ah(&self) -> f64 {
        self.model().capacity_ah
    }

    #[getter]
    fn rated_capacity_ah(&self) -> f64 {
        self.model().rated_capacity_ah
    }

    #[getter]
    fn voltage_min_v(&self) -> f64 {
        self.model().voltage_min_v
    }

    #[getter]
    fn voltage_max_v(&self) -> f64 {
        self.model().voltage_max_v
    }

    /// SOC breakpoints, fractions.
    #[getter]
    fn soc(&self) -> Vec<f64> {
        self.model().soc.clone()
    }

    /// Temperature breakpoints (degrees C).
    #[getter]
    fn temperature_c(&self) -> Vec<f64> {
        self.model().temperature_c.clone()
    }

    /// Returns a table with one row per SOC, at this temperature: open-circuit voltage, series resistance, and the
    /// resistance and time constant of each branch.
    #[pyo3(signature = (soc, temperature_c=25.0))]
    fn table(&self, soc: &Bound<'_, PyAny>, temperature_c: f64) -> PyResult<Table> {
        let (soc, model) = (arrays::column("soc", soc)?, self.model());
        if let Some(found) = soc.values.iter().find(|soc| !(0.0..=1.0).contains(*soc)) {
            return Err(data(format!("soc contains {found}, must be fractions from 0 to 1")));
        }
        if !temperature_c.is_finite() {
            return Err(data(format!("temperature_c = {temperature_c}, must be a finite number")));
        }
        let positions: Vec<_> = soc.values.iter().map(|soc| model.grid_position(*soc, temperature_c)).collect();
        let names: [[&str; 2]; 3] = [["r1_ohm", "tau1_s"], ["r2_ohm", "tau2_s"], ["r3_ohm", "tau3_s"]];
        let mut columns = vec![
            ("soc", reals(soc.values.to_vec())),
            ("ocv_v", reals(positions.iter().map(|at| model.ocv_v(at)).collect())),
            ("r0_ohm", reals(positions.iter().map(|at| model.r0_ohm(at)).collect())),
        ];
        for (branch, [r_ohm, tau_s]) in names.into_iter().enumerate().take(model.branches.len()) {
            columns.push((r_ohm, reals(positions.iter().map(|at| model.branch_r_ohm(branch, at)).collect())));
            columns.push((tau_s, reals(positions.iter().map(|at| model.branch_tau_s(branch, at)).collect())));
        }
        Table::new(columns)
    }

    /// Returns the SOC, a fraction, at an open-circuit voltage.
    #[pyo3(signature = (voltage_v, temperature_c=25.0))]
    fn soc_of_ocv(&self, voltage_v: f64, temperature_c: f64) -> PyResult<f64> {
        if !voltage_v.is_finite() || !temperature_c.is_finite() {
            return Err(data(format!(
                "voltage_v = {voltage_v}, temperature_c = {temperature_c}, must be finite numbers"
            )));
        }
        let soc = self.model().soc_of_ocv(voltage_v, temperature_c);
        if OCV_SOC.contains(&soc) {
            return Ok(soc);
        }
        let CoreModel { voltage_min_v, voltage_max_v, .. } = *self.model();
        let hint = if (voltage_min_v..=voltage_max_v).contains(&(voltage_v / 1000.0)) { ": probably mV" } else { "" };
        Err(data(format!("voltage_v = {voltage_v}, must be near {voltage_min_v} to {voltage_max_v} V{hint}")))
    }

    /// Returns the text of a cell model file, in the format of `model export`.
    fn text(&self) -> String {
        cell_model::text(&self.0, "Written by packwatch.")
    }

    /// Writes the cell model file atomically.
    fn write(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| write(&path, &self.text()))
    }

    fn __repr__(&self) -> String {
        format!("<packwatch.CellModel {:?}, {} Ah>", self.model().name, self.model().capacity_ah)
    }
}

/// Writes a text file atomically.
pub(crate) fn write(path: &Path, text: &str) -> PyResult<()> {
    packwatch_lab::write_file(path, text.as_bytes()).map_err(file)
}
