//! Holds frames until the results that they announce are on disk.
//!
//! During a commit, every announcing frame ([`Transmit::announces`]) waits. These are the frames that announce the
//! result, the cyclic frames that would repeat it, and all other frames of the same kinds. If the first packet of a
//! J1939 transfer (a message in several packets) waits, its later packets wait too. The frames are sent in order. The
//! status frame is not held, because its state of charge and validity must be up to date. Of the alarms, it states only
//! the number of raised alarms.
//!
//! No frame waits longer than [`MAX_WAIT`], because an alarm on the bus is more important than an alarm on disk.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

use crate::monitor::Transmit;

/// Maximum wait of a frame for the disk.
const MAX_WAIT: Duration = Duration::from_millis(200);
/// Maximum number of held frames. If more frames are held, all of them are released. The largest pack, with an alarm
/// for each cell, sends this many frames in twice [`MAX_WAIT`].
const MAX_HELD: usize = 4096;

/// Holds announcing frames while commits are running.
#[derive(Debug, Default)]
pub struct CommitBarrier {
    held: VecDeque<(u64, Transmit)>,
    /// Tickets (numbers of commits) that are not on disk yet, with their deadlines.
    tickets: VecDeque<(u64, Instant)>,
}

impl CommitBarrier {
    /// Opens a ticket. Announcing frames wait until the ticket is closed.
    pub fn begin(&mut self, ticket: u64, now: Instant) {
        self.tickets.push_back((ticket, now + MAX_WAIT));
    }

    /// Holds an announcing frame while a ticket is open. Returns `false` if the frame may be sent.
    pub fn hold(&mut self, transmit: &Transmit) -> bool {
        let last = self.tickets.back().filter(|_| transmit.announces);
        self.held.extend(last.map(|(ticket, _)| (*ticket, *transmit)));
        last.is_some()
    }

    /// Closes all tickets up to `ticket` and sends their frames.
    pub fn release(&mut self, ticket: u64, mut send: impl FnMut(&Transmit)) {
        while self.tickets.front().is_some_and(|(waiting, _)| *waiting <= ticket) {
            self.tickets.pop_front();
        }
        self.held.retain(|(waiting, transmit)| {
            let is_released = *waiting <= ticket;
            if is_released {
                send(transmit);
            }
            !is_released
        });
    }

    /// The last ticket that is overdue, because it has waited too long or too many frames are held.
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
        Transmit { time: Timestamp::ZERO, bus: BusIndex(0), frame, announces: true, secured: None }
    }

    fn sent(barrier: &mut CommitBarrier, ticket: u64) -> Vec<u8> {
        let mut sent = Vec::new();
        barrier.release(ticket, |transmit| sent.push(transmit.frame.data()[0]));
        sent
    }

    #[test]
    fn announcing_frames_wait_in_order() {
        let now = Instant::now();
        let mut barrier = CommitBarrier::default();
        let (control, data, health) = (0x10, 0x11, 0x12);
        assert!(!barrier.hold(&frame(health, 0)), "nothing to wait for");
        barrier.begin(1, now);
        // The frames are the first packet of a transfer, its later packets, and a cyclic frame between them.
        for (id, data) in [(control, 1), (data, 2), (health, 3), (data, 4)] {
            assert!(barrier.hold(&frame(id, data)));
        }
        assert!(!barrier.hold(&Transmit { announces: false, ..frame(0x13, 9) }), "a status frame is sent");
        barrier.begin(2, now);
        assert!(barrier.hold(&frame(data, 5)));
        assert_eq!(sent(&mut barrier, 1), [1, 2, 3, 4]);
        assert!(barrier.hold(&frame(health, 6)));
        assert_eq!(sent(&mut barrier, 2), [5, 6]);
        assert!(!barrier.hold(&frame(health, 7)), "all results are on disk");
    }

    #[test]
    fn wait_is_limited() {
        let now = Instant::now();
        let mut barrier = CommitBarrier::default();
        barrier.begin(1, now);
        barrier.begin(2, now + MAX_WAIT / 2);
        assert_eq!(barrier.overdue(now + MAX_WAIT / 2), None);
        assert_eq!(barrier.overdue(now + MAX_WAIT), Some(1));
        assert_eq!(barrier.overdue(now + 2 * MAX_WAIT), Some(2));
        barrier.release(2, |_| {});
        assert_eq!(barrier.overdue(now + 2 * MAX_WAIT), None);
    }
}
