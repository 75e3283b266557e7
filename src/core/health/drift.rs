//! Estimates a cell's capacity and its fade per cycle with a linear Kalman filter, one step per half-cycle.
//!
//! State x = [C (Ah), fade (Ah per full cycle)]. Measurement: the capacity according to one half-cycle alone
//! (`ScalarGaussian::information_until`). At the end of a charge of w full cycles, C -= w fade. The capacity also
//! follows a random walk; the caller passes its variance.
//!
//! The cell model has errors that do not change with time (lasting errors, [`super::end_errors`]). The filter considers
//! these errors but does not estimate them (Schmidt-Kalman filter; Woodbury and Junkins 2010). In addition to the
//! covariance P, the filter stores how much the error of x changes per standard deviation of each lasting error. The
//! lasting errors increase the published variance and reduce the gain, so they never average out.
//!
//! Assumed: all fade happens at the end of a charge. `check` checks the numbers of a stored filter; other inputs are
//! not checked.

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
    /// Change of the state's error (true minus estimated) per standard deviation of each lasting error.
    by_end: [[f64; N]; END_ERRORS],
}

impl DriftFilter {
    /// Creates a filter with the initial capacity `capacity` (Ah).
    pub fn new(config: &CapacityConfig, capacity: ScalarGaussian) -> Self {
        let mut p = [[0.0; N]; N];
        p[C][C] = capacity.variance;
        p[FADE][FADE] = config.fade_std_ah_per_cycle * config.fade_std_ah_per_cycle;
        Self { x: [capacity.mean, 0.0], p, by_end: [[0.0; N]; END_ERRORS] }
    }

    /// Capacity (Ah); its variance includes the lasting errors.
    pub fn capacity(&self) -> ScalarGaussian {
        let lasting: f64 = self.by_end.iter().map(|column| column[C] * column[C]).sum();
        ScalarGaussian { mean: self.x[C], variance: self.p[C][C] + lasting }
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        InvalidState::unless_capacity("a learned capacity", self.x[C])?;
        let all = self.x.iter().chain(self.p.iter().flatten()).chain(self.by_end.iter().flatten());
        InvalidState::unless_numbers("a number of a learned capacity's filter", all.copied())?;
        InvalidState::unless_positive("the variance of a learned capacity", self.p[C][C])?;
        for i in 0..N {
            InvalidState::unless_natural("a variance of a learned capacity's filter", self.p[i][i])?;
            for j in 0..i {
                let (covariance, most) = (self.p[i][j], (self.p[i][i] * self.p[j][j]).sqrt());
                // Tolerates rounding of the stored numbers.
                let fits = covariance.abs() <= most * (1.0 + 1e-5) && (covariance - self.p[j][i]).abs() <= most * 1e-5;
                InvalidState::unless(
                    fits,
                    "a covariance of a learned capacity's filter",
                    covariance,
                    "within its variances",
                )?;
            }
        }
        Ok(())
    }

    /// Updates with the capacity `z` measured by a half-cycle. `effects_ah`: change of `z` per standard deviation of
    /// each lasting error.
    pub fn update(&mut self, z: Measurement, effects_ah: &[f64; END_ERRORS]) {
        // Effect of the lasting errors on the innovation: their effect on the estimate C plus their effect on the
        // measurement.
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

    /// Whether the capacity is plausible for a cell model of capacity `cell_ah`, and all numbers of the filter can be
    /// stored.
    pub(super) fn is_possible(&self, cell_ah: f64) -> bool {
        bounds::TRUSTED_CAPACITY.has(self.x[C] / cell_ah) && self.check().is_ok()
    }

    /// Raises the variance of the capacity to at least `variance` (Ah^2), because new voltages have contradicted
    /// earlier measurements.
    pub fn doubt(&mut self, variance: f64) {
        self.p[C][C] = self.p[C][C].max(variance);
    }

    /// Raises the capacity to at least `charge_ah`, because the cell has moved this charge in one half-cycle.
    pub fn at_least(&mut self, charge_ah: f64) {
        self.x[C] = self.x[C].max(charge_ah);
    }

    /// Predicts the state after a half-cycle. `cycles`: length of the half-cycle in full cycles; `charged`: full cycles
    /// that cause fade; `capacity_variance`: process noise of the capacity (Ah^2).
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

    /// Runs cycles with a swing of 60 % on a cell that loses `loss_ah` at the end of each charge. Returns the filter
    /// and the cell's true capacity (Ah).
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
    fn constant_fade_is_learned_without_capacity_lag() {
        let (drift, true_ah) = cycle(&CONFIG, 0.03);
        assert!((drift.x[FADE] - 0.05).abs() < 2e-3, "{drift:?}");
        assert!((drift.capacity().mean - true_ah).abs() < 3e-3, "{drift:?}, true {true_ah}");
    }

    #[test]
    fn fade_without_prior_variance_is_not_learned() {
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
    fn lasting_error_does_not_average_out() {
        let lasting = |first_ah: f64| [first_ah, 0.0, 0.0, 0.0, 0.0];
        let measured = |effect_ah: f64| {
            let mut drift = DriftFilter::new(&CONFIG, ScalarGaussian::from_std(2.5, 0.2));
            for _ in 0..1000 {
                drift.update(Measurement { value: 2.65, variance: 1e-4 }, &lasting(effect_ah));
            }
            drift.capacity()
        };
        // Expected standard deviation after one noise-free measurement with a lasting error of 0.05 Ah, from a prior of
        // 0.2 Ah.
        let (kept, expected) = (measured(0.05).std(), 0.05 * 0.2 / f64::hypot(0.05, 0.2));
        assert!((kept - expected).abs() < 1e-3, "{kept} {expected}");
        assert!(measured(0.0).std() < 0.001);
    }

    #[test]
    fn lasting_errors_of_opposite_sign_cancel() {
        let mut drift = DriftFilter::new(&CONFIG, ScalarGaussian::from_std(2.5, 0.2));
        for k in 0..200 {
            let error = if k % 2 == 0 { 0.05 } else { -0.05 };
            drift.update(Measurement { value: 2.6 + error, variance: 1e-4 }, &[error, 0.0, 0.0, 0.0, 0.0]);
        }
        let capacity = drift.capacity();
        assert!((capacity.mean - 2.6).abs() < 0.003 && capacity.std() < 0.003, "{capacity:?}");
    }

    #[test]
    fn stored_filter_is_restored_unless_numbers_impossible() {
        let (drift, _) = cycle(&CONFIG, 0.03);
        let again: DriftFilter = serde_json::from_value(serde_json::to_value(drift).expect("writes")).expect("reads");
        assert_eq!((again, again.check()), (drift, Ok(())));
        let broken = DriftFilter { by_end: [[f64::NAN; N]; END_ERRORS], ..drift };
        assert!(broken.check().is_err());
    }
}
