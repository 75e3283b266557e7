//! Kalman filters as pure numbers: they know no battery.

pub mod simd;
pub mod linear;
pub mod unscented;

pub use linear::{ScalarGaussian, Measurement};
pub use unscented::{FilterError, Gaussian, Noise, Spread, Update};
