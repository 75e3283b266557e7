//! Training rows, settings of a fit, its progress, and limits.
//!
//! Input: values from the caller. [`fit`](super::fit) checks them all and rejects values out of range.

use std::ops::ControlFlow;

use serde::{Deserialize, Serialize};

use super::basis::Basis;
use super::error::RegressionError;
use super::kernel::Kernel;

/// Most inputs per row.
pub const MAX_DIMENSIONS: usize = 256;
/// Most rows of an exact fit: the matrix then has 3.2 GB, and a search needs three of them.
pub const MAX_EXACT_ROWS: usize = 20_000;
/// Most neighbours per row.
pub const MAX_NEIGHBOURS: usize = 500;

/// Rows to train on.
#[derive(Debug, Clone, Copy)]
pub struct TrainingRows<'a> {
    /// Inputs, row-major.
    pub inputs: &'a [f64],
    /// Number of inputs per row.
    pub dimensions: usize,
    /// Value to predict, one per row.
    pub targets: &'a [f64],
    /// Line of each row in its file, for errors; empty = rows count from 1.
    pub lines: &'a [u64],
}

/// Approximation of the covariance of many rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Form {
    /// No approximation.
    Exact,
    /// Each row is conditioned on its nearest rows among those before it in a seeded order (Vecchia's approximation); a prediction is
    /// conditioned on the nearest of all rows.
    Nearest {
        /// Number of neighbours, 1 to 500.
        neighbours: usize,
    },
}

impl Form {
    /// Checks its numbers and the number of rows against the limits.
    pub(super) fn check(self, rows: usize) -> Result<(), RegressionError> {
        let (what, found, most, advice) = match self {
            Self::Exact => ("rows of an exact fit", rows, MAX_EXACT_ROWS, "; use the form nearest"),
            Self::Nearest { neighbours } => ("neighbours", neighbours, MAX_NEIGHBOURS, ""),
        };
        if (1..=most).contains(&found) {
            return Ok(());
        }
        Err(RegressionError::range(what, found, format!("1 to {most}{advice}")))
    }
}

/// Settings of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct GprSettings {
    /// Covariance function.
    pub kernel: Kernel,
    /// Mean function.
    pub basis: Basis,
    /// Whether every input has its own length scale.
    pub ard: bool,
    /// Whether inputs are standardised to mean 0 and standard deviation 1; length scales are then in standard deviations.
    pub standardise: bool,
    /// Exact, or by nearest neighbours.
    pub form: Form,
    /// Additional searches from seeded random starts.
    pub restarts: usize,
    /// Seed of starts, order and folds.
    pub seed: u64,
    /// Most steps of one search; 0 = keep the start.
    pub max_iterations: usize,
    /// Initial hyperparameters in the order and units of [`Model::hyperparameters`](super::Model::hyperparameters); empty = derived from the rows.
    pub start: Vec<f64>,
    /// Whether nearby training rows, each predicted from all others, calibrate the 95 % interval; otherwise it is Gaussian.
    pub calibrate: bool,
    /// Number of threads, at least 1.
    pub threads: usize,
}

impl GprSettings {
    /// Default settings: constant basis, one length scale, standardised inputs, one search; exact up to 2,000 rows.
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

/// Progress of a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitProgress {
    /// Fold being fitted, from 1; 1 of 1 outside a cross-validation.
    pub fold: usize,
    /// Number of folds.
    pub folds: usize,
    /// Current search, from 1.
    pub search: usize,
    /// Number of searches.
    pub searches: usize,
    /// Steps of this search so far.
    pub iteration: usize,
    /// Most steps of a search.
    pub max_iterations: usize,
    /// Best log marginal likelihood of this search per row, for standardised targets.
    pub log_likelihood_per_row: f64,
}

/// Callback after each step of a search; `Break` cancels the fit with [`RegressionError::Cancelled`](super::RegressionError::Cancelled).
pub type ProgressCallback<'a> = dyn FnMut(FitProgress) -> ControlFlow<()> + 'a;
