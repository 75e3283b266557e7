//! Gaussian process through inducing points (fully independent training conditional, FITC; Snelson and Ghahramani 2006,
//! Quinonero-Candela and Rasmussen 2005).
//!
//! With u the function at `m` points Z, rows are independent given u: `K = V'V + diag(l)` with `V = L^-1 k(Z, X)`,
//! `L L' = k(Z, Z)` and `l_i = k(x_i, x_i) - |v_i|^2 + noise`: a noise of its own for each row. With `B = I + V l^-1 V'`,
//! `c = B^-1 V l^-1 e`, `e = y - H beta` and `a_i = (e_i - v_i' c) / l_i`:
//!
//! `-log p = 1/2 (sum ln l_i + ln |B| + sum e_i^2 / l_i - c' V l^-1 e) + n/2 ln 2 pi`.
//!
//! Derivative, with `w_i = 1/2 (1/l_i - v_i' B^-1 v_i / l_i^2 - a_i^2)`, `Y_i = 1/2 B^-1 v_i / l_i - v_i w_i - 1/2 c a_i`:
//! by `k(Z, X)` it is `2 L^-T Y`, by `k(Z, Z)` `-L^-T Y V' L^-1`, by the variance of row i (and its noise) `w_i`.
//!
//! In: standardised rows, inducing points and hyperparameters. Out: likelihood, gradient, predictions. A matrix that is not
//! positive definite with the largest jitter is an error. Rows are processed in blocks, twice; memory is m^2 and m times a block, for any number of rows. `k(Z, Z)` always
//! has a hundred-millionth added to its diagonal: a smooth kernel could seldom be factorised without it.

use std::f64::consts::TAU;

use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::solve_upper_triangular_in_place;
use faer::{Accum, MatMut, MatRef};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::basis::Coefficients;
use super::error::RegressionError;
use super::jitter::{Jitter, until_positive};
use super::kd_tree::KdTree;
use super::linear_algebra::{add, cholesky, dot, log_determinant, parallelism, solve_lower, solve_upper};
use super::pairs::{BLOCK_PAIRS, by_column, squares};
use super::plan::{Covariance, Plan, Work};
use super::scale::StandardisedRows;

/// Rows of a block.
const BLOCK: usize = 512;
/// Part of its diagonal added to `k(Z, Z)`.
const NUGGET: f64 = 1e-8;
/// Passes of k-means.
const MEANS_PASSES: usize = 10;

/// State for predictions.
#[derive(Debug, Clone)]
pub(super) struct Posterior {
    pub data: StandardisedRows,
    covariance: Covariance,
    coefficients: Coefficients,
    points: Vec<f64>,
    /// Points, column after column.
    columns: Vec<f64>,
    /// Factor of `k(Z, Z)`, lower, column after column.
    l: Vec<f64>,
    /// Factor of B.
    b: Vec<f64>,
    c: Vec<f64>,
    /// `B^-1 V l^-1 H`, column after column.
    basis_solved: Vec<f64>,
    /// Jitter of `k(Z, Z)`.
    added: f64,
    /// Minus the log likelihood.
    pub value: f64,
    pub jitter: Jitter,
}

/// Points as means of clusters of rows in the metric: seeded k-means.
pub(super) fn choose(data: &StandardisedRows, metric: &[f64], count: usize, seed: u64) -> Vec<f64> {
    let (n, d) = (data.len(), data.dimensions);
    if count >= n {
        return data.inputs.clone();
    }
    let mut first: Vec<usize> = (0..n).collect();
    first.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
    first.truncate(count);
    first.sort_unstable();
    let mut points: Vec<f64> = first.iter().flat_map(|row| data.row(*row).to_vec()).collect();
    for _ in 0..MEANS_PASSES {
        let tree = KdTree::new(&points, metric);
        let nearest: Vec<u32> =
            data.inputs.par_chunks(d).with_min_len(64).map(|row| tree.nearest(row, 1, count, None)[0]).collect();
        let (mut sums, mut members) = (vec![0.0; points.len()], vec![0.0; count]);
        for (row, point) in nearest.iter().enumerate() {
            let point = *point as usize;
            members[point] += 1.0;
            sums[point * d..][..d].iter_mut().zip(data.row(row)).for_each(|(sum, x)| *sum += x);
        }
        // A point without rows (two were equal) keeps its position.
        (0..points.len()).filter(|at| members[at / d] > 0.0).for_each(|at| points[at] = sums[at] / members[at / d]);
    }
    points
}

/// One block of rows: `V`, column after column, and l.
struct Block {
    v: Vec<f64>,
    l: Vec<f64>,
}

impl Posterior {
    pub(super) fn new(
        data: &StandardisedRows,
        plan: &Plan,
        theta: &[f64],
        points: &[f64],
    ) -> Result<Self, RegressionError> {
        let covariance = Covariance::new(plan.clone(), theta);
        let (d, m) = (data.dimensions, points.len() / data.dimensions);
        let columns = by_column(points, d);
        let (l, added) = factor_of_points(&covariance, points, &columns)?;
        let mut jitter = Jitter::default();
        jitter.note(added);
        let mut posterior = Self {
            data: data.clone(),
            covariance,
            coefficients: Coefficients { beta: vec![], covariance: vec![], squared_norm: 0.0 },
            points: points.to_vec(),
            columns,
            l,
            b: vec![0.0; m * m],
            c: vec![],
            basis_solved: vec![],
            added,
            value: 0.0,
            jitter,
        };
        posterior.first_pass()?;
        Ok(posterior)
    }

    pub(super) fn points(&self) -> &[f64] {
        &self.points
    }

    fn count(&self) -> usize {
        self.points.len() / self.data.dimensions
    }

    /// `L^-1 k(Z, x)` of rows, column after column.
    fn projected(&self, rows: &[f64]) -> Vec<f64> {
        let (m, d) = (self.count(), self.data.dimensions);
        let count = rows.len() / d;
        let mut v = vec![0.0; m * count];
        v.par_chunks_mut(m).zip(rows.par_chunks(d)).for_each_init(Default::default, |scratch, (out, row)| {
            self.covariance.cross(&self.columns, 0, row, scratch, out);
        });
        solve_lower(&self.l, m, &mut v);
        v
    }

    fn block(&self, rows: &[f64]) -> Block {
        let v = self.projected(rows);
        let own = |column: &[f64]| {
            (self.covariance.prior_variance - dot(column, column)).max(0.0) + self.covariance.noise_variance
        };
        let l = v.chunks(self.count()).map(own).collect();
        Block { v, l }
    }

    /// Target and basis of a row.
    fn right(&self, row: usize) -> Vec<f64> {
        let size = self.data.basis.size(self.data.dimensions);
        let basis = (0..size).map(|k| self.data.basis.value(self.data.row(row), k));
        std::iter::once(self.data.targets[row]).chain(basis).collect()
    }

    fn first_pass(&mut self) -> Result<(), RegressionError> {
        let (m, n, d) = (self.count(), self.data.len(), self.data.dimensions);
        let size = self.data.basis.size(d);
        let width = size + 1;
        let mut b = vec![0.0; m * m];
        (0..m).for_each(|k| b[k * m + k] = 1.0);
        let (mut right, mut g, mut logs) = (vec![0.0; m * width], vec![0.0; width * width], 0.0);
        for (at, rows) in self.data.inputs.chunks(BLOCK * d).enumerate() {
            let mut block = self.block(rows);
            for (k, (column, l)) in block.v.chunks_mut(m).zip(&block.l).enumerate() {
                let row = self.right(at * BLOCK + k);
                (0..width * width).for_each(|p| g[p] += row[p / width] * row[p % width] / l);
                for (c, x) in row.iter().enumerate() {
                    right[c * m..][..m].iter_mut().zip(column.iter()).for_each(|(sum, v)| *sum += v * x / l);
                }
                logs += l.ln();
                let root = l.sqrt().recip();
                column.iter_mut().for_each(|v| *v *= root);
            }
            add_square(&mut b, &block.v, m);
        }
        if !cholesky(&mut b, m) {
            return Err(RegressionError::NotPositiveDefinite { jitter: self.added });
        }
        self.b = b;
        solve_lower(&self.b, m, &mut right);
        for at in 0..width * width {
            g[at] -= dot(&right[at / width * m..][..m], &right[at % width * m..][..m]);
        }
        self.coefficients = Coefficients::solve(&g, size)?;
        (self.c, self.basis_solved) = self.coefficients.weights(&self.b, m, right);
        self.value = 0.5 * (logs + log_determinant(&self.b, m) + self.coefficients.squared_norm + n as f64 * TAU.ln());
        Ok(())
    }

    /// `B^-1/2 v` (lower factor) of a block.
    fn through_b(&self, v: &[f64]) -> Vec<f64> {
        let mut t = v.to_vec();
        solve_lower(&self.b, self.count(), &mut t);
        t
    }

    /// `a_i` and `v_i' B^-1 v_i` of a row.
    fn weight(&self, row: usize, v: &[f64], t: &[f64], l: f64) -> (f64, f64) {
        let mean = self.coefficients.mean(self.data.basis, self.data.row(row)) + dot(v, &self.c);
        ((self.data.targets[row] - mean) / l, dot(t, t))
    }

    /// Derivative of minus the log likelihood by every parameter.
    pub(super) fn gradient(&self) -> Vec<f64> {
        let (m, d) = (self.count(), self.data.dimensions);
        let parameters = self.covariance.plan.parameters.len();
        let (mut gradient, mut by_points, mut by_rows) = (vec![0.0; parameters], vec![0.0; m * m], 0.0);
        for (at, rows) in self.data.inputs.chunks(BLOCK * d).enumerate() {
            let block = self.block(rows);
            let count = block.l.len();
            let mut y = self.through_b(&block.v);
            let weights: Vec<(f64, f64)> = (0..count)
                .map(|k| {
                    let (v, t, l) = (&block.v[k * m..][..m], &y[k * m..][..m], block.l[k]);
                    let (a, square) = self.weight(at * BLOCK + k, v, t, l);
                    (a, 0.5 * (1.0 / l - square / (l * l) - a * a))
                })
                .collect();
            by_rows += weights.iter().map(|(_, w)| w).sum::<f64>();
            solve_upper(&self.b, m, &mut y);
            for (k, column) in y.chunks_mut(m).enumerate() {
                let ((a, w), half) = (weights[k], 0.5 / block.l[k]);
                let others = block.v[k * m..][..m].iter().zip(&self.c);
                column.iter_mut().zip(others).for_each(|(y, (v, c))| *y = half * *y - w * v - 0.5 * a * c);
            }
            let product = MatMut::from_column_major_slice_mut(&mut by_points, m, m);
            let (left, right) =
                (MatRef::from_column_major_slice(&y, m, count), MatRef::from_column_major_slice(&block.v, m, count));
            matmul(product, Accum::Add, left, right.transpose(), -1.0, parallelism());
            solve_upper(&self.l, m, &mut y);
            y.iter_mut().for_each(|p| *p *= 2.0);
            self.add_columns(rows, &y, &mut gradient);
        }
        self.add_points(by_points, by_rows, &mut gradient);
        gradient[parameters - 1] += 2.0 * self.covariance.noise_variance * by_rows;
        gradient
    }

    /// Adds the derivative through `k(Z, x)` of rows, weights column after column.
    fn add_columns(&self, rows: &[f64], weights: &[f64], gradient: &mut [f64]) {
        let (m, d) = (self.count(), self.data.dimensions);
        let parts: Vec<Vec<f64>> = (weights.par_chunks(m).zip(rows.par_chunks(d)))
            .map_init(Default::default, |scratch: &mut (Vec<f64>, Work), (column, row)| {
                let mut part = vec![0.0; gradient.len()];
                for (k, some) in column.chunks(BLOCK_PAIRS).enumerate() {
                    squares(&self.columns, k * BLOCK_PAIRS, some.len(), row, &mut scratch.0);
                    self.covariance.add_gradient(&scratch.0, some, &mut scratch.1, &mut part);
                }
                part
            })
            .collect();
        parts.iter().for_each(|part| add(gradient, part));
    }

    /// Adds the derivative through `k(Z, Z)` (from `-Y V'`) and through the variances of the rows.
    fn add_points(&self, mut weights: Vec<f64>, by_rows: f64, gradient: &mut [f64]) {
        let (m, d) = (self.count(), self.data.dimensions);
        let upper = MatRef::from_column_major_slice(&self.l, m, m).transpose();
        let mut square = MatMut::from_column_major_slice_mut(&mut weights, m, m);
        solve_upper_triangular_in_place(upper, square.as_mut(), parallelism());
        solve_upper_triangular_in_place(upper, square.as_mut().transpose_mut(), parallelism());
        let mut diagonal = by_rows;
        let mut scratch: (Vec<f64>, Work) = Default::default();
        for j in 0..m {
            let point = &self.points[j * d..][..d];
            diagonal += weights[j * m + j] * (1.0 + NUGGET + self.added);
            for from in (j + 1..m).step_by(BLOCK_PAIRS) {
                let count = BLOCK_PAIRS.min(m - from);
                squares(&self.columns, from, count, point, &mut scratch.0);
                let both: Vec<f64> = (from..from + count).map(|i| weights[j * m + i] + weights[i * m + j]).collect();
                self.covariance.add_gradient(&scratch.0, &both, &mut scratch.1, gradient);
            }
        }
        self.covariance.add_gradient(&vec![0.0; d], &[diagonal], &mut scratch.1, gradient);
    }

    /// Mean and variance of the function at standardised rows.
    pub(super) fn predict(&self, queries: &[f64]) -> Vec<(f64, f64)> {
        let (m, d) = (self.count(), self.data.dimensions);
        let mut all = Vec::with_capacity(queries.len() / d);
        for rows in queries.chunks(BLOCK * d) {
            let v = self.projected(rows);
            let t = self.through_b(&v);
            all.extend(rows.chunks(d).zip(v.chunks(m).zip(t.chunks(m))).map(|(row, (v, t))| {
                let solved = |k: usize| dot(v, &self.basis_solved[k * m..][..m]);
                let rest: Vec<f64> =
                    (0..self.coefficients.beta.len()).map(|k| self.data.basis.value(row, k) - solved(k)).collect();
                let own = (self.covariance.prior_variance - dot(v, v)).max(0.0);
                let mean = self.coefficients.mean(self.data.basis, row) + dot(v, &self.c);
                (mean, own + dot(t, t) + self.coefficients.variance(&rest))
            }));
        }
        all
    }

    /// For some rows: residual and variance of the measurement, predicted from all other rows (with the present coefficients).
    pub(super) fn left_out(&self, rows: &[u32]) -> Vec<(f64, f64)> {
        let m = self.count();
        let mut all = Vec::with_capacity(rows.len());
        for some in rows.chunks(BLOCK) {
            let inputs: Vec<f64> = some.iter().flat_map(|row| self.data.row(*row as usize).to_vec()).collect();
            let block = self.block(&inputs);
            let t = self.through_b(&block.v);
            all.extend(some.iter().enumerate().map(|(k, row)| {
                let l = block.l[k];
                let (a, square) = self.weight(*row as usize, &block.v[k * m..][..m], &t[k * m..][..m], l);
                let precision = (1.0 / l - square / (l * l)).max(f64::MIN_POSITIVE);
                (a / precision, 1.0 / precision)
            }));
        }
        all
    }
}

/// Adds `v v'` to the lower triangle of `b`.
fn add_square(b: &mut [f64], v: &[f64], m: usize) {
    let v = MatRef::from_column_major_slice(v, m, v.len() / m);
    triangular::matmul(
        MatMut::from_column_major_slice_mut(b, m, m),
        BlockStructure::TriangularLower,
        Accum::Add,
        v,
        BlockStructure::Rectangular,
        v.transpose(),
        BlockStructure::Rectangular,
        1.0,
        parallelism(),
    );
}

/// Factor of `k(Z, Z)`, and the jitter on its diagonal, as part of it.
fn factor_of_points(
    covariance: &Covariance,
    points: &[f64],
    columns: &[f64],
) -> Result<(Vec<f64>, f64), RegressionError> {
    let d = covariance.plan.dimensions;
    let m = points.len() / d;
    let mut matrix = vec![0.0; m * m];
    let jitter = until_positive(|jitter| {
        let mut scratch = Default::default();
        for (j, column) in matrix.chunks_mut(m).enumerate() {
            column[j] = covariance.prior_variance * (1.0 + NUGGET + jitter);
            covariance.cross(columns, j + 1, &points[j * d..][..d], &mut scratch, &mut column[j + 1..]);
        }
        cholesky(&mut matrix, m)
    })?;
    Ok((matrix, jitter))
}
