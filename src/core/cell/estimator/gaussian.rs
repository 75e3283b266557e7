//! Mean and covariance of one cell's state, for any number of branches.
//!
//! Values have the units of the states. Inputs are not checked. rho is the cell's resistance relative to the model. A
//! *constant error* is an error that does not change with time, for example the offset of a sensor.

use nalgebra::{SMatrix, SVector};

use super::state_vector::{
    BRANCHES, CAPACITY, CONSTANT_ERRORS, KNOWN_VARIANCE, LOG_RESISTANCE, UNKNOWN_SOC_VARIANCE, square, widened,
};
use crate::cell::MAX_BRANCHES;
use crate::filter::ScalarGaussian;
use crate::quantity::bounds;

pub(super) const MAX_STATES: usize = BRANCHES + MAX_BRANCHES;

pub(super) type Covariance = SMatrix<f64, MAX_STATES, MAX_STATES>;

/// Mean and covariance of a cell's state. Elements from index `states` on are 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Gaussian {
    /// Three, plus one per branch.
    pub(super) states: usize,
    pub(super) mean: SVector<f64, MAX_STATES>,
    /// Covariance without the constant errors, symmetric and positive definite.
    pub(super) covariance: Covariance,
    /// Column k: error of the mean (true minus mean) caused by one standard deviation of constant error k.
    pub(super) by_constant: SMatrix<f64, MAX_STATES, CONSTANT_ERRORS>,
}

pub(super) struct LearnedState {
    pub(super) log_resistance: ScalarGaussian,
    pub(super) capacity: ScalarGaussian,
    /// Covariance of ln rho and the capacity, without the constant errors.
    pub(super) covariance: f64,
    /// Errors of ln rho and of the capacity that the constant errors have caused.
    pub(super) by_constant: SMatrix<f64, 2, CONSTANT_ERRORS>,
}

impl Gaussian {
    /// The state at a start: new SOC and branch voltages, learned resistance and capacity.
    pub(super) fn at_start(soc: ScalarGaussian, branch_variance: &[f64], learned: &LearnedState) -> Self {
        let states = BRANCHES + branch_variance.len();
        let (mut mean, mut by_constant) = (SVector::zeros(), SMatrix::<f64, MAX_STATES, CONSTANT_ERRORS>::zeros());
        let mut variance = SVector::<f64, MAX_STATES>::zeros();
        variance.rows_mut(BRANCHES, branch_variance.len()).copy_from_slice(branch_variance);
        (mean[0], variance[0]) = (soc.mean, soc.variance);
        for (k, (i, kept)) in
            [(LOG_RESISTANCE, learned.log_resistance), (CAPACITY, learned.capacity)].into_iter().enumerate()
        {
            let row = learned.by_constant.row(k);
            (mean[i], variance[i]) = (kept.mean, (kept.variance - row.norm_squared()).max(KNOWN_VARIANCE));
            by_constant.set_row(i, &row);
        }
        let mut x = Self { states, mean, covariance: SMatrix::from_diagonal(&variance), by_constant };
        x.correlate(LOG_RESISTANCE, CAPACITY, learned.covariance);
        x
    }

    pub(super) fn correlate(&mut self, i: usize, j: usize, covariance: f64) {
        (self.covariance[(i, j)], self.covariance[(j, i)]) = (covariance, covariance);
    }

    /// Mean of state `i`, and its variance with the constant errors.
    pub(super) fn marginal(&self, i: usize) -> ScalarGaussian {
        let variance = self.covariance[(i, i)] + self.by_constant.row(i).norm_squared();
        ScalarGaussian { mean: self.mean[i], variance }
    }

    /// Whether a cell can have the state. If not, the filter restarts.
    pub(super) fn is_possible(&self) -> bool {
        bounds::FILTER_SOC.has(self.mean[0])
            && bounds::LOG_RESISTANCE.has(self.mean[LOG_RESISTANCE])
            && bounds::CAPACITY_AH.has(self.mean[CAPACITY])
            && self.mean.iter().chain(&self.by_constant).all(|x| bounds::NUMBER.has(*x))
            && (0..self.states).all(|i| (1e-40..=bounds::NUMBER.high).contains(&self.covariance[(i, i)]))
    }

    /// Corrects the mean by `deviations` standard deviations of a constant error, and multiplies the standard deviation
    /// of the error by `remains`.
    pub(super) fn absorb(&mut self, constant_error: usize, deviations: f64, remains: f64) {
        let column = self.by_constant.column(constant_error).into_owned();
        self.mean += column * deviations;
        if remains <= 1.0 {
            self.by_constant.set_column(constant_error, &(column * remains));
        } else {
            // The constant error has grown. The states do not depend on its new part, so a smaller share of their
            // errors comes from this constant error. The other share moves to `covariance`.
            self.by_constant.set_column(constant_error, &(column / remains));
            self.covariance += column * column.transpose() * (1.0 - 1.0 / square(remains));
        }
    }

    /// Raises the uncertainty after a gap of unknown length. The SOC is unknown. Each branch voltage is between its old
    /// value and 0, because the branch may have relaxed.
    pub(super) fn widen_after_unknown_gap(&mut self) {
        self.covariance[(0, 0)] = widened(self.covariance[(0, 0)], UNKNOWN_SOC_VARIANCE);
        for i in BRANCHES..self.states {
            self.mean[i] *= 0.5;
            self.covariance[(i, i)] += square(self.mean[i]);
        }
    }

    pub(super) fn isolate(&mut self, i: usize) {
        let variance = self.covariance[(i, i)];
        self.covariance.row_mut(i).fill(0.0);
        self.covariance.column_mut(i).fill(0.0);
        self.covariance[(i, i)] = variance;
        self.by_constant.row_mut(i).fill(0.0);
    }

    /// Replaces this Gaussian by its mixture with `other`, which has the weight `weight`. The difference between their
    /// constant errors is small compared with the difference between their means, so it is ignored.
    pub(super) fn merge(&mut self, other: &Self, weight: f64) {
        let apart = other.mean - self.mean;
        let between = apart * apart.transpose();
        self.covariance =
            self.covariance * (1.0 - weight) + other.covariance * weight + between * (weight * (1.0 - weight));
        self.by_constant = self.by_constant * (1.0 - weight) + other.by_constant * weight;
        self.mean += apart * weight;
    }
}
