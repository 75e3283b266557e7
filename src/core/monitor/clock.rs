//! The monitor's clock, which follows the times of the inputs. The clock detects that the computer was asleep, or that
//! the driver's clock was set back.
//!
//! In: the time of each input. Out: the time that the stages use, and a [`TimeJump`] if an input does not closely
//! follow the previous input. An input may be older than the clock's time by up to [`MERGE_TOLERANCE_NS`]. Such an
//! input is counted and treated as if it had the clock's time.

use super::message::MERGE_TOLERANCE_NS;
use crate::quantity::Timestamp;

/// Longest time between inputs, including ticks, while the computer is awake (s): 500 tick periods.
pub(crate) const ASLEEP_S: f64 = 5.0;
const ASLEEP_NS: i64 = (ASLEEP_S * 1e9) as i64;

/// Period of the checks that depend only on time (staleness, debounce) (s).
pub(crate) const HOUSEKEEPING_S: f64 = 0.1;

#[derive(Debug, Default)]
pub(crate) struct Clock {
    pub(crate) has_started: bool,
    /// Time of the latest input that had an effect.
    pub(crate) now: Timestamp,
    /// Number of inputs whose time was before the clock's time.
    pub(crate) time_backwards: u64,
    /// Time at which a tick next has an effect; `None` before the first input.
    pub(crate) due: Option<Timestamp>,
}

/// A jump of time: an input does not closely follow the previous input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum TimeJump {
    /// The driver's clock was set back, so the elapsed time is unknown.
    Backwards {
        /// Size of the step back (s).
        seconds: f64,
    },
    /// No input arrived for a while: the computer was asleep, or the log has a gap.
    Asleep {
        /// Time without an input (s).
        seconds: f64,
    },
}

impl Clock {
    /// Whether a tick at `time` is too early to have an effect.
    #[inline]
    pub(crate) fn is_before_due(&self, time: Timestamp) -> bool {
        self.due.is_some_and(|due| time < due)
    }

    /// Advances to the time of an input. If time jumps, returns the jump and leaves the clock unchanged. The caller
    /// then ends everything in progress and sets the new time.
    #[inline]
    pub(crate) fn advance(&mut self, time: Timestamp) -> Option<TimeJump> {
        if (0..=ASLEEP_NS).contains(&time.nanos().saturating_sub(self.now.nanos())) {
            self.now = time;
            return None;
        }
        self.jump(time)
    }

    #[cold]
    fn jump(&mut self, time: Timestamp) -> Option<TimeJump> {
        let elapsed_s = time.since(self.now);
        if elapsed_s < 0.0 {
            self.time_backwards = self.time_backwards.saturating_add(1);
            let is_set_back = time < self.now.plus_nanos(-MERGE_TOLERANCE_NS);
            return is_set_back.then_some(TimeJump::Backwards { seconds: -elapsed_s });
        }
        if elapsed_s > ASLEEP_S {
            return Some(TimeJump::Asleep { seconds: elapsed_s });
        }
        self.now = time;
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_moves_forward_and_jumps_are_reported() {
        let at = Timestamp::from_secs;
        let mut clock = Clock { now: at(100.0), ..Clock::default() };
        assert_eq!((clock.advance(at(105.0)), clock.now), (None, at(105.0)));
        // An input that was merged out of order is counted, and the clock's time stays.
        assert_eq!((clock.advance(at(104.5)), clock.now), (None, at(105.0)));
        assert_eq!((clock.advance(at(100.0)), clock.now), (Some(TimeJump::Backwards { seconds: 5.0 }), at(105.0)));
        assert_eq!((clock.advance(at(111.0)), clock.now), (Some(TimeJump::Asleep { seconds: 6.0 }), at(105.0)));
        assert_eq!(clock.time_backwards, 2);
    }
}
