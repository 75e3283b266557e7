//! Learns a resistance ratio for the slowest RC branch of each cell, in addition to the resistance ratio of the whole
//! cell.
//!
//! In: evidence from innovations (measured minus predicted voltages). Out: the ratio and its standard deviation. If a
//! model has a single branch, this branch covers all time constants, so its ratio stays 1.
//!
//! Reason: diffusion and electrolyte determine the slowest branch. They vary between cells, and they age differently
//! from contacts and charge transfer. The state [`LOG_RESISTANCE`](super::state_vector::LOG_RESISTANCE) mostly follows
//! contacts and charge transfer. Without a separate ratio, a wrong voltage of the slowest branch would be mistaken for
//! charge.
//!
//! Source: Friedland (1969), separate estimation of a bias, as in [`crate::health::offset`].

use serde::{Deserialize, Serialize};

use crate::quantity::InvalidState;

/// Minimum standard deviation of the ratio, relative to the configured standard deviation. Old evidence loses its
/// validity because the ratio changes with temperature and SOC.
const LEAST_PART: f64 = 0.5;

/// Maximum information that one correction uses, relative to 1 / variance of the ratio. The errors of the model repeat
/// from voltage to voltage, so many voltages give hardly more information than one.
const MAX_INFORMATION: f64 = 0.3;

const RANGE: (f64, f64) = (0.05, 3.0);

/// The learned ratio, and the evidence since its last correction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SlowBranch {
    /// Actual voltage of the cell's slowest branch, divided by the voltage that follows from the model and the cell's
    /// resistance ratio.
    pub(super) ratio: f64,
    /// Standard deviation of the ratio, relative to the configured standard deviation.
    pub(super) part: f64,
    /// Sum of d^2 / R, where d is the effect of one standard deviation of the ratio on an innovation, and R is the
    /// variance of the innovation without this effect.
    pub(super) information: f64,
    /// Sum of d x innovation / R.
    pub(super) score: f64,
}

/// A correction of the ratio.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Correction {
    pub(super) deviations: f64,
    /// Factor by which the evidence reduces the standard deviation of the ratio.
    pub(super) remains: f64,
    /// Factor that then raises the standard deviation to its minimum [`LEAST_PART`]; 1 if this is not necessary.
    pub(super) widened: f64,
}

impl Default for SlowBranch {
    fn default() -> Self {
        Self { ratio: 1.0, part: 1.0, information: 0.0, score: 0.0 }
    }
}

impl SlowBranch {
    /// Standard deviation of the ratio. `configured` is the standard deviation without evidence.
    #[inline]
    pub(super) fn std(&self, configured: f64) -> f64 {
        self.part * configured
    }

    /// Corrects the ratio with the evidence and clears the evidence. Returns `None` if the evidence is not usable.
    pub(super) fn correct(&mut self, configured: f64) -> Option<Correction> {
        let (information, score) = (self.information, self.score);
        (self.information, self.score) = (0.0, 0.0);
        let std = self.std(configured);
        if !(information > 0.0 && information.is_finite() && score.is_finite() && std > 0.0) {
            return None;
        }
        // Evidence beyond two standard deviations has another cause, so the score is limited.
        let most = 2.0 * (information * (1.0 + information)).sqrt();
        let counted = information.min(MAX_INFORMATION) / information;
        let (information, score) = (counted * information, counted * score.clamp(-most, most));
        let deviations = score / (1.0 + information);
        let ratio = (self.ratio + deviations * std).clamp(RANGE.0, RANGE.1);
        let remains = 1.0 / (1.0 + information).sqrt();
        let part = (self.part * remains).max(LEAST_PART);
        let correction =
            Correction { deviations: (ratio - self.ratio) / std, remains, widened: part / (self.part * remains) };
        (self.ratio, self.part) = (ratio, part);
        Some(correction)
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let (low, high) = RANGE;
        InvalidState::unless(
            (low..=high).contains(&self.ratio),
            "the ratio of a slow branch",
            self.ratio,
            "0.05 to 3",
        )?;
        InvalidState::unless(
            (LEAST_PART..=1.0).contains(&self.part),
            "the deviation of a slow branch",
            self.part,
            "0.5 to 1",
        )?;
        InvalidState::unless_natural("the information about a slow branch", self.information)?;
        InvalidState::unless_number("the evidence about a slow branch", self.score)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evidence_corrects_ratio_once() {
        let mut slow = SlowBranch { information: 0.25, score: -0.25, ..SlowBranch::default() };
        let correction = slow.correct(0.4).expect("evidence");
        // Information of 0.25, relative to the prior, moves the ratio by 0.25 / 1.25 of a standard deviation.
        assert!((correction.deviations + 0.2).abs() < 1e-12, "{correction:?}");
        assert!((correction.remains - 0.8_f64.sqrt()).abs() < 1e-12 && correction.widened == 1.0, "{correction:?}");
        assert!((slow.ratio - 0.92).abs() < 1e-12, "{slow:?}");
        assert_eq!(slow.correct(0.4), None);
        for _ in 0..100 {
            slow = SlowBranch { information: 0.25, score: 0.0, ..slow };
            slow.correct(0.4).expect("evidence");
        }
        assert!((slow.std(0.4) - 0.2).abs() < 1e-12 && (slow.ratio - 0.92).abs() < 1e-12, "{slow:?}");
        assert_eq!(slow.check(), Ok(()));
    }

    #[test]
    fn information_and_contradiction_are_limited() {
        let ratio = |information: f64, score: f64| {
            let mut slow = SlowBranch { information, score, ..SlowBranch::default() };
            slow.correct(0.4).expect("evidence");
            slow.ratio
        };
        assert!((ratio(30.0, -30.0) - ratio(MAX_INFORMATION, -MAX_INFORMATION)).abs() < 1e-12);
        assert_eq!(ratio(0.25, 50.0), ratio(0.25, 2.0 * (0.25_f64 * 1.25).sqrt()));
    }

    #[test]
    fn ratio_stays_in_range_for_any_evidence() {
        let mut slow = SlowBranch::default();
        for (information, score) in
            [(1.0, f64::NAN), (1.0, f64::INFINITY), (f64::INFINITY, 1.0), (0.0, 1.0), (f64::NAN, 1.0)]
        {
            (slow.information, slow.score) = (information, score);
            assert_eq!((slow.correct(0.3), slow), (None, SlowBranch::default()));
        }
        for score in [-1e3, 1e6] {
            for _ in 0..100 {
                (slow.information, slow.score) = (1.0, score);
                slow.correct(0.3);
                assert_eq!(slow.check(), Ok(()), "{score}");
            }
        }
        assert_eq!(slow.ratio, RANGE.1);
        assert!(SlowBranch { ratio: 0.0, ..slow }.check().is_err());
        assert!(SlowBranch { part: f64::NAN, ..slow }.check().is_err());
    }
}
