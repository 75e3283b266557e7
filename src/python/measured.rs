//! Implements the Python function `read`, which reads a measured file (packwatch's CSV or the Battery Data Format) as a
//! table.

use std::path::PathBuf;
use std::sync::Arc;

use arrow_array::{ArrayRef, StringArray};
use packwatch_host::io::csv_log::CsvOptions;
use packwatch_lab::measured::{MeasuredFile, MeasuredPart};
use pyo3::prelude::*;

use crate::error::{data, of_library};
use crate::table::{Table, reals};

/// Reads a measured file.
#[pyfunction]
#[pyo3(signature = (path, *, bdf_positive="charge"))]
pub(crate) fn read(py: Python<'_>, path: PathBuf, bdf_positive: &str) -> PyResult<Table> {
    if !["charge", "discharge"].contains(&bdf_positive) {
        return Err(data(format!("bdf_positive {bdf_positive:?}, must be charge or discharge")));
    }
    let file = py.detach(|| MeasuredFile::read(&path, &CsvOptions::default())).map_err(of_library)?;
    let sign = if file.is_bdf && bdf_positive == "discharge" { -1.0 } else { 1.0 };
    let column = |of: fn(&MeasuredPart) -> &Vec<f64>, sign: f64| {
        reals(file.parts.iter().flat_map(|part| of(part).iter().map(|value| sign * value + 0.0)).collect())
    };
    let words = |of: fn(&MeasuredPart) -> &str| -> ArrayRef {
        let known = |part: &MeasuredPart| Some(of(part).to_owned()).filter(|word| !word.is_empty());
        let all = file.parts.iter().flat_map(|part| std::iter::repeat_n(known(part), part.len()));
        Arc::new(all.collect::<StringArray>())
    };
    Table::new(vec![
        ("time_s", column(|part| &part.time_s, 1.0)),
        ("current_a", column(|part| &part.current_a, sign)),
        ("voltage_v", column(|part| &part.voltage_v, 1.0)),
        ("temperature_c", column(|part| &part.temperature_c, 1.0)),
        ("discharged_ah", column(|part| &part.discharged_ah, sign)),
        ("part", words(|part| &part.key)),
        ("type", words(|part| &part.kind)),
    ])
}
