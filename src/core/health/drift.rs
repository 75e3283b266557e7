//! Slow drifts of a cell: its capacity, and the fade per cycle. A linear Kalman filter with one step per half-cycle.
//!
//! State x = [C (Ah), fade (Ah per full cycle)]. Measurement: the capacity by the half-cycle alone
//! (`ScalarGaussian::information_until`). At the end of a charge of w full cycles: C -= w fade. C walks (the caller's noise).
//!
//! The measurement's lasting errors ([`super::end_errors`]) are considered, not estimated (Schmidt; Woodbury and Junkins
//! 2010): beside P stands, per error, what one standard deviation of it makes of x. They count in the gain and in the
//! published variance, and never average out.
//!
//! Assumed: the fade of a cycle shows from its end on. Inputs are not checked; a stored state is.

use serde::{Deserialize, Serialize};

use super::CapacityConfig;
use super::end_errors::END_ERRORS;
use crate::filter::{Measurement, ScalarGaussian};
use crate::quantity::InvalidState;
use crate::quantity::bounds;

const C: usize = 0;
const FADE: usize = 1;
const N: usize = 2;

/// The filter of one cell.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriftFilter {
    x: [f64; N],
    /// Covariance without the lasting errors.
    p: [[f64; N]; N],
    /// Error of the state (true less estimated) by one standard deviation of each lasting error.
    by_end: [[f64; N]; END_ERRORS],
}

impl DriftFilter {
    /// A filter that starts from this capacity.
    pub fn new(config: &CapacityConfig, capacity: ScalarGaussian) -> Self {
        let mut p = [[0.0; N]; N];
        p[C][C] = capacity.variance;
        p[FADE][FADE] = config.fade_std_ah_per_cycle * config.fade_std_ah_per_cycle;
        Self { x: [capacity.mean, 0.0], p, by_end: [[0.0; N]; END_ERRORS] }
    }

    /// Capacity, Ah, with the lasting errors in its variance.
    pub fn capacity(&self) -> ScalarGaussian {
        let lasting: f64 = self.by_end.iter().map(|column| column[C] * column[C]).sum();
        ScalarGaussian { mean: self.x[C], variance: self.p[C][C] + lasting }
    }

    /// Checks a stored filter; the error is its first impossible number.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        InvalidState::unless_capacity("a learned capacity", self.x[C])?;
        let all = self.x.iter().chain(self.p.iter().flatten()).chain(self.by_end.iter().flatten());
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

    /// Updates with the capacity measured by a half-cycle, of which one standard deviation of each lasting error moves
    /// `effects_ah`.
    pub fn update(&mut self, z: Measurement, effects_ah: &[f64; END_ERRORS]) {
        // The innovation's error: C's and the measurement's own.
        let by_end: [f64; END_ERRORS] = std::array::from_fn(|k| self.by_end[k][C] + effects_ah[k]);
        let lasting: f64 = by_end.iter().map(|b| b * b).sum();
        let own_variance = self.p[C][C] + z.variance;
        let innovation = z.value - self.x[C];
        let cross: [f64; N] = std::array::from_fn(|i| self.p[i][C]);
        let gain: [f64; N] = std::array::from_fn(|i| {
            let considered: f64 = by_end.iter().zip(&self.by_end).map(|(b, column)| b * column[i]).sum();
            (cross[i] + considered) / (own_variance + lasting)
        });
        for i in 0..N {
            self.x[i] += gain[i] * innovation;
            for (column, b) in self.by_end.iter_mut().zip(by_end) {
                column[i] -= gain[i] * b;
            }
            for j in 0..N {
                self.p[i][j] += gain[i] * gain[j] * own_variance - gain[i] * cross[j] - cross[i] * gain[j];
            }
        }
    }

    /// Whether a capacity of the model's cell, and numbers that can be stored.
    pub(super) fn is_possible(&self, cell_ah: f64) -> bool {
        bounds::TRUSTED_CAPACITY.has(self.x[C] / cell_ah) && self.check().is_ok()
    }

    /// Widens the capacity to at least a variance, Ah^2: what was measured does not hold.
    pub fn doubt(&mut self, variance: f64) {
        self.p[C][C] = self.p[C][C].max(variance);
    }

    /// Raises the capacity to a charge, Ah, that was moved in one half-cycle.
    pub fn at_least(&mut self, charge_ah: f64) {
        self.x[C] = self.x[C].max(charge_ah);
    }

    /// Predicts over a half-cycle of `cycles` full cycles, of which `charged` count as fade; `capacity_variance` is the
    /// capacity's process noise.
    pub fn predict(&mut self, config: &CapacityConfig, cycles: f64, charged: f64, capacity_variance: f64) {
        self.x[C] -= charged * self.x[FADE];
        for j in 0..N {
            self.p[C][j] -= charged * self.p[FADE][j];
        }
        for row in self.p.iter_mut().chain(&mut self.by_end) {
            row[C] -= charged * row[FADE];
        }
        let walk = |std: f64| std * std * cycles;
        self.p[C][C] += capacity_variance;
        self.p[FADE][FADE] += walk(config.fade_noise_ah_per_cycle);
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
        end_error_v: Some(0.0),
        current_gain_std: 0.005,
        current_offset_std_a: 0.02,
        fade_std_ah_per_cycle: 0.1,
        fade_noise_ah_per_cycle: 0.0,
    };

    /// 60 % cycles of a cell that loses `loss_ah` at the end of each charge.
    fn cycle(config: &CapacityConfig, loss_ah: f64) -> (DriftFilter, f64) {
        let mut drift = DriftFilter::new(config, ScalarGaussian::from_std(2.5, 0.1));
        let mut true_ah = 2.6;
        for k in 0..40 {
            drift.update(Measurement { value: true_ah, variance: 1e-4 }, &[0.0; END_ERRORS]);
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
    fn the_fade_is_learned_and_the_capacity_does_not_lag() {
        let (drift, true_ah) = cycle(&CONFIG, 0.03);
        assert!((drift.x[FADE] - 0.05).abs() < 2e-3, "{drift:?}");
        assert!((drift.capacity().mean - true_ah).abs() < 3e-3, "{drift:?}, true {true_ah}");
    }

    #[test]
    fn a_fade_without_prior_variance_is_not_learned() {
        let (drift, _) = cycle(&CapacityConfig { fade_std_ah_per_cycle: 0.0, ..CONFIG }, 0.03);
        assert_eq!(drift.x[FADE], 0.0);
    }

    #[test]
    fn covariance_stays_symmetric_and_positive() {
        let (drift, _) = cycle(&CONFIG, 0.0);
        for i in 0..N {
            assert!(drift.p[i][i] > 0.0, "{drift:?}");
            for j in 0..N {
                assert!((drift.p[i][j] - drift.p[j][i]).abs() < 1e-12);
                assert!(drift.p[i][j] * drift.p[i][j] <= drift.p[i][i] * drift.p[j][j] * (1.0 + 1e-9));
            }
        }
    }

    #[test]
    fn a_lasting_error_counts_once_however_often_it_is_measured() {
        let lasting = |first_ah: f64| [first_ah, 0.0, 0.0, 0.0, 0.0];
        let measured = |effect_ah: f64| {
            let mut drift = DriftFilter::new(&CONFIG, ScalarGaussian::from_std(2.5, 0.2));
            for _ in 0..1000 {
                drift.update(Measurement { value: 2.65, variance: 1e-4 }, &lasting(effect_ah));
            }
            drift.capacity()
        };
        // One deviation of 0.05 Ah and the prior of 0.2 Ah: what one reading without noise would leave.
        let (kept, expected) = (measured(0.05).std(), 0.05 * 0.2 / f64::hypot(0.05, 0.2));
        assert!((kept - expected).abs() < 1e-3, "{kept} {expected}");
        assert!(measured(0.0).std() < 0.001);
    }

    #[test]
    fn an_error_that_two_swings_show_with_opposite_signs_cancels() {
        let mut drift = DriftFilter::new(&CONFIG, ScalarGaussian::from_std(2.5, 0.2));
        for k in 0..200 {
            let error = if k % 2 == 0 { 0.05 } else { -0.05 };
            drift.update(Measurement { value: 2.6 + error, variance: 1e-4 }, &[error, 0.0, 0.0, 0.0, 0.0]);
        }
        let capacity = drift.capacity();
        assert!((capacity.mean - 2.6).abs() < 0.003 && capacity.std() < 0.003, "{capacity:?}");
    }

    #[test]
    fn a_stored_filter_is_read_back_and_one_with_impossible_numbers_rejected() {
        let (drift, _) = cycle(&CONFIG, 0.03);
        let again: DriftFilter = serde_json::from_value(serde_json::to_value(drift).expect("writes")).expect("reads");
        assert_eq!((again, again.check()), (drift, Ok(())));
        let broken = DriftFilter { by_end: [[f64::NAN; N]; END_ERRORS], ..drift };
        assert!(broken.check().is_err());
    }
}
