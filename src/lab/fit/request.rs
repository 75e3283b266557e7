//! Defines and checks the arguments of a fit for the command line and the Python module.
//!
//! Only [`FitRequest::check`] defines the allowed ranges. Errors name the command-line argument.

use std::path::PathBuf;

use crate::cell::MAX_BRANCHES;
use crate::error::{LabError, check_values as check};
use crate::io::csv_log::CsvOptions;
use crate::quantity::bounds;

/// Maximum number of SOC breakpoints: one per percent. The duration of a fit grows with the cube of this number.
pub const MAX_SOC_NODES: usize = 101;

/// Arguments of a fit.
#[derive(Debug, Clone, Default)]
pub struct FitRequest {
    /// Name of the cell.
    pub name: String,
    /// Capacity that defines the SOC (Ah). `None` = the capacity of the slow test or of the deepest discharge. For an
    /// ageing cell, `None` = the mean capacity of the discharges.
    pub capacity_ah: Option<f64>,
    /// Capacity on the label (Ah); `None` = `capacity_ah`.
    pub rated_ah: Option<f64>,
    /// Lowest voltage under load (V); `None` = from the data.
    pub voltage_min_v: Option<f64>,
    /// Highest voltage under charge (V); `None` = from the data.
    pub voltage_max_v: Option<f64>,
    /// Shift of the open-circuit curve as the cell loses capacity: with 0, the curve shrinks evenly; 1 is a pure loss
    /// of lithium. `None` = from the electrodes found in a slow test. If no electrodes were found, the shift is 0, or
    /// [`super::AGEING_SHIFT`] for an ageing cell.
    pub ageing_shift: Option<f64>,
    /// Slow tests: files with discharges so slow that they show the open-circuit voltage.
    pub ocv: Vec<PathBuf>,
    /// Number of RC branches, 1 to 3; `None` = 2, or 1 for an ageing cell.
    pub branches: Option<usize>,
    /// Initial time constants (s), one per branch, rising; `None` = the defaults.
    pub tau_s: Option<Vec<f64>>,
    /// Temperature breakpoints (degrees C), rising; `None` = from the data.
    pub temperature_c: Option<Vec<f64>>,
    /// SOC breakpoints, rising from 0 to 1; `None` = the defaults.
    pub soc: Option<Vec<f64>>,
    /// For an ageing cell: highest number in the column `cycle` that is used. `ocv` and `capacity_ah` must then be
    /// empty. `None` = the cell is not ageing.
    pub first_cycles: Option<usize>,
    /// Columns and current sign of the files, if their headers do not state them.
    pub table: CsvOptions,
    /// Files to fit; at least one.
    pub files: Vec<PathBuf>,
}

impl FitRequest {
    /// Checks the range of every argument, and that the arguments are compatible.
    ///
    /// # Errors
    /// An argument is out of its range, or two arguments are not compatible.
    pub fn check(&self) -> Result<(), LabError> {
        if self.files.is_empty() {
            return Err("no files, must be one or more".into());
        }
        self.check_cell()?;
        self.check_branches()?;
        self.check_nodes()
    }

    fn check_cell(&self) -> Result<(), LabError> {
        let positive = [
            ("--capacity", self.capacity_ah),
            ("--rated", self.rated_ah),
            ("--voltage-min", self.voltage_min_v),
            ("--voltage-max", self.voltage_max_v),
        ];
        for (key, value) in positive {
            check(key, value, is_above_0, "a finite number above 0")?;
        }
        check("--ageing-shift", self.ageing_shift, |shift| (0.0..=1.0).contains(&shift), "0 to 1")?;
        if let (Some(low_v), Some(high_v)) = (self.voltage_min_v, self.voltage_max_v)
            && low_v >= high_v
        {
            return Err(LabError::Data(format!("--voltage-min = {low_v}, must be below --voltage-max = {high_v}")));
        }
        if self.first_cycles == Some(0) {
            return Err("--first-cycles = 0, must be 1 or more".into());
        }
        for (key, is_given) in [("--ocv", !self.ocv.is_empty()), ("--capacity", self.capacity_ah.is_some())] {
            if is_given && self.first_cycles.is_some() {
                return Err(LabError::Data(format!("{key} must not be given together with --first-cycles")));
            }
        }
        Ok(())
    }

    fn check_branches(&self) -> Result<(), LabError> {
        if let Some(found) = self.branches.filter(|found| !(1..=MAX_BRANCHES).contains(found)) {
            return Err(LabError::Data(format!("--branches = {found}, must be 1 to {MAX_BRANCHES}")));
        }
        let Some(tau_s) = &self.tau_s else { return Ok(()) };
        check_list("--tau", tau_s, 1..=MAX_BRANCHES)?;
        check("--tau", tau_s.iter().copied(), is_above_0, "finite numbers above 0")?;
        match (tau_s.len(), self.branches) {
            (found, Some(branches)) if found != branches => {
                Err(LabError::Data(format!("--tau has {found} values, --branches is {branches}: must agree")))
            }
            _ => Ok(()),
        }
    }

    fn check_nodes(&self) -> Result<(), LabError> {
        if let Some(temperatures_c) = &self.temperature_c {
            let allowed = bounds::TEMPERATURE_C;
            // No data set has more than 32 temperatures.
            check_list("--temperatures", temperatures_c, 1..=32)?;
            check("--temperatures", temperatures_c.iter().copied(), |found| allowed.has(found), allowed.allowed)?;
        }
        let Some(soc) = &self.soc else { return Ok(()) };
        check_list("--soc-nodes", soc, 2..=MAX_SOC_NODES)?;
        check("--soc-nodes", soc.first().copied(), |first| first == 0.0, "a list that begins with 0")?;
        check("--soc-nodes", soc.last().copied(), |last| last == 1.0, "a list that ends with 1")
    }
}

fn is_above_0(value: f64) -> bool {
    value.is_finite() && value > 0.0
}

fn check_list(key: &str, list: &[f64], allowed: std::ops::RangeInclusive<usize>) -> Result<(), LabError> {
    if !allowed.contains(&list.len()) {
        let (found, least, most) = (list.len(), allowed.start(), allowed.end());
        return Err(LabError::Data(format!("{key} has {found} values, must have {least} to {most}")));
    }
    // NaN must count as falling, but a >= b is false for NaN.
    let falling = list.array_windows().find(|[a, b]| a.partial_cmp(b) != Some(std::cmp::Ordering::Less));
    falling.map_or(Ok(()), |[a, b]| Err(LabError::Data(format!("{key}: {b} follows {a}, must rise"))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn usual() -> FitRequest {
        FitRequest { files: vec!["drive.csv".into()], ..FitRequest::default() }
    }

    #[test]
    fn request_with_only_files_is_allowed() {
        assert_eq!(usual().check(), Ok(()));
    }

    #[test]
    fn every_argument_out_of_range_is_reported() {
        let nan = Some(f64::NAN);
        let list = |values: &[f64]| Some(values.to_vec());
        let cases = [
            (FitRequest::default(), "no files, must be one or more"),
            (FitRequest { capacity_ah: Some(0.0), ..usual() }, "--capacity = 0, must be a finite number above 0"),
            (FitRequest { rated_ah: nan, ..usual() }, "--rated = NaN, must be a finite number above 0"),
            (
                FitRequest { voltage_min_v: Some(-1.0), ..usual() },
                "--voltage-min = -1, must be a finite number above 0",
            ),
            (FitRequest { voltage_max_v: nan, ..usual() }, "--voltage-max = NaN, must be a finite number above 0"),
            (
                FitRequest { voltage_min_v: Some(4.2), voltage_max_v: Some(4.2), ..usual() },
                "--voltage-min = 4.2, must be below --voltage-max = 4.2",
            ),
            (FitRequest { ageing_shift: Some(1.5), ..usual() }, "--ageing-shift = 1.5, must be 0 to 1"),
            (FitRequest { first_cycles: Some(0), ..usual() }, "--first-cycles = 0, must be 1 or more"),
            (
                FitRequest { first_cycles: Some(3), capacity_ah: Some(2.0), ..usual() },
                "--capacity must not be given together with --first-cycles",
            ),
            (
                FitRequest { first_cycles: Some(3), ocv: vec!["slow.csv".into()], ..usual() },
                "--ocv must not be given together with --first-cycles",
            ),
            (FitRequest { branches: Some(0), ..usual() }, "--branches = 0, must be 1 to 3"),
            (FitRequest { branches: Some(4), ..usual() }, "--branches = 4, must be 1 to 3"),
            (FitRequest { tau_s: Some(vec![]), ..usual() }, "--tau has 0 values, must have 1 to 3"),
            (FitRequest { tau_s: list(&[-5.0, 5.0]), ..usual() }, "--tau = -5, must be finite numbers above 0"),
            (FitRequest { tau_s: list(&[5.0, f64::NAN]), ..usual() }, "--tau: NaN follows 5, must rise"),
            (
                FitRequest { tau_s: list(&[5.0]), branches: Some(2), ..usual() },
                "--tau has 1 values, --branches is 2: must agree",
            ),
            (FitRequest { temperature_c: Some(vec![]), ..usual() }, "--temperatures has 0 values, must have 1 to 32"),
            (
                FitRequest { temperature_c: list(&[-273.0]), ..usual() },
                "--temperatures = -273, must be -100 to 200 degrees C",
            ),
            (FitRequest { soc: list(&[0.0]), ..usual() }, "--soc-nodes has 1 values, must have 2 to 101"),
            (FitRequest { soc: list(&[0.1, 1.0]), ..usual() }, "--soc-nodes = 0.1, must be a list that begins with 0"),
            (FitRequest { soc: list(&[0.0, 0.9]), ..usual() }, "--soc-nodes = 0.9, must be a list that ends with 1"),
            (FitRequest { soc: list(&[0.0, 0.5, 0.5, 1.0]), ..usual() }, "--soc-nodes: 0.5 follows 0.5, must rise"),
        ];
        for (request, text) in cases {
            assert_eq!(request.check(), Err(LabError::Data(text.to_owned())));
        }
    }
}
