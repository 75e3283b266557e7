//! Defines training rows, and the settings, progress and limits of a fit. [`fit`](super::fit) rejects values that are
//! out of range.

use std::ops::ControlFlow;

use serde::{Deserialize, Serialize};

use super::basis::Basis;
use super::error::RegressionError;
use super::kernel::Kernel;

/// Maximum number of inputs per row.
pub const MAX_DIMENSIONS: usize = 256;
/// Maximum number of rows of an exact fit. A covariance matrix then has 3.2 GB, and a search needs three such matrices.
pub const MAX_EXACT_ROWS: usize = 20_000;
/// Maximum number of neighbours per row.
pub const MAX_NEIGHBOURS: usize = 500;

/// Rows to which a model is fitted.
#[derive(Debug, Clone, Copy)]
pub struct TrainingRows<'a> {
    /// Inputs, row-major.
    pub inputs: &'a [f64],
    /// Number of inputs per row.
    pub dimensions: usize,
    /// Values that the model predicts, one per row.
    pub targets: &'a [f64],
    /// Line of each row in its file, for error messages; empty = error messages count the rows from 1.
    pub lines: &'a [u64],
}

/// Computation of the covariance of the rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Form {
    /// Uses all pairs of rows, without approximation.
    Exact,
    /// Vecchia's approximation. The rows are put in a random order. The density of a row then depends only on the
    /// nearest of the rows before it. A prediction depends only on the nearest training rows.
    Nearest {
        /// Number of neighbours, 1 to 500.
        neighbours: usize,
    },
}

impl Form {
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
    /// Whether inputs are standardised to mean 0 and standard deviation 1. If so, length scales are multiples of the
    /// inputs' standard deviations.
    pub standardise: bool,
    /// Form of the covariance: exact, or approximated with nearest neighbours.
    pub form: Form,
    /// Number of additional searches, each from a seeded random start.
    pub restarts: usize,
    /// Seed of the random starts, of the order of the rows, and of the folds.
    pub seed: u64,
    /// Maximum number of steps of one search; 0 = the hyperparameters keep their initial values.
    pub max_iterations: usize,
    /// Initial hyperparameters, in the order and units of [`Model::hyperparameters`](super::Model::hyperparameters);
    /// empty = derived from the rows.
    pub start: Vec<f64>,
    /// Whether the 95 % interval is calibrated by predicting each training row from all other training rows. Without
    /// calibration, the interval is Gaussian.
    pub calibrate: bool,
    /// Number of threads, at least 1.
    pub threads: usize,
}

impl GprSettings {
    /// Returns the default settings: constant mean function, one length scale for all inputs, standardised inputs, one
    /// search. The form is exact for up to 2,000 rows.
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
    /// Number of the current fold, from 1. It is 1 outside a cross-validation.
    pub fold: usize,
    /// Number of folds. It is 1 outside a cross-validation.
    pub folds: usize,
    /// Number of the current search, from 1.
    pub search: usize,
    /// Number of searches.
    pub searches: usize,
    /// Number of steps that this search has made.
    pub iteration: usize,
    /// Maximum number of steps of a search.
    pub max_iterations: usize,
    /// Best log marginal likelihood of this search, divided by the number of rows; for standardised targets.
    pub log_likelihood_per_row: f64,
}

/// Callback before the first step and after each step of a search. If it returns `Break`, the fit ends with
/// [`RegressionError::Cancelled`](super::RegressionError::Cancelled).
pub type ProgressCallback<'a> = dyn FnMut(FitProgress) -> ControlFlow<()> + 'a;
