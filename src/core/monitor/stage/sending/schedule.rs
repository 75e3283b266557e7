//! Due times and counters of the cyclic frames, and how a restart or a sleep changes them.

use serde::{Deserialize, Serialize};

use super::alarm_queue::AlarmQueue;
use crate::can::encode::{FRESHNESS_PERIOD_MS, SendCounters};
use crate::monitor::config::OutputConfig;
use crate::quantity::Timestamp;

/// Number of freshness values (counters of authenticated frames) skipped at a start, because an earlier process may
/// have sent frames after its state was stored. The driver stores the state before the first frame, and again when half
/// of these values have been used. At [`FRESHNESS_PER_S`] values per second, the clock gains more values in a day than
/// 300 starts skip, so up to 300 starts a day do not raise the freshness above the clock's value.
pub const RESTART_FRESHNESS: u64 = 1 << 16;
/// At a start, the freshness is at least this value times the clock's time in seconds. The daemon sends fewer frames
/// than this per second, so the clock gives a higher value than earlier runs have used (see [`RESTART_FRESHNESS`]).
const FRESHNESS_PER_S: u64 = 256;

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Schedule {
    pub(super) housekeeping: Timestamp,
    pub(super) status: Timestamp,
    pub(super) health: Timestamp,
    pub(super) alarm: Timestamp,
    /// Counts the alarm periods. If several thresholds have alarms with unknown values, the count selects the threshold
    /// whose alarm is announced next.
    pub(super) alarm_turn: usize,
    pub(super) digest: Timestamp,
    /// Counts the digests (a digest contains the state of every rule, and one threshold). The count selects the
    /// threshold in the next digest.
    pub(super) threshold_turn: usize,
    /// Earliest time of the next reply.
    pub(super) reply: Timestamp,
    pub(crate) alarms: AlarmQueue,
    /// Counters of the frames' end-to-end protection.
    pub(super) counters: SendCounters,
    /// Time of the next frame that announces the freshness for commands.
    pub(super) freshness: Timestamp,
    /// Freshness of the last authenticated frame; all messages share one sequence.
    pub(crate) sent_freshness: u64,
    /// Whether cyclic frames are omitted, because the buses sleep.
    #[serde(default)]
    pub(super) is_quiet: bool,
    /// Cyclic frames are sent until this time, even if the buses sleep. A restarted program must first observe the
    /// silence itself.
    #[serde(default)]
    pub(super) quiet_from: Timestamp,
}

impl Schedule {
    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        for due in self.dues() {
            *due = due.plus_nanos(by_nanos);
        }
        self.reply = self.reply.plus_nanos(by_nanos);
        self.alarms.rebase(by_nanos);
    }

    fn dues(&mut self) -> [&mut Timestamp; 6] {
        let Self { housekeeping, status, health, alarm, digest, freshness, .. } = self;
        [housekeeping, status, health, alarm, digest, freshness]
    }

    /// Applies the periods of a new configuration. A shorter period takes effect immediately.
    pub(super) fn reconfigure(&mut self, now: Timestamp, before: &OutputConfig, after: &OutputConfig) {
        let periods_s =
            |of: &OutputConfig| [of.status_period_s, of.health_period_s, of.alarm_period_s, of.digest_period_s];
        let dues = [&mut self.status, &mut self.health, &mut self.alarm, &mut self.digest];
        for (due, (before_s, after_s)) in dues.into_iter().zip(periods_s(before).into_iter().zip(periods_s(after))) {
            if before_s != after_s {
                *due = (*due).min(now.plus_secs(after_s));
            }
        }
    }

    pub(super) fn restart(&mut self, now: Timestamp) {
        self.is_quiet = false;
        self.dues().into_iter().for_each(|due| *due = now);
        self.reply = self.reply.min(now);
        self.alarms.restart(now);
    }

    /// After a restart, ensures that cyclic frames are sent until `time`.
    pub(crate) fn set_quiet_from(&mut self, time: Timestamp) {
        self.quiet_from = time;
    }

    /// Moves `quiet_from` after the clock was set back by `seconds`.
    pub(crate) fn step_back(&mut self, seconds: f64) {
        self.quiet_from = self.quiet_from.plus_secs(-seconds);
    }

    /// Starts the freshness of authenticated frames above all values that an earlier process can have sent, because
    /// receivers accept each value only once. If the stored state was lost, the value follows from the clock.
    pub(crate) fn begin_freshness(&mut self, now: Timestamp) {
        let by_clock = u64::try_from(now.nanos() / 1_000_000_000).unwrap_or(0).saturating_mul(FRESHNESS_PER_S);
        self.sent_freshness = self.sent_freshness.saturating_add(RESTART_FRESHNESS).max(by_clock);
    }

    /// Whether the status, health and alarm frames and the digest are due.
    pub(super) fn take_frames_due(&mut self, now: Timestamp, config: &OutputConfig) -> [bool; 4] {
        let due = [
            take_due(&mut self.status, now, config.status_period_s),
            take_due(&mut self.health, now, config.health_period_s),
            take_due(&mut self.alarm, now, config.alarm_period_s),
            take_due(&mut self.digest, now, config.digest_period_s),
        ];
        due.map(|is_due| is_due && !self.is_quiet)
    }

    pub(super) fn take_freshness_due(&mut self, now: Timestamp) -> bool {
        take_due(&mut self.freshness, now, f64::from(FRESHNESS_PERIOD_MS) / 1000.0) && !self.is_quiet
    }
}

/// Whether work is due. If so, sets the next due time; missed periods are skipped.
pub(super) fn take_due(due: &mut Timestamp, now: Timestamp, period_s: f64) -> bool {
    if now < *due {
        return false;
    }
    let next = due.plus_secs(period_s);
    *due = if next > now { next } else { now.plus_secs(period_s) };
    true
}
