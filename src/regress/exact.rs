//! Implements the exact Gaussian process, which uses all pairs of the n rows. Time grows with n^3 and memory with n^2.
//!
//! Input: standardised rows and hyperparameters. Output: likelihood, gradient and predictions. If the covariance matrix
//! is not positive definite even with the largest jitter, the result is an error.
//!
//! With `K = k(X, X) + noise`, the residuals `r = y - H beta` and `a = K^-1 r`:
//!
//! `-log p = 1/2 r' a + 1/2 ln |K| + n/2 ln 2 pi`, `-d log p = 1/2 tr((K^-1 - a a') dK)`.

use std::f64::consts::TAU;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::{MatMut, MatRef};
use rayon::prelude::*;

use super::basis::Coefficients;
use super::cross_covariance::{BLOCK_PAIRS, by_column, squares};
use super::error::RegressionError;
use super::jitter::{Jitter, until_positive};
use super::linear_algebra::{add, cholesky, dot, log_determinant, parallelism, solve_lower};
use super::plan::{Covariance, Plan, Work};
use super::scale::StandardisedRows;

const BLOCK_QUERIES: usize = 256;

#[derive(Debug, Clone)]
pub(super) struct Posterior {
    pub data: StandardisedRows,
    pub covariance: Covariance,
    pub coefficients: Coefficients,
    /// Inputs of the training rows, column-major.
    columns: Vec<f64>,
    factor: Vec<f64>,
    /// `K^-1 (y - H beta)`.
    alpha: Vec<f64>,
    /// `K^-1 H`, column-major.
    basis_solved: Vec<f64>,
    /// Negative logarithm of the marginal likelihood.
    pub value: f64,
    pub jitter: Jitter,
    /// Jitter on the diagonal, as a fraction of the signal variance; 0 = no jitter was necessary.
    used_jitter: f64,
}

impl Posterior {
    pub(super) fn new(data: StandardisedRows, plan: Plan, theta: &[f64]) -> Result<Self, RegressionError> {
        let (n, covariance) = (data.len(), Covariance::new(plan, theta));
        let columns = by_column(&data.inputs, data.dimensions);
        let mut factor = vec![0.0; n * n];
        let mut jitter = Jitter::default();
        let used_jitter = until_positive(|added| {
            fill(&covariance, &data, &columns, added, &mut factor);
            cholesky(&mut factor, n)
        })?;
        jitter.note(used_jitter);
        let size = data.basis.size(data.dimensions);
        let mut right = data.targets.clone();
        for k in 0..size {
            right.extend((0..n).map(|row| data.basis.value(data.row(row), k)));
        }
        let width = size + 1;
        solve_lower(&factor, n, &mut right);
        let column = |k: usize| &right[k * n..][..n];
        let g: Vec<f64> = (0..width * width).map(|at| dot(column(at / width), column(at % width))).collect();
        let coefficients = Coefficients::solve(&g, size)?;
        let (alpha, basis_solved) = coefficients.weights(&factor, n, right);
        let value = 0.5 * (coefficients.squared_norm + log_determinant(&factor, n) + n as f64 * TAU.ln());
        Ok(Self { data, covariance, coefficients, columns, factor, alpha, basis_solved, value, jitter, used_jitter })
    }

    /// Returns the derivatives of the negative log likelihood with respect to every parameter.
    pub(super) fn gradient(&self) -> Vec<f64> {
        let n = self.data.len();
        let par = parallelism();
        let mut inverse = vec![0.0; n * n];
        let mut memory = MemBuffer::new(llt::inverse::inverse_scratch::<f64>(n, par));
        llt::inverse::inverse(
            MatMut::from_column_major_slice_mut(&mut inverse, n, n),
            MatRef::from_column_major_slice(&self.factor, n, n),
            par,
            MemStack::new(&mut memory),
        );
        let parameters = self.covariance.plan.parameters.len();
        let parts: Vec<(Vec<f64>, f64)> = (inverse.par_chunks(n).enumerate())
            .map_init(Default::default, |scratch: &mut (Vec<f64>, Vec<f64>, Work), (j, column)| {
                let mut gradient = vec![0.0; parameters];
                let (point, aj) = (self.data.row(j), self.alpha[j]);
                for from in (j + 1..n).step_by(BLOCK_PAIRS) {
                    let count = BLOCK_PAIRS.min(n - from);
                    squares(&self.columns, from, count, point, &mut scratch.0);
                    scratch.1.clear();
                    let weight = |(k, a): (&f64, &f64)| k - a * aj;
                    scratch.1.extend(column[from..][..count].iter().zip(&self.alpha[from..][..count]).map(weight));
                    self.covariance.add_gradient(&scratch.0, &scratch.1, &mut scratch.2, &mut gradient);
                }
                (gradient, 0.5 * (column[j] - aj * aj))
            })
            .collect();
        let (mut gradient, mut diagonal) = (vec![0.0; parameters], 0.0);
        for (part, weight) in parts {
            add(&mut gradient, &part);
            diagonal += weight;
        }
        let zero = vec![0.0; self.data.dimensions];
        let prior = diagonal * (1.0 + self.used_jitter);
        self.covariance.add_gradient(&zero, &[prior], &mut Work::default(), &mut gradient);
        gradient[parameters - 1] += 2.0 * self.covariance.noise_variance * diagonal;
        gradient
    }

    pub(super) fn predict(&self, queries: &[f64]) -> Vec<(f64, f64)> {
        let (n, d) = (self.data.len(), self.data.dimensions);
        let mut all = Vec::with_capacity(queries.len() / d);
        let mut block = vec![0.0; n * BLOCK_QUERIES.min(queries.len() / d)];
        for rows in queries.chunks(BLOCK_QUERIES * d) {
            let count = rows.len() / d;
            let block = &mut block[..n * count];
            block.par_chunks_mut(n).zip(rows.par_chunks(d)).for_each_init(Default::default, |scratch, (out, row)| {
                self.covariance.cross(&self.columns, 0, row, scratch, out);
            });
            let means: Vec<(f64, Vec<f64>)> =
                block.par_chunks(n).zip(rows.par_chunks(d)).map(|(column, row)| self.mean(row, column)).collect();
            solve_lower(&self.factor, n, block);
            all.extend(means.into_iter().zip(block.chunks(n)).map(|((mean, rest), column)| {
                let own = (self.covariance.prior_variance - dot(column, column)).max(0.0);
                (mean, own + self.coefficients.variance(&rest))
            }));
        }
        all
    }

    /// Returns the mean at a row, and the argument `rest` of [`Coefficients::variance`].
    fn mean(&self, row: &[f64], cross: &[f64]) -> (f64, Vec<f64>) {
        let n = self.data.len();
        let rest = |k: usize| self.data.basis.value(row, k) - dot(&self.basis_solved[k * n..][..n], cross);
        let rest = (0..self.coefficients.beta.len()).map(rest).collect();
        (self.coefficients.mean(self.data.basis, row) + dot(&self.alpha, cross), rest)
    }

    /// Predicts each given row from all other rows. Returns the residual and the variance of a measurement for each
    /// row. The coefficients of the mean function are not fitted again.
    pub(super) fn left_out(&self, rows: &[u32]) -> Vec<(f64, f64)> {
        let n = self.data.len();
        let mut all = Vec::with_capacity(rows.len());
        for some in rows.chunks(BLOCK_QUERIES) {
            let mut units = vec![0.0; n * some.len()];
            some.iter().enumerate().for_each(|(k, row)| units[k * n + *row as usize] = 1.0);
            solve_lower(&self.factor, n, &mut units);
            all.extend(some.iter().zip(units.chunks(n)).map(|(row, column)| {
                let precision = dot(column, column);
                (self.alpha[*row as usize] / precision, 1.0 / precision)
            }));
        }
        all
    }
}

fn fill(covariance: &Covariance, data: &StandardisedRows, columns: &[f64], jitter: f64, matrix: &mut [f64]) {
    let n = data.len();
    let diagonal = covariance.prior_variance * (1.0 + jitter) + covariance.noise_variance;
    matrix.par_chunks_mut(n).enumerate().with_max_len(8).for_each_init(Default::default, |scratch, (j, column)| {
        column[j] = diagonal;
        covariance.cross(columns, j + 1, data.row(j), scratch, &mut column[j + 1..]);
    });
}
