//! The slowest branch's resistance beside those of the cell's other parts: a ratio to the model's, learned per cell.
//!
//! In: the effect of one standard deviation of the ratio on innovations, V, and these, V. Out: the ratio and its standard
//! deviation. Diffusion and the electrolyte vary from cell to cell and age apart from the contacts and the charge transfer,
//! which [`LOG_RESISTANCE`](super::state_vector::LOG_RESISTANCE) follows; a slow voltage that is not there is mistaken for
//! charge.
//!
//! Source: Friedland (1969), separate estimation of a bias, as for the current's offset ([`crate::health::offset`]). The ratio is
//! corrected at changes of mode.

use serde::{Deserialize, Serialize};

use super::state_vector::square;
use crate::filter::Update;
use crate::quantity::InvalidState;

/// Least standard deviation, part of the first one: the ratio changes with temperature and SOC, and no evidence is for good.
const LEAST_PART: f64 = 1.0 / 3.0;

/// Largest correction at a time, standard deviations.
const MAX_DEVIATIONS: f64 = 3.0;

/// Least and largest ratio.
const RANGE: (f64, f64) = (0.05, 3.0);

/// The learned ratio, and the evidence since it was last corrected.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SlowBranch {
    /// Voltage of the slowest branch relative to the model's with the cell's resistance ratio.
    pub(super) ratio: f64,
    /// Its standard deviation relative to the configured one.
    pub(super) part: f64,
    /// Sum of d^2 / R, with d the effect of one standard deviation on an innovation of variance R without it.
    pub(super) information: f64,
    /// Sum of d x innovation / R.
    pub(super) score: f64,
}

/// A correction of the ratio, in standard deviations from before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Correction {
    pub(super) deviations: f64,
    /// Standard deviation that the evidence leaves, relative to that before.
    pub(super) remains: f64,
    /// Standard deviation now, relative to that.
    pub(super) widened: f64,
}

impl Default for SlowBranch {
    fn default() -> Self {
        Self { ratio: 1.0, part: 1.0, information: 0.0, score: 0.0 }
    }
}

impl SlowBranch {
    /// Standard deviation of the ratio, with `configured` before any evidence.
    #[inline]
    pub(super) fn std(&self, configured: f64) -> f64 {
        self.part * configured
    }

    /// Adds what a reading says, whose innovation one standard deviation of the ratio moves by `effect_v`.
    #[inline]
    pub(super) fn note(&mut self, effect_v: f64, update: &Update) {
        let per_variance = effect_v / (update.innovation_variance - square(effect_v));
        self.information += per_variance * effect_v;
        self.score += per_variance * update.innovation;
    }

    /// Corrects the ratio by the evidence, which is then used; `None` when there is none.
    pub(super) fn correct(&mut self, configured: f64) -> Option<Correction> {
        let (information, score) = (self.information, self.score);
        (self.information, self.score) = (0.0, 0.0);
        let std = self.std(configured);
        if !(information > 0.0 && score.is_finite() && std > 0.0) {
            return None;
        }
        let deviations = (score / (1.0 + information)).clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS);
        let ratio = (self.ratio + deviations * std).clamp(RANGE.0, RANGE.1);
        let remains = 1.0 / (1.0 + information).sqrt();
        let part = (self.part * remains).max(LEAST_PART);
        let correction =
            Correction { deviations: (ratio - self.ratio) / std, remains, widened: part / (self.part * remains) };
        (self.ratio, self.part) = (ratio, part);
        Some(correction)
    }

    /// Checks stored numbers; the error is the first impossible one.
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
            "1/3 to 1",
        )?;
        InvalidState::unless_natural("the information about a slow branch", self.information)?;
        InvalidState::unless_number("the evidence about a slow branch", self.score)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evidence_corrects_the_ratio_once_and_leaves_a_least_deviation() {
        let mut slow = SlowBranch { information: 3.0, score: -3.0, ..SlowBranch::default() };
        let correction = slow.correct(0.4).expect("evidence");
        // Three times the prior's information say one deviation: three quarters of it, and half the deviation.
        assert_eq!(correction, Correction { deviations: -0.75, remains: 0.5, widened: 1.0 });
        assert!((slow.ratio - 0.7).abs() < 1e-12 && (slow.std(0.4) - 0.2).abs() < 1e-12, "{slow:?}");
        assert_eq!(slow.correct(0.4), None);
        slow = SlowBranch { information: 99.0, score: 0.0, ..slow };
        let correction = slow.correct(0.4).expect("evidence");
        assert!((slow.std(0.4) - 0.4 / 3.0).abs() < 1e-12, "{slow:?}");
        assert!((correction.remains * correction.widened - 2.0 / 3.0).abs() < 1e-12, "{correction:?}");
        assert_eq!(slow.check(), Ok(()));
    }

    #[test]
    fn the_ratio_stays_within_its_range_whatever_the_evidence() {
        let mut slow = SlowBranch::default();
        for score in [f64::NAN, f64::INFINITY] {
            slow.score = score;
            slow.information = 1.0;
            assert_eq!((slow.correct(0.3), slow), (None, SlowBranch::default()));
        }
        for score in [-1e3, 1e6] {
            for _ in 0..100 {
                (slow.information, slow.score) = (1.0, score);
                slow.correct(0.3);
                assert_eq!(slow.check(), Ok(()), "{score}");
            }
        }
        assert_eq!(slow.ratio, 3.0);
        assert!(SlowBranch { ratio: 0.0, ..slow }.check().is_err());
        assert!(SlowBranch { part: f64::NAN, ..slow }.check().is_err());
    }
}
