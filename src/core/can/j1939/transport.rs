//! Broadcasts a payload of more than 8 bytes in packets (BAM of J1939-21): an announcement, then 7 bytes per packet.
//!
//! The standard requires 50 to 200 ms between packets. Each frame is due 50 ms after the previous frame was sent. If a
//! frame is sent late, because the caller polls late, the next frame is therefore not sent too soon.

use serde::{Deserialize, Serialize};

use super::id::{GLOBAL_ADDRESS, PGN_TRANSPORT_CONTROL, PGN_TRANSPORT_DATA, TRANSPORT_PRIORITY, can_id, pgn_bytes};
use super::trouble_code::{DmPayload, MAX_PAYLOAD};
use crate::can::Frame;
use crate::quantity::Timestamp;

/// Shortest time between two frames of the transport protocol, ns.
pub(super) const PACKET_SPACING_NS: i64 = 50_000_000;

/// Control byte of the announcement.
pub(super) const BAM: u8 = 32;
pub(super) const PACKET_BYTES: usize = 7;

// Sequence numbers are one byte and start at 1.
const _: () = assert!(MAX_PAYLOAD <= 255 * PACKET_BYTES);

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Transfer {
    pub(super) pgn: u32,
    /// Time of the next packet.
    pub(super) due: Timestamp,
    payload: DmPayload,
    sent_packets: u8,
}

impl Transfer {
    /// Returns the transfer with its announcement.
    pub(super) fn start(now: Timestamp, pgn: u32, payload: DmPayload, source: u8) -> (Self, Option<Frame>) {
        let transfer = Self { pgn, due: now.plus_nanos(PACKET_SPACING_NS), payload, sent_packets: 0 };
        let bytes = payload.as_slice().len();
        let [size_low, size_high] = u16::try_from(bytes).unwrap_or(u16::MAX).to_le_bytes();
        let packets = u8::try_from(bytes.div_ceil(PACKET_BYTES)).unwrap_or(u8::MAX);
        let [low, middle, high] = pgn_bytes(pgn);
        let announcement = [BAM, size_low, size_high, packets, 0xFF, low, middle, high];
        let id = can_id(TRANSPORT_PRIORITY, PGN_TRANSPORT_CONTROL, GLOBAL_ADDRESS, source);
        (transfer, Frame::classic(id, &announcement))
    }

    pub(super) fn poll(&mut self, now: Timestamp, source: u8) -> Option<Frame> {
        if now < self.due || self.is_complete() {
            return None;
        }
        let from = usize::from(self.sent_packets) * PACKET_BYTES;
        self.sent_packets += 1;
        self.due = now.plus_nanos(PACKET_SPACING_NS);
        let mut packet = [0xFF; 1 + PACKET_BYTES];
        packet[0] = self.sent_packets;
        for (to, byte) in packet[1..].iter_mut().zip(self.payload.as_slice().iter().skip(from)) {
            *to = *byte;
        }
        Frame::classic(can_id(TRANSPORT_PRIORITY, PGN_TRANSPORT_DATA, GLOBAL_ADDRESS, source), &packet)
    }

    pub(super) fn is_complete(&self) -> bool {
        usize::from(self.sent_packets) * PACKET_BYTES >= self.payload.as_slice().len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::id::PGN_DM1;
    use super::super::trouble_code::{Lamps, TroubleCode, dm_payload};
    use super::*;

    fn at(ms: i64) -> Timestamp {
        Timestamp::from_nanos(ms * 1_000_000)
    }

    fn payload(codes: u32) -> DmPayload {
        let codes: Vec<_> = (1..=codes).map(|spn| TroubleCode::new(spn, 31, 1).unwrap()).collect();
        dm_payload(Lamps::default(), &codes)
    }

    #[test]
    fn five_codes_are_announced_and_sent_in_four_packets() {
        let (mut transfer, announcement) = Transfer::start(at(0), PGN_DM1, payload(5), 0xF9);
        let announcement = announcement.unwrap();
        assert_eq!(announcement.id().raw(), 0x1CEC_FFF9);
        assert_eq!(announcement.data(), [32, 22, 0, 4, 0xFF, 0xCA, 0xFE, 0x00]);
        let packets: Vec<Frame> = (1..=4).map(|n| transfer.poll(at(50 * n), 0xF9).unwrap()).collect();
        assert!(transfer.is_complete());
        let ids: Vec<u32> = packets.iter().map(|packet| packet.id().raw()).collect();
        assert_eq!(ids, [0x1CEB_FFF9; 4]);
        assert_eq!(packets[0].data(), [1, 0x00, 0xFF, 1, 0, 31, 1, 2]);
        assert_eq!(packets[1].data(), [2, 0, 31, 1, 3, 0, 31, 1]);
        assert_eq!(packets[2].data(), [3, 4, 0, 31, 1, 5, 0, 31]);
        assert_eq!(packets[3].data(), [4, 1, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF]);
        assert_eq!(transfer.poll(at(1000), 0xF9), None, "nothing after the last packet");
    }

    #[test]
    fn packets_keep_spacing_after_late_poll() {
        let (mut transfer, _) = Transfer::start(at(0), PGN_DM1, payload(27), 1);
        assert_eq!(transfer.poll(at(49), 1), None);
        assert!(transfer.poll(at(90), 1).is_some());
        assert_eq!(transfer.poll(at(139), 1), None);
        assert!(transfer.poll(at(140), 1).is_some());
    }

    #[test]
    fn longest_transfer_ends_within_a_second_despite_late_polls() {
        let (mut transfer, _) = Transfer::start(at(0), PGN_DM1, payload(27), 1);
        let mut now = at(0);
        while !transfer.is_complete() {
            now = transfer.due.plus_nanos(10_000_000);
            assert!(transfer.poll(now, 1).is_some());
        }
        assert_eq!(now, at(960));
    }
}
