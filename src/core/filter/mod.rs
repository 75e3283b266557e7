//! Kalman filters on plain numbers, independent of batteries.
//!
//! In: means, (co)variances and measurements in any unit. Out: the same after a prediction or an update. A step that
//! cannot be computed returns a [`FilterError`] and changes nothing.

pub mod linear;
pub mod simd;
pub mod unscented;

pub use linear::{Measurement, ScalarGaussian, update_states};
pub use unscented::{FilterError, Gaussian, MeasurementNoise, SigmaPointWeights, Update};
