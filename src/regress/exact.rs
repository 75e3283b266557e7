//! Gaussian process over all pairs of rows: no approximation, n^3 time, n^2 memory.
//!
//! In: standardised rows and hyperparameters. Out: likelihood, gradient, predictions. A matrix that is not positive
//! definite with the largest jitter is an error.
//!
//! With `K = k(X, X) + noise` and `a = K^-1 (y - H beta)`:
//!
//! `-log p = 1/2 (y - H beta)' a + 1/2 ln |K| + n/2 ln 2 pi`, `-d log p = 1/2 tr((K^-1 - a a') dK)`.

use std::f64::consts::TAU;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{MatMut, MatRef, Par};
use rayon::prelude::*;

use super::RegressionError;
use super::basis::Coefficients;
use super::jitter::{Jitter, until_positive};
use super::nearest::StandardisedRows;
use super::plan::{Plan, Values, Work};

/// Pairs evaluated at a time: their memory fits the near cache.
const BLOCK_PAIRS: usize = 1024;
/// Queries of one block of a prediction.
const BLOCK_QUERIES: usize = 256;
/// Columns one thread takes at a time.
const COLUMNS: usize = 8;

/// State for predictions.
#[derive(Debug, Clone)]
pub(super) struct Posterior {
    pub data: StandardisedRows,
    pub plan: Plan,
    pub values: Values,
    pub coefficients: Coefficients,
    /// Inputs, column after column.
    columns: Vec<f64>,
    /// Cholesky factor, lower, column after column.
    factor: Vec<f64>,
    /// `K^-1 (y - H beta)`.
    alpha: Vec<f64>,
    /// `K^-1 H`, column after column.
    basis_solved: Vec<f64>,
    /// Minus the log likelihood.
    pub value: f64,
    pub jitter: Jitter,
    /// Jitter on the diagonal, as part of the prior variance.
    used_jitter: f64,
}

/// Parallelism of the present thread pool, for faer.
pub(super) fn parallelism() -> Par {
    match rayon::current_num_threads() {
        0 | 1 => Par::Seq,
        threads => Par::rayon(threads),
    }
}

/// Row-major to column-major.
pub(super) fn by_column(inputs: &[f64], dimensions: usize) -> Vec<f64> {
    (0..dimensions).flat_map(|d| inputs.iter().skip(d).step_by(dimensions).copied()).collect()
}

/// Kernel of one point with the rows `first..` of `columns` (which has `n` rows), into `out`.
#[expect(clippy::too_many_arguments, reason = "one flat loop of arithmetic")]
pub(super) fn cross(
    plan: &Plan,
    values: &Values,
    columns: &[f64],
    n: usize,
    first: usize,
    point: &[f64],
    scratch: &mut (Vec<f64>, Work),
    out: &mut [f64],
) {
    for (block, part) in out.chunks_mut(BLOCK_PAIRS).enumerate() {
        let (from, count) = (first + block * BLOCK_PAIRS, part.len());
        squares(columns, n, from, count, point, &mut scratch.0);
        part.copy_from_slice(plan.evaluate(values, &scratch.0, count, &mut scratch.1));
    }
}

pub(super) fn squares(columns: &[f64], n: usize, from: usize, count: usize, point: &[f64], out: &mut Vec<f64>) {
    out.resize(count * point.len(), 0.0);
    for (d, x) in point.iter().enumerate() {
        let column = &columns[d * n + from..][..count];
        out[d * count..][..count].iter_mut().zip(column).for_each(|(square, c)| *square = (c - x) * (c - x));
    }
}

/// Factorises in place; `false` = not positive definite.
pub(super) fn cholesky(matrix: &mut [f64], n: usize) -> bool {
    let par = parallelism();
    let mut memory = MemBuffer::new(llt::factor::cholesky_in_place_scratch::<f64>(n, par, Default::default()));
    let matrix = MatMut::from_column_major_slice_mut(matrix, n, n);
    let done =
        llt::factor::cholesky_in_place(matrix, Default::default(), par, MemStack::new(&mut memory), Default::default());
    done.is_ok()
}

impl Posterior {
    pub(super) fn new(data: StandardisedRows, plan: Plan, theta: &[f64]) -> Result<Self, RegressionError> {
        let (n, values) = (data.len(), plan.values(theta));
        let columns = by_column(&data.inputs, data.dimensions);
        let mut factor = vec![0.0; n * n];
        let mut jitter = Jitter::default();
        let used_jitter = until_positive(|added| {
            fill(&plan, &values, &data, &columns, added, &mut factor);
            cholesky(&mut factor, n)
        })?;
        jitter.note(used_jitter);
        let mut posterior = Self {
            data,
            plan,
            values,
            coefficients: Coefficients { beta: vec![], covariance: vec![], squared_norm: 0.0 },
            columns,
            factor,
            alpha: vec![],
            basis_solved: vec![],
            value: 0.0,
            jitter,
            used_jitter,
        };
        posterior.solve()?;
        Ok(posterior)
    }

    /// Coefficients, weights and likelihood from the factor.
    fn solve(&mut self) -> Result<(), RegressionError> {
        let (n, data) = (self.data.len(), &self.data);
        let size = data.basis.size(data.dimensions);
        let mut right = data.targets.clone();
        for k in 0..size {
            right.extend((0..n).map(|row| data.basis.value(data.row(row), k)));
        }
        let l = MatRef::from_column_major_slice(&self.factor, n, n);
        let width = size + 1;
        solve_lower_triangular_in_place(l, MatMut::from_column_major_slice_mut(&mut right, n, width), parallelism());
        let dot = |a: usize, b: usize| -> f64 {
            right[a * n..][..n].iter().zip(&right[b * n..][..n]).map(|(x, y)| x * y).sum()
        };
        let g: Vec<f64> = (0..width * width).map(|at| dot(at / width, at % width)).collect();
        self.coefficients = Coefficients::solve(&g, size)?;
        let upper = l.transpose();
        solve_upper_triangular_in_place(
            upper,
            MatMut::from_column_major_slice_mut(&mut right, n, width),
            parallelism(),
        );
        self.alpha = right[..n].to_vec();
        for (k, beta) in self.coefficients.beta.iter().enumerate() {
            self.alpha.iter_mut().zip(&right[(k + 1) * n..]).for_each(|(a, h)| *a -= beta * h);
        }
        self.basis_solved = right[n..].to_vec();
        let log_determinant: f64 = (0..n).map(|k| self.factor[k * n + k].ln()).sum::<f64>() * 2.0;
        self.value = 0.5 * (self.coefficients.squared_norm + log_determinant + n as f64 * TAU.ln());
        Ok(())
    }

    /// Derivative of minus the log likelihood by every parameter.
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
        let parameters = self.plan.parameters.len();
        let parts: Vec<(Vec<f64>, f64)> = (inverse.par_chunks(n).enumerate())
            .map_init(Default::default, |scratch: &mut (Vec<f64>, Vec<f64>, Work), (j, column)| {
                let mut gradient = vec![0.0; parameters];
                let (point, aj) = (self.data.row(j), self.alpha[j]);
                for from in (j + 1..n).step_by(BLOCK_PAIRS) {
                    let count = BLOCK_PAIRS.min(n - from);
                    squares(&self.columns, n, from, count, point, &mut scratch.0);
                    scratch.1.clear();
                    let weight = |(k, a): (&f64, &f64)| k - a * aj;
                    scratch.1.extend(column[from..][..count].iter().zip(&self.alpha[from..][..count]).map(weight));
                    self.plan.add_gradient(&self.values, &scratch.0, &scratch.1, &mut scratch.2, &mut gradient);
                }
                (gradient, 0.5 * (column[j] - aj * aj))
            })
            .collect();
        let (mut gradient, mut diagonal) = (vec![0.0; parameters], 0.0);
        for (part, weight) in parts {
            gradient.iter_mut().zip(part).for_each(|(total, sum)| *total += sum);
            diagonal += weight;
        }
        let zero = vec![0.0; self.data.dimensions];
        let prior = diagonal * (1.0 + self.used_jitter);
        self.plan.add_gradient(&self.values, &zero, &[prior], &mut Work::default(), &mut gradient);
        gradient[parameters - 1] += 2.0 * self.values.noise_variance * diagonal;
        gradient
    }

    /// Mean and variance of the function at standardised rows.
    pub(super) fn predict(&self, queries: &[f64]) -> Vec<(f64, f64)> {
        let (n, d) = (self.data.len(), self.data.dimensions);
        let mut all = Vec::with_capacity(queries.len() / d);
        let mut block = vec![0.0; n * BLOCK_QUERIES.min(queries.len() / d)];
        for rows in queries.chunks(BLOCK_QUERIES * d) {
            let count = rows.len() / d;
            let block = &mut block[..n * count];
            block.par_chunks_mut(n).zip(rows.par_chunks(d)).for_each_init(Default::default, |scratch, (out, row)| {
                cross(&self.plan, &self.values, &self.columns, n, 0, row, scratch, out);
            });
            let means: Vec<(f64, Vec<f64>)> =
                block.par_chunks(n).zip(rows.par_chunks(d)).map(|(column, row)| self.mean(row, column)).collect();
            let l = MatRef::from_column_major_slice(&self.factor, n, n);
            solve_lower_triangular_in_place(l, MatMut::from_column_major_slice_mut(block, n, count), parallelism());
            all.extend(means.into_iter().zip(block.chunks(n)).map(|((mean, rest), column)| {
                let explained: f64 = column.iter().map(|v| v * v).sum();
                (mean, (self.values.prior_variance - explained).max(0.0) + self.coefficients.variance(&rest))
            }));
        }
        all
    }

    /// Mean at a row, and the part of its basis that the rows do not explain.
    fn mean(&self, row: &[f64], cross: &[f64]) -> (f64, Vec<f64>) {
        let n = self.data.len();
        let dot = |a: &[f64]| a.iter().zip(cross).map(|(x, y)| x * y).sum::<f64>();
        let rest = |k: usize| self.data.basis.value(row, k) - dot(&self.basis_solved[k * n..][..n]);
        let rest = (0..self.coefficients.beta.len()).map(rest).collect();
        (self.coefficients.mean(self.data.basis, row) + dot(&self.alpha), rest)
    }

    /// For some rows: residual and variance of the measurement, predicted from all other rows (with the present coefficients).
    pub(super) fn left_out(&self, rows: &[u32]) -> Vec<(f64, f64)> {
        let n = self.data.len();
        let mut all = Vec::with_capacity(rows.len());
        for some in rows.chunks(BLOCK_QUERIES) {
            let mut units = vec![0.0; n * some.len()];
            some.iter().enumerate().for_each(|(k, row)| units[k * n + *row as usize] = 1.0);
            let l = MatRef::from_column_major_slice(&self.factor, n, n);
            let right = MatMut::from_column_major_slice_mut(&mut units, n, some.len());
            solve_lower_triangular_in_place(l, right, parallelism());
            all.extend(some.iter().zip(units.chunks(n)).map(|(row, column)| {
                let precision: f64 = column.iter().map(|v| v * v).sum();
                (self.alpha[*row as usize] / precision, 1.0 / precision)
            }));
        }
        all
    }
}

/// The covariance of all measurements, lower triangle.
fn fill(plan: &Plan, values: &Values, data: &StandardisedRows, columns: &[f64], jitter: f64, matrix: &mut [f64]) {
    let n = data.len();
    let diagonal = values.prior_variance * (1.0 + jitter) + values.noise_variance;
    matrix.par_chunks_mut(n).enumerate().with_max_len(COLUMNS).for_each_init(
        Default::default,
        |scratch, (j, column)| {
            column[j] = diagonal;
            cross(plan, values, columns, n, j + 1, data.row(j), scratch, &mut column[j + 1..]);
        },
    );
}
