//! Learns the offset of the current sensor. All cells share this sensor.
//!
//! In: the evidence in the voltages of all cells ([`EstimatorBank::offset_evidence`]) and the elapsed time (s). Out:
//! mean and standard deviation of the offset in the current of one cell (A), measured minus true. The offset is best
//! observed at rest, when the counted charge drifts but the voltage does not. Current readings of exactly zero are
//! ignored, because a sensor that reads exactly zero suppresses small currents.
//!
//! Source: Friedland (1969), separate estimation of a bias. There, a filter ignores the bias, and its innovations are
//! used to estimate the bias. In packwatch, the filter considers the bias in its gain, and the correction is applied
//! only when the mode (charge, rest, discharge) changes.
//!
//! [`EstimatorBank::offset_evidence`]: crate::cell::EstimatorBank::offset_evidence

use serde::{Deserialize, Serialize};

use crate::filter::ScalarGaussian;
use crate::quantity::InvalidState;

/// A learned offset.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurrentOffset {
    /// Mean of the offset in the current of one cell (A). It is subtracted from that current.
    mean_a: f64,
    /// Standard deviation as a fraction of the configured standard deviation. `None` = no offset has been learned; the
    /// fraction is then 1.
    part: Option<f64>,
}

impl CurrentOffset {
    /// Mean of the offset in the current of one cell (A).
    pub fn mean_a(&self) -> f64 {
        self.mean_a
    }

    /// Standard deviation of the offset (A); `configured_a` if there has been no evidence.
    pub fn std_a(&self, configured_a: f64) -> f64 {
        self.part() * configured_a
    }

    /// The learned offset (A); `None` if there has been no evidence or learning is off (`configured_a` is 0).
    pub fn learned(&self, configured_a: f64) -> Option<ScalarGaussian> {
        let part = self.part.filter(|_| configured_a > 0.0)?;
        Some(ScalarGaussian::from_std(self.mean_a, part * configured_a))
    }

    fn part(&self) -> f64 {
        self.part.unwrap_or(1.0)
    }

    /// Updates the offset with the evidence. For each innovation, d is its change if the offset grows by one standard
    /// deviation, and R is its variance. `information` is the sum of d^2 / R over the innovations; `score` is the sum
    /// of d x innovation / R. Returns the correction in units of the standard deviation before the update.
    pub fn update(&mut self, configured_a: f64, (information, score): (f64, f64)) -> f64 {
        let std_a = self.std_a(configured_a);
        if !(information > 0.0 && score.is_finite() && std_a > 0.0) {
            return 0.0;
        }
        let most_a = 5.0 * configured_a;
        // Evidence beyond three standard deviations must have another cause than an offset.
        let deviations = (score / (1.0 + information)).clamp(-3.0, 3.0);
        let mean_a = (self.mean_a + deviations * std_a).clamp(-most_a, most_a);
        let corrected = (mean_a - self.mean_a) / std_a;
        self.mean_a = mean_a;
        self.part = Some(self.part() / (1.0 + information).sqrt());
        corrected
    }

    /// Adds the uncertainty of a drift over `seconds`. The drift is a random walk; its standard deviation after one day
    /// is a tenth of the initial standard deviation. Sensors drift this much with temperature.
    pub fn drift(&mut self, seconds: f64) {
        if let Some(part) = &mut self.part {
            *part = (*part * *part + 0.1 * 0.1 * seconds.max(0.0) / 86_400.0).sqrt().min(1.0);
        }
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        InvalidState::unless_number("the offset of the current", self.mean_a)?;
        let part = self.part();
        InvalidState::unless(
            part > 0.0 && part <= 1.0,
            "the deviation of the current's offset",
            part,
            "above 0, at most 1",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evidence_is_weighted_by_deviation_and_counts_once() {
        let mut offset = CurrentOffset::default();
        assert_eq!((offset.mean_a(), offset.std_a(0.05), offset.learned(0.05)), (0.0, 0.05, None));
        // Evidence for an offset of one standard deviation; it contains three times the information of the prior.
        let corrected = offset.update(0.05, (3.0, 3.0));
        assert!((corrected - 0.75).abs() < 1e-12 && (offset.mean_a() - 0.0375).abs() < 1e-12, "{offset:?}");
        assert!((offset.std_a(0.05) - 0.025).abs() < 1e-12);
        assert_eq!(offset.learned(0.05), Some(ScalarGaussian::from_std(offset.mean_a(), offset.std_a(0.05))));
        assert_eq!(offset.learned(0.0), None, "offset learning is off");
        // Evidence for a remaining offset of half the present standard deviation.
        offset.update(0.05, (99.0, 50.0));
        assert!((offset.mean_a() - 0.05).abs() < 1e-12 && (offset.std_a(0.05) - 0.0025).abs() < 1e-12, "{offset:?}");
    }

    #[test]
    fn invalid_or_missing_evidence_changes_nothing() {
        for evidence in [(0.0, 0.0), (-1.0, 3.0), (f64::NAN, 1.0), (2.0, f64::INFINITY)] {
            let mut offset = CurrentOffset::default();
            assert_eq!((offset.update(0.05, evidence), offset), (0.0, CurrentOffset::default()), "{evidence:?}");
        }
        let mut unlearned = CurrentOffset::default();
        assert_eq!((unlearned.update(0.0, (5.0, 5.0)), unlearned.mean_a()), (0.0, 0.0));
    }

    #[test]
    fn mean_is_bounded_and_deviation_grows_with_time() {
        let mut offset = CurrentOffset::default();
        for _ in 0..100 {
            offset.update(0.05, (1.0, 1e3));
            offset.drift(86_400.0);
        }
        assert!((offset.mean_a() - 0.25).abs() < 1e-12, "{offset:?}");
        offset.drift(400.0 * 86_400.0);
        assert_eq!(offset.std_a(0.05), 0.05);
        assert!(offset.check().is_ok());
        assert!(CurrentOffset { part: Some(0.0), ..offset }.check().is_err());
    }
}
