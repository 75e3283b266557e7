//! Detects charge, rest or discharge from the pack current, with dead band, hysteresis and minimum duration.
//!
//! In: pack current in A (positive = discharge), `None` if stale. Out: changes of mode. A change is reported after the
//! new mode has lasted for the minimum duration. The change has the time at which the new mode began.

use serde::{Deserialize, Serialize};

use super::TransitionConfig;
use crate::quantity::{Mode, Timestamp};

/// A mode that has not yet lasted for the minimum duration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct ModeCandidate {
    mode: Mode,
    since: Timestamp,
}

/// A confirmed change of mode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModeChange {
    pub from: Mode,
    pub to: Mode,
    /// Beginning of the new mode.
    pub since: Timestamp,
}

/// Outcome of one observation.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TransitionOutcome {
    /// The change of mode that this observation confirms, if any.
    pub change: Option<ModeChange>,
    /// Whether a new candidate mode begins with this observation. If so, the caller stores the totals and the SOC of
    /// all cells. If the candidate is confirmed, the next half-cycle starts from these values.
    pub candidate_begins: bool,
}

/// Detects changes of mode.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct TransitionDetector {
    mode: Mode,
    candidate: Option<ModeCandidate>,
}

impl TransitionDetector {
    /// The confirmed mode.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Handles the current at `time`. If the candidate has lasted long enough by then, it is confirmed first.
    pub fn observe(&mut self, config: &TransitionConfig, time: Timestamp, current_a: Option<f64>) -> TransitionOutcome {
        let change = self.poll(config, time);
        let observed = self.classify(config, current_a);
        let idle = |mode| matches!(mode, Mode::Rest | Mode::Unknown);
        let mut candidate_begins = false;
        self.candidate = match self.candidate {
            _ if observed == self.mode => None,
            // If the current becomes stale soon after a load ends, rest and unknown mode count as the same candidate,
            // which began at the end of the load.
            Some(before) if before.mode == observed || (idle(before.mode) && idle(observed)) => {
                Some(ModeCandidate { mode: observed, since: before.since })
            }
            _ => {
                candidate_begins = true;
                Some(ModeCandidate { mode: observed, since: time })
            }
        };
        TransitionOutcome { change, candidate_begins }
    }

    /// Confirms the candidate if it has lasted long enough by `time`.
    pub fn poll(&mut self, config: &TransitionConfig, time: Timestamp) -> Option<ModeChange> {
        self.candidate.filter(|candidate| time.since(candidate.since) >= config.min_duration_s)?;
        self.settle()
    }

    /// Confirms the candidate regardless of its duration.
    pub fn settle(&mut self) -> Option<ModeChange> {
        let candidate = self.candidate?;
        let from = std::mem::replace(&mut self.mode, candidate.mode);
        self.candidate = None;
        Some(ModeChange { from, to: candidate.mode, since: candidate.since })
    }

    /// Mode of a current. Charge or discharge begins only if the current exceeds the dead band plus the hysteresis. The
    /// charge or discharge continues while the current exceeds the dead band.
    fn classify(&self, config: &TransitionConfig, current_a: Option<f64>) -> Mode {
        let Some(current_a) = current_a else { return Mode::Unknown };
        let enter = config.dead_band_a + config.hysteresis_a;
        let edge = |mode| if self.mode == mode { config.dead_band_a } else { enter };
        if current_a > edge(Mode::Discharge) {
            Mode::Discharge
        } else if current_a < -edge(Mode::Charge) {
            Mode::Charge
        } else {
            Mode::Rest
        }
    }

    /// Shifts all timestamps by `by_nanos`, to another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        if let Some(candidate) = &mut self.candidate {
            candidate.since = candidate.since.plus_nanos(by_nanos);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: TransitionConfig =
        TransitionConfig { dead_band_a: 0.1, hysteresis_a: 0.05, min_duration_s: 2.0, min_swing: 0.0 };

    fn run(samples: &[(f64, Option<f64>)]) -> Vec<ModeChange> {
        let mut detector = TransitionDetector::default();
        samples.iter().filter_map(|&(t, i)| detector.observe(&CONFIG, Timestamp::from_secs(t), i).change).collect()
    }

    #[test]
    fn mode_is_confirmed_after_minimum_duration_dated_from_start() {
        let changes =
            run(&[(0.0, Some(1.0)), (1.0, Some(1.0)), (2.0, Some(1.0)), (3.0, Some(-1.0)), (5.5, Some(-1.0))]);
        let modes: Vec<_> = changes.iter().map(|c| (c.from, c.to, c.since.secs())).collect();
        assert_eq!(modes, [(Mode::Unknown, Mode::Discharge, 0.0), (Mode::Discharge, Mode::Charge, 3.0)]);
    }

    #[test]
    fn short_regeneration_is_not_a_transition() {
        let changes = run(&[(0.0, Some(1.0)), (2.0, Some(1.0)), (3.0, Some(-5.0)), (4.0, Some(1.0)), (9.0, Some(1.0))]);
        assert_eq!(changes.len(), 1);
    }

    #[test]
    fn current_within_hysteresis_keeps_mode() {
        let mut detector = TransitionDetector::default();
        let mut mode_after = |t, i| {
            detector.observe(&CONFIG, Timestamp::from_secs(t), Some(i));
            detector.poll(&CONFIG, Timestamp::from_secs(t + 2.0));
            detector.mode()
        };
        assert_eq!(mode_after(0.0, 0.12), Mode::Rest);
        assert_eq!(mode_after(10.0, 0.2), Mode::Discharge);
        assert_eq!(mode_after(20.0, 0.12), Mode::Discharge);
        assert_eq!(mode_after(30.0, 0.08), Mode::Rest);
        assert_eq!(mode_after(40.0, -0.2), Mode::Charge);
        assert_eq!(mode_after(50.0, f64::MIN_POSITIVE), Mode::Rest);
    }

    #[test]
    fn stale_current_gives_unknown_mode() {
        let changes = run(&[(0.0, Some(1.0)), (2.0, Some(1.0)), (3.0, None), (6.0, None)]);
        assert_eq!(changes.last().map(|c| c.to), Some(Mode::Unknown));
    }
}
