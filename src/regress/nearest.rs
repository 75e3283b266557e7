//! Implements the Gaussian process with nearest neighbours: Vecchia's approximation (Vecchia 1988, Datta et al. 2016).
//!
//! The rows are put in a seeded random order. The density of all rows is then a product with one term per row: the
//! density of the row given all its predecessors. In the approximation, each term is the density of the row given only
//! its `m` nearest predecessors. The approximation is a proper density. It is exact if every row has at most `m`
//! predecessors. Each term needs a Cholesky factor of a matrix with about `m` rows, regardless of the number of
//! training rows. The density is conditional on measurements, which include noise.
//!
//! For one term, let K be the covariance matrix of the neighbours and the row, with the row last. Let `q = K^-1 e_n`
//! with the last unit vector `e_n`, `A = K^-1 [y H]` and `a = A (1, -beta)'`. The conditional variance of the row is
//! then `1/q_n`, and its residual is `a_n/q_n`. Therefore:
//!
//! `-log p = -1/2 ln q_n + 1/2 a_n^2 / q_n + 1/2 ln 2 pi`,
//!
//! `-d log p = c q' dK q - (a_n/q_n) q' dK a`, with `c = 1/2 (1 + a_n^2/q_n) / q_n`.
//!
//! The coefficients beta are generalised least-squares coefficients, so the derivative with respect to beta is 0.
//!
//! The search for hyperparameters may use a seeded subset of the terms. Neighbours are selected among all rows, so the
//! sum over the subset gives an unbiased estimate of the sum over all terms. If the length scales have changed the
//! order of distances, the neighbours are selected again.
//!
//! Input: standardised rows and hyperparameters. Output: likelihood, gradient and predictions. If a covariance matrix
//! is not positive definite even with the largest jitter, the result is an error.

use std::f64::consts::TAU;

use rayon::prelude::*;

use super::basis::Coefficients;
use super::error::RegressionError;
use super::jitter::{Jitter, until_positive};
use super::kd_tree::KdTree;
use super::linear_algebra::add;
use super::plan::{Covariance, Plan, Work};
use super::scale::StandardisedRows;

/// Number of rows per task. It is fixed, so that the rounding of sums does not depend on the number of threads.
const CHUNK: usize = 64;

#[derive(Debug, Clone)]
pub(super) struct ConditionalFactors {
    pub rows: Vec<u32>,
    neighbours: Vec<Vec<u32>>,
}

pub(super) struct LikelihoodSums {
    /// Negative log density of the rows.
    pub value: f64,
    pub gradient: Vec<f64>,
    pub coefficients: Coefficients,
    pub jitter: Jitter,
}

/// A batch of terms. `g` sums their contributions to `[y H]' K^-1 [y H]`. `log` sums half of `ln(2 pi variance)`.
struct FactorBatch {
    factors: Vec<ConditionalFactor>,
    g: Vec<f64>,
    log: f64,
}

/// Results for one term, which the computation of the gradient uses again.
struct ConditionalFactor {
    q: Vec<f64>,
    /// `K^-1 [y H]`, column-major.
    a: Vec<f64>,
    jitter: f64,
}

impl ConditionalFactors {
    pub(super) fn new(data: &StandardisedRows, rows: Vec<u32>, metric: &[f64], neighbours: usize) -> Self {
        let tree = KdTree::new(&data.inputs, metric);
        let of = |row: &u32| tree.nearest(data.row(*row as usize), neighbours, *row as usize, None);
        let neighbours = rows.par_iter().with_min_len(CHUNK).map(of).collect();
        Self { rows, neighbours }
    }

    /// Returns the sums over all terms. The gradient is computed only on request.
    pub(super) fn sums(
        &self,
        data: &StandardisedRows,
        plan: &Plan,
        theta: &[f64],
        with_gradient: bool,
    ) -> Result<LikelihoodSums, RegressionError> {
        let covariance = &Covariance::new(plan.clone(), theta);
        let size = data.basis.size(data.dimensions);
        let width = size + 1;
        let first: Vec<Result<FactorBatch, RegressionError>> = (self.rows.par_chunks(CHUNK))
            .zip(self.neighbours.par_chunks(CHUNK))
            .map_init(|| Scratch::new(data, covariance), |scratch, (rows, near)| scratch.part(rows, near))
            .collect();
        let (mut g, mut value, mut factors) = (vec![0.0; width * width], 0.0, Vec::with_capacity(first.len()));
        let mut jitter = Jitter::default();
        for part in first {
            let part = part?;
            part.factors.iter().for_each(|factor| jitter.note(factor.jitter));
            add(&mut g, &part.g);
            value += part.log;
            factors.push(part.factors);
        }
        let coefficients = Coefficients::solve(&g, size)?;
        value += 0.5 * coefficients.squared_norm;
        let gradient =
            if with_gradient { self.gradient(data, covariance, &factors, &coefficients.beta) } else { vec![] };
        Ok(LikelihoodSums { value, gradient, coefficients, jitter })
    }

    fn gradient(
        &self,
        data: &StandardisedRows,
        covariance: &Covariance,
        factors: &[Vec<ConditionalFactor>],
        beta: &[f64],
    ) -> Vec<f64> {
        let count = covariance.plan.parameters.len();
        let parts: Vec<Vec<f64>> = (self.neighbours.par_chunks(CHUNK))
            .zip(self.rows.par_chunks(CHUNK).zip(factors))
            .map_init(
                || Scratch::new(data, covariance),
                |scratch, (neighbours, (rows, factors))| {
                    let mut gradient = vec![0.0; count];
                    for ((near, row), factor) in neighbours.iter().zip(rows).zip(factors) {
                        scratch.gather(*row, near);
                        scratch.add_gradient(factor, beta, &mut gradient);
                    }
                    gradient
                },
            )
            .collect();
        let mut gradient = vec![0.0; count];
        parts.iter().for_each(|part| add(&mut gradient, part));
        gradient
    }
}

struct Scratch<'a> {
    data: &'a StandardisedRows,
    covariance: &'a Covariance,
    /// Squared differences of all pairs of rows below the diagonal (column-major). One more pair at the end has the
    /// difference 0 and represents the diagonal.
    squares: Vec<f64>,
    matrix: Vec<f64>,
    weights: Vec<f64>,
    rows: Vec<u32>,
    work: Work,
}

impl<'a> Scratch<'a> {
    fn new(data: &'a StandardisedRows, covariance: &'a Covariance) -> Self {
        let (squares, matrix, weights) = (vec![], vec![], vec![]);
        Self { data, covariance, squares, matrix, weights, rows: vec![], work: Work::default() }
    }

    fn gather(&mut self, row: u32, near: &[u32]) {
        let data = self.data;
        self.rows.clear();
        self.rows.extend_from_slice(near);
        self.rows.push(row);
        let n = self.rows.len();
        let pairs = n * (n - 1) / 2 + 1;
        self.squares.clear();
        for d in 0..data.dimensions {
            let column: Vec<f64> = self.rows.iter().map(|r| data.inputs[*r as usize * data.dimensions + d]).collect();
            for j in 0..n {
                self.squares.extend(column[j + 1..].iter().map(|x| (x - column[j]) * (x - column[j])));
            }
            self.squares.push(0.0);
        }
        debug_assert_eq!(self.squares.len(), pairs * data.dimensions);
    }

    fn part(&mut self, rows: &[u32], neighbours: &[Vec<u32>]) -> Result<FactorBatch, RegressionError> {
        let width = self.data.basis.size(self.data.dimensions) + 1;
        let mut part = FactorBatch { factors: Vec::with_capacity(rows.len()), g: vec![0.0; width * width], log: 0.0 };
        for (row, near) in rows.iter().zip(neighbours) {
            let factor = self.factor(*row, near)?;
            let (n, q) = (factor.q.len(), factor.q[factor.q.len() - 1]);
            let last: Vec<f64> = (0..width).map(|c| factor.a[c * n + n - 1]).collect();
            (0..width * width).for_each(|at| part.g[at] += last[at / width] * last[at % width] / q);
            part.log += 0.5 * (TAU.ln() - q.ln());
            part.factors.push(factor);
        }
        Ok(part)
    }

    fn factor(&mut self, row: u32, near: &[u32]) -> Result<ConditionalFactor, RegressionError> {
        self.gather(row, near);
        let (data, n) = (self.data, self.rows.len());
        let kernel = self.covariance.evaluate(&self.squares, n * (n - 1) / 2 + 1, &mut self.work);
        let jitter = factorise(&mut self.matrix, kernel, n, self.covariance)?;
        let width = data.basis.size(data.dimensions) + 1;
        let mut a = Vec::with_capacity(width * n);
        a.extend(self.rows.iter().map(|r| data.targets[*r as usize]));
        for k in 0..width - 1 {
            a.extend(self.rows.iter().map(|r| data.basis.value(data.row(*r as usize), k)));
        }
        for column in a.chunks_exact_mut(n) {
            forward(&self.matrix, column);
            backward(&self.matrix, column);
        }
        let mut q = vec![0.0; n];
        q[n - 1] = 1.0 / self.matrix[n * n - 1];
        backward(&self.matrix, &mut q);
        Ok(ConditionalFactor { q, a, jitter })
    }

    fn add_gradient(&mut self, factor: &ConditionalFactor, beta: &[f64], gradient: &mut [f64]) {
        let covariance = self.covariance;
        let (q, n) = (&factor.q, factor.q.len());
        let mut a = factor.a[..n].to_vec();
        for (k, coefficient) in beta.iter().enumerate() {
            a.iter_mut().zip(&factor.a[(k + 1) * n..]).for_each(|(total, h)| *total -= coefficient * h);
        }
        let (an, qn) = (a[n - 1], q[n - 1]);
        let (c, b) = (0.5 * (1.0 + an * an / qn) / qn, -an / qn);
        self.weights.clear();
        for j in 0..n {
            let (cq, bq, ba) = (2.0 * c * q[j], b * q[j], b * a[j]);
            self.weights.extend(q[j + 1..].iter().zip(&a[j + 1..]).map(|(qi, ai)| qi * (cq + ba) + bq * ai));
        }
        let diagonal: f64 = q.iter().zip(&a).map(|(q, a)| c * q * q + b * q * a).sum();
        self.weights.push(diagonal * (1.0 + factor.jitter));
        covariance.add_gradient(&self.squares, &self.weights, &mut self.work, gradient);
        gradient[covariance.plan.parameters.len() - 1] += 2.0 * covariance.noise_variance * diagonal;
    }
}

/// Replaces `matrix` by the lower Cholesky factor (column-major) of the covariance matrix. `kernel` is the lower
/// triangle of the covariance matrix without its diagonal. The diagonal is the sum of prior variance, jitter and noise
/// variance. Returns the jitter, as a fraction of the prior variance.
fn factorise(matrix: &mut Vec<f64>, kernel: &[f64], n: usize, covariance: &Covariance) -> Result<f64, RegressionError> {
    matrix.resize(n * n, 0.0);
    until_positive(|jitter| {
        let mut from = 0;
        for j in 0..n {
            matrix[j * n + j] = covariance.prior_variance * (1.0 + jitter) + covariance.noise_variance;
            matrix[j * n + j + 1..][..n - j - 1].copy_from_slice(&kernel[from..][..n - j - 1]);
            from += n - j - 1;
        }
        faer::traits::pulp::Arch::new().dispatch(|| cholesky(matrix, n))
    })
}

/// Replaces a lower triangle (column-major) by its Cholesky factor. Returns `false` if the matrix is not positive
/// definite.
#[inline(always)]
fn cholesky(matrix: &mut [f64], n: usize) -> bool {
    for j in 0..n {
        let (before, rest) = matrix.split_at_mut(j * n);
        let column = &mut rest[j..n];
        // Loading and storing the current column dominates the cost, so four earlier columns are subtracted at a time.
        let mut k = 0;
        while k + 4 <= j {
            let c = |i: usize| &before[(k + i) * n + j..(k + i + 1) * n];
            let (c0, c1, c2, c3) = (c(0), c(1), c(2), c(3));
            let (f0, f1, f2, f3) = (c0[0], c1[0], c2[0], c3[0]);
            for i in 0..column.len() {
                column[i] -= (f0 * c0[i] + f1 * c1[i]) + (f2 * c2[i] + f3 * c3[i]);
            }
            k += 4;
        }
        for k in k..j {
            let other = &before[k * n + j..(k + 1) * n];
            let f = other[0];
            column.iter_mut().zip(other).for_each(|(x, o)| *x -= f * o);
        }
        let pivot = column[0];
        if pivot.is_nan() || pivot <= 0.0 {
            return false;
        }
        let inverse = 1.0 / pivot.sqrt();
        column.iter_mut().for_each(|x| *x *= inverse);
        column[0] = pivot.sqrt();
    }
    true
}

/// Solves `L x = b` in place, with the lower factor in `matrix`.
fn forward(matrix: &[f64], b: &mut [f64]) {
    let n = b.len();
    for j in 0..n {
        b[j] /= matrix[j * n + j];
        let f = b[j];
        let column = &matrix[j * n + j + 1..(j + 1) * n];
        b[j + 1..].iter_mut().zip(column).for_each(|(x, l)| *x -= f * l);
    }
}

/// Solves `L' x = b` in place, with the lower factor in `matrix`.
fn backward(matrix: &[f64], b: &mut [f64]) {
    let n = b.len();
    for j in (0..n).rev() {
        let column = &matrix[j * n + j + 1..(j + 1) * n];
        let dot: f64 = column.iter().zip(&b[j + 1..]).map(|(l, x)| l * x).sum();
        b[j] = (b[j] - dot) / matrix[j * n + j];
    }
}

#[derive(Debug, Clone)]
pub(super) struct Posterior {
    pub data: StandardisedRows,
    covariance: Covariance,
    pub coefficients: Coefficients,
    pub neighbours: usize,
    tree: KdTree,
}

impl Posterior {
    pub(super) fn new(
        data: StandardisedRows,
        plan: Plan,
        theta: &[f64],
        coefficients: Coefficients,
        neighbours: usize,
    ) -> Self {
        let covariance = Covariance::new(plan, theta);
        let tree = KdTree::new(&data.inputs, &covariance.metric());
        Self { data, covariance, coefficients, neighbours, tree }
    }

    /// Returns mean and variance of the function at standardised rows. If `excluded` is given, the prediction of row
    /// `k` ignores the training row `excluded[k]`.
    pub(super) fn predict(
        &self,
        queries: &[f64],
        excluded: Option<&[u32]>,
    ) -> Result<Vec<(f64, f64)>, RegressionError> {
        let d = self.data.dimensions;
        let parts: Result<Vec<Vec<(f64, f64)>>, RegressionError> = (queries.par_chunks(CHUNK * d).enumerate())
            .map_init(
                || Scratch::new(&self.data, &self.covariance),
                |scratch, (chunk, rows)| {
                    let one = |(at, row): (usize, &[f64])| {
                        self.one(scratch, row, excluded.map(|excluded| excluded[chunk * CHUNK + at] as usize))
                    };
                    rows.chunks_exact(d).enumerate().map(one).collect()
                },
            )
            .collect();
        Ok(parts?.concat())
    }

    fn one(&self, scratch: &mut Scratch, row: &[f64], excluded: Option<usize>) -> Result<(f64, f64), RegressionError> {
        let near = self.tree.nearest(row, self.neighbours, self.data.len(), excluded);
        let (Some((last, rest)), n) = (near.split_last(), near.len()) else {
            let h: Vec<f64> = (0..self.coefficients.beta.len()).map(|k| self.data.basis.value(row, k)).collect();
            let variance = self.covariance.prior_variance + self.coefficients.variance(&h);
            return Ok((self.coefficients.mean(self.data.basis, row), variance));
        };
        scratch.gather(*last, rest);
        let kernel = self.covariance.evaluate(&scratch.squares, n * (n - 1) / 2 + 1, &mut scratch.work);
        factorise(&mut scratch.matrix, kernel, n, &self.covariance)?;
        scratch.squares.clear();
        for (d, x) in row.iter().enumerate() {
            let value = |r: &u32| self.data.row(*r as usize)[d] - x;
            scratch.squares.extend(near.iter().map(|r| value(r) * value(r)));
        }
        let mut cross = self.covariance.evaluate(&scratch.squares, n, &mut scratch.work).to_vec();
        forward(&scratch.matrix, &mut cross);
        let explained: f64 = cross.iter().map(|v| v * v).sum();
        backward(&scratch.matrix, &mut cross);
        let mut mean = self.coefficients.mean(self.data.basis, row);
        let mut rest: Vec<f64> = (0..self.coefficients.beta.len()).map(|k| self.data.basis.value(row, k)).collect();
        for (weight, r) in cross.iter().zip(&near) {
            let near_row = self.data.row(*r as usize);
            mean += weight * (self.data.targets[*r as usize] - self.coefficients.mean(self.data.basis, near_row));
            (0..rest.len()).for_each(|k| rest[k] -= weight * self.data.basis.value(near_row, k));
        }
        let variance = (self.covariance.prior_variance - explained).max(0.0) + self.coefficients.variance(&rest);
        Ok((mean, variance))
    }
}
