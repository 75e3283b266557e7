//! Computes sigma points in pairs: the columns of the Cholesky factor, and the odd and even parts of a function over
//! each pair (see [`super`]).
//!
//! In: covariances. Out: columns, resistance ratios, and odd and even parts, in the units of the states. If a
//! covariance has no Cholesky factor, `PartialCholesky::is_positive` is false, and results can be NaN.

use super::types::{KernelConstants, at};
use crate::cell::estimator::state_vector::LOG_RESISTANCE;
use crate::filter::simd::{Lanes, Mask};

/// Number of columns of the Cholesky factor that are computed. The other columns change only branch voltages.
pub(super) const COLUMNS: usize = 3;

/// The first columns of the lower Cholesky factor, and the remaining covariance of the branches.
pub(super) struct PartialCholesky<const L: usize, const N: usize> {
    pub(super) columns: [[Lanes<L>; N]; COLUMNS],
    /// `rest[i][j]`: remaining covariance of the branch states i and j <= i. All other elements are zero.
    pub(super) rest: [[Lanes<L>; N]; N],
    pub(super) is_positive: Mask<L>,
}

impl<const L: usize, const N: usize> PartialCholesky<L, N> {
    #[inline(always)]
    pub(super) fn new<const T: usize>(covariance: &[Lanes<L>; T]) -> Self {
        let first = CholeskyColumn::new::<T, 0>(covariance, []);
        let second = CholeskyColumn::new::<T, 1>(covariance, [&first]);
        let third = CholeskyColumn::new::<T, 2>(covariance, [&first, &second]);
        let columns = [first.scaled, second.scaled, third.scaled];
        let mut rest = [[Lanes::splat(0.0); N]; N];
        for i in COLUMNS..N {
            for j in COLUMNS..=i {
                let mut left = covariance[at(i, j)];
                for column in &columns {
                    left = left - column[i] * column[j];
                }
                rest[i][j] = left;
            }
        }
        Self { columns, is_positive: is_positive(&rest), rest }
    }
}

struct CholeskyColumn<const L: usize, const N: usize> {
    /// Column of the covariance, minus the contributions of the previous columns.
    left: [Lanes<L>; N],
    per_pivot: Lanes<L>,
    scaled: [Lanes<L>; N],
}

impl<const L: usize, const N: usize> CholeskyColumn<L, N> {
    /// Computes column K from the previous columns without their square roots, so that the processor does not wait for
    /// a root. If the pivot is not positive, the column contains NaN.
    #[inline(always)]
    fn new<const T: usize, const K: usize>(covariance: &[Lanes<L>; T], done: [&Self; K]) -> Self {
        let mut left = [Lanes::splat(0.0); N];
        for i in K..N {
            left[i] = covariance[at(i, K)];
        }
        for done in done {
            let factor = done.left[K] * done.per_pivot;
            for i in K..N {
                left[i] = left[i] - done.left[i] * factor;
            }
        }
        let root = left[K].sqrt();
        let per_pivot = left[K].reciprocal();
        let per_root = root * per_pivot;
        let mut scaled = [Lanes::splat(0.0); N];
        scaled[K] = root;
        for i in K + 1..N {
            scaled[i] = left[i] * per_root;
        }
        Self { left, per_pivot, scaled }
    }
}

/// Whether the remaining covariance is positive definite.
#[inline(always)]
fn is_positive<const L: usize, const N: usize>(rest: &[[Lanes<L>; N]; N]) -> Mask<L> {
    let mut left = *rest;
    let mut positive = Mask::splat(true);
    for k in COLUMNS..N {
        positive = positive & left[k][k].above_number(0.0);
        for i in k + 1..N {
            let factor = left[i][k] / left[k][k];
            for j in k + 1..=i {
                left[i][j] = left[i][j] - factor * left[j][k];
            }
        }
    }
    positive
}

/// Resistances of the sigma points, divided by the resistance at the centre. The third pair has the same resistance as
/// the centre.
pub(super) struct ResistanceRatios<const L: usize> {
    pub(super) first: [Lanes<L>; 2],
    /// Odd and even part of the second pair's factor: sinh d / s and (cosh d - 1) / s. d is the distance of the points
    /// from the centre in ln(resistance); s is [`KernelConstants::scale`].
    pub(super) second: [Lanes<L>; 2],
}

impl<const L: usize> ResistanceRatios<L> {
    #[inline(always)]
    pub(super) fn new<const N: usize>(c: &KernelConstants, columns: &[[Lanes<L>; N]; COLUMNS]) -> Self {
        let (up, down) = (columns[0][LOG_RESISTANCE] * c.scale).exp_of_both_signs();
        let (grown, shrunk) = (columns[1][LOG_RESISTANCE] * c.scale).exp_of_both_signs();
        let per_scale = 1.0 / c.scale;
        Self {
            first: [up, down],
            second: [(grown - shrunk) * (0.5 * per_scale), ((grown + shrunk) * 0.5 - Lanes::splat(1.0)) * per_scale],
        }
    }
}

/// Odd and even parts of a function, for each pair of the first three columns.
#[derive(Clone, Copy)]
pub(super) struct OddEvenParts<const L: usize> {
    pub(super) odd: [Lanes<L>; COLUMNS],
    pub(super) even: [Lanes<L>; COLUMNS],
}

impl<const L: usize> OddEvenParts<L> {
    pub(super) const NONE: Self = Self { odd: [Lanes([0.0; L]); COLUMNS], even: [Lanes([0.0; L]); COLUMNS] };

    /// Sets the parts of pair `k` from the values of the function at its plus point, at its minus point and at the
    /// centre.
    #[inline(always)]
    pub(super) fn put(&mut self, c: &KernelConstants, k: usize, plus: Lanes<L>, minus: Lanes<L>, centre: Lanes<L>) {
        self.odd[k] = (plus - minus) * (0.5 / c.scale);
        self.even[k] = ((plus + minus) * 0.5 - centre) * (1.0 / c.scale);
    }

    /// Mean of the function minus its value at the centre.
    #[inline(always)]
    pub(super) fn shift(&self, c: &KernelConstants) -> Lanes<L> {
        (self.even[0] + self.even[1] + self.even[2]) * (1.0 / c.scale)
    }
}

#[inline(always)]
pub(super) fn sum<const L: usize>(a: [Lanes<L>; COLUMNS], b: [Lanes<L>; COLUMNS]) -> Lanes<L> {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
