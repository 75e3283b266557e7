//! Gaussian process regression: pure numbers, knows no battery.
//!
//! A target y at inputs x is modelled as `h(x)' beta + f(x) + noise`: a basis `h` (none, a constant, a plane) whose
//! coefficients come from generalised least squares, a Gaussian process `f` with a covariance function ([`Kernel`]), and
//! white noise. Hyperparameters maximise the marginal likelihood, whose gradient is exact. (Rasmussen and Williams,
//! *Gaussian Processes for Machine Learning*, 2006, chapters 2, 5 and 8.)
//!
//! The way of the numbers: [`Rows`] are checked and standardised ([`scale`]) -> one of three forms gives the likelihood
//! with its gradient, the coefficients and predictions ([`exact`]: all rows with all; [`nearest`]: each row with its
//! nearest; [`inducing`]: through a few points) -> [`search`] maximises -> [`Model`] predicts, is saved and loaded;
//! [`folds`] holds rows out.
//!
//! | form | memory | time of one likelihood | good for |
//! | --- | --- | --- | --- |
//! | [`Form::Exact`] | n^2 | n^3 | up to some thousands of rows |
//! | [`Form::Nearest`] | n m | n m^3 | any number of rows, few inputs; rough kernels above all |
//! | [`Form::Inducing`] | n m | n m^2 | smooth functions, many inputs |
//!
//! Deviation 1: the paper used a fully independent conditional (inducing points) for its 30,723 rows. [`Form::Nearest`] is
//! the default for as many: a rough function over months cannot go through a few hundred points.
//! Deviation 2: what a prediction does not know of the basis' coefficients is part of its variance.
//!
//! Deviation 3: the 95 % interval is not 1.96 standard deviations: training rows predicted without themselves say how
//! wide it must be, and where ([`Settings::calibrate`]).
//!
//! Results are the same for the same rows, settings and seed on one machine; linear algebra may differ in the last bits
//! between machines and numbers of threads.

mod basis;
mod calibration;
mod exact;
mod fault;
mod folds;
mod inducing;
mod jitter;
mod kernel;
mod minimise;
mod model;
mod nearest;
mod plan;
mod saved;
mod scale;
mod search;
mod tree;
mod wide;

#[cfg(test)]
mod tests;

pub use basis::Basis;
pub use fault::Fault;
pub use folds::{Fold, Folds, Score, assign, cross_validate, score};
pub use jitter::Jitter;
pub use kernel::{Kernel, Shape};
pub use model::{Hyperparameter, Model, Prediction, fit};

use std::ops::ControlFlow;

use serde::{Deserialize, Serialize};

/// Most inputs of a row.
pub const MAX_DIMENSIONS: usize = 256;
/// Most rows of an exact fit: its matrix alone is then 3.2 GB, and a search needs three of them.
pub const MAX_EXACT_ROWS: usize = 20_000;
/// Most neighbours of a row.
pub const MAX_NEIGHBOURS: usize = 500;
/// Most inducing points.
pub const MAX_INDUCING: usize = 5_000;

/// Rows to learn from.
#[derive(Debug, Clone, Copy)]
pub struct Rows<'a> {
    /// Inputs, row after row.
    pub inputs: &'a [f64],
    /// Inputs of one row.
    pub dimensions: usize,
    /// What is to be predicted, one a row.
    pub targets: &'a [f64],
    /// Line of each row in its file, for errors; empty = rows are counted from 1.
    pub lines: &'a [u64],
}

/// How the covariance of many rows is dealt with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Form {
    /// No approximation.
    Exact,
    /// Each row is conditioned on its nearest among the rows before it in a seeded order (Vecchia's approximation), a
    /// prediction on the nearest of all.
    Nearest {
        /// How many, 1 to 500.
        neighbours: usize,
    },
    /// Through inducing points with a row-wise correction of the noise (fully independent training conditional).
    Inducing {
        /// How many, 1 to 5000.
        points: usize,
    },
}

/// What to fit and how.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Covariance function.
    pub kernel: Kernel,
    /// Mean function.
    pub basis: Basis,
    /// A length scale for every input instead of one for all.
    pub ard: bool,
    /// Inputs are brought to mean 0 and standard deviation 1; length scales are then in standard deviations.
    pub standardise: bool,
    /// Exact or sparse.
    pub form: Form,
    /// Searches from seeded random starts beside the first.
    pub restarts: usize,
    /// Seed of starts, order, inducing points and folds.
    pub seed: u64,
    /// Most steps of one search; 0 = the start is taken as it is.
    pub max_iterations: usize,
    /// Hyperparameters to start from, in the order and units of [`Model::hyperparameters`]; empty = guessed from the rows.
    pub start: Vec<f64>,
    /// The 95 % interval is made as wide as training rows near by, predicted without themselves, say; else Gaussian.
    pub calibrate: bool,
    /// Threads, 1 or more.
    pub threads: usize,
}

impl Settings {
    /// A constant basis, one length scale, standardised inputs, one search; exact up to 2,000 rows.
    pub fn new(kernel: Kernel, rows: usize) -> Self {
        Self {
            kernel,
            basis: Basis::Constant,
            ard: false,
            standardise: true,
            form: if rows <= 2000 { Form::Exact } else { Form::Nearest { neighbours: 40 } },
            restarts: 0,
            seed: 1,
            max_iterations: 60,
            start: Vec::new(),
            calibrate: true,
            threads: 1,
        }
    }
}

/// How far the work is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Fold being fitted, from 1; 1 of 1 outside a cross-validation.
    pub fold: usize,
    /// Number of folds.
    pub folds: usize,
    /// Search under way, from 1.
    pub search: usize,
    /// Number of searches.
    pub searches: usize,
    /// Steps of this search that are done.
    pub iteration: usize,
    /// Most steps of a search.
    pub max_iterations: usize,
    /// Best log marginal likelihood of this search per row, in standardised targets.
    pub log_likelihood_per_row: f64,
}

/// Called now and then; `Break` gives up the work with [`Fault::Cancelled`].
pub type Watcher<'a> = dyn FnMut(Progress) -> ControlFlow<()> + 'a;
