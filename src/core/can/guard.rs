//! Checks the end-to-end protection of input messages.
//!
//! In: frames with their time and interface, in order of arrival, and the current time, also while no frame arrives
//! ([`Guards::poll`]). Out: the [`Status`] of each frame and counts per message. A [`GuardChange`] reports that a
//! message starts to fail its check or becomes usable again.
//!
//! If a message's cycle time is known, each period without a frame counts as one [`Status::NoNewData`]. The first
//! missing frame is counted after one and a half periods, to allow for jitter. The check tolerates a configured number
//! of missing frames: after them, the next frame is still usable. Up to this number, no change is reported, so that a
//! sender with jitter does not fill the log.
//!
//! After sleep, a restart of the program or a clock step, missing frames are not the sender's fault. The check of each
//! message then waits for a first frame again ([`Guards::restart`]). A restarted program restores the counts of
//! results, but not the frame counter of each message. While the program was stopped, the sender continued to count. A
//! stored frame counter would therefore reject good frames, or accept an old frame by chance. If no time has passed
//! since the state was stored, the frame counters are restored too ([`Guards::resume`]).

use serde::{Deserialize, Serialize};

use crate::can::e2e::{CheckConfig, Receiver, Status, StatusCounts};
use crate::can::{CanId, Frame, FrameKind};
use crate::quantity::{BusIndex, Timestamp};

/// After this number of periods without a frame, one frame counts as missed. Each further period counts one more.
const MISSED_AFTER_PERIODS: f64 = 1.5;

/// Configuration of one protected message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GuardConfig {
    pub bus: BusIndex,
    pub id: CanId,
    pub check: CheckConfig,
    /// Above 0. `None` = unknown, so missing frames are not counted.
    pub cycle_time_s: Option<f64>,
}

/// Reports that a message started to fail its check, or became usable again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GuardChange {
    pub bus: BusIndex,
    pub id: CanId,
    pub status: Status,
    pub usable: bool,
    /// Failed checks since the message was last usable.
    pub count: u64,
}

/// Counts of one message, for reports and snapshots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GuardCounts {
    pub bus: BusIndex,
    pub id: CanId,
    pub counts: StatusCounts,
}

/// Progress of one message's check. A monitor that continues without a gap in time resumes from it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GuardProgress {
    bus: BusIndex,
    id: CanId,
    receiver: Receiver,
    missed_at: Option<Timestamp>,
    missed: u64,
    failed: u64,
}

#[derive(Debug, Clone)]
struct Guard {
    config: GuardConfig,
    receiver: Receiver,
    /// When the next frame counts as missed.
    missed_at: Option<Timestamp>,
    /// Consecutive periods without a frame.
    missed: u64,
    /// Failed checks since the last usable frame; 0 = no failure was reported.
    failed: u64,
}

/// Checks all protected input messages.
#[derive(Debug, Clone, Default)]
pub struct Guards {
    /// Sorted by interface and identifier.
    guards: Vec<Guard>,
    pub(crate) changes: Vec<GuardChange>,
}

impl Guards {
    /// Creates guards. If several entries name the same message, the first is used.
    pub fn new(mut configs: Vec<GuardConfig>) -> Self {
        configs.sort_by_key(|config| (config.bus, config.id));
        configs.dedup_by_key(|config| (config.bus, config.id));
        let guard = |config| Guard { config, receiver: Receiver::default(), missed_at: None, missed: 0, failed: 0 };
        // The capacity suffices, because a check adds at most two changes and a poll adds at most one change per
        // message.
        Self { changes: Vec::with_capacity(configs.len() + 1), guards: configs.into_iter().map(guard).collect() }
    }

    /// Inherits the counts of messages that are also in `old`. If the configuration of a message is unchanged, also
    /// inherits the state of its check (the receiver), because a new receiver would not use its first frame.
    #[must_use]
    pub fn inheriting(mut self, old: &Self) -> Self {
        for guard in &mut self.guards {
            let same = |old: &&Guard| (old.config.bus, old.config.id) == (guard.config.bus, guard.config.id);
            match old.guards.iter().find(same) {
                Some(old) if old.config == guard.config => guard.clone_from(old),
                Some(old) => guard.receiver = Receiver::with_counts(*old.receiver.counts()),
                None => {}
            }
        }
        self
    }

    /// Checks a frame; `None` = the message is not protected, or the frame is a remote request.
    #[inline]
    pub fn check(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame) -> Option<Status> {
        if self.guards.is_empty() || frame.kind() == FrameKind::Remote {
            return None;
        }
        self.check_protected(now, bus, frame)
    }

    fn check_protected(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame) -> Option<Status> {
        let key = (bus, frame.id());
        let found = self.guards.binary_search_by_key(&key, |guard| (guard.config.bus, guard.config.id)).ok()?;
        let guard = &mut self.guards[found];
        guard.count_missed(now, &mut self.changes);
        guard.missed = 0;
        let status = guard.receiver.check(&guard.config.check, frame.data());
        guard.missed_at = guard.config.cycle_time_s.map(|period_s| now.plus_secs(MISSED_AFTER_PERIODS * period_s));
        guard.note(status, 1, &mut self.changes);
        Some(status)
    }

    /// Counter that the next frame must have; `None` = any counter.
    pub fn next_counter(&self, bus: BusIndex, id: CanId) -> Option<u8> {
        let found = self.guards.binary_search_by_key(&(bus, id), |guard| (guard.config.bus, guard.config.id)).ok()?;
        let guard = &self.guards[found];
        guard.receiver.next_counter(guard.config.check.protection.profile)
    }

    /// Counts frames that are missing at `now`.
    pub fn poll(&mut self, now: Timestamp) {
        self.guards.iter_mut().for_each(|guard| guard.count_missed(now, &mut self.changes));
    }

    /// Makes every receiver wait for a first frame again. Keeps the counts.
    pub fn restart(&mut self) {
        for guard in &mut self.guards {
            guard.receiver.restart();
            (guard.missed_at, guard.missed) = (None, 0);
        }
    }

    /// Counts per message, by interface and identifier.
    pub fn counts(&self) -> impl Iterator<Item = GuardCounts> + '_ {
        self.guards.iter().map(|guard| GuardCounts {
            bus: guard.config.bus,
            id: guard.config.id,
            counts: *guard.receiver.counts(),
        })
    }

    /// The progress of each check.
    pub fn progress(&self) -> Vec<GuardProgress> {
        let of = |guard: &Guard| GuardProgress {
            bus: guard.config.bus,
            id: guard.config.id,
            receiver: guard.receiver.clone(),
            missed_at: guard.missed_at,
            missed: guard.missed,
            failed: guard.failed,
        };
        self.guards.iter().map(of).collect()
    }

    /// Resumes stored progress. The caller restores the counts first.
    pub fn resume(&mut self, stored: &[GuardProgress]) {
        for guard in &mut self.guards {
            let key = (guard.config.bus, guard.config.id);
            if let Some(of) = stored.iter().find(|of| (of.bus, of.id) == key) {
                guard.receiver.resume(guard.config.check.protection.profile, &of.receiver);
                (guard.missed_at, guard.missed, guard.failed) = (of.missed_at, of.missed, of.failed);
            }
        }
    }

    /// Restores stored counts and restarts the receivers.
    pub fn restore(&mut self, state: &[GuardCounts]) {
        self.restart();
        for guard in &mut self.guards {
            let key = (guard.config.bus, guard.config.id);
            if let Some(stored) = state.iter().find(|stored| (stored.bus, stored.id) == key) {
                guard.receiver = Receiver::with_counts(stored.counts);
            }
        }
    }
}

impl Guard {
    fn count_missed(&mut self, now: Timestamp, changes: &mut Vec<GuardChange>) {
        let Some(period_s) = self.config.cycle_time_s else { return };
        // The first period begins when the program starts to listen.
        let missed_at = *self.missed_at.get_or_insert(now.plus_secs(MISSED_AFTER_PERIODS * period_s));
        if now < missed_at {
            return;
        }
        // Avoids a division by 0.
        let period_ns = Timestamp::ZERO.plus_secs(period_s).nanos().max(1);
        let periods = now.nanos().saturating_sub(missed_at.nanos()) / period_ns + 1;
        self.missed_at = Some(missed_at.plus_nanos(periods.saturating_mul(period_ns)));
        let periods = u64::try_from(periods).unwrap_or(0);
        self.missed = self.missed.saturating_add(periods);
        let status = self.receiver.no_new_data(&self.config.check, periods);
        self.note(status, periods, changes);
    }

    /// Adds a change if the message becomes usable or starts to fail.
    fn note(&mut self, status: Status, checks: u64, changes: &mut Vec<GuardChange>) {
        let GuardConfig { bus, id, check, .. } = self.config;
        if status.is_usable() {
            let count = std::mem::take(&mut self.failed);
            if count > 0 {
                changes.push(GuardChange { bus, id, status, usable: true, count });
            }
            return;
        }
        if self.failed > 0 {
            self.failed = self.failed.saturating_add(checks);
            return;
        }
        self.failed = match status {
            // A first frame is neither a success nor a failure.
            Status::Initial => 0,
            Status::NoNewData if self.missed <= u64::from(check.max_delta_counter_init) => 0,
            Status::NoNewData => self.missed,
            _ => checks,
        };
        if self.failed > 0 {
            changes.push(GuardChange { bus, id, status, usable: false, count: self.failed });
        }
    }
}

#[cfg(test)]
mod tests;
