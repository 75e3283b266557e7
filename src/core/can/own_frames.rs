//! Detects other senders that use packwatch's own identifiers.
//!
//! In: sent frames, received frames. Out: an [`OwnIdChange`] at the first frame of another sender, and a second
//! [`OwnIdChange`] after [`GONE_S`] without a frame of this sender. A socket does not receive its own frames, but an
//! adapter or a recorded log may return them. Therefore, each sent frame may return once, unchanged, within [`ECHO_S`].

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::can::id_table::IdTable;
use crate::can::{CanId, Frame};
use crate::quantity::{BusIndex, Timestamp};

/// Longest delay (s) of an echo (a sent frame that is received again).
const ECHO_S: f64 = 1.0;
/// Enough for one second of status, health and alarm frames on two interfaces.
const MAX_SENT: usize = 128;
/// Without a frame for this time (s), another sender counts as gone.
const GONE_S: f64 = 10.0;

/// Reports that another sender started or stopped using packwatch's identifiers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct OwnIdChange {
    pub bus: BusIndex,
    /// From the other sender's latest frame.
    pub id: CanId,
    pub active: bool,
    /// 1 when the sender started, the total when it stopped.
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

/// The checksum replaces the payload of up to 64 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct SentFrame {
    time: Timestamp,
    bus: BusIndex,
    id: CanId,
    sum: u64,
}

/// FNV-1a over words of eight bytes, which is faster than over single bytes. The checksum identifies copies and is not
/// secure. Up to a length of eight bytes, different payloads of the same length have different checksums.
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

/// Detects other senders of packwatch's identifiers.
#[derive(Debug, Clone, Default)]
pub struct OwnFrames {
    numbers: IdTable,
    count: usize,
    state: OwnFramesState,
    pub(crate) changes: Vec<OwnIdChange>,
}

impl OwnFrames {
    /// Creates the detector for packwatch's identifiers.
    pub fn new(own: impl IntoIterator<Item = (BusIndex, CanId)>) -> Self {
        let own: Vec<_> = own.into_iter().collect();
        let count = own.len();
        let mut own_frames = Self { numbers: IdTable::new(own), count, ..Self::default() };
        own_frames.state.sent.reserve_exact(MAX_SENT);
        own_frames
    }

    /// Whether an identifier is one of packwatch's identifiers.
    #[inline]
    pub fn has(&self, bus: BusIndex, id: CanId) -> bool {
        self.numbers.number(bus, id) < self.count
    }

    /// Handles a sent frame.
    pub fn note_sent(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        if self.has(bus, frame.id()) {
            if self.state.sent.len() >= MAX_SENT {
                self.state.sent.pop_front();
            }
            self.state.sent.push_back(SentFrame { time, bus, id: frame.id(), sum: sum(frame.data()) });
        }
    }

    /// Handles a received frame.
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

    /// Reports senders that are gone.
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

    /// Longest time (s) that another sender has been present; 0 = no other sender.
    pub fn longest_s(&self, now: Timestamp) -> f64 {
        // At least 1 ns, because 0 means that there is no other sender.
        self.state.uses.iter().map(|other| now.since(other.since).max(1e-9)).fold(0.0, f64::max)
    }

    /// Interfaces with another sender, and the latest identifier that this sender used.
    pub fn uses(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.state.uses.iter().map(|other| (other.bus, other.id))
    }

    /// Reports every other sender as gone and discards the expected echoes.
    pub fn restart(&mut self) {
        self.poll(Timestamp::from_nanos(i64::MAX));
        self.state.uses.clear();
        self.state.sent.clear();
    }

    /// The state to store.
    pub fn state(&self) -> &OwnFramesState {
        &self.state
    }

    /// Restores a stored state and keeps packwatch's identifiers.
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
    fn other_sender_is_reported_at_start_and_end() {
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
    fn only_first_echo_of_sent_frame_is_own() {
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
        assert_eq!(own.changes.len(), 1, "after two seconds, the frame is not an echo");
    }
}
