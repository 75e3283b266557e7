//! Checks the end-to-end protection of input messages.
//!
//! In: frames with their time and interface, in order of arrival; between frames, the time ([`Guards::poll`]). Out: the
//! [`Status`] of each frame and counts per message. A [`GuardChange`] reports that a message starts to fail its check
//! or becomes usable again.
//!
//! If a message's cycle time is known, each period without a frame counts as one [`Status::NoNewData`]. The first
//! missing frame is counted one and a half periods after the last frame; the half period allows for jitter. Each
//! further period counts one more. As long as the check allows as many lost frames as are missing, no change is
//! reported, because the next frame will be usable. Otherwise, a sender with jitter would fill the log.
//!
//! A time without listening is not the sender's fault. After sleep, a restart of the program or a clock step, the
//! receivers wait for a first frame again ([`Guards::restart`]). For the same reason, a restarted program restores the
//! counts but not the frame counters. The sender has continued to send, so a stored frame counter would reject good
//! frames, or accept an old frame that fits by chance. Only a state that resumes without a gap restores the counts and
//! the frame counters ([`Guards::resume`]).

use serde::{Deserialize, Serialize};

use crate::can::e2e::{CheckConfig, Receiver, Status, StatusCounts};
use crate::can::{CanId, Frame, FrameKind};
use crate::quantity::{BusIndex, Timestamp};

/// If no frame arrives within this number of periods after the last frame, a frame counts as missed. Each further
/// period counts one more frame.
const MISSED_AFTER_PERIODS: f64 = 1.5;

/// Configuration of one protected message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GuardConfig {
    pub bus: BusIndex,
    pub id: CanId,
    /// Settings of the check.
    pub check: CheckConfig,
    /// Period (s), above 0; `None` = unknown, so missing frames are not counted.
    pub cycle_time_s: Option<f64>,
}

/// Reports that a message started to fail its check, or became usable again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GuardChange {
    pub bus: BusIndex,
    pub id: CanId,
    /// The status that caused the change.
    pub status: Status,
    /// Whether the message is usable now.
    pub usable: bool,
    /// Number of failed checks since the message was last usable. When the message becomes usable again, this number is
    /// the total.
    pub count: u64,
}

/// Counts of one message, for reports and snapshots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GuardCounts {
    pub bus: BusIndex,
    pub id: CanId,
    /// Number of checks by status.
    pub counts: StatusCounts,
}

/// Progress of one message's check, for a snapshot from which the monitor resumes without a gap.
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
    /// When the next frame counts as missed; `None` = the cycle time is unknown, or listening has not started.
    missed_at: Option<Timestamp>,
    /// Consecutive periods without a frame.
    missed: u64,
    /// Number of failed checks since the last usable frame; 0 = no failure has been reported since then.
    failed: u64,
}

/// Checks all protected input messages.
#[derive(Debug, Clone, Default)]
pub struct Guards {
    /// Sorted by interface and identifier.
    guards: Vec<Guard>,
    /// Changes to be published, in order.
    pub(crate) changes: Vec<GuardChange>,
}

impl Guards {
    /// Creates guards for messages. If several entries are for the same message, the first entry is used.
    pub fn new(mut configs: Vec<GuardConfig>) -> Self {
        configs.sort_by_key(|config| (config.bus, config.id));
        configs.dedup_by_key(|config| (config.bus, config.id));
        let guard = |config| Guard { config, receiver: Receiver::default(), missed_at: None, missed: 0, failed: 0 };
        // A check adds at most two changes (frames were missing, the message is usable again), and a poll adds at most
        // one change per message. Therefore nothing is allocated later.
        Self { changes: Vec::with_capacity(configs.len() + 1), guards: configs.into_iter().map(guard).collect() }
    }

    /// Inherits the counts from `old` for the messages that are in both `self` and `old`. If the configuration of a
    /// message has not changed, also inherits the message's receiver. With a new receiver, the next frame would be a
    /// first frame, which is not used.
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

    /// Checks a frame; `None` = the message is not protected, or the frame is a remote request, which carries no data.
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

    /// Counter that the next frame of a protected message must have; `None` = the message is not protected, or any
    /// counter is valid.
    pub fn next_counter(&self, bus: BusIndex, id: CanId) -> Option<u8> {
        let found = self.guards.binary_search_by_key(&(bus, id), |guard| (guard.config.bus, guard.config.id)).ok()?;
        let guard = &self.guards[found];
        guard.receiver.next_counter(guard.config.check.protection.profile)
    }

    /// Counts frames that are missing at `now`.
    pub fn poll(&mut self, now: Timestamp) {
        self.guards.iter_mut().for_each(|guard| guard.count_missed(now, &mut self.changes));
    }

    /// Lets every receiver wait for a first frame again. Keeps the counts. Called after a time without listening or a
    /// clock step.
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

    /// Resumes the stored progress of each check. The caller restores the counts first.
    pub fn resume(&mut self, stored: &[GuardProgress]) {
        for guard in &mut self.guards {
            let key = (guard.config.bus, guard.config.id);
            if let Some(of) = stored.iter().find(|of| (of.bus, of.id) == key) {
                guard.receiver.resume(guard.config.check.protection.profile, &of.receiver);
                (guard.missed_at, guard.missed, guard.failed) = (of.missed_at, of.missed, of.failed);
            }
        }
    }

    /// Restores stored counts and restarts the receivers. Ignores counts of messages that are no longer protected.
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
    /// Counts one [`Status::NoNewData`] for each period without a frame.
    fn count_missed(&mut self, now: Timestamp, changes: &mut Vec<GuardChange>) {
        let Some(period_s) = self.config.cycle_time_s else { return };
        // At the start of listening, the first period begins now.
        let missed_at = *self.missed_at.get_or_insert(now.plus_secs(MISSED_AFTER_PERIODS * period_s));
        if now < missed_at {
            return;
        }
        // At least one nanosecond, to avoid a division by 0.
        let period_ns = Timestamp::ZERO.plus_secs(period_s).nanos().max(1);
        let periods = now.nanos().saturating_sub(missed_at.nanos()) / period_ns + 1;
        self.missed_at = Some(missed_at.plus_nanos(periods.saturating_mul(period_ns)));
        let periods = u64::try_from(periods).unwrap_or(0);
        self.missed = self.missed.saturating_add(periods);
        let status = self.receiver.no_new_data(&self.config.check, periods);
        self.note(status, periods, changes);
    }

    /// Records the status of one or more checks; adds a change if the message turns usable or failing.
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
            // A first frame is neither good nor bad.
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
