//! Kalman filters, interpolation, statistics and minimisation on plain numbers, independent of batteries.
//!
//! In: means, (co)variances and measurements in any unit. Out: the same after a prediction or an update. A step that
//! cannot be computed returns a [`FilterError`] and changes nothing.

pub mod bisection;
pub mod interpolation;
pub mod levenberg_marquardt;
pub mod linear;
pub mod simd;
mod statistics;
pub mod unscented;

pub use bisection::{bisect, crossing};
pub use interpolation::{interpolate, locate};
pub use linear::{Measurement, ScalarGaussian, update_states};
pub use statistics::{bell, ends, median, normal_cdf, probability_below};
pub use unscented::{CONSIDERED, CONSTANT_ERRORS, FilterError, Gaussian, MeasurementNoise, SigmaPointWeights, Update};

/// x^2.
#[inline]
pub fn square(x: f64) -> f64 {
    x * x
}
