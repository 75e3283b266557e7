//! Stores and restores the state of an estimator as a document.
//!
//! In: an estimator, or a stored document. Out: the document, or the restored estimator. [`CellState::check`] rejects
//! numbers that no filter can use. If a stored covariance is not positive definite, its correlations are dropped.

use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

use super::cell_estimator::CellEstimator;
use super::gaussian::{Covariance, Gaussian, MAX_STATES};
use super::memory::{Memory, check_log_resistance};
use super::state_vector::{BRANCHES, CAPACITY, CONSTANT_ERRORS, LOG_RESISTANCE};
use crate::quantity::InvalidState;
use crate::quantity::bounds;

/// The estimator's state as a document.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellState {
    /// Mean of the filter's state in the order [SOC, U_1 .. U_n, ln rho, C]; empty before the first voltage.
    mean: Vec<f64>,
    /// Row by row, with the states in the same order as in `mean`.
    covariance: Vec<f64>,
    /// Effect of the constant errors, such as a sensor offset (see `Gaussian::by_constant`): one value per constant
    /// error for each state in `mean`.
    by_constant: Vec<f64>,
    memory: Memory,
}

/// Converts an index in the document, which has `n` states, to the index in the filter.
const fn place_of(i: usize, n: usize) -> usize {
    match i {
        0 => 0,
        i if i + 2 < n => BRANCHES + i - 1,
        i if i + 2 == n => LOG_RESISTANCE,
        _ => CAPACITY,
    }
}

impl CellEstimator {
    /// Returns the state for storing.
    pub fn snapshot(&self) -> CellState {
        let (mean, covariance, by_constant) = self.filter.as_ref().map_or_else(Default::default, document);
        CellState { mean, covariance, by_constant, memory: self.memory }
    }

    /// Restores a stored state. Returns `None` if the number of branches is not `branches`, or if the lengths do not
    /// fit.
    ///
    /// If rounding has made the covariance inconsistent, only its variances are kept. If the SOC is impossible, the
    /// filter is discarded and starts from the next voltage.
    pub fn restore(state: &CellState, branches: usize) -> Option<Self> {
        let filter = match (state.mean.len(), branches) {
            (0, _) => None,
            _ if !state.mean.first().is_some_and(|soc| bounds::FILTER_SOC.has(*soc)) => None,
            (states, _) if states != BRANCHES + branches => return None,
            _ => Some(gaussian(state)?),
        };
        Some(Self { filter, memory: state.memory })
    }
}

impl CellState {
    /// Checks that a filter can continue from the stored numbers.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn check(&self) -> Result<(), InvalidState> {
        self.memory.check()?;
        InvalidState::unless_numbers("a mean of a cell's filter", self.mean.iter().copied())?;
        InvalidState::unless_numbers("a covariance of a cell's filter", self.covariance.iter().copied())?;
        InvalidState::unless_numbers("a constant error of a cell's filter", self.by_constant.iter().copied())?;
        let size = self.mean.len();
        let variances = self.covariance.iter().step_by(size + 1);
        variances.copied().try_for_each(|x| InvalidState::unless_positive("a variance of a cell's filter", x))?;
        let [soc, .., log_resistance, capacity_ah] = self.mean[..] else { return Ok(()) };
        bounds::STORED_SOC.check("the SOC of a cell's filter", soc)?;
        check_log_resistance(log_resistance)?;
        InvalidState::unless_capacity("the capacity of a cell's filter", capacity_ah)
    }
}

fn document(x: &Gaussian) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let n = x.states;
    let place = |i| place_of(i, n);
    let mean = (0..n).map(|i| x.mean[place(i)]).collect();
    // A variance that has decayed to 0 is stored as the smallest allowed variance.
    let least = |i: usize| if i / n == i % n { bounds::VARIANCE.low } else { f64::NEG_INFINITY };
    let covariance = (0..n * n).map(|i| x.covariance[(place(i / n), place(i % n))].max(least(i))).collect();
    let by_constant =
        (0..n * CONSTANT_ERRORS).map(|i| x.by_constant[(place(i / CONSTANT_ERRORS), i % CONSTANT_ERRORS)]);
    (mean, covariance, by_constant.collect())
}

fn gaussian(state: &CellState) -> Option<Gaussian> {
    let n = state.mean.len();
    if state.covariance.len() != n * n || state.by_constant.len() != n * CONSTANT_ERRORS {
        return None;
    }
    let (mut mean, mut covariance, mut by_constant) = (SVector::zeros(), Covariance::zeros(), SMatrix::zeros());
    let place = |i| place_of(i, n);
    for i in 0..n {
        mean[place(i)] = state.mean[i];
        (0..CONSTANT_ERRORS).for_each(|k| by_constant[(place(i), k)] = state.by_constant[i * CONSTANT_ERRORS + k]);
        (0..n).for_each(|j| covariance[(place(i), place(j))] = state.covariance[i * n + j]);
    }
    let mut factored = covariance;
    (n..MAX_STATES).for_each(|i| factored[(i, i)] = 1.0);
    let is_symmetric = (covariance - covariance.transpose()).amax() <= 1e-9 * covariance.amax();
    if !(is_symmetric && factored.cholesky().is_some()) {
        covariance = SMatrix::from_diagonal(&covariance.diagonal());
    }
    Some(Gaussian { states: n, mean, covariance, by_constant })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::CellStep;
    use crate::cell::estimator::tests::config;
    use crate::cell::model::tests::small_model;

    /// Rests the cell at 3.7 V for `seconds`; returns the number of resets.
    fn resets(estimator: &mut CellEstimator, seconds: u32) -> usize {
        let step = CellStep {
            measured_s: 1.0,
            charge_as: 0.0,
            offset_s: 0.0,
            unmeasured_s: 0.0,
            current_a: Some(0.0),
            temperature_c: Some(25.0),
            ambient_c: 25.0,
            voltage_v: 3.7,
            is_voltage_frozen: false,
        };
        (0..seconds).filter(|_| estimator.step(&small_model(), &config(), &step).reset).count()
    }

    fn settled() -> CellState {
        let mut estimator = CellEstimator::new(&config());
        resets(&mut estimator, 100);
        estimator.snapshot()
    }

    #[test]
    fn inconsistent_correlations_are_dropped_and_variances_kept() {
        let mut state = settled();
        let last = state.covariance.len() - 1;
        let both = (state.covariance[0] * state.covariance[last]).sqrt() * 1.01;
        (state.covariance[3], state.covariance[last - 3]) = (both, both);
        assert_eq!(state.check(), Ok(()));
        let mut estimator = CellEstimator::restore(&state, 1).expect("one branch");
        let restored = estimator.snapshot();
        assert_eq!((restored.covariance[0], restored.covariance[3]), (state.covariance[0], 0.0));
        assert_eq!(resets(&mut estimator, 10), 0);
    }

    #[test]
    fn unusable_capacity_is_reset_once() {
        for (mean, variance) in [(2.0, -0.04), (2.0, f64::NAN), (0.0, 0.04)] {
            let mut state = settled();
            let last = state.covariance.len() - 1;
            (state.mean[3], state.covariance[last]) = (mean, variance);
            assert!(state.check().is_err(), "`check` must reject the mean {mean} with the variance {variance}");
            let mut estimator = CellEstimator::restore(&state, 1).expect("one branch");
            assert!(resets(&mut estimator, 20) <= 1, "{mean} {variance}");
            assert!(estimator.capacity().mean > 0.5 && estimator.capacity().variance > 0.0, "{mean} {variance}");
        }
    }
}
