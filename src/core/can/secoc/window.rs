//! The freshness that commands may have: announced by their receiver, never accepted twice, old after two announcements.
//!
//! The receiver announces a value once a second, each time [`ANNOUNCEMENT_STEP`] higher. A command carries the announced value
//! or one of those up to the next, each once and in rising order. Accepted is what lies above everything accepted before, is
//! not older than the announcement before the last, and was announced: a command that is held back is worthless two seconds
//! later, and one made for a value that an attacker invents is worthless until this receiver announces it.
//!
//! The sender keeps nothing over a restart: it waits for an announcement. The receiver does: it begins
//! [`RESTART_STEPS`] announcements beyond its stored state, and not before the time of its clock, so that no value of the run
//! before comes again although it was not stored.

use serde::{Deserialize, Serialize};

use super::{Authentication, MAX_CANDIDATES, MacCheck};
use crate::quantity::Timestamp;

/// From one announcement to the next; the commands that one of them serves.
pub const ANNOUNCEMENT_STEP: u64 = 16;
/// Announcements skipped at a start: more than an hour of a state that could not be stored.
const RESTART_STEPS: u64 = 4096;
/// Beyond this a stored value is damaged: it would take 10^9 years.
const MAX_FRESHNESS: u64 = 1 << 60;

/// The freshness values that a receiver accepts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FreshnessWindow {
    /// The last announced value, a multiple of the step.
    pub(super) announced: u64,
    /// The highest accepted value.
    pub(super) accepted: u64,
}

impl FreshnessWindow {
    /// Begins a run at `now`, beyond everything an earlier run can have announced.
    pub fn begin(&mut self, now: Timestamp) {
        let by_clock = u64::try_from(now.nanos() / 1_000_000_000).unwrap_or(0).saturating_mul(ANNOUNCEMENT_STEP);
        self.advance(RESTART_STEPS);
        self.announced = self.announced.max(by_clock);
    }

    /// The next value to announce.
    pub fn announce(&mut self) -> u64 {
        self.advance(1);
        self.announced
    }

    /// Ends the validity of everything announced: after time without listening.
    pub fn expire(&mut self) {
        self.advance(2);
    }

    fn advance(&mut self, steps: u64) {
        self.announced = self.announced.saturating_add(steps * ANNOUNCEMENT_STEP).min(MAX_FRESHNESS);
    }

    /// The lowest value that is accepted.
    pub fn lowest(&self) -> u64 {
        self.announced.saturating_sub(ANNOUNCEMENT_STEP).max(self.accepted.saturating_add(1))
    }

    /// The values that a payload's freshness may stand for; none = it is old, or too short.
    pub fn check(&self, authentication: Authentication, payload: &[u8]) -> MacCheck {
        let mut candidates = [None; MAX_CANDIDATES];
        if let Some(sent) = authentication.sent_freshness(payload) {
            let mask = authentication.freshness_mask();
            let fitting = (self.lowest()..self.announced + ANNOUNCEMENT_STEP).filter(|value| value & mask == sent);
            candidates.iter_mut().zip(fitting).for_each(|(place, value)| *place = Some(value));
        }
        MacCheck { authentication, candidates }
    }

    /// The last announced value.
    pub fn announced(&self) -> u64 {
        self.announced
    }

    /// Takes a value: from here on neither it nor a lower one is accepted.
    pub fn accept(&mut self, freshness: u64) {
        self.accepted = self.accepted.max(freshness);
    }

    /// Whether a stored window is possible.
    pub fn is_possible(&self) -> bool {
        self.announced <= MAX_FRESHNESS
            && self.announced.is_multiple_of(ANNOUNCEMENT_STEP)
            && self.accepted < self.announced.saturating_add(ANNOUNCEMENT_STEP)
    }
}
