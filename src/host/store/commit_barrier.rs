//! Frames that wait until what they announce is on the disk.
//!
//! What announces ([`Transmit::announces`]) waits, all of it, for as long as anything learned is not yet on the disk: not
//! only the frames of the input that taught it, but also the cyclic ones that come meanwhile and would tell the same, and
//! the later packets of a transfer whose first one waits. They go in the order in which they came. The status frame is not
//! held: state of charge and validity must not grow old; it tells how many alarms are raised, and of none which.
//!
//! Nothing waits longer than [`MAX_WAIT`]: an alarm that is not on the disk is worth more than one that is not on the bus.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

use crate::monitor::Transmit;

/// Longest wait for the disk.
const MAX_WAIT: Duration = Duration::from_millis(200);
/// Frames in waiting: what a pack of the largest size sends in twice that time, with an alarm for each cell; beyond,
/// they go.
const MAX_HELD: usize = 4096;

/// See the module.
#[derive(Debug, Default)]
pub struct CommitBarrier {
    held: VecDeque<(u64, Transmit)>,
    /// Tickets not yet answered, and until when to wait.
    tickets: VecDeque<(u64, Instant)>,
}

impl CommitBarrier {
    /// Frames of this ticket will wait.
    pub fn begin(&mut self, ticket: u64, now: Instant) {
        self.tickets.push_back((ticket, now + MAX_WAIT));
    }

    /// Lets a frame wait, where it announces something and a ticket is open; `false` = it may go.
    pub fn take(&mut self, transmit: &Transmit) -> bool {
        let last = self.tickets.back().filter(|_| transmit.announces);
        self.held.extend(last.map(|(ticket, _)| (*ticket, *transmit)));
        last.is_some()
    }

    /// Everything up to `ticket` is answered: its frames go.
    pub fn release(&mut self, ticket: u64, mut send: impl FnMut(&Transmit)) {
        while self.tickets.front().is_some_and(|(waiting, _)| *waiting <= ticket) {
            self.tickets.pop_front();
        }
        self.held.retain(|(waiting, transmit)| {
            let goes = *waiting <= ticket;
            if goes {
                send(transmit);
            }
            !goes
        });
    }

    /// The last ticket that has waited too long, or has too many frames behind it.
    pub fn overdue(&self, now: Instant) -> Option<u64> {
        if self.held.len() > MAX_HELD {
            return self.tickets.back().map(|(ticket, _)| *ticket);
        }
        self.tickets.iter().take_while(|(_, until)| now >= *until).last().map(|(ticket, _)| *ticket)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::{CanId, Frame};
    use crate::quantity::{BusIndex, Timestamp};

    fn frame(id: u32, data: u8) -> Transmit {
        let frame = Frame::classic(CanId::standard(id).unwrap(), &[data]).unwrap();
        Transmit { time: Timestamp::ZERO, bus: BusIndex(0), frame, announces: true }
    }

    fn sent(hold: &mut CommitBarrier, ticket: u64) -> Vec<u8> {
        let mut sent = Vec::new();
        hold.release(ticket, |transmit| sent.push(transmit.frame.data()[0]));
        sent
    }

    #[test]
    fn while_a_ticket_is_open_all_that_announces_waits_and_keeps_its_order() {
        let now = Instant::now();
        let mut hold = CommitBarrier::default();
        let (control, data, health) = (0x10, 0x11, 0x12);
        assert!(!hold.take(&frame(health, 0)), "nothing to wait for");
        hold.begin(1, now);
        // A transfer's announcement, its packets by later ticks, a cyclic frame between.
        for (id, data) in [(control, 1), (data, 2), (health, 3), (data, 4)] {
            assert!(hold.take(&frame(id, data)));
        }
        assert!(!hold.take(&Transmit { announces: false, ..frame(0x13, 9) }), "a state goes");
        hold.begin(2, now);
        assert!(hold.take(&frame(data, 5)));
        assert_eq!(sent(&mut hold, 1), [1, 2, 3, 4]);
        assert!(hold.take(&frame(health, 6)));
        assert_eq!(sent(&mut hold, 2), [5, 6]);
        assert!(!hold.take(&frame(health, 7)), "all is on the disk");
    }

    #[test]
    fn nothing_waits_longer_than_the_limit() {
        let now = Instant::now();
        let mut hold = CommitBarrier::default();
        hold.begin(1, now);
        hold.begin(2, now + MAX_WAIT / 2);
        assert_eq!(hold.overdue(now + MAX_WAIT / 2), None);
        assert_eq!(hold.overdue(now + MAX_WAIT), Some(1));
        assert_eq!(hold.overdue(now + 2 * MAX_WAIT), Some(2));
        hold.release(2, |_| {});
        assert_eq!(hold.overdue(now + 2 * MAX_WAIT), None);
    }
}
