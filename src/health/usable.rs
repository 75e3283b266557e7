//! Usable capacity: what a full cell delivers at a stated current and temperature down to a cut-off voltage
//! under load. It follows from the capacity and from how far the resistance has grown.
//!
//! The discharge is taken as quasi-static: every branch settled, V(s) = OCV(s) - I rho (R0(s) + sum R_i(s)).
//! It ends at the highest SOC below full where V reaches the cut-off. Standard deviation by first-order
//! propagation of (capacity, ln rho) with their covariance.

use super::UsableConfig;
use crate::cell::{CellEstimator, CellModel};
use crate::filter::Belief;

/// Step of the search for the cut-off, fraction of SOC: finer than any table's interval.
const SOC_STEP: f64 = 0.005;

/// Step of the numerical derivative over ln rho.
const LOG_STEP: f64 = 0.01;

/// Usable share of the capacity for one resistance ratio, fraction (0 when even a full cell is below the cut-off).
pub fn usable_fraction(model: &CellModel, config: &UsableConfig, resistance_ratio: f64) -> f64 {
    let margin_v = |soc: f64| {
        let place = model.place(soc, config.temperature_c);
        model.ocv_v(&place) - config.current_a * resistance_ratio * model.settled_ohm(&place) - config.cutoff_v
    };
    let mut high = config.full_soc;
    if margin_v(high) <= 0.0 {
        return 0.0;
    }
    // Below SOC 0 the open-circuit voltage goes on falling: a cut-off under it is reached there.
    while high > -0.5 {
        let low = high - SOC_STEP;
        if margin_v(low) <= 0.0 {
            let end = crate::cell::model::falling_crossing(low, high, |soc| -margin_v(soc));
            return config.full_soc - end;
        }
        high = low;
    }
    config.full_soc - high
}

/// Usable capacity and its variance, Ah. `capacity` is the published belief (its variance may hold more than
/// the filter's own).
pub fn usable_capacity(model: &CellModel, config: &UsableConfig, cell: &CellEstimator, capacity: Belief) -> Belief {
    let log_r = cell.log_resistance();
    let at = |log_ratio: f64| usable_fraction(model, config, libm::exp(log_ratio));
    let fraction = at(log_r.mean);
    let slope = capacity.mean * (at(log_r.mean + LOG_STEP) - at(log_r.mean - LOG_STEP)) / (2.0 * LOG_STEP);
    let variance = fraction * fraction * capacity.variance
        + slope * slope * log_r.variance
        + 2.0 * fraction * slope * cell.capacity_resistance_covariance();
    Belief { mean: fraction * capacity.mean, variance: variance.max(0.0) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;

    const CONFIG: UsableConfig = UsableConfig { current_a: 2.0, temperature_c: 0.0, cutoff_v: 3.3, full_soc: 1.0 };

    #[test]
    fn without_resistance_the_cutoff_is_on_the_open_circuit_curve() {
        // OCV 3.0 + 1.2 s up to 0.5: 3.3 V at s = 0.25.
        assert!((usable_fraction(&small_model(), &CONFIG, 1e-12) - 0.75).abs() < 1e-6);
    }

    #[test]
    fn resistance_takes_its_share() {
        // Settled resistance 0.12 - 0.08 s below s = 0.5: 3.0 + 1.2 s - 2 (0.12 - 0.08 s) = 3.3 at s = 0.54/1.36, which is below 0.5.
        let fraction = usable_fraction(&small_model(), &CONFIG, 1.0);
        assert!((fraction - (1.0 - 0.54 / 1.36)).abs() < 1e-6, "{fraction}");
        assert!(usable_fraction(&small_model(), &CONFIG, 2.0) < fraction);
        assert_eq!(usable_fraction(&small_model(), &CONFIG, 100.0), 0.0);
    }
}
