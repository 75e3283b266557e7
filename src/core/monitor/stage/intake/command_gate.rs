//! Decides which authenticated command frames are executed.
//!
//! The sender of a command calculates its authenticator (a checksum with a secret key) from the command and a
//! *freshness*. The freshness is a counter value that packwatch announces and accepts only once, so that a recorded
//! command cannot be sent again.
//!
//! In: a command frame, and the freshness with which its authenticator is right (`None` if it is wrong). Out:
//! permission to execute the command, or the reason for the refusal; the freshness to announce.
//!
//! With many attempts, an attacker can guess a short authenticator. After [`FORGED_BURST`] wrong authenticators, the
//! gate is *under attack* for [`FORGED_PERIOD_NS`]. After this period, each further wrong authenticator starts another
//! period. For every [`FORGED_PERIOD_NS`] without a wrong authenticator, the gate tolerates one more, up to
//! [`FORGED_BURST`].
//!
//! During an attack, a command with a right authenticator is executed only if it is sent again within [`REPEAT_NS`],
//! with another freshness. A genuine sender repeats a refused command, so its commands are executed even during an
//! attack. An attacker must guess right twice.

use serde::{Deserialize, Serialize};

use crate::can::encode::{CommandRefusal, FRESHNESS_PERIOD_MS};
use crate::can::secoc::{Authentication, FreshnessWindow, MacCheck};
use crate::quantity::{InvalidState, Timestamp};

/// Number of wrong authenticators that start an attack, if none was wrong for a long time before.
const FORGED_BURST: i64 = 10;
/// Time after which one more wrong authenticator is tolerated, ns. With this time, the probability is 1 in 1900 that an
/// attacker guesses an authenticator of 24 bits within a day.
const FORGED_PERIOD_NS: i64 = 10_000_000_000;
/// Longest time between a command and its repetition during an attack, ns. At 2000 guesses a second (the default flood
/// limit), the probability is 1 in 800 that an attacker guesses an authenticator of 24 bits and its repetition within a
/// day.
const REPEAT_NS: i64 = 1_000_000_000;

/// Age (ns) above which an announced freshness is outdated: two announcement periods.
const STALE_NS: i64 = 2 * FRESHNESS_PERIOD_MS as i64 * 1_000_000;

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CommandGate {
    window: FreshnessWindow,
    announced_at: Timestamp,
    /// End of the time under attack, in which commands must be repeated.
    attacked_until: Timestamp,
    /// A command that the sender must repeat, and the time by which the sender must repeat it.
    unconfirmed: Option<(Timestamp, Vec<u8>)>,
    pub(crate) counts: CommandCounts,
}

/// Frames of an authenticated command message, by result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CommandCounts {
    /// Frames with a right authenticator whose command was permitted.
    pub authentic: u64,
    /// Frames with a wrong authenticator.
    pub forged: u64,
    /// Frames whose freshness was already used, was too old or had not been announced.
    pub old: u64,
    /// Frames with a right authenticator whose command must be repeated, because many wrong authenticators arrived.
    pub unconfirmed: u64,
}

impl CommandCounts {
    /// Differences between these counts and the earlier counts `before`.
    pub fn since(&self, before: &Self) -> Self {
        Self {
            authentic: self.authentic.saturating_sub(before.authentic),
            forged: self.forged.saturating_sub(before.forged),
            old: self.old.saturating_sub(before.old),
            unconfirmed: self.unconfirmed.saturating_sub(before.unconfirmed),
        }
    }
}

impl CommandGate {
    pub(crate) fn begin(&mut self, now: Timestamp) {
        self.window.begin(now);
        self.announced_at = now;
    }

    /// Handles a period in which no frames were received, or a step of the clock.
    pub(crate) fn restart(&mut self, now: Timestamp) {
        self.window.expire();
        self.attacked_until = self.attacked_until.min(now.plus_nanos(FORGED_PERIOD_NS));
        self.unconfirmed = None;
    }

    pub(crate) fn announce(&mut self, now: Timestamp) -> u64 {
        self.announced_at = now;
        self.window.announce()
    }

    pub(crate) fn mac_check(&self, authentication: Authentication, payload: &[u8]) -> MacCheck {
        self.window.check(authentication, payload)
    }

    /// Judges a frame. `verified` is the freshness with which the frame's authenticator is right; `None` = it is wrong.
    ///
    /// # Errors
    /// The reason why the command is not executed.
    pub(crate) fn judge(
        &mut self,
        now: Timestamp,
        authentication: Authentication,
        payload: &[u8],
        verified: Option<u64>,
    ) -> Result<(), CommandRefusal> {
        let check = self.mac_check(authentication, payload);
        let is_attacked = self.attacked_until > now;
        let is_stale = now.nanos().saturating_sub(self.announced_at.nanos()) > STALE_NS;
        let (count, verdict) = if is_stale || check.is_empty() {
            (&mut self.counts.old, Err(CommandRefusal::OldFreshness))
        } else if let Some(freshness) = verified.filter(|freshness| check.has(*freshness)) {
            self.window.accept(freshness);
            let data = &payload[..payload.len().saturating_sub(authentication.profile.trailer_bytes())];
            let before = self.unconfirmed.take().filter(|(until, before)| now <= *until && before == data);
            if is_attacked && before.is_none() {
                self.unconfirmed = Some((now.plus_nanos(REPEAT_NS), data.to_vec()));
                (&mut self.counts.unconfirmed, Err(CommandRefusal::RepeatNeeded))
            } else {
                (&mut self.counts.authentic, Ok(()))
            }
        } else {
            if !is_attacked {
                let earliest = now.plus_nanos(-(FORGED_BURST - 1) * FORGED_PERIOD_NS);
                self.attacked_until = self.attacked_until.max(earliest).plus_nanos(FORGED_PERIOD_NS);
            }
            (&mut self.counts.forged, Err(CommandRefusal::NotAuthentic))
        };
        *count = count.saturating_add(1);
        verdict
    }

    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.announced_at = self.announced_at.plus_nanos(by_nanos);
        self.attacked_until = self.attacked_until.plus_nanos(by_nanos);
        if let Some((until, _)) = &mut self.unconfirmed {
            *until = until.plus_nanos(by_nanos);
        }
    }

    pub(crate) fn check_state(&self) -> Result<(), InvalidState> {
        let found = self.window.announced() as f64;
        let allowed = "a multiple of 16 up to 2^60, above the accepted values";
        InvalidState::unless(self.window.is_possible(), "the freshness of commands", found, allowed)
    }
}

#[cfg(test)]
mod tests;
