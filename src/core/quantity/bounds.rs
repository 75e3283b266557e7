//! Physical bounds of the quantities of cells, sensors and clocks.
//!
//! The same bounds apply to configuration keys, cell models, stored states and running filters. If the state of a
//! filter leaves its bounds, the filter restarts. The bounds are wide: a number outside is certainly wrong, but a
//! number inside may be wrong, too.

use super::InvalidState;

/// A closed range. `allowed` describes it with the unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    pub low: f64,
    pub high: f64,
    pub allowed: &'static str,
}

impl Bounds {
    const fn new(low: f64, high: f64, allowed: &'static str) -> Self {
        Self { low, high, allowed }
    }

    /// Whether the value is in the range; `false` for NaN.
    #[inline]
    pub fn has(&self, value: f64) -> bool {
        self.low <= value && value <= self.high
    }

    /// Rejects a value of a stored state outside the range.
    pub fn check(&self, what: &'static str, found: f64) -> Result<(), InvalidState> {
        InvalidState::unless(self.has(found), what, found, self.allowed)
    }

    /// Applies [`Self::check`] to every value and returns the first error.
    pub fn check_all(&self, what: &'static str, all: impl IntoIterator<Item = f64>) -> Result<(), InvalidState> {
        all.into_iter().try_for_each(|found| self.check(what, found))
    }
}

/// Configured capacity of a cell (Ah): from a watch cell to a hundred times the largest cell on the market.
pub const CONFIGURED_CAPACITY_AH: Bounds = Bounds::new(1e-3, 1e5, "0.001 to 1e5 Ah");

/// Estimated capacity of a cell (Ah), far beyond [`CONFIGURED_CAPACITY_AH`] in both directions.
pub const CAPACITY_AH: Bounds = Bounds::new(1e-6, 1e9, "1e-6 to 1e9 Ah");

/// SOC in a running filter. A model's curve is extrapolated up to these bounds.
pub const FILTER_SOC: Bounds = Bounds::new(-0.5, 1.5, "-0.5 to 1.5");

/// SOC of a trusted estimate. The bounds allow for the error at the ends of a curve.
pub const TRUSTED_SOC: Bounds = Bounds::new(-0.1, 1.1, "-0.1 to 1.1");

/// SOC in a stored state. Earlier versions allowed a wider range than [`FILTER_SOC`].
pub const STORED_SOC: Bounds = Bounds::new(-10.0, 10.0, "-10 to 10");

/// Natural logarithm of a cell's resistance relative to new: a factor of about 1,000 in both directions.
pub const LOG_RESISTANCE: Bounds = Bounds::new(-7.0, 7.0, "-7 to 7");

/// Like [`LOG_RESISTANCE`], for a trusted estimate: a factor of 33.
pub const TRUSTED_LOG_RESISTANCE: Bounds = Bounds::new(-3.5, 3.5, "-3.5 to 3.5");

/// Trusted learned capacity, relative to the capacity of the cell model or of the configuration. A worn cell keeps more
/// than a twentieth of its capacity, and no cell has three times the capacity on its label.
pub const TRUSTED_CAPACITY: Bounds = Bounds::new(0.05, 3.0, "0.05 to 3 times the cell's capacity");

/// Configured initial capacity, relative to the cell model's capacity.
pub const INITIAL_CAPACITY: Bounds = Bounds::new(0.05, 3.0, "0.05 to 3 times the cell model's capacity");

/// Resistance in a cell (ohm): from a copper bar to a watch cell.
pub const RESISTANCE_OHM: Bounds = Bounds::new(1e-9, 1e3, "1e-9 to 1000 ohm");

/// Capacitance of a branch, F.
pub const CAPACITANCE_F: Bounds = Bounds::new(1e-6, 1e12, "1e-6 to 1e12 F");

/// Temperature of a cell (degrees C).
pub const TEMPERATURE_C: Bounds = Bounds::new(-100.0, 200.0, "-100 to 200 degrees C");

/// Voltage of a cell (V). The bounds are wide, because the reading may come from a broken wire.
pub const VOLTAGE_V: Bounds = Bounds::new(-1e3, 1e3, "-1000 to 1000 V");

/// Current of a pack (A).
pub const CURRENT_A: Bounds = Bounds::new(-1e6, 1e6, "-1e6 to 1e6 A");

/// Duration (s): up to 300 years.
pub const TIME_S: Bounds = Bounds::new(0.0, 1e10, "0 to 1e10 s");

/// Counted charge (As): [`CURRENT_A`] for [`TIME_S`].
pub const CHARGE_AS: Bounds = Bounds::new(-1e16, 1e16, "-1e16 to 1e16 As");

/// A point in time, ns. The difference of two points fits the clock's range.
pub const STAMP_NS: Bounds = Bounds::new(-4.6e18, 4.6e18, "within 145 years of the clock's origin");

/// Any number without a more specific bound. Its square and its cube do not overflow.
pub const NUMBER: Bounds = Bounds::new(-1e20, 1e20, "at most 1e20 in size");

/// Variance of any quantity. The lower bound is so large that its square does not underflow to 0.
pub const VARIANCE: Bounds = Bounds::new(1e-150, 1e20, "1e-150 to 1e20");

/// Configured standard deviation or noise density of any quantity.
pub const DEVIATION: Bounds = Bounds::new(0.0, 1e3, "0 to 1000");

/// Standard deviation of a voltage sensor's noise (V). No converter is better than the lower bound.
pub const VOLTAGE_NOISE_V: Bounds = Bounds::new(1e-6, 10.0, "1e-6 to 10 V");

/// Spread of the sigma points. Below the lower bound, the differences between the points are lost in rounding.
pub const SIGMA_POINT_SPREAD: Bounds = Bounds::new(1e-3, 1.0, "0.001 to 1");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn range_includes_ends_but_not_nan() {
        assert!(TEMPERATURE_C.has(-100.0) && TEMPERATURE_C.has(200.0));
        assert!(!TEMPERATURE_C.has(f64::NAN) && !TEMPERATURE_C.has(200.1) && !TEMPERATURE_C.has(f64::INFINITY));
        let fault = TIME_S.check_all("a time", [1.0, -1.0]).expect_err("negative");
        assert_eq!((fault.found, fault.allowed), (-1.0, "0 to 1e10 s"));
    }

    #[test]
    fn narrower_bounds_lie_within_wider_ones() {
        for (inner, outer) in [
            (CONFIGURED_CAPACITY_AH, CAPACITY_AH),
            (TRUSTED_SOC, FILTER_SOC),
            (FILTER_SOC, STORED_SOC),
            (TRUSTED_LOG_RESISTANCE, LOG_RESISTANCE),
        ] {
            assert!(outer.has(inner.low) && outer.has(inner.high), "{inner:?} {outer:?}");
        }
    }
}
