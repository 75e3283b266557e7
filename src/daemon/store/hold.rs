//! Frames that wait until what they announce is on the disk.
//!
//! Frames of one input wait together for one ticket; later frames of the same identifier on the same interface wait
//! behind them, so that nobody sees them in another order (their counters count). All others go at once. Nothing waits
//! longer than [`MAX_WAIT`]: an alarm that is not on the disk is worth more than one that is not on the bus.

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
pub(crate) struct Hold {
    held: VecDeque<(u64, Transmit)>,
    /// Tickets not yet answered, and until when to wait.
    tickets: VecDeque<(u64, Instant)>,
}

impl Hold {
    /// Frames of this ticket will wait.
    pub(crate) fn begin(&mut self, ticket: u64, now: Instant) {
        self.tickets.push_back((ticket, now + MAX_WAIT));
    }

    /// The ticket a frame must wait for because an earlier one of its identifier does.
    pub(crate) fn behind(&self, transmit: &Transmit) -> Option<u64> {
        let same = |held: &&(u64, Transmit)| held.1.bus == transmit.bus && held.1.frame.id() == transmit.frame.id();
        self.held.iter().rev().find(same).map(|(ticket, _)| *ticket)
    }

    /// Lets a frame wait.
    pub(crate) fn push(&mut self, ticket: u64, transmit: Transmit) {
        self.held.push_back((ticket, transmit));
    }

    /// Everything up to `ticket` is answered: its frames go.
    pub(crate) fn release(&mut self, ticket: u64, mut send: impl FnMut(&Transmit)) {
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
    pub(crate) fn overdue(&self, now: Instant) -> Option<u64> {
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

    fn frame(bus: u8, id: u32, data: u8) -> Transmit {
        let id = CanId::standard(id).unwrap();
        Transmit { time: Timestamp::ZERO, bus: BusIndex(bus), frame: Frame::classic(id, &[data]).unwrap() }
    }

    fn sent(hold: &mut Hold, ticket: u64) -> Vec<u8> {
        let mut sent = Vec::new();
        hold.release(ticket, |transmit| sent.push(transmit.frame.data()[0]));
        sent
    }

    #[test]
    fn frames_of_one_identifier_keep_their_order_and_others_pass() {
        let now = Instant::now();
        let mut hold = Hold::default();
        hold.begin(1, now);
        hold.push(1, frame(0, 0x10, 1));
        assert_eq!(hold.behind(&frame(0, 0x10, 2)), Some(1));
        assert_eq!(hold.behind(&frame(0, 0x11, 2)), None);
        assert_eq!(hold.behind(&frame(1, 0x10, 2)), None);
        hold.push(1, frame(0, 0x10, 2));
        hold.begin(2, now);
        hold.push(2, frame(0, 0x12, 3));
        hold.push(2, frame(0, 0x10, 4));
        assert_eq!(hold.behind(&frame(0, 0x10, 5)), Some(2));
        assert_eq!(sent(&mut hold, 1), [1, 2]);
        assert_eq!(sent(&mut hold, 2), [3, 4]);
    }

    #[test]
    fn nothing_waits_longer_than_the_limit() {
        let now = Instant::now();
        let mut hold = Hold::default();
        hold.begin(1, now);
        hold.begin(2, now + MAX_WAIT / 2);
        assert_eq!(hold.overdue(now + MAX_WAIT / 2), None);
        assert_eq!(hold.overdue(now + MAX_WAIT), Some(1));
        assert_eq!(hold.overdue(now + 2 * MAX_WAIT), Some(2));
        hold.release(2, |_| {});
        assert_eq!(hold.overdue(now + 2 * MAX_WAIT), None);
    }
}
