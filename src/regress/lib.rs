//! Gaussian process regression on plain numbers, independent of batteries.
//!
//! Models a target y at inputs x as `h(x)' beta + f(x) + noise`: a basis `h` (none, a constant, a plane) with generalised least-squares
//! coefficients, a Gaussian process `f` with a covariance function ([`Kernel`]), and white noise. Hyperparameters maximise the marginal
//! likelihood with its exact gradient. (Rasmussen and Williams, *Gaussian Processes for Machine Learning*, 2006, chapters 2, 5 and 8.)
//!
//! Data flow: [`TrainingRows`] are checked and standardised ([`scale`]) -> one of two forms computes the likelihood, its gradient, the
//! coefficients and predictions ([`exact`]: all pairs of rows; [`nearest`]: each row with its nearest rows) -> [`search`] maximises the
//! likelihood -> [`Model`] predicts, is saved and loaded. [`folds`] cross-validates. Bad rows, settings and saved models are a
//! [`RegressionError`].
//!
//! | form | memory | time of one likelihood | suitable for |
//! | --- | --- | --- | --- |
//! | [`Form::Exact`] | n^2 | n^3 | up to a few thousand rows |
//! | [`Form::Nearest`] | n m | n m^3 | any number of rows, few inputs |
//!
//! Deviation 1: the paper used a fully independent conditional (inducing points) for its 30,723 rows. Here [`Form::Nearest`] is the
//! default for that many rows, because a few hundred points cannot represent a rough function over months.
//! Deviation 2: the variance of a prediction includes the uncertainty of the basis' coefficients.
//!
//! Deviation 3: the 95 % interval is not 1.96 standard deviations. Its width is calibrated row by row with leave-one-out predictions of
//! training rows ([`GprSettings::calibrate`]).
//!
//! The same rows, settings and seed give the same results on one machine. Between machines and numbers of threads, linear algebra may
//! differ in the last bits.

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
