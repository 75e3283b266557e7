//! The time of the inputs: never back, with time asleep and a clock that was set back found out.
//!
//! In: the time of each input. Out: the time the stages work with, and a [`TimeJump`] where an input does not follow
//! closely on the one before. A step back within [`MERGE_TOLERANCE_NS`] is counted and treated as "now".

use super::message::MERGE_TOLERANCE_NS;
use crate::quantity::Timestamp;

/// Without any input, not even a tick, for this long, the computer was asleep, s: 500 ticks.
pub(crate) const ASLEEP_S: f64 = 5.0;
const ASLEEP_NS: i64 = (ASLEEP_S * 1e9) as i64;

/// Period of the work that only watches the clock (staleness, debounce), s.
pub(crate) const HOUSEKEEPING_S: f64 = 0.1;

/// The clock of one monitor.
#[derive(Debug, Default)]
pub(crate) struct Clock {
    /// Whether an input has come.
    pub(crate) has_started: bool,
    /// Time of the latest input that did something.
    pub(crate) now: Timestamp,
    /// Inputs with a time before that of an earlier one.
    pub(crate) time_backwards: u64,
    /// When a tick next does something; `None` = not started.
    pub(crate) due: Option<Timestamp>,
}

/// An input that does not follow closely on the one before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum TimeJump {
    /// The clock was set back by this much, s: how much time passed is unknown.
    Backwards {
        /// Size of the step, s.
        seconds: f64,
    },
    /// No input came for this long, s: the computer was asleep, or the log has a hole.
    Asleep {
        /// Length, s.
        seconds: f64,
    },
}

impl Clock {
    /// Whether a tick at `time` comes too early to do anything.
    #[inline]
    pub(crate) fn is_before_due(&self, time: Timestamp) -> bool {
        self.due.is_some_and(|due| time < due)
    }

    /// Moves to the time of an input. After a jump the time is still that before it: the caller ends what was under
    /// way, then [sets](Self::set) the new time.
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
        // Merged out of order: counted, and the time stays.
        assert_eq!((clock.advance(at(104.5)), clock.now), (None, at(105.0)));
        assert_eq!((clock.advance(at(100.0)), clock.now), (Some(TimeJump::Backwards { seconds: 5.0 }), at(105.0)));
        assert_eq!((clock.advance(at(111.0)), clock.now), (Some(TimeJump::Asleep { seconds: 6.0 }), at(105.0)));
        assert_eq!(clock.time_backwards, 2);
    }
}
