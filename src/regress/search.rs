//! Hyperparameters by maximum marginal likelihood: where to start, within which bounds, from how many places.

use std::ops::ControlFlow;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::minimise::{Limits, Lowest, Point, minimise};
use super::plan::{Parameter, Plan, Role};
use super::{Fault, Progress, Watcher};

/// Fall of the negative log likelihood per row that no longer counts; twice running ends a search.
const CONVERGED_PER_ROW: f64 = 5e-6;

/// Lowest and highest value of a parameter, in standardised units, before the logarithm.
fn bounds(role: Role) -> (f64, f64) {
    match role {
        Role::Length => (1e-4, 1e4),
        Role::Alpha => (1e-2, 1e3),
        // More is a mean function in disguise, along a ridge that takes long to follow.
        Role::Signal => (1e-3, 2e1),
        // Not less: the matrix stays positive definite with the roundings of a smooth kernel.
        Role::Noise => (1e-4, 1e1),
    }
}

/// Where a random start may lie.
fn start_range(role: Role) -> (f64, f64) {
    match role {
        Role::Length => (0.05, 5.0),
        Role::Alpha => (0.2, 5.0),
        Role::Signal => (0.3, 3.0),
        Role::Noise => (0.03, 0.8),
    }
}

/// Logarithms of bounds; `spread` is the standard deviation of the inputs (1 when they are standardised).
pub(super) fn log_bounds(plan: &Plan, spread: f64) -> (Vec<f64>, Vec<f64>) {
    let of = |parameter: &Parameter| {
        let (low, high) = bounds(parameter.role);
        let unit = if parameter.role == Role::Length { spread } else { 1.0 };
        ((low * unit).ln(), (high * unit).ln())
    };
    plan.parameters.iter().map(of).unzip()
}

/// The start when none is given: length scales of one standard deviation, noise 30 % of the targets' deviation.
pub(super) fn first_start(plan: &Plan, spread: f64) -> Vec<f64> {
    let signals = plan.parameters.iter().filter(|p| p.role == Role::Signal).count().max(1);
    let of = |parameter: &Parameter| match parameter.role {
        Role::Length => spread.ln(),
        Role::Alpha => 0.0,
        Role::Signal => -0.5 * (signals as f64).ln(),
        Role::Noise => 0.3_f64.ln(),
    };
    plan.parameters.iter().map(of).collect()
}

/// The `k`-th random start of a seed, k from 1.
pub(super) fn random_start(plan: &Plan, spread: f64, seed: u64, k: usize) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(k as u64);
    let mut of = |parameter: &Parameter| {
        let (low, high) = start_range(parameter.role);
        let unit = if parameter.role == Role::Length { spread } else { 1.0 };
        let part: f64 = random.random();
        ((low * unit).ln()) * (1.0 - part) + (high * unit).ln() * part
    };
    plan.parameters.iter().map(&mut of).collect()
}

/// One search with its place in the whole, for the watcher.
pub(super) struct Watched<'a, 'w> {
    pub watcher: &'a mut Watcher<'w>,
    pub progress: Progress,
    pub rows: usize,
}

impl Watched<'_, '_> {
    pub(super) fn tell(&mut self, iteration: usize, value: f64) -> Result<(), Fault> {
        self.progress.iteration = iteration;
        self.progress.log_likelihood_per_row = -value / self.rows as f64;
        match (self.watcher)(self.progress) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(Fault::Cancelled),
        }
    }
}

/// Searches from one start. A matrix that cannot be factorised counts as no value there.
pub(super) fn descend(
    start: &[f64],
    (low, high): (&[f64], &[f64]),
    max_iterations: usize,
    watched: &mut Watched,
    mut objective: impl FnMut(&[f64]) -> Result<(f64, Vec<f64>), Fault>,
) -> Result<Option<Lowest>, Fault> {
    let limits = Limits { low, high, max_iterations, tolerance: CONVERGED_PER_ROW * watched.rows as f64 };
    // The search works per row, so that a first step of the gradient's length is a sensible one.
    let scale = 1.0 / watched.rows as f64;
    let limits = Limits { tolerance: limits.tolerance * scale, ..limits };
    let evaluate = |theta: &[f64]| -> Result<Point, Fault> {
        match objective(theta) {
            Ok((value, gradient)) => Ok(Some((value * scale, gradient.iter().map(|g| g * scale).collect()))),
            Err(Fault::NotPositiveDefinite { .. }) => Ok(None),
            Err(other) => Err(other),
        }
    };
    let rows = watched.rows as f64;
    minimise(start, &limits, evaluate, |at| watched.tell(at.iterations, at.value * rows))
}
