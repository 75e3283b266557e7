//! Scalar Kalman filter, interpolation, statistics and minimisation. This module knows nothing about batteries.
//!
//! In: means, (co)variances and measurements in any unit. Out: the means and (co)variances after a prediction or an
//! update.

pub mod bisection;
pub mod interpolation;
pub mod levenberg_marquardt;
pub mod linear;
pub mod simd;
mod statistics;

pub use bisection::{bisect, crossing};
pub use interpolation::{interpolate, locate};
pub use linear::{Measurement, ScalarGaussian, update_states};
pub use statistics::{bell, ends, median, normal_cdf, probability_below};

/// x^2.
#[inline]
pub fn square(x: f64) -> f64 {
    x * x
}
