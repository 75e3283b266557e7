//! Mathematics of the estimators: scalar Kalman filter, interpolation, bisection, minimisation, statistics and
//! arithmetic on several numbers at once. Nothing here is specific to batteries.
//!
//! In and out: numbers in any unit.

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
