//! Kalman filters as pure numbers: they know no battery.

pub mod linear;
pub mod simd;
pub mod unscented;

pub use linear::{Measurement, ScalarGaussian};
pub use unscented::{FilterError, Gaussian, Noise, Spread, Update};
