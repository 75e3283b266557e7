//! Receiver of the DM1 of one address, in one frame or in packets (BAM).
//!
//! In: any frames of the bus. Out: the codes of each complete DM1, or that it cannot be read: too short, in an old layout,
//! with a packet missing. Other groups, and transfers without their announcement, are ignored. Any bytes are accepted;
//! memory is bounded by the longest transfer, 1785 bytes.

use super::id::{
    GLOBAL_ADDRESS, Header, PGN_DM1, PGN_TRANSPORT_CONTROL, PGN_TRANSPORT_DATA, WITHOUT_PRIORITY, can_id, pgn_of,
};
use super::transport::{BAM, PACKET_BYTES};
use super::trouble_code::{TroubleCode, dm_codes};
use crate::can::{Frame, FrameKind};

/// A received DM1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ReceivedDm1 {
    /// Its codes; an empty list = no active code.
    Codes(Vec<TroubleCode>),
    /// It cannot be read.
    Unreadable,
}

impl ReceivedDm1 {
    fn of(payload: &[u8]) -> Self {
        dm_codes(payload).map_or(Self::Unreadable, Self::Codes)
    }
}

/// A transfer that has begun.
#[derive(Debug, Clone, PartialEq, Eq)]
struct IncomingTransfer {
    size: usize,
    next_packet: u8,
    bytes: Vec<u8>,
}

/// Receives the DM1 of one address.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dm1Receiver {
    address: u8,
    transfer: Option<IncomingTransfer>,
}

impl Dm1Receiver {
    /// A receiver for this address.
    pub const fn new(address: u8) -> Self {
        Self { address, transfer: None }
    }

    /// Identifier and mask of every frame it needs, at any priority.
    pub fn patterns(&self) -> [(u32, u32); 3] {
        [PGN_DM1, PGN_TRANSPORT_CONTROL, PGN_TRANSPORT_DATA]
            .map(|pgn| (can_id(0, pgn, GLOBAL_ADDRESS, self.address).raw(), WITHOUT_PRIORITY))
    }

    /// Takes a frame. Returns the DM1 that ends with it.
    pub fn take(&mut self, frame: &Frame) -> Option<ReceivedDm1> {
        let header = Header::of(frame.id()).filter(|header| header.source == self.address)?;
        if frame.kind() != FrameKind::Classic || header.destination != GLOBAL_ADDRESS {
            return None;
        }
        match header.pgn {
            PGN_DM1 => Some(ReceivedDm1::of(frame.data())),
            PGN_TRANSPORT_CONTROL => self.take_announcement(frame.data()),
            PGN_TRANSPORT_DATA => self.take_packet(frame.data()),
            _ => None,
        }
    }

    /// A new transfer ends the previous one, complete or not.
    fn take_announcement(&mut self, data: &[u8]) -> Option<ReceivedDm1> {
        let &[BAM, size_low, size_high, packets, _, low, middle, high] = data else { return None };
        let broken = self.transfer.take().map(|_| ReceivedDm1::Unreadable);
        if pgn_of([low, middle, high]) != PGN_DM1 {
            return broken;
        }
        let size = usize::from(u16::from_le_bytes([size_low, size_high]));
        // Bytes of a transfer: more than a frame holds, no more than 255 packets do.
        if !(9..=255 * PACKET_BYTES).contains(&size) || size.div_ceil(PACKET_BYTES) != usize::from(packets) {
            return Some(ReceivedDm1::Unreadable);
        }
        self.transfer = Some(IncomingTransfer { size, next_packet: 1, bytes: Vec::with_capacity(size + PACKET_BYTES) });
        broken
    }

    fn take_packet(&mut self, data: &[u8]) -> Option<ReceivedDm1> {
        let mut transfer = self.transfer.take()?;
        match data {
            [number, bytes @ ..] if *number == transfer.next_packet && bytes.len() == PACKET_BYTES => {
                transfer.bytes.extend_from_slice(bytes);
            }
            _ => return Some(ReceivedDm1::Unreadable),
        }
        if let Some(payload) = transfer.bytes.get(..transfer.size) {
            return Some(ReceivedDm1::of(payload));
        }
        // Incomplete, so this was not the last of at most 255 packets.
        transfer.next_packet = transfer.next_packet.saturating_add(1);
        self.transfer = Some(transfer);
        None
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::id::PGN_DM2;
    use super::super::transport::Transfer;
    use super::super::trouble_code::{DmPayload, Lamps, dm_payload};
    use super::*;
    use crate::can::CanId;
    use crate::quantity::Timestamp;

    const ADDRESS: u8 = 0xF9;

    fn codes(count: u32) -> Vec<TroubleCode> {
        (1..=count).map(|spn| TroubleCode::new(spn, 31, 1).unwrap()).collect()
    }

    fn payload(count: u32) -> DmPayload {
        dm_payload(Lamps::default(), &codes(count))
    }

    fn frame(id: u32, data: &[u8]) -> Frame {
        Frame::classic(CanId::Extended(id), data).unwrap()
    }

    /// A transfer as the node sends it: announcement first.
    fn transfer(pgn: u32, count: u32) -> Vec<Frame> {
        let (mut transfer, announcement) = Transfer::start(Timestamp::ZERO, pgn, payload(count), ADDRESS);
        let packets = std::iter::from_fn(|| transfer.poll(transfer.due, ADDRESS));
        announcement.into_iter().chain(packets).collect()
    }

    fn received(frames: &[Frame]) -> Vec<ReceivedDm1> {
        let mut receiver = Dm1Receiver::new(ADDRESS);
        frames.iter().filter_map(|frame| receiver.take(frame)).collect()
    }

    #[test]
    fn messages_of_the_node_are_received_with_every_number_of_codes() {
        for priority in [0, 3, 6] {
            let single = |count| frame(priority << 26 | 0x00FE_CAF9, payload(count).as_slice());
            let wanted = [ReceivedDm1::Codes(vec![]), ReceivedDm1::Codes(codes(1))];
            assert_eq!(received(&[single(0), single(1)]), wanted, "priority {priority}");
        }
        for count in 2..=27 {
            assert_eq!(received(&transfer(PGN_DM1, count)), [ReceivedDm1::Codes(codes(count))], "{count} codes");
        }
    }

    #[test]
    fn other_addresses_groups_and_kinds_of_frame_are_ignored() {
        let data = payload(1);
        let other = [
            frame(0x18FE_CAF8, data.as_slice()),
            frame(0x18FE_CBF9, data.as_slice()),
            frame(0x19FE_CAF9, data.as_slice()),
            frame(0x1CEB_21F9, data.as_slice()),
            Frame::fd(CanId::Extended(0x18FE_CAF9), false, false, data.as_slice()).unwrap(),
        ];
        assert_eq!(received(&other), []);
        assert_eq!(received(&transfer(PGN_DM2, 5)), []);
        assert_eq!(received(&transfer(PGN_DM1, 5)[1..]), [], "without its announcement");
    }

    #[test]
    fn a_missing_packet_is_reported_and_the_next_transfer_is_complete() {
        let mut frames = transfer(PGN_DM1, 5);
        frames.remove(2);
        frames.extend(transfer(PGN_DM1, 2));
        assert_eq!(received(&frames), [ReceivedDm1::Unreadable, ReceivedDm1::Codes(codes(2))]);
    }

    #[test]
    fn a_transfer_that_another_cuts_short_is_reported() {
        let mut frames = transfer(PGN_DM1, 5);
        frames.pop();
        frames.extend(transfer(PGN_DM2, 5));
        assert_eq!(received(&frames), [ReceivedDm1::Unreadable]);
    }

    #[test]
    fn an_announcement_that_contradicts_itself_is_reported() {
        let announce = |size: u8, packets| frame(0x1CEC_FFF9, &[32, size, 0, packets, 0xFF, 0xCA, 0xFE, 0]);
        assert_eq!(received(&[announce(22, 3), announce(8, 2)]), [ReceivedDm1::Unreadable, ReceivedDm1::Unreadable]);
    }

    #[test]
    fn its_patterns_are_those_of_the_standard_without_the_priority() {
        let wanted = [0x00FE_CAF9, 0x00EC_FFF9, 0x00EB_FFF9].map(|id| (id, 0x03FF_FFFF));
        assert_eq!(Dm1Receiver::new(ADDRESS).patterns(), wanted);
    }

    proptest! {
        #[test]
        fn any_frames_are_accepted(
            frames in prop::collection::vec((0_usize..4, prop::collection::vec(any::<u8>(), 0..=8)), 0..100),
        ) {
            let mut receiver = Dm1Receiver::new(ADDRESS);
            for (which, mut data) in frames {
                let id = [0x18FE_CAF9, 0x1CEC_FFF9, 0x1CEB_FFF9, 0x1CEC_FFF9][which];
                // Every fourth announces a DM1, so that transfers do begin.
                if which == 3 && data.len() == 8 {
                    data[0] = BAM;
                    data[2] = 0;
                    data[3] = data[1].div_ceil(7);
                    data[5..].copy_from_slice(&[0xCA, 0xFE, 0]);
                }
                receiver.take(&frame(id, &data));
            }
            prop_assert!(receiver.transfer.is_none_or(|transfer| transfer.bytes.len() < transfer.size));
        }
    }
}
