//! Decides when the next checkpoint of the state is due. Checkpoints are limited because each writes the whole state,
//! which wears flash memory.
//!
//! In: the size and time of every written state. States that are written with committed alarms count too, so they
//! postpone checkpoints. A pack of 96 cells (70 kB) gets a checkpoint every 7 minutes, a pack of 12 cells every minute.

use crate::quantity::Timestamp;

/// Bytes of states written per day. In total 20 MB may be written per day; history and file system take the rest.
const BYTES_PER_DAY: f64 = 15e6;
/// Bytes that may be written ahead of the daily rate, for alarms that change often after a quiet time.
const MAX_AHEAD_BYTES: f64 = 3e6;

/// The schedule of checkpoints.
#[derive(Debug)]
pub(super) struct CheckpointSchedule {
    /// Shortest period, s.
    period_s: f64,
    /// Time of the last state.
    last: Option<Timestamp>,
    /// Bytes written ahead of the daily rate at the time `last`.
    ahead_bytes: f64,
}

impl CheckpointSchedule {
    /// A schedule with this shortest period, s.
    pub(super) fn new(period_s: f64) -> Self {
        Self { period_s, last: None, ahead_bytes: 0.0 }
    }

    /// Whether a checkpoint is due, at least `period_s` after the last state. The first one is due a period after the start.
    pub(super) fn is_due(&mut self, now: Timestamp, period_s: f64) -> bool {
        now.since(*self.last.get_or_insert(now)) >= self.period_s.max(period_s) && self.ahead_at(now) <= 0.0
    }

    /// Whether frequently changing alarms may be committed at once.
    pub(super) fn has_room(&self, now: Timestamp) -> bool {
        self.ahead_at(now) < MAX_AHEAD_BYTES
    }

    /// Notes that a state of this size was written.
    pub(super) fn note_written(&mut self, now: Timestamp, bytes: u64) {
        self.ahead_bytes = self.ahead_at(now) + bytes as f64;
        self.last = Some(now);
    }

    fn ahead_at(&self, now: Timestamp) -> f64 {
        let elapsed_s = self.last.map_or(0.0, |last| now.since(last).max(0.0));
        (self.ahead_bytes - elapsed_s * BYTES_PER_DAY / 86_400.0).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Checkpoints and bytes of one day, if states of this size are also committed at this interval, s.
    fn day(bytes: u64, commit_every_s: Option<u32>) -> (u32, u64) {
        let (mut schedule, mut checkpoints, mut written) = (CheckpointSchedule::new(60.0), 0, 0);
        for second in 0..86_400_u32 {
            let now = Timestamp::from_secs(f64::from(second));
            let is_due = schedule.is_due(now, 0.0);
            checkpoints += u32::from(is_due);
            if is_due || commit_every_s.is_some_and(|every_s| second % every_s == 0 && schedule.has_room(now)) {
                schedule.note_written(now, bytes);
                written += bytes;
            }
        }
        (checkpoints, written)
    }

    #[test]
    fn large_state_is_written_less_often() {
        assert_eq!(day(9_000, None).0, 1439);
        let (checkpoints, written) = day(70_000, None);
        assert!((205..=215).contains(&checkpoints) && written <= 15_100_000, "{checkpoints}, {written} bytes");
    }

    #[test]
    fn commits_postpone_checkpoints() {
        let (checkpoints, written) = day(70_000, Some(3600));
        assert!((180..=190).contains(&checkpoints) && written <= 15_100_000, "{checkpoints}, {written} bytes");
        // Alarms flicker every second.
        let (checkpoints, written) = day(70_000, Some(1));
        assert!(checkpoints == 0 && written <= 18_100_000, "{checkpoints}, {written} bytes");
    }
}
