//! Gaussian process regression on numbers. This crate is independent of batteries.
//!
//! The model of a target y at the inputs x is `y = m(x) + f(x) + noise`. The mean function `m` is zero, a constant or a
//! plane, with generalised least-squares coefficients. `f` is a Gaussian process with a covariance function
//! ([`Kernel`]), and the noise is white. The hyperparameters maximise the marginal likelihood. The search uses the
//! exact gradient of the likelihood. Source: Rasmussen and Williams, *Gaussian Processes for Machine Learning*, 2006,
//! chapters 2, 5 and 8.
//!
//! Data flow:
//!
//! 1. [`scale`] checks the [`TrainingRows`] and standardises them.
//! 2. One of two forms of the regression computes the likelihood, its gradient, the coefficients and the predictions.
//!    [`exact`] uses all pairs of rows; [`nearest`] uses each row with its nearest rows.
//! 3. [`search`] maximises the likelihood.
//! 4. [`Model`] predicts. It can be saved and loaded.
//!
//! [`folds`] cross-validates. Invalid rows, settings and saved models give a [`RegressionError`].
//!
//! In this table, n is the number of rows and m is the number of neighbours of a row:
//!
//! | form | memory | time of one likelihood | suitable for |
//! | --- | --- | --- | --- |
//! | [`Form::Exact`] | n^2 | n^3 | up to a few thousand rows |
//! | [`Form::Nearest`] | n m | n m^3 | any number of rows, few inputs |
//!
//! Deviations from the paper that packwatch follows ("Battery Predictions for Electronic Prognostics"):
//!
//! 1. The paper used a fully independent conditional approximation (inducing points) for its 30,723 rows. Here,
//!    [`Form::Nearest`] is the default for so many rows, because a few hundred inducing points cannot represent a
//!    rough function over months.
//! 2. The variance of a prediction includes the uncertainty of the mean function's coefficients.
//! 3. The half width of the 95 % interval is not fixed at 1.96 standard deviations. It is calibrated for each predicted
//!    row with leave-one-out predictions of training rows ([`GprSettings::calibrate`]).
//!
//! The same rows, settings and seed give the same results on the same machine with the same number of threads.
//! Otherwise, results of the linear algebra may differ in the last bits.

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
