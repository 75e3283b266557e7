//! Decides when the next checkpoint is due. A checkpoint writes the whole state of the daemon (what it has learned), so
//! it wears the flash memory.
//!
//! In: the size and the time of each write to the store. Alarm changes and learned results are written at once, between
//! the checkpoints. The more bytes they write, the later the next checkpoint is due. A pack of 96 cells (state of
//! 70 kB) gets a checkpoint every 7 minutes, a pack of 12 cells every minute.

use crate::quantity::Timestamp;

/// Bytes per day above which checkpoints are delayed. Together with bursts of alarms, at most 20 MB may be written per
/// day.
const BYTES_PER_DAY: f64 = 15e6;
/// Bytes that a commit without a state writes. SQLite writes three of its pages (1 kB each), first to its log and later
/// to its database file. Each of these two writes is rounded up to a page of the operating system (4 kB).
const COMMIT_BYTES: f64 = 8e3;
/// Bytes that each row adds to a commit: the sum of the bytes in SQLite's log and in its database file.
const ROW_BYTES: f64 = 180.0;
/// Maximum time without a checkpoint (s), regardless of what else was written.
const MAX_PERIOD_S: f64 = 3600.0;

#[derive(Debug)]
pub(super) struct CheckpointSchedule {
    /// Minimum time between two checkpoints (s).
    period_s: f64,
    /// Time when the state was last written.
    last: Option<Timestamp>,
    /// Bytes written in excess of the rate [`BYTES_PER_DAY`], and the time at which this excess was computed.
    ahead: (f64, Timestamp),
}

impl CheckpointSchedule {
    pub(super) fn new(period_s: f64) -> Self {
        Self { period_s, last: None, ahead: (0.0, Timestamp::ZERO) }
    }

    /// Whether a checkpoint is due. It is not due before both `period_s` and the schedule's own minimum period have
    /// passed since the last checkpoint (for the first checkpoint: since the first call). If too many bytes were
    /// written, it is delayed further, until [`MAX_PERIOD_S`] has passed.
    pub(super) fn is_due(&mut self, now: Timestamp, period_s: f64) -> bool {
        let elapsed_s = now.since(*self.last.get_or_insert(now));
        let may_write = self.ahead_at(now) <= 0.0 || elapsed_s >= MAX_PERIOD_S;
        elapsed_s >= self.period_s.max(period_s) && may_write
    }

    /// Records a commit of `rows` rows and a state of `state_bytes` bytes; `None` = a commit without a state.
    pub(super) fn note_written(&mut self, now: Timestamp, rows: usize, state_bytes: Option<u64>) {
        let bytes = state_bytes.map_or(COMMIT_BYTES, |bytes| bytes as f64) + ROW_BYTES * rows as f64;
        self.ahead = (self.ahead_at(now) + bytes, now);
        self.last = state_bytes.map_or(self.last, |_| Some(now));
    }

    fn ahead_at(&self, now: Timestamp) -> f64 {
        let (ahead_bytes, noted) = self.ahead;
        (ahead_bytes - now.since(noted).max(0.0) * BYTES_PER_DAY / 86_400.0).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Simulates a day and returns the number of checkpoints and the number of bytes written. Each state has `bytes`
    /// bytes. A row is committed in every second that `commits` selects.
    fn day(bytes: u64, commits: impl Fn(u32) -> bool) -> (u32, f64) {
        let (mut schedule, mut checkpoints, mut written) = (CheckpointSchedule::new(60.0), 0, 0.0);
        for second in 0..86_400_u32 {
            let now = Timestamp::from_secs(f64::from(second));
            if schedule.is_due(now, 0.0) {
                schedule.note_written(now, 0, Some(bytes));
                (checkpoints, written) = (checkpoints + 1, written + bytes as f64);
            }
            if commits(second) {
                schedule.note_written(now, 1, None);
                written += COMMIT_BYTES + ROW_BYTES;
            }
        }
        (checkpoints, written)
    }

    #[test]
    fn large_state_is_written_less_often() {
        assert_eq!(day(9_000, |_| false).0, 1439);
        let (checkpoints, written) = day(70_000, |_| false);
        assert!((205..=215).contains(&checkpoints) && written <= 15.1e6, "{checkpoints}, {written} bytes");
    }

    #[test]
    fn alarms_delay_checkpoints_by_at_most_an_hour() {
        // Ten alarms change per minute during the last hour.
        let (checkpoints, written) = day(70_000, |second| second >= 82_800 && second % 6 == 0);
        assert!((195..=206).contains(&checkpoints) && written <= 19.5e6, "{checkpoints}, {written} bytes");
        let (checkpoints, _) = day(70_000, |second| second % 6 == 0);
        assert_eq!(checkpoints, 23);
    }
}
