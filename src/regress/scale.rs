//! Checks rows, and standardises inputs and targets by mean and standard deviation.
//!
//! Input: rows. Output: standardised rows. Wrong lengths give an error. A number that is not finite gives an error that
//! names the line of the row.

use serde::{Deserialize, Serialize};

use super::basis::Basis;
use super::error::RegressionError;
use super::settings::{MAX_DIMENSIONS, TrainingRows};

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Scale {
    pub means: Vec<f64>,
    pub deviations: Vec<f64>,
    pub target_mean: f64,
    pub target_deviation: f64,
}

pub(super) fn check(rows: &TrainingRows) -> Result<(), RegressionError> {
    let (d, n) = (rows.dimensions, rows.targets.len());
    if d == 0 || d > MAX_DIMENSIONS {
        return Err(RegressionError::range("inputs of a row", d, format!("1 to {MAX_DIMENSIONS}")));
    }
    if rows.inputs.len() != d * n {
        return Err(RegressionError::range("number of inputs", rows.inputs.len(), format!("{d} x {n} rows")));
    }
    if n < 2 {
        return Err(RegressionError::range("rows", n, "2 or more"));
    }
    if !rows.lines.is_empty() && rows.lines.len() != n {
        return Err(RegressionError::range("line numbers", rows.lines.len(), format!("none or {n}")));
    }
    let line = |row: usize| rows.lines.get(row).copied().unwrap_or(row as u64 + 1);
    let bad_input = rows.inputs.iter().position(|x| !x.is_finite());
    let bad_target = rows.targets.iter().position(|y| !y.is_finite());
    let target_first = bad_target.is_some_and(|row| bad_input.is_none_or(|at| row < at / d));
    match (bad_input, bad_target) {
        (_, Some(row)) if target_first => {
            Err(RegressionError::NotFinite { line: line(row), what: "target".to_owned(), found: rows.targets[row] })
        }
        (Some(at), _) => {
            let what = format!("input {}", at % d + 1);
            Err(RegressionError::NotFinite { line: line(at / d), what, found: rows.inputs[at] })
        }
        _ => Ok(()),
    }
}

/// Returns mean and standard deviation of the values. If all values are equal, the standard deviation is 1.
fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let count = values.clone().count() as f64;
    // Subtracting the first value avoids rounding of the sum of many equal values.
    let first = values.clone().next().unwrap_or(0.0);
    let mean = first + values.clone().map(|v| v - first).sum::<f64>() / count;
    let deviation = (values.map(|v| (v - mean) * (v - mean)).sum::<f64>() / count).sqrt();
    let flat = deviation.is_nan() || deviation <= 1e-12 * mean.abs().max(f64::MIN_POSITIVE);
    (mean, if flat { 1.0 } else { deviation })
}

/// Standardised rows. [`Form::Nearest`](super::Form::Nearest) keeps them in random order.
#[derive(Debug, Clone)]
pub(super) struct StandardisedRows {
    pub dimensions: usize,
    pub inputs: Vec<f64>,
    pub targets: Vec<f64>,
    pub basis: Basis,
}

impl StandardisedRows {
    pub(super) fn row(&self, at: usize) -> &[f64] {
        &self.inputs[at * self.dimensions..][..self.dimensions]
    }

    pub(super) fn len(&self) -> usize {
        self.targets.len()
    }
}

impl Scale {
    /// Computes the scale of checked rows. With [`Basis::Zero`], the mean of the targets is not subtracted.
    pub(super) fn of(rows: &TrainingRows, standardise: bool, basis: Basis) -> Self {
        let column = |d: usize| rows.inputs.iter().skip(d).step_by(rows.dimensions).copied();
        let inputs: Vec<(f64, f64)> =
            (0..rows.dimensions).map(|d| if standardise { moments(column(d)) } else { (0.0, 1.0) }).collect();
        let (mean, deviation) = moments(rows.targets.iter().copied());
        Self {
            means: inputs.iter().map(|m| m.0).collect(),
            deviations: inputs.iter().map(|m| m.1).collect(),
            target_mean: if basis == Basis::Zero { 0.0 } else { mean },
            target_deviation: deviation,
        }
    }

    /// Returns the first column whose mean or standard deviation overflows, as `input 2` or `target`.
    pub(super) fn too_wide(&self) -> Option<String> {
        let target = (!self.target_deviation.is_finite() || !self.target_mean.is_finite()).then(|| "target".to_owned());
        let is_wide = |(mean, deviation): (&f64, &f64)| !mean.is_finite() || !deviation.is_finite();
        let input = self.means.iter().zip(&self.deviations).position(is_wide);
        input.map(|d| format!("input {}", d + 1)).or(target)
    }

    pub(super) fn inputs(&self, inputs: &[f64]) -> Vec<f64> {
        let d = self.means.len();
        inputs.iter().enumerate().map(|(at, x)| (x - self.means[at % d]) / self.deviations[at % d]).collect()
    }

    pub(super) fn targets(&self, targets: &[f64]) -> Vec<f64> {
        targets.iter().map(|y| (y - self.target_mean) / self.target_deviation).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_constant_column_has_unit_scale() {
        assert_eq!(moments(std::iter::repeat_n(0.1, 1_000_000)), (0.1, 1.0));
    }

    #[test]
    fn non_finite_number_is_rejected_with_line() {
        let (inputs, targets) = ([1.0, 2.0, 3.0, f64::NAN], [1.0, 2.0]);
        let rows = TrainingRows { inputs: &inputs, dimensions: 2, targets: &targets, lines: &[12, 19] };
        assert_eq!(check(&rows).expect_err("NaN").to_string(), "line 19: input 2 = NaN, must be a finite number");
        let rows = TrainingRows { inputs: &inputs[..2], dimensions: 1, targets: &[1.0, f64::INFINITY], lines: &[] };
        assert_eq!(check(&rows).expect_err("inf").to_string(), "line 2: target = inf, must be a finite number");
        let rows = TrainingRows { inputs: &inputs[..3], dimensions: 2, targets: &targets, lines: &[] };
        assert_eq!(check(&rows).expect_err("short").to_string(), "number of inputs = 3, must be 2 x 2 rows");
    }

    #[test]
    fn constant_columns_keep_their_scale() {
        let rows = TrainingRows { inputs: &[5.0, 5.0, 5.0], dimensions: 1, targets: &[1.0, 2.0, 6.0], lines: &[] };
        let scale = Scale::of(&rows, true, Basis::Constant);
        assert_eq!((scale.means[0], scale.deviations[0], scale.target_mean), (5.0, 1.0, 3.0));
        assert_eq!(Scale::of(&rows, true, Basis::Zero).target_mean, 0.0);
        assert_eq!(scale.inputs(&[5.0]), [0.0]);
    }
}
