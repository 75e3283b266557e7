//! Finds frames with identifiers of our own that we did not send: another sender speaks in our name.
//!
//! In: frames that we sent, frames that came. Out: an [`OwnIdChange`] at the first such frame, and when none has come for
//! [`GONE_S`]. A socket does not receive what it sent; where an adapter or a recorded log returns our frames all the same, each
//! sent frame may come back once, unchanged, within [`ECHO_S`].

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::can::id_table::IdTable;
use crate::can::{CanId, Frame};
use crate::quantity::{BusIndex, Timestamp};

/// An echo comes back within this time, s.
const ECHO_S: f64 = 1.0;
/// Sent frames that may come back: a second of status, health and alarm frames on two interfaces.
const MAX_SENT: usize = 128;
/// Without another such frame for this long the other sender is gone, s.
const GONE_S: f64 = 10.0;

/// Another sender uses our identifiers, or does no more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct OwnIdChange {
    /// Interface.
    pub bus: BusIndex,
    /// Identifier of its latest frame.
    pub id: CanId,
    /// Whether it began.
    pub active: bool,
    /// Frames so far: 1 when it begins, all of them when it ends.
    pub frames: u64,
}

/// Another sender on one interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OwnIdUse {
    bus: BusIndex,
    id: CanId,
    since: Timestamp,
    latest: Timestamp,
    frames: u64,
}

/// A frame that we sent, with a check sum in the place of its payload: to keep it needs no memory of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct SentFrame {
    time: Timestamp,
    bus: BusIndex,
    id: CanId,
    sum: u64,
}

/// A sum of a payload and its length, like FNV-1a with words of eight bytes in place of bytes: it is made for every sent frame, and
/// a copy is to be recognised, not to be proven. Two of one length of up to eight bytes never have the same.
fn sum(data: &[u8]) -> u64 {
    let start = 0xCBF2_9CE4_8422_2325 ^ data.len() as u64;
    data.chunks(8).fold(start, |sum, chunk| {
        let mut word = [0; 8];
        word[..chunk.len()].copy_from_slice(chunk);
        (sum ^ u64::from_le_bytes(word)).wrapping_mul(0x100_0000_01B3)
    })
}

/// State for a snapshot.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OwnFramesState {
    uses: Vec<OwnIdUse>,
    sent: VecDeque<SentFrame>,
}

/// Our identifiers, and what came with them.
#[derive(Debug, Clone, Default)]
pub struct OwnFrames {
    numbers: IdTable,
    /// Number of our identifiers.
    count: usize,
    state: OwnFramesState,
    /// Changes that wait to be published, in their order.
    pub(crate) changes: Vec<OwnIdChange>,
}

impl OwnFrames {
    /// For these identifiers.
    pub fn new(own: impl IntoIterator<Item = (BusIndex, CanId)>) -> Self {
        let own: Vec<_> = own.into_iter().collect();
        let count = own.len();
        let mut own_frames = Self { numbers: IdTable::new(own), count, ..Self::default() };
        own_frames.state.sent.reserve_exact(MAX_SENT);
        own_frames
    }

    /// Whether an identifier is ours.
    #[inline]
    pub fn has(&self, bus: BusIndex, id: CanId) -> bool {
        self.numbers.number(bus, id) < self.count
    }

    /// Takes a frame that we send.
    pub fn note_sent(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        if self.has(bus, frame.id()) {
            if self.state.sent.len() >= MAX_SENT {
                self.state.sent.pop_front();
            }
            self.state.sent.push_back(SentFrame { time, bus, id: frame.id(), sum: sum(frame.data()) });
        }
    }

    /// Takes a frame that came.
    #[inline]
    pub fn handle(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame) {
        if self.has(bus, frame.id()) {
            self.handle_own(now, bus, frame);
        }
    }

    fn handle_own(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame) {
        let is_echo = |sent: &SentFrame| {
            (sent.bus, sent.id) == (bus, frame.id())
                && sent.sum == sum(frame.data())
                && now.since(sent.time).abs() <= ECHO_S
        };
        if let Some(echo) = self.state.sent.iter().position(is_echo) {
            self.state.sent.remove(echo);
            return;
        }
        let id = frame.id();
        if let Some(other) = self.state.uses.iter_mut().find(|other| other.bus == bus) {
            (other.id, other.latest, other.frames) = (id, now, other.frames.saturating_add(1));
        } else {
            self.state.uses.push(OwnIdUse { bus, id, since: now, latest: now, frames: 1 });
            self.changes.push(OwnIdChange { bus, id, active: true, frames: 1 });
        }
    }

    /// Finds senders that are gone.
    pub fn poll(&mut self, now: Timestamp) {
        let changes = &mut self.changes;
        self.state.uses.retain(|other| {
            let is_there = now.since(other.latest).abs() <= GONE_S;
            if !is_there {
                changes.push(OwnIdChange { bus: other.bus, id: other.id, active: false, frames: other.frames });
            }
            is_there
        });
    }

    /// For how long another sender has been there, s; 0 = there is none.
    pub fn longest_s(&self, now: Timestamp) -> f64 {
        // In this very moment it is there already: 0 would say that there is none.
        self.state.uses.iter().map(|other| now.since(other.since).max(1e-9)).fold(0.0, f64::max)
    }

    /// Interfaces with another sender, and its latest identifier.
    pub fn uses(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.state.uses.iter().map(|other| (other.bus, other.id))
    }

    /// After time without listening, or a step of the clock: every other sender is gone, and no echo comes.
    pub fn restart(&mut self) {
        self.poll(Timestamp::from_nanos(i64::MAX));
        self.state.uses.clear();
        self.state.sent.clear();
    }

    /// Returns the state.
    pub fn state(&self) -> &OwnFramesState {
        &self.state
    }

    /// Continues a state, with these identifiers.
    pub fn resume(&mut self, stored: &OwnFramesState) {
        self.state.clone_from(stored);
        self.state.sent.truncate(MAX_SENT);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BUS: BusIndex = BusIndex(0);
    const OWN: CanId = CanId::Standard(0x6B0);

    fn frame(id: CanId, byte: u8) -> Frame {
        Frame::classic(id, &[byte; 8]).expect("8 bytes")
    }

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_secs(seconds)
    }

    #[test]
    fn another_sender_is_reported_once_and_its_end_with_the_count() {
        let mut own = OwnFrames::new([(BUS, OWN)]);
        for k in 0..300_u32 {
            own.handle(at(f64::from(k) * 0.01), BUS, &frame(OWN, 7));
            own.handle(at(f64::from(k) * 0.01), BUS, &frame(CanId::Standard(0x123), 7));
            own.poll(at(f64::from(k) * 0.01));
        }
        assert!(own.longest_s(at(3.0)) >= 3.0);
        own.poll(at(20.0));
        let expected = [(true, 1), (false, 300)];
        assert_eq!(own.changes.iter().map(|it| (it.active, it.frames)).collect::<Vec<_>>(), expected);
        assert_eq!(own.longest_s(at(20.0)), 0.0);
    }

    #[test]
    fn an_echo_of_a_sent_frame_is_ours_and_a_second_copy_is_not() {
        let mut own = OwnFrames::new([(BUS, OWN)]);
        own.note_sent(at(1.0), BUS, &frame(OWN, 1));
        own.handle(at(1.001), BUS, &frame(OWN, 1));
        assert_eq!(own.changes, []);
        own.handle(at(1.002), BUS, &frame(OWN, 1));
        assert_eq!(own.changes.len(), 1);
        own.note_sent(at(20.0), BUS, &frame(OWN, 2));
        own.poll(at(20.0));
        own.changes.clear();
        own.handle(at(22.0), BUS, &frame(OWN, 2));
        assert_eq!(own.changes.len(), 1, "an echo does not take two seconds");
    }
}
