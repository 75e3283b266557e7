//! Decides which authenticated command frames are executed.
//!
//! In: a command frame and the freshness with which its authenticator is right, if there is one. Out: whether it is executed, or
//! why not; the freshness to announce.
//!
//! A short authenticator can be guessed by trying often. After [`FORGED_BURST`] wrong ones, and then for [`FORGED_PERIOD_NS`]
//! after each, one right authenticator is not enough: the same command must come again, with another freshness, within
//! [`REPEAT_NS`]. A genuine sender, who repeats a command that was refused, is served during an attack; a guess must be right
//! twice.

use serde::{Deserialize, Serialize};

use crate::can::encode::{CommandRefusal, FRESHNESS_PERIOD_MS};
use crate::can::secoc::{Authentication, FreshnessWindow, MacCheck};
use crate::quantity::{InvalidState, Timestamp};

/// Wrong authenticators at once after a pause.
const FORGED_BURST: i64 = 10;
/// Then one in this time, ns: one of 24 bits is guessed within a day with a probability of 1 in 1900.
const FORGED_PERIOD_NS: i64 = 10_000_000_000;
/// Longest time between a command and its repetition during an attack, ns. At 2000 guesses a second, the most that the flood
/// limit admits by default, one of 24 bits and its repetition are right within a day with a probability of 1 in 800.
const REPEAT_NS: i64 = 1_000_000_000;

/// Without an announcement for this long what was announced is old, ns: two periods, as with announcements.
const STALE_NS: i64 = 2 * FRESHNESS_PERIOD_MS as i64 * 1_000_000;

/// The gate with its counts; all of it is kept over a restart.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CommandGate {
    window: FreshnessWindow,
    /// When the freshness was last announced.
    announced_at: Timestamp,
    /// Until when one right authenticator is not enough.
    attacked_until: Timestamp,
    /// A command that must come again, and until when.
    unconfirmed: Option<(Timestamp, Vec<u8>)>,
    pub(crate) counts: CommandCounts,
}

/// Frames of an authenticated command message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CommandCounts {
    /// With a right authenticator and a fresh value.
    pub authentic: u64,
    /// With a wrong authenticator.
    pub forged: u64,
    /// With a freshness that was used before, is too old or was not announced.
    pub old: u64,
    /// With a right authenticator, but to be repeated, because many wrong ones came.
    pub unconfirmed: u64,
}

impl CommandCounts {
    /// The counts since `before`.
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
    /// Begins a run at `now`.
    pub(crate) fn begin(&mut self, now: Timestamp) {
        self.window.begin(now);
        self.announced_at = now;
    }

    /// After time without listening, or a step of the clock.
    pub(crate) fn restart(&mut self, now: Timestamp) {
        self.window.expire();
        self.attacked_until = self.attacked_until.min(now.plus_nanos(FORGED_PERIOD_NS));
        self.unconfirmed = None;
    }

    /// The freshness to announce next.
    pub(crate) fn announce(&mut self, now: Timestamp) -> u64 {
        self.announced_at = now;
        self.window.announce()
    }

    /// What the authenticator of a payload is checked with.
    pub(crate) fn mac_check(&self, authentication: Authentication, payload: &[u8]) -> MacCheck {
        self.window.check(authentication, payload)
    }

    /// Judges a frame. `verified`: the freshness with which its authenticator is right.
    ///
    /// # Errors
    /// Why it is not executed.
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

    /// Moves the stored times onto another clock.
    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.announced_at = self.announced_at.plus_nanos(by_nanos);
        self.attacked_until = self.attacked_until.plus_nanos(by_nanos);
        if let Some((until, _)) = &mut self.unconfirmed {
            *until = until.plus_nanos(by_nanos);
        }
    }

    pub(crate) fn check_state(&self) -> Result<(), InvalidState> {
        let found = self.window.announced() as f64;
        let allowed = "a multiple of 16 up to 2^60, above what was accepted";
        InvalidState::unless(self.window.is_possible(), "the freshness of commands", found, allowed)
    }
}
