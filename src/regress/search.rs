//! Finds hyperparameters with maximum marginal likelihood: starts, bounds, and the search from each start.
//!
//! Input: a plan (the list of hyperparameters) and an objective, which is a function of the logarithms of these
//! parameters. Output: the best point, or `None` if the objective has no value at the start.

use std::ops::ControlFlow;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::error::RegressionError;
use super::minimise::{Evaluation, Minimum, SearchLimits, minimise};
use super::plan::{Parameter, ParameterRole, Plan};
use super::settings::{FitProgress, ProgressCallback};

/// Returns the bounds of a parameter and the range of its random starts, in standardised units (not logarithms).
fn ranges(role: ParameterRole) -> [(f64, f64); 2] {
    match role {
        ParameterRole::Length => [(1e-4, 1e4), (0.05, 5.0)],
        ParameterRole::Alpha => [(1e-2, 1e3), (0.2, 5.0)],
        // With larger values, the process would act like a mean function, and a long ridge of the likelihood would slow
        // the search.
        ParameterRole::Signal => [(1e-3, 2e1), (0.3, 3.0)],
        // The lower bound keeps the matrix of a smooth kernel positive definite despite rounding.
        ParameterRole::Noise => [(1e-4, 1e1), (0.03, 0.8)],
    }
}

/// Returns the logarithms of the bounds. `spread` is the typical standard deviation of an input; 1 = the inputs are
/// standardised.
pub(super) fn log_bounds(plan: &Plan, spread: f64) -> (Vec<f64>, Vec<f64>) {
    let of = |parameter: &Parameter| {
        let [(low, high), _] = ranges(parameter.role);
        let unit = if parameter.role == ParameterRole::Length { spread } else { 1.0 };
        ((low * unit).ln(), (high * unit).ln())
    };
    plan.parameters.iter().map(of).unzip()
}

/// Returns the default start: length scales of one standard deviation of the inputs, and noise of 30 % of the target's
/// standard deviation.
pub(super) fn first_start(plan: &Plan, spread: f64) -> Vec<f64> {
    let signals = plan.parameters.iter().filter(|p| p.role == ParameterRole::Signal).count().max(1);
    let of = |parameter: &Parameter| match parameter.role {
        ParameterRole::Length => spread.ln(),
        ParameterRole::Alpha => 0.0,
        ParameterRole::Signal => -0.5 * (signals as f64).ln(),
        ParameterRole::Noise => 0.3_f64.ln(),
    };
    plan.parameters.iter().map(of).collect()
}

/// Returns the `k`-th random start of a seed; `k` counts from 1.
pub(super) fn random_start(plan: &Plan, spread: f64, seed: u64, k: usize) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(k as u64);
    let mut of = |parameter: &Parameter| {
        let [_, (low, high)] = ranges(parameter.role);
        let unit = if parameter.role == ParameterRole::Length { spread } else { 1.0 };
        let part: f64 = random.random();
        ((low * unit).ln()) * (1.0 - part) + (high * unit).ln() * part
    };
    plan.parameters.iter().map(&mut of).collect()
}

pub(super) struct SearchMonitor<'a, 'w> {
    pub watcher: &'a mut ProgressCallback<'w>,
    pub progress: FitProgress,
    pub rows: usize,
}

impl SearchMonitor<'_, '_> {
    pub(super) fn report(&mut self, iteration: usize, value: f64) -> Result<(), RegressionError> {
        self.progress.iteration = iteration;
        self.progress.log_likelihood_per_row = -value / self.rows as f64;
        match (self.watcher)(self.progress) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(RegressionError::Cancelled),
        }
    }
}

/// Searches from one start. The objective has no value at a point where a matrix cannot be factorised.
pub(super) fn descend(
    start: &[f64],
    (low, high): (&[f64], &[f64]),
    max_iterations: usize,
    monitor: &mut SearchMonitor,
    mut objective: impl FnMut(&[f64]) -> Result<(f64, Vec<f64>), RegressionError>,
) -> Result<Option<Minimum>, RegressionError> {
    // The first step is as long as the gradient, so the objective is divided by the number of rows.
    let rows = monitor.rows as f64;
    let scale = 1.0 / rows;
    // The search ends after two successive steps that each lower the negative log likelihood per row by less than 5e-6.
    let limits = SearchLimits { low, high, max_iterations, tolerance: 5e-6 * rows * scale };
    let evaluate = |theta: &[f64]| -> Result<Evaluation, RegressionError> {
        match objective(theta) {
            Ok((value, gradient)) => Ok(Some((value * scale, gradient.iter().map(|g| g * scale).collect()))),
            Err(RegressionError::NotPositiveDefinite { .. }) => Ok(None),
            Err(other) => Err(other),
        }
    };
    minimise(start, &limits, evaluate, |at| monitor.report(at.iterations, at.value * rows))
}
