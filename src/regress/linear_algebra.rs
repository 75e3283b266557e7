//! Provides dense linear algebra on column-major slices. The factorisation and the solvers use all threads of the
//! current thread pool.
//!
//! [`cholesky`] reports a matrix that is not positive definite. If an input is NaN, the result is NaN.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{MatMut, MatRef, Par};

/// Returns the number of threads of the current thread pool, in the form that faer needs.
pub(super) fn parallelism() -> Par {
    match rayon::current_num_threads() {
        0 | 1 => Par::Seq,
        threads => Par::rayon(threads),
    }
}

/// Replaces the lower triangle of a matrix by its Cholesky factor. Returns `false` if the matrix is not positive
/// definite.
pub(super) fn cholesky(matrix: &mut [f64], n: usize) -> bool {
    let par = parallelism();
    let mut memory = MemBuffer::new(llt::factor::cholesky_in_place_scratch::<f64>(n, par, Default::default()));
    let matrix = MatMut::from_column_major_slice_mut(matrix, n, n);
    let done =
        llt::factor::cholesky_in_place(matrix, Default::default(), par, MemStack::new(&mut memory), Default::default());
    done.is_ok()
}

/// Solves `L X = right` in place. `l` is a lower Cholesky factor of size `n`.
pub(super) fn solve_lower(l: &[f64], n: usize, right: &mut [f64]) {
    let columns = right.len() / n;
    let right = MatMut::from_column_major_slice_mut(right, n, columns);
    solve_lower_triangular_in_place(MatRef::from_column_major_slice(l, n, n), right, parallelism());
}

/// Solves `L' X = right` in place. `l` is a lower Cholesky factor of size `n`.
pub(super) fn solve_upper(l: &[f64], n: usize, right: &mut [f64]) {
    let columns = right.len() / n;
    let right = MatMut::from_column_major_slice_mut(right, n, columns);
    solve_upper_triangular_in_place(MatRef::from_column_major_slice(l, n, n).transpose(), right, parallelism());
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

pub(super) fn add(total: &mut [f64], part: &[f64]) {
    total.iter_mut().zip(part).for_each(|(total, part)| *total += part);
}

pub(super) fn log_determinant(l: &[f64], n: usize) -> f64 {
    (0..n).map(|k| l[k * n + k].ln()).sum::<f64>() * 2.0
}
