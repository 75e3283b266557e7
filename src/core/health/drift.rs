//! Slow drifts of a cell: its capacity, the fade per cycle, and the offset of the current sensor. A linear Kalman filter
//! with one step per half-cycle.
//!
//! State x = [C (Ah), fade (Ah per full cycle), offset (A per cell)]. Measurement: the capacity by
//! the half-cycle alone (`ScalarGaussian::information_until`), z = C + (C / I) d, with I the half-cycle's mean current (A, positive =
//! discharge) and d the error of the offset that is already subtracted from the current: an offset increases the measured
//! charge of a discharge and lowers that of a charge, so the errors of their capacities have opposite signs.
//! At the end of a charge of w full cycles: C -= w fade. C walks (the caller's noise), the offset walks slowly.
//!
//! Assumed: the fade of a cycle shows from its end on; the offset is the same in charge and discharge. Inputs are not
//! checked; a stored state is.

use serde::{Deserialize, Serialize};

use super::CapacityConfig;
use crate::filter::{Measurement, ScalarGaussian, update_states};
use crate::quantity::InvalidState;

/// Random walk of the offset in a full cycle, part of its first standard deviation: sensors drift with temperature.
const OFFSET_WALK: f64 = 0.1;

const C: usize = 0;
const FADE: usize = 1;
const OFFSET: usize = 2;
const N: usize = 3;

/// The filter of one cell.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriftFilter {
    x: [f64; N],
    p: [[f64; N]; N],
}

impl DriftFilter {
    /// A filter that starts from this capacity.
    pub fn new(config: &CapacityConfig, capacity: ScalarGaussian) -> Self {
        let mut p = [[0.0; N]; N];
        p[C][C] = capacity.variance;
        p[FADE][FADE] = config.fade_std_ah_per_cycle * config.fade_std_ah_per_cycle;
        p[OFFSET][OFFSET] = config.current_offset_std_a * config.current_offset_std_a;
        Self { x: [capacity.mean, 0.0, 0.0], p }
    }

    /// Capacity, Ah.
    pub fn capacity(&self) -> ScalarGaussian {
        ScalarGaussian { mean: self.x[C], variance: self.p[C][C] }
    }

    /// Offset of the current, per cell, A: measured less true.
    pub fn offset_a(&self) -> f64 {
        self.x[OFFSET]
    }

    /// Checks a stored filter; the error is its first impossible number.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        InvalidState::unless_capacity("a learned capacity", self.x[C])?;
        let all = self.x.iter().chain(self.p.iter().flatten());
        InvalidState::unless_numbers("a number of a learned capacity's filter", all.copied())?;
        InvalidState::unless_positive("the variance of a learned capacity", self.p[C][C])?;
        for i in 0..N {
            InvalidState::unless_natural("a variance of a learned capacity's filter", self.p[i][i])?;
            for j in 0..i {
                let (covariance, most) = (self.p[i][j], (self.p[i][i] * self.p[j][j]).sqrt());
                // The stored numbers are rounded.
                let fits = covariance.abs() <= most * (1.0 + 1e-5) && (covariance - self.p[j][i]).abs() <= most * 1e-5;
                InvalidState::unless(
                    fits,
                    "a covariance of a learned capacity's filter",
                    covariance,
                    "what its variances allow",
                )?;
            }
        }
        Ok(())
    }

    /// Updates with the capacity measured by a half-cycle with this mean current.
    pub fn update(&mut self, z: Measurement, mean_current_a: f64) {
        let by_offset = self.x[C] / mean_current_a;
        let ph: [f64; N] = std::array::from_fn(|i| self.p[i][C] + by_offset * self.p[i][OFFSET]);
        let innovation_variance = z.variance + ph[C] + by_offset * ph[OFFSET];
        let innovation = z.value - self.x[C];
        update_states(&mut self.x, &mut self.p, &ph, innovation, innovation_variance);
    }

    /// Predicts over a half-cycle of `cycles` full cycles, of which `charged` count as fade; `capacity_variance` is the
    /// capacity's process noise.
    pub fn predict(&mut self, config: &CapacityConfig, cycles: f64, charged: f64, capacity_variance: f64) {
        self.x[C] -= charged * self.x[FADE];
        for j in 0..N {
            self.p[C][j] -= charged * self.p[FADE][j];
        }
        for row in &mut self.p {
            row[C] -= charged * row[FADE];
        }
        let walk = |std: f64| std * std * cycles;
        self.p[C][C] += capacity_variance;
        self.p[FADE][FADE] += walk(config.fade_noise_ah_per_cycle);
        self.p[OFFSET][OFFSET] += walk(OFFSET_WALK * config.current_offset_std_a);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::CapacityMethod;

    const CONFIG: CapacityConfig = CapacityConfig {
        method: CapacityMethod::Swing,
        noise_ah_per_cycle: 0.01,
        noise_ah_per_rest_day: 0.0,
        end_error_v: 0.0,
        end_load_error: 0.0,
        ageing_shift_error: 0.0,
        current_gain_std: 0.005,
        current_offset_std_a: 0.02,
        fade_std_ah_per_cycle: 0.1,
        fade_noise_ah_per_cycle: 0.0,
    };

    /// 60 % cycles at 1 A of a cell that loses `loss_ah` at the end of each charge, measured with `offset_a`.
    fn cycle(config: &CapacityConfig, loss_ah: f64, offset_a: f64) -> (DriftFilter, f64) {
        let mut drift = DriftFilter::new(config, ScalarGaussian::from_std(2.5, 0.1));
        let mut true_ah = 2.6;
        for k in 0..40 {
            let current_a = if k % 2 == 0 { 1.0 } else { -1.0 };
            let error = (offset_a - drift.offset_a()) / current_a;
            drift.update(Measurement { value: true_ah * (1.0 + error), variance: 1e-4 }, current_a);
            if k == 39 {
                break;
            }
            let charged = if k % 2 == 0 { 0.0 } else { 0.6 };
            drift.predict(config, 0.3, charged, 0.3e-4);
            true_ah -= loss_ah * charged / 0.6;
        }
        (drift, true_ah)
    }

    #[test]
    fn fade_and_offset_are_separated_and_the_capacity_is_free_of_both() {
        let (drift, true_ah) = cycle(&CONFIG, 0.03, 0.01);
        assert!((drift.offset_a() - 0.01).abs() < 1e-3, "{drift:?}");
        assert!((drift.x[FADE] - 0.05).abs() < 2e-3, "{drift:?}");
        assert!((drift.capacity().mean - true_ah).abs() < 3e-3, "{drift:?}, true {true_ah}");
    }

    #[test]
    fn fade_and_offset_without_prior_variance_are_not_learned() {
        let config = CapacityConfig { current_offset_std_a: 0.0, fade_std_ah_per_cycle: 0.0, ..CONFIG };
        let (drift, _) = cycle(&config, 0.03, 0.01);
        assert_eq!((drift.x[FADE], drift.x[OFFSET]), (0.0, 0.0));
    }

    #[test]
    fn covariance_stays_symmetric_and_positive() {
        let (drift, _) = cycle(&CONFIG, 0.0, -0.02);
        for i in 0..N {
            assert!(drift.p[i][i] > 0.0, "{drift:?}");
            for j in 0..N {
                assert!((drift.p[i][j] - drift.p[j][i]).abs() < 1e-12);
                assert!(drift.p[i][j] * drift.p[i][j] <= drift.p[i][i] * drift.p[j][j] * (1.0 + 1e-9));
            }
        }
    }
}
