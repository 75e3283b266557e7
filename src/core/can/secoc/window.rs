//! Decides which freshness values a command may have. A freshness value is the counter of an authenticated command; it
//! prevents replays.
//!
//! The receiver announces a value once a second, each time [`ANNOUNCEMENT_STEP`] higher. A command carries the
//! announced value, or a higher value below the next announcement. The sender uses each value once and in rising order.
//! The receiver accepts a value if it is higher than all values accepted before, not below the previous announcement,
//! and below the next announcement. If an attacker delays a command, the command therefore expires within two seconds.
//! A command with an invented value is useless until the receiver announces that value.
//!
//! The sender stores nothing: after a restart, it waits for an announcement. The receiver stores its state. After a
//! restart, the receiver begins [`RESTART_STEPS`] announcements above the stored state, or at [`ANNOUNCEMENT_STEP`]
//! times its clock (Unix time in seconds) if that is higher. It therefore never reuses a value of the previous run,
//! even if that value was not stored.

use serde::{Deserialize, Serialize};

use super::{Authentication, MAX_CANDIDATES, MacCheck};
use crate::quantity::Timestamp;

/// Difference between two announcements, and the number of commands that one announcement allows.
pub const ANNOUNCEMENT_STEP: u64 = 16;
/// Number of announcements that are skipped at a start. They cover more than an hour in which the state could not be
/// stored.
const RESTART_STEPS: u64 = 4096;
/// A higher stored value is damaged, because reaching it takes 10^9 years.
const MAX_FRESHNESS: u64 = 1 << 60;

/// Freshness values that a receiver accepts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FreshnessWindow {
    pub(super) announced: u64,
    pub(super) accepted: u64,
}

impl FreshnessWindow {
    /// Begins a run. Skips every value that an earlier run can have announced.
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

    /// Expires every announced value.
    pub fn expire(&mut self) {
        self.advance(2);
    }

    fn advance(&mut self, steps: u64) {
        self.announced = self.announced.saturating_add(steps * ANNOUNCEMENT_STEP).min(MAX_FRESHNESS);
    }

    /// The lowest acceptable value.
    pub fn lowest(&self) -> u64 {
        self.announced.saturating_sub(ANNOUNCEMENT_STEP).max(self.accepted.saturating_add(1))
    }

    /// A payload contains only the low bits of its freshness value. Returns the acceptable values with these bits.
    /// Empty if the freshness value has expired or the payload is too short.
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

    /// Accepts a value. Afterwards, neither this value nor a lower value is acceptable.
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
