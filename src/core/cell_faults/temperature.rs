//! Temperature sensors that do not follow the load: frozen ones, and ones that have fallen off.
//!
//! In: the temperature at each cell and that in the middle of the pack, row by row. Cells of one sensor show the same, so a faulty
//! sensor appears as its cells. With one sensor for all cells, or two, nothing is known: none stands out.

use serde::{Deserialize, Serialize};

/// Sum of squared warmings from which on a sensor is judged, K^2.
const LEAST_K2: f64 = 30.0;
/// Part of the pack's warming below which a sensor does not follow, and above which it does again.
const DETACHED: f64 = 0.35;
const ATTACHED: f64 = 0.6;

/// How one cell's temperature follows the pack's.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Following {
    /// Slow mean, degrees C.
    slow_c: Option<f64>,
    /// Sums of squares of the pack's warming and of products with the one here, K^2.
    squares_k2: f64,
    products_k2: f64,
    pub(super) is_detached: bool,
}

impl Following {
    /// Takes the temperature of a row `seconds` after the one before; the warming, K: an offset of the sensor is none.
    pub(super) fn warming_k(&mut self, seconds: f64, here_c: f64) -> f64 {
        let slow_c = self.slow_c.get_or_insert(here_c);
        // Time over which a warming counts as one of the load.
        *slow_c = here_c + libm::exp(-seconds.max(0.0) / 7200.0) * (*slow_c - here_c);
        here_c - *slow_c
    }

    /// Compares the warming of a row with that in the middle of the pack.
    pub(super) fn compare(&mut self, seconds: f64, middle_k: f64, here_k: f64) {
        // After five days what was seen counts half.
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

    /// Two days: the pack warms by 8 K each time; the sensor shows this part of it.
    fn after_days(part: f64) -> Following {
        let (mut pack, mut following) = (Following::default(), Following::default());
        for row in 0..2 * 288 {
            let warming_k = if row % 72 < 24 { 8.0 * f64::from(row % 72) / 24.0 } else { 0.0 };
            let middle_k = pack.warming_k(300.0, 20.0 + warming_k);
            let here_k = following.warming_k(300.0, 25.0 + part * warming_k);
            following.compare(300.0, middle_k, here_k);
        }
        following
    }

    #[test]
    fn a_sensor_that_shows_little_of_the_warming_is_detached() {
        assert!(after_days(0.0).is_detached && after_days(0.2).is_detached);
        assert!(!after_days(0.7).is_detached && !after_days(1.2).is_detached);
    }

    #[test]
    fn a_pack_that_does_not_warm_says_nothing() {
        let mut following = Following::default();
        (0..1000).for_each(|row| following.compare(300.0, 0.1 * f64::from(row % 2), 0.0));
        assert!(!following.is_detached, "{following:?}");
    }
}
