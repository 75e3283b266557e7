//! Generates ticks for logs that contain none. A tick is a time at which the core runs although no record arrives.
//!
//! In the daemon, the driver ticks every [`TICK_PERIOD_MS`](crate::monitor::TICK_PERIOD_MS) while the computer is
//! awake. A plain log only states when frames arrived. This module generates the same ticks for a plain log, at
//! multiples of the period. A tick at time T comes after every record of time T and before the first later record.
//!
//! After each record, the recorder counts as awake for a fixed time, the sleep gap, even if the next record arrives
//! later. The ticks in this time let the core detect a lost input, as the daemon does on a silent bus. When the sleep
//! gap has passed, the recorder counts as asleep, and the ticks stop. The first record of the log and the first record
//! after sleep wake the recorder. When the recorder wakes, there is one tick with the time of that record. The ticks
//! end with the log's last record.
//!
//! The caller passes the time of the core's next necessary tick ([`Ticks::pop`]'s `due`). Earlier ticks are skipped
//! because they would change nothing.

use crate::monitor::MERGE_TOLERANCE_NS;
use crate::quantity::Timestamp;

/// Generates ticks between records.
#[derive(Debug, Clone)]
pub struct Ticks {
    period_ns: i64,
    sleep_gap_ns: i64,
    next_ns: i64,
    /// Ticks before this time may be popped.
    limit_ns: i64,
    /// Time of the latest record; `None` before the first record and after [`Ticks::sleep`].
    latest_ns: Option<i64>,
    /// Time of the tick with which the recorder wakes. The ticks that precede the gap are popped before this tick.
    wake_ns: Option<i64>,
}

impl Ticks {
    /// Generates ticks every `period_ms` (at least 1). If no other record arrives within `sleep_gap_s` after a record,
    /// the ticks stop.
    pub fn new(period_ms: u32, sleep_gap_s: f64) -> Self {
        Self {
            period_ns: i64::from(period_ms.max(1)) * 1_000_000,
            sleep_gap_ns: (sleep_gap_s * 1e9) as i64,
            next_ns: i64::MAX,
            limit_ns: i64::MIN,
            latest_ns: None,
            wake_ns: None,
        }
    }

    /// Announces a record at `time`. The caller then calls [`pop`](Self::pop) until `None`, and processes the record.
    /// Returns whether this record wakes the recorder: the record is the first one or follows a sleep gap, or the
    /// recorder's clock was set back. A record slightly older than the latest record (interfaces merged out of order)
    /// causes no tick.
    #[inline]
    pub fn advance(&mut self, time: Timestamp) -> bool {
        let time_ns = time.nanos();
        let Some(latest_ns) = self.latest_ns else {
            self.limit_ns = time_ns.min(self.limit_ns);
            self.latest_ns = Some(time_ns);
            self.wake_ns = Some(time_ns);
            return true;
        };
        if time_ns < latest_ns.saturating_sub(MERGE_TOLERANCE_NS) {
            // The recorder's clock was set back, so the ticks continue from the new time.
            (self.limit_ns, self.latest_ns, self.wake_ns) = (i64::MIN, Some(time_ns), Some(time_ns));
            return true;
        }
        let asleep = time_ns.saturating_sub(latest_ns) > self.sleep_gap_ns;
        if asleep {
            self.limit_ns = latest_ns.saturating_add(self.sleep_gap_ns).saturating_add(1);
            self.wake_ns = Some(time_ns);
        } else {
            self.limit_ns = self.limit_ns.max(time_ns);
        }
        self.latest_ns = Some(latest_ns.max(time_ns));
        asleep
    }

    /// Ends the log, or starts an unknown gap. The remaining ticks up to the latest record may be popped. The next
    /// record wakes the recorder, regardless of its stamp.
    pub fn sleep(&mut self) {
        if let Some(latest_ns) = self.latest_ns.take() {
            self.limit_ns = latest_ns.saturating_add(1);
        }
    }

    /// Whether the caller must call [`pop`](Self::pop), regardless of what the core needs. Returns `false` after most
    /// records.
    #[inline]
    pub fn is_pending(&self) -> bool {
        self.next_ns < self.limit_ns || self.wake_ns.is_some()
    }

    /// Returns the next tick at or after `due`, the time at which the core needs a tick. `due` is `None` if the core
    /// needs no tick.
    pub fn pop(&mut self, due: Option<Timestamp>) -> Option<Timestamp> {
        if self.next_ns < self.limit_ns {
            let due_ns = due.map_or(self.limit_ns, |d| d.nanos().min(self.limit_ns));
            if due_ns > self.next_ns {
                self.next_ns = self.at_or_after(due_ns);
            }
        }
        if self.next_ns < self.limit_ns {
            let tick = self.next_ns;
            self.next_ns = self.at_or_after(tick.saturating_add(1));
            return Some(Timestamp::from_nanos(tick));
        }
        if let Some(wake_ns) = self.wake_ns.take() {
            self.next_ns = wake_ns;
            self.limit_ns = wake_ns;
        }
        None
    }

    fn at_or_after(&self, time_ns: i64) -> i64 {
        let into = time_ns.rem_euclid(self.period_ns);
        if into == 0 { time_ns } else { time_ns.saturating_add(self.period_ns - into) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EVERY: Option<Timestamp> = Some(Timestamp::from_nanos(i64::MIN));

    /// Returns the times of the ticks, ms, for records at `records` ms, up to the end of the log.
    fn ticks_ms(records: &[i64], due: Option<Timestamp>) -> Vec<i64> {
        let mut ticks = Ticks::new(10, 0.05);
        let mut made = Vec::new();
        let mut drain = |ticks: &mut Ticks| {
            while ticks.is_pending() {
                made.extend(ticks.pop(due).map(|tick| tick.nanos() / 1_000_000));
            }
        };
        for &record in records {
            ticks.advance(Timestamp::from_nanos(record * 1_000_000));
            drain(&mut ticks);
        }
        ticks.sleep();
        drain(&mut ticks);
        made
    }

    #[test]
    fn ticks_are_aligned_and_end_with_last_record() {
        assert_eq!(ticks_ms(&[3, 45], EVERY), [3, 10, 20, 30, 40]);
        assert_eq!(ticks_ms(&[0, 20], EVERY), [0, 10, 20]);
    }

    #[test]
    fn records_precede_tick_of_same_time() {
        assert_eq!(ticks_ms(&[10, 10, 10], EVERY), [10]);
    }

    #[test]
    fn ticks_stop_after_sleep_gap_and_resume_after_hole() {
        let ticks = ticks_ms(&[0, 15, 40_000_003, 40_000_020], EVERY);
        assert_eq!(ticks, [0, 10, 20, 30, 40, 50, 60, 40_000_003, 40_000_010, 40_000_020]);
    }

    #[test]
    fn hole_equal_to_sleep_gap_is_not_sleep() {
        assert_eq!(ticks_ms(&[5, 55], EVERY), [5, 10, 20, 30, 40, 50]);
        assert_eq!(ticks_ms(&[5, 66], EVERY), [5, 10, 20, 30, 40, 50, 66]);
    }

    #[test]
    fn earlier_record_causes_no_tick() {
        assert_eq!(ticks_ms(&[20, 5, 20, 25], EVERY), [20]);
    }

    #[test]
    fn clock_set_back_restarts_tick_grid() {
        assert_eq!(ticks_ms(&[9_000_000, 9_000_015, 5_003, 5_025], EVERY), [9_000_000, 9_000_010, 5_003, 5_010, 5_020]);
    }

    #[test]
    fn ticks_resume_with_record_after_unknown_gap() {
        let mut ticks = Ticks::new(10, 30.0);
        ticks.advance(Timestamp::from_nanos(100_000_000));
        while ticks.pop(EVERY).is_some() {}
        ticks.sleep();
        assert_eq!(ticks.pop(EVERY), Some(Timestamp::from_nanos(100_000_000)));
        assert_eq!(ticks.pop(EVERY), None);
        assert!(ticks.advance(Timestamp::from_nanos(7_000_000)));
        assert_eq!(ticks.pop(EVERY), None);
        ticks.advance(Timestamp::from_nanos(11_000_000));
        assert_eq!(ticks.pop(EVERY), Some(Timestamp::from_nanos(7_000_000)));
        assert_eq!(ticks.pop(EVERY), Some(Timestamp::from_nanos(10_000_000)));
        assert_eq!(ticks.pop(EVERY), None);
    }

    #[test]
    fn ticks_before_due_time_are_skipped() {
        assert_eq!(ticks_ms(&[0, 45], Some(Timestamp::from_nanos(21_000_000))), [30, 40]);
        assert_eq!(ticks_ms(&[0, 45], None), [0i64; 0]);
    }

    #[test]
    fn skipped_ticks_keep_tick_grid() {
        let mut ticks = Ticks::new(10, 30.0);
        ticks.advance(Timestamp::from_nanos(3_000_000));
        while ticks.pop(None).is_some() {}
        ticks.advance(Timestamp::from_nanos(25_000_000));
        assert_eq!(ticks.pop(None), None);
        ticks.advance(Timestamp::from_nanos(45_000_000));
        assert_eq!(ticks.pop(EVERY), Some(Timestamp::from_nanos(30_000_000)));
    }
}
