//! The receiver of one protected message: E2E_P01Check of AUTOSAR, called once per frame and once for each period
//! without a frame.
//!
//! In: payloads in order of arrival. Out: a [`Status`] for each payload, and counts by status.
//!
//! State, with AUTOSAR's names:
//!
//! * WaitForFirstData: `last_valid` is `None`.
//! * LastValidCounter: counter of the last accepted frame.
//! * MaxDeltaCounter: largest allowed counter step. Each call increases it by one, because the call may stand for a
//!   lost frame. An accepted frame resets it.
//! * NoNewOrRepeatedDataCounter: number of periods without a frame and of repeated frames since the counter in the
//!   frames last changed. Damaged frames do not count.
//! * SyncCounter: number of valid frames still required before a broken sequence is trusted again.

use serde::{Deserialize, Serialize};

use super::{Profile, Protection};

/// AUTOSAR's limit of NoNewOrRepeatedDataCounter.
const MAX_REPEATED: u8 = 14;

/// Settings of the check of one message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CheckConfig {
    pub protection: Protection,
    /// Number of frames that may be lost between two accepted frames. Each call without an accepted frame allows one
    /// more.
    pub max_delta_counter_init: u8,
    /// Maximum number of periods without a frame and of repeated frames since the counter last changed. Above this
    /// number, the sequence is broken. 14 = any number.
    pub max_no_new_or_repeated_data: u8,
    /// Number of valid frames required after a broken sequence.
    pub sync_counter_init: u8,
}

impl CheckConfig {
    /// Default settings: one frame may be lost, repetitions do not break the sequence, and a broken sequence is trusted
    /// again at once.
    pub const fn new(protection: Protection) -> Self {
        Self { protection, max_delta_counter_init: 1, max_no_new_or_repeated_data: MAX_REPEATED, sync_counter_init: 0 }
    }
}

/// Result of the check of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Status {
    /// The next frame in sequence.
    Ok = 0,
    /// No frame arrived within its period.
    NoNewData = 1,
    /// Damaged, too short, from another message, or with an invalid counter.
    WrongCrc = 2,
    /// In sequence, but one of the frames required after a broken sequence.
    Sync = 3,
    /// The first intact frame. There is no previous counter to compare with.
    Initial = 4,
    /// The same counter as in the last accepted frame.
    Repeated = 5,
    /// Frames were lost, but no more than allowed.
    OkSomeLost = 6,
    /// The counter jumped further than allowed.
    WrongSequence = 7,
}

impl Status {
    /// All statuses, in the order of their numbers.
    pub const ALL: [Self; 8] = [
        Self::Ok,
        Self::NoNewData,
        Self::WrongCrc,
        Self::Sync,
        Self::Initial,
        Self::Repeated,
        Self::OkSomeLost,
        Self::WrongSequence,
    ];

    /// Whether the payload may be used (AUTOSAR's mapping with profile behaviour 1).
    pub const fn is_usable(self) -> bool {
        match self {
            Self::Ok | Self::OkSomeLost | Self::Sync => true,
            Self::NoNewData | Self::WrongCrc | Self::Initial | Self::Repeated | Self::WrongSequence => false,
        }
    }

    /// Name in events and reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::NoNewData => "no_new_data",
            Self::WrongCrc => "wrong_crc",
            Self::Sync => "sync",
            Self::Initial => "initial",
            Self::Repeated => "repeated",
            Self::OkSomeLost => "ok_some_lost",
            Self::WrongSequence => "wrong_sequence",
        }
    }
}

/// Count of each status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct StatusCounts([u64; Status::ALL.len()]);

impl StatusCounts {
    pub const fn get(&self, status: Status) -> u64 {
        self.0[status as usize]
    }

    /// Every status with its count.
    pub fn iter(&self) -> impl Iterator<Item = (Status, u64)> + '_ {
        Status::ALL.into_iter().map(|status| (status, self.get(status)))
    }

    pub fn total(&self) -> u64 {
        self.0.iter().fold(0, |sum, count| sum.saturating_add(*count))
    }

    fn add(&mut self, status: Status, times: u64) {
        let count = &mut self.0[status as usize];
        *count = count.saturating_add(times);
    }
}

/// State of one message's receiver. The counts are stored separately.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Receiver {
    last_valid: Option<u8>,
    /// Largest allowed counter step. Each call adds one before the comparison.
    max_delta: u8,
    no_new_or_repeated: u8,
    sync: u8,
    #[serde(skip)]
    counts: StatusCounts,
}

impl Receiver {
    /// Checks the payload of a frame.
    pub fn check(&mut self, config: &CheckConfig, payload: &[u8]) -> Status {
        self.grow(config.protection.profile, 1);
        let status = match config.protection.verified_counter(payload) {
            None => Status::WrongCrc,
            Some(counter) => self.take(config, counter),
        };
        self.counts.add(status, 1);
        status
    }

    /// Counts periods without a frame.
    pub(crate) fn no_new_data(&mut self, config: &CheckConfig, periods: u64) -> Status {
        self.grow(config.protection.profile, periods);
        self.count_repeated(periods);
        self.counts.add(Status::NoNewData, periods);
        Status::NoNewData
    }

    /// A receiver that waits for its first frame, with these counts.
    pub(crate) fn with_counts(counts: StatusCounts) -> Self {
        Self { counts, ..Self::default() }
    }

    /// Takes the state of `stored`, but keeps its own counts.
    pub(crate) fn resume(&mut self, profile: Profile, stored: &Self) {
        let last_valid = stored.last_valid.filter(|counter| *counter <= profile.max_counter());
        *self = Self { last_valid, counts: self.counts, ..stored.clone() };
    }

    /// Waits for a first frame again; keeps the counts.
    pub fn restart(&mut self) {
        *self = Self::with_counts(self.counts);
    }

    /// Counter of the next frame in sequence; `None` = any counter.
    pub fn next_counter(&self, profile: Profile) -> Option<u8> {
        self.last_valid.map(|last| profile.next_counter(last))
    }

    pub const fn counts(&self) -> &StatusCounts {
        &self.counts
    }

    fn grow(&mut self, profile: Profile, calls: u64) {
        self.max_delta = grown(self.max_delta, calls, profile.max_counter());
    }

    fn count_repeated(&mut self, calls: u64) {
        self.no_new_or_repeated = grown(self.no_new_or_repeated, calls, MAX_REPEATED);
    }

    /// Handles an intact frame.
    fn take(&mut self, config: &CheckConfig, counter: u8) -> Status {
        let Some(last) = self.last_valid else {
            self.accept(config, counter);
            return Status::Initial;
        };
        let delta = config.protection.profile.counter_delta(last, counter);
        if delta == 0 {
            self.count_repeated(1);
            return Status::Repeated;
        }
        if delta > self.max_delta {
            self.no_new_or_repeated = 0;
            self.sync = config.sync_counter_init;
            // With profile 5 or a configured synchronisation, the sequence continues from any intact frame. Otherwise,
            // the last accepted counter stays until the sender reaches it again or the allowed step is large enough.
            if self.sync > 0 || config.protection.profile == Profile::P05 {
                self.accept(config, counter);
            }
            return Status::WrongSequence;
        }
        self.accept(config, counter);
        match (self.synchronise(config), delta) {
            (true, _) => Status::Sync,
            (false, 1) => Status::Ok,
            (false, _) => Status::OkSomeLost,
        }
    }

    fn accept(&mut self, config: &CheckConfig, counter: u8) {
        self.last_valid = Some(counter);
        self.max_delta = config.max_delta_counter_init;
    }

    /// Counts a frame in sequence. Returns whether it is one of the frames required after a broken sequence.
    fn synchronise(&mut self, config: &CheckConfig) -> bool {
        if self.no_new_or_repeated > config.max_no_new_or_repeated_data {
            self.sync = config.sync_counter_init;
        }
        self.no_new_or_repeated = 0;
        let is_required = self.sync > 0;
        self.sync = self.sync.saturating_sub(1);
        is_required
    }
}

fn grown(from: u8, by: u64, limit: u8) -> u8 {
    from.saturating_add(u8::try_from(by).unwrap_or(u8::MAX)).min(limit)
}

#[cfg(test)]
mod tests;
