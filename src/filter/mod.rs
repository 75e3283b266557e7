//! Kalman filters as pure numbers: they know no battery.

pub mod lanes;
pub mod linear;
pub mod unscented;

pub use linear::{Belief, Measurement};
pub use unscented::{FilterError, Gaussian, Noise, Spread, Update};
