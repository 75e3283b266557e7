//! What a cell did between two changes of mode.

use crate::filter::ScalarGaussian;
use crate::quantity::Mode;

/// One completed half-cycle of one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HalfCycle {
    /// Charge or discharge.
    pub mode: Mode,
    /// Charge moved, Ah, positive.
    pub charge_ah: f64,
    /// SOC swing, fraction, positive when it agrees with the charge, and its variance (errors of both ends counted as
    /// independent); `None` when its beginning was not estimated.
    pub swing: Option<ScalarGaussian>,
    /// SOC at its end, fraction.
    pub end_soc: Option<f64>,
    /// SOC at both ends, fractions; `None` when it was not estimated.
    pub ends: Option<[f64; 2]>,
    /// Duration, s.
    pub duration_s: f64,
    /// Mean current, A, positive = discharge.
    pub mean_current_a: f64,
    /// Mean temperature, degrees C; `None` when there was none.
    pub mean_temperature_c: Option<f64>,
}
