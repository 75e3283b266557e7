//! Kalman filters, bisection and statistics on plain numbers, independent of batteries.
//!
//! In: means, (co)variances and measurements in any unit. Out: the same after a prediction or an update. A step that
//! cannot be computed returns a [`FilterError`] and changes nothing.

pub mod bisection;
pub mod linear;
pub mod simd;
mod statistics;
pub mod unscented;

pub use bisection::bisect;
pub use linear::{Measurement, ScalarGaussian, update_states};
pub use statistics::{median, normal_cdf};
pub use unscented::{CONSIDERED, CONSTANT_ERRORS, FilterError, Gaussian, MeasurementNoise, SigmaPointWeights, Update};
