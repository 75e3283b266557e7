//! The receiver of one protected message: E2E_P01Check of AUTOSAR, called once per frame (or once per period without one).
//!
//! In: payloads in the order of their arrival. Out: a [`Status`] each, and how often each was given. States, in AUTOSAR's
//! words: WaitForFirstData (`last_valid` is `None`); LastValidCounter; MaxDeltaCounter, which grows by one with each call,
//! since each call may be a frame that was lost, and falls back with each valid frame; NoNewOrRepeatedDataCounter; and
//! SyncCounter, the valid frames still wanted before the sequence is believed again after it broke.

use serde::{Deserialize, Serialize};

use super::{Profile, Protection};

/// NoNewOrRepeatedDataCounter stops here, as in AUTOSAR: a `max_no_new_or_repeated_data` of 14 allows any number.
const MAX_REPEATED: u8 = 14;

/// How one message is checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CheckConfig {
    /// Profile and data identifier.
    pub protection: Protection,
    /// Frames that may be lost between two calls; each call without a valid frame allows one more.
    pub max_delta_counter_init: u8,
    /// Calls in a row without a new frame after which the sequence must be shown anew; 14 = any number.
    pub max_no_new_or_repeated_data: u8,
    /// Valid frames in sequence that show it: as many are [`Status::Sync`]; 0 = none is asked for.
    pub sync_counter_init: u8,
}

impl CheckConfig {
    /// One frame may be lost, repetitions do not break the sequence, a broken sequence is believed again at once.
    pub const fn new(protection: Protection) -> Self {
        Self { protection, max_delta_counter_init: 1, max_no_new_or_repeated_data: MAX_REPEATED, sync_counter_init: 0 }
    }
}

/// What the check says of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Status {
    /// Intact and the next in sequence.
    Ok = 0,
    /// No frame came in its period.
    NoNewData = 1,
    /// Damaged, too short, another message's, or with a counter no sender may use.
    WrongCrc = 2,
    /// Intact and in sequence, after the sequence had broken: it is being shown anew.
    Sync = 3,
    /// The first intact frame: nothing to compare its counter with.
    Initial = 4,
    /// Intact, but the counter is that of the last frame.
    Repeated = 5,
    /// Intact; some frames before it were lost, no more than allowed.
    OkSomeLost = 6,
    /// Intact, but the counter jumped further than allowed.
    WrongSequence = 7,
}

impl Status {
    /// All of them, in the order of their numbers.
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

    /// Whether the payload may be used: AUTOSAR's mapping with profile behaviour 1.
    pub const fn is_usable(self) -> bool {
        match self {
            Self::Ok | Self::OkSomeLost | Self::Sync => true,
            Self::NoNewData | Self::WrongCrc | Self::Initial | Self::Repeated | Self::WrongSequence => false,
        }
    }

    /// The word for it in events and reports.
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

/// How often each status was given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct StatusCounts([u64; Status::ALL.len()]);

impl StatusCounts {
    /// How often `status` was given.
    pub const fn get(&self, status: Status) -> u64 {
        self.0[status as usize]
    }

    /// Every status with its count, zeros too.
    pub fn iter(&self) -> impl Iterator<Item = (Status, u64)> + '_ {
        Status::ALL.into_iter().map(|status| (status, self.get(status)))
    }

    /// Every status given so far, whichever.
    pub fn total(&self) -> u64 {
        self.0.iter().fold(0, |sum, count| sum.saturating_add(*count))
    }

    fn add(&mut self, status: Status, times: u64) {
        let count = &mut self.0[status as usize];
        *count = count.saturating_add(times);
    }
}

/// State of one message's receiver.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Receiver {
    /// Counter of the last valid frame; `None` = none yet.
    last_valid: Option<u8>,
    /// Largest step of the counter the next frame may show.
    max_delta: u8,
    /// Calls in a row without a new frame.
    no_new_or_repeated: u8,
    /// Valid frames still wanted.
    sync: u8,
    /// Frames lost before the last valid one.
    lost: u8,
    counts: StatusCounts,
}

impl Receiver {
    /// Checks one frame's payload.
    pub fn check(&mut self, config: &CheckConfig, payload: &[u8]) -> Status {
        self.grow(config.protection.profile, 1);
        let status = match config.protection.verified_counter(payload) {
            None => Status::WrongCrc,
            Some(counter) => self.take(config, counter),
        };
        self.counts.add(status, 1);
        status
    }

    /// A period went by without a frame.
    pub fn no_new_data(&mut self, config: &CheckConfig) -> Status {
        self.miss(config, 1)
    }

    /// So many periods went by without a frame.
    pub(crate) fn miss(&mut self, config: &CheckConfig, periods: u64) -> Status {
        self.grow(config.protection.profile, periods);
        self.count_repeated(periods);
        self.counts.add(Status::NoNewData, periods);
        Status::NoNewData
    }

    /// A receiver that waits for its first frame and has these counts.
    pub(crate) fn with_counts(counts: StatusCounts) -> Self {
        Self { counts, ..Self::default() }
    }

    /// Waits for a first frame again and keeps the counts.
    pub fn restart(&mut self) {
        *self = Self::with_counts(self.counts);
    }

    /// How often each status was given.
    pub const fn counts(&self) -> &StatusCounts {
        &self.counts
    }

    /// Frames lost before the last one that was OK or OKSOMELOST (or SYNC).
    pub const fn lost(&self) -> u8 {
        self.lost
    }

    /// Each call may stand for a frame of the sender's that was lost.
    fn grow(&mut self, profile: Profile, calls: u64) {
        self.max_delta = grown(self.max_delta, calls, profile.max_counter());
    }

    fn count_repeated(&mut self, calls: u64) {
        self.no_new_or_repeated = grown(self.no_new_or_repeated, calls, MAX_REPEATED);
    }

    /// An intact frame with this counter.
    fn take(&mut self, config: &CheckConfig, counter: u8) -> Status {
        let Some(last) = self.last_valid else {
            self.believe(config, counter);
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
            // Profile 5 goes on from any intact frame, and so does a synchronisation that is to come. Profile 1 without one
            // keeps the last counter it believed, until the sender comes round to it or the allowed step reaches that far.
            if self.sync > 0 || config.protection.profile == Profile::P05 {
                self.believe(config, counter);
            }
            return Status::WrongSequence;
        }
        self.believe(config, counter);
        self.lost = delta - 1;
        match (self.synchronise(config), delta) {
            (true, _) => Status::Sync,
            (false, 1) => Status::Ok,
            (false, _) => Status::OkSomeLost,
        }
    }

    fn believe(&mut self, config: &CheckConfig, counter: u8) {
        self.last_valid = Some(counter);
        self.max_delta = config.max_delta_counter_init;
    }

    /// Whether this frame, in sequence, is one of those that must show the sequence anew.
    fn synchronise(&mut self, config: &CheckConfig) -> bool {
        if self.no_new_or_repeated > config.max_no_new_or_repeated_data {
            self.sync = config.sync_counter_init;
        }
        self.no_new_or_repeated = 0;
        let wanted = self.sync > 0;
        self.sync = self.sync.saturating_sub(1);
        wanted
    }
}

/// `from` and `by` more, at most `limit`.
fn grown(from: u8, by: u64, limit: u8) -> u8 {
    from.saturating_add(u8::try_from(by).unwrap_or(u8::MAX)).min(limit)
}

#[cfg(test)]
mod tests;
