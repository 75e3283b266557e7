//! A half-cycle: one charge or one discharge of a cell.

use crate::filter::ScalarGaussian;
use crate::quantity::Mode;

/// One completed half-cycle of one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HalfCycle {
    pub mode: Mode,
    /// Charge moved (Ah), positive.
    pub charge_ah: f64,
    /// Change of the SOC (fraction) with its variance; positive if the SOC rose during a charge or fell during a
    /// discharge. The variance treats the SOC errors at the two ends as independent. `None` if the SOC at the start or
    /// the end was not estimated.
    pub swing: Option<ScalarGaussian>,
    /// SOC at the end, fraction; `None` if it was not estimated.
    pub end_soc: Option<f64>,
    /// SOC at the start and the end, fractions; `None` if the SOC at the end was not estimated. If only the SOC at the
    /// start is unknown, both values are the SOC at the end.
    pub ends: Option<[f64; 2]>,
    pub duration_s: f64,
    /// Mean current (A); positive = discharge.
    pub mean_current_a: f64,
    /// Mean temperature (degrees C); `None` without a temperature reading.
    pub mean_temperature_c: Option<f64>,
}
