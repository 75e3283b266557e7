//! Defines the mean function and computes its generalised least-squares coefficients.
//!
//! Input: the matrix `G = [y H]' K^-1 [y H]`, where `y` are the targets, `H` the values of the mean function's terms at
//! every row, and `K` the covariance of the measurements. Output: the coefficients beta and their covariance. If the
//! rows cannot separate the terms, the result is an error.
//!
//! The coefficients are the ordinary least-squares solution of `W y` on `W H`, where W is a square root of `K^-1`. `G`
//! determines the coefficients, their covariance and the squared norm of the residual. The exact Gaussian process and
//! its nearest-neighbour approximation both compute `G`.

use serde::{Deserialize, Serialize};

use super::error::RegressionError;
use super::linear_algebra::solve_upper;

/// Mean function.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Basis {
    /// The mean is zero.
    Zero,
    /// The mean is a constant.
    Constant,
    /// The mean is a constant plus a slope for every input.
    Linear,
}

impl Basis {
    /// Returns the number of coefficients.
    pub fn size(self, dimensions: usize) -> usize {
        match self {
            Self::Zero => 0,
            Self::Constant => 1,
            Self::Linear => 1 + dimensions,
        }
    }

    /// Returns the value of the mean function's k-th term at a (standardised) row.
    pub(super) fn value(self, row: &[f64], k: usize) -> f64 {
        if k == 0 { 1.0 } else { row[k - 1] }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Coefficients {
    pub beta: Vec<f64>,
    /// Inverse of `H' K^-1 H`, row-major.
    pub covariance: Vec<f64>,
    /// `(y - H beta)' K^-1 (y - H beta)`.
    pub squared_norm: f64,
}

impl Coefficients {
    /// Solves for the coefficients. `g` is the matrix `G`: symmetric, row-major, `(1 + size)^2` elements. Its first row
    /// and column belong to the targets, the others to the `size` terms of the mean function.
    pub(super) fn solve(g: &[f64], size: usize) -> Result<Self, RegressionError> {
        let width = size + 1;
        let fault =
            || RegressionError::range("basis", format!("{size} functions"), "functions that the rows can separate");
        // Compute the Cholesky factor of the block `H' K^-1 H`, scaled to ones on its diagonal.
        let scale: Vec<f64> = (1..width).map(|k| g[k * width + k].sqrt()).collect();
        if scale.iter().any(|s| !(*s > 0.0 && s.is_finite())) {
            return Err(fault());
        }
        let mut l = vec![0.0; size * size];
        for i in 0..size {
            for j in 0..=i {
                let dot: f64 = (0..j).map(|k| l[i * size + k] * l[j * size + k]).sum();
                let rest = g[(i + 1) * width + j + 1] / (scale[i] * scale[j]) - dot;
                l[i * size + j] = if i > j {
                    rest / l[j * size + j]
                } else if rest > 1e-12 {
                    rest.sqrt()
                } else {
                    return Err(fault());
                };
            }
        }
        let inverse = inverse_from_factor(&l, size);
        let covariance: Vec<f64> =
            (0..size * size).map(|at| inverse[at] / (scale[at / size] * scale[at % size])).collect();
        let beta: Vec<f64> = (0..size).map(|i| (0..size).map(|j| covariance[i * size + j] * g[j + 1]).sum()).collect();
        let squared_norm = g[0] - (0..size).map(|j| beta[j] * g[j + 1]).sum::<f64>();
        Ok(Self { beta, covariance, squared_norm: squared_norm.max(0.0) })
    }

    /// Returns `K^-1 (y - H beta)` and `K^-1 H`. `right` holds `L^-1 [y H]`, and `factor` holds `L` of `K = L L'`.
    pub(super) fn weights(&self, factor: &[f64], n: usize, mut right: Vec<f64>) -> (Vec<f64>, Vec<f64>) {
        solve_upper(factor, n, &mut right);
        let functions = right.split_off(n);
        for (beta, function) in self.beta.iter().zip(functions.chunks(n)) {
            right.iter_mut().zip(function).for_each(|(a, h)| *a -= beta * h);
        }
        (right, functions)
    }

    pub(super) fn mean(&self, basis: Basis, row: &[f64]) -> f64 {
        (0..self.beta.len()).map(|k| self.beta[k] * basis.value(row, k)).sum()
    }

    /// Returns the contribution of the coefficients' uncertainty to the variance of a prediction at the row x. `rest`
    /// is `h - H' K^-1 k` with the mean function's terms `h` at x and the covariances `k` of x with the training rows.
    pub(super) fn variance(&self, rest: &[f64]) -> f64 {
        let size = self.beta.len();
        (0..size * size).map(|at| rest[at / size] * self.covariance[at] * rest[at % size]).sum::<f64>().max(0.0)
    }
}

fn inverse_from_factor(l: &[f64], size: usize) -> Vec<f64> {
    let mut inverse = vec![0.0; size * size];
    for column in 0..size {
        let mut x = vec![0.0; size];
        for i in column..size {
            let unit = if i == column { 1.0 } else { 0.0 };
            x[i] = (unit - (column..i).map(|k| l[i * size + k] * x[k]).sum::<f64>()) / l[i * size + i];
        }
        for i in (0..size).rev() {
            x[i] = (x[i] - (i + 1..size).map(|k| l[k * size + i] * x[k]).sum::<f64>()) / l[i * size + i];
        }
        for i in 0..size {
            inverse[i * size + column] = x[i];
        }
    }
    inverse
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_agree_with_least_squares() {
        // y = 2 + 3 x at x = 0, 1, 2, 3 with unit covariance, but the last y is larger by 1.
        let rows = [(2.0, 0.0), (5.0, 1.0), (8.0, 2.0), (12.0, 3.0)];
        let mut g = vec![0.0; 9];
        for (y, x) in rows {
            let v = [y, 1.0, x];
            for at in 0..9 {
                g[at] += v[at / 3] * v[at % 3];
            }
        }
        let found = Coefficients::solve(&g, 2).expect("well posed");
        assert!((found.beta[0] - 1.8).abs() < 1e-9 && (found.beta[1] - 3.3).abs() < 1e-9, "{found:?}");
        assert!((found.squared_norm - 0.3).abs() < 1e-9);
        assert!((found.covariance[3] - 0.2).abs() < 1e-9 && (found.covariance[1] + 0.3).abs() < 1e-9);
        assert!((found.variance(&[1.0, 2.0]) - 0.3).abs() < 1e-9);
    }

    #[test]
    fn inseparable_functions_are_rejected() {
        let g = [3.0, 1.0, 2.0, 1.0, 1.0, 2.0, 2.0, 2.0, 4.0];
        assert!(Coefficients::solve(&g, 2).is_err());
    }
}
