//! Finds temperature sensors that do not follow the load because they are frozen or detached.
//!
//! In: per row (a few minutes of samples), the temperature at each cell and the median warming of the pack. The warming
//! is a temperature minus its slow mean. Cells that share a sensor show the same temperature, so a faulty sensor
//! appears as a fault of a range of cells. If the pack has only one or two sensors, a faulty sensor cannot be
//! recognised.

use serde::{Deserialize, Serialize};

/// Minimum sum of the pack's squared warmings (K^2). With a smaller sum, no sensor is judged.
const LEAST_K2: f64 = 30.0;
/// A sensor counts as detached if it shows less than the fraction `DETACHED` of the pack's warming. A detached sensor
/// counts as attached again if it shows more than the fraction `ATTACHED`.
const DETACHED: f64 = 0.35;
const ATTACHED: f64 = 0.6;

/// Warming at one cell relative to the median warming of the pack.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct WarmingRatio {
    /// Slow mean of the temperature (degrees C).
    slow_c: Option<f64>,
    squares_k2: f64,
    products_k2: f64,
    pub(super) is_detached: bool,
}

impl WarmingRatio {
    /// Handles the temperature of a row, `seconds` after the previous row. Returns the warming (K): the temperature
    /// minus the slow mean of the temperature. A constant sensor offset cancels in this difference.
    pub(super) fn warming_k(&mut self, seconds: f64, here_c: f64) -> f64 {
        let slow_c = self.slow_c.get_or_insert(here_c);
        // The slow mean has a time constant of two hours, which is the time constant of warming by the load.
        *slow_c = here_c + libm::exp(-seconds.max(0.0) / 7200.0) * (*slow_c - here_c);
        here_c - *slow_c
    }

    pub(super) fn compare(&mut self, seconds: f64, middle_k: f64, here_k: f64) {
        // The weight of a row halves every five days.
        let older = libm::exp2(-seconds.max(0.0) / (5.0 * 86_400.0));
        self.squares_k2 = older * self.squares_k2 + middle_k * middle_k;
        self.products_k2 = older * self.products_k2 + middle_k * here_k;
        if self.squares_k2 >= LEAST_K2 {
            let part = self.products_k2 / self.squares_k2;
            self.is_detached = part < if self.is_detached { ATTACHED } else { DETACHED };
        }
    }

    pub(super) fn numbers(&self) -> [f64; 3] {
        [self.slow_c.unwrap_or_default(), self.squares_k2, self.products_k2]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Simulates two days of a pack that warms by 8 K several times. The sensor shows the fraction `part` of this
    /// warming.
    fn after_days(part: f64) -> WarmingRatio {
        let (mut pack, mut following) = (WarmingRatio::default(), WarmingRatio::default());
        for row in 0..2 * 288 {
            let warming_k = if row % 72 < 24 { 8.0 * f64::from(row % 72) / 24.0 } else { 0.0 };
            let middle_k = pack.warming_k(300.0, 20.0 + warming_k);
            let here_k = following.warming_k(300.0, 25.0 + part * warming_k);
            following.compare(300.0, middle_k, here_k);
        }
        following
    }

    #[test]
    fn sensor_with_little_warming_is_detached() {
        assert!(after_days(0.0).is_detached && after_days(0.2).is_detached);
        assert!(!after_days(0.7).is_detached && !after_days(1.2).is_detached);
    }

    #[test]
    fn pack_without_warming_detaches_no_sensor() {
        let mut following = WarmingRatio::default();
        (0..1000).for_each(|row| following.compare(300.0, 0.1 * f64::from(row % 2), 0.0));
        assert!(!following.is_detached, "{following:?}");
    }
}
