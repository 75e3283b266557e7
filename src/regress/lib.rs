//! Gaussian process regression on plain numbers, independent of batteries.
//!
//! A target y at inputs x is modelled as `h(x)' beta + f(x) + noise`: a basis `h` (none, a constant, a plane) whose
//! coefficients come from generalised least squares, a Gaussian process `f` with a covariance function ([`Kernel`]), and
//! white noise. Hyperparameters maximise the marginal likelihood, whose gradient is exact. (Rasmussen and Williams,
//! *Gaussian Processes for Machine Learning*, 2006, chapters 2, 5 and 8.)
//!
//! Data flow: [`TrainingRows`] are checked and standardised ([`scale`]) -> one of two forms computes the likelihood with
//! its gradient, the coefficients and predictions ([`exact`]: all pairs of rows; [`nearest`]: each row with its nearest
//! ones) -> [`search`] maximises -> [`Model`] predicts, is saved and loaded; [`folds`] cross-validates. Bad rows, settings and saved models are a [`RegressionError`].
//!
//! | form | memory | time of one likelihood | good for |
//! | --- | --- | --- | --- |
//! | [`Form::Exact`] | n^2 | n^3 | up to some thousands of rows |
//! | [`Form::Nearest`] | n m | n m^3 | any number of rows, few inputs |
//!
//! Deviation 1: the paper used a fully independent conditional (inducing points) for its 30,723 rows. [`Form::Nearest`] is
//! the default for as many: a few hundred points cannot represent a rough function over months.
//! Deviation 2: the variance of a prediction includes the uncertainty of the basis' coefficients.
//!
//! Deviation 3: the 95 % interval is not 1.96 standard deviations: training rows predicted without themselves set its
//! width, row by row ([`GprSettings::calibrate`]).
//!
//! Results are the same for the same rows, settings and seed on one machine; linear algebra may differ in the last bits
//! between machines and numbers of threads.

mod basis;
mod calibration;
mod cross_covariance;
mod error;
mod exact;
mod folds;
mod jitter;
mod kd_tree;
mod kernel;
mod linear_algebra;
mod minimise;
mod model;
mod nearest;
mod plan;
mod saved;
mod scale;
mod search;
mod settings;
mod vector_math;

#[cfg(test)]
mod tests;

pub use basis::Basis;
pub use calibration::GAUSSIAN;
pub use error::RegressionError;
pub use folds::{Fold, Folds, PredictionScore, assign, cross_validate, score};
pub use jitter::Jitter;
pub use kernel::{Kernel, Shape};
pub use model::{FitOutcome, Hyperparameter, Model, ModelSpec, Prediction, fit};
pub use settings::{
    FitProgress, Form, GprSettings, MAX_DIMENSIONS, MAX_EXACT_ROWS, MAX_NEIGHBOURS, ProgressCallback, TrainingRows,
};
