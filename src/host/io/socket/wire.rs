//! Decodes and encodes the bytes of `struct can_frame` and `struct canfd_frame` of linux/can.h.

use crate::can::{CanId, Frame, FrameKind};

/// Bytes of `struct can_frame`.
pub(super) const CLASSIC_BYTES: usize = 16;
/// Bytes of `struct canfd_frame`.
pub(super) const FD_BYTES: usize = 72;
/// Offset of the payload in both structs.
const DATA_AT: usize = 8;

/// Identifier bit that marks a 29-bit identifier.
pub(super) const EXTENDED_FLAG: u32 = 0x8000_0000;
/// Identifier bit that marks a remote request.
pub(super) const REMOTE_FLAG: u32 = 0x4000_0000;
/// Identifier bit that marks an error frame.
pub(super) const ERROR_FLAG: u32 = 0x2000_0000;
/// Bits of a standard identifier.
pub(super) const STANDARD_MASK: u32 = 0x7FF;
/// Bits of an extended identifier, and the class bits of an error frame.
pub(super) const EXTENDED_MASK: u32 = 0x1FFF_FFFF;

/// FD flag: bit rate switch.
const FD_BRS: u8 = 0x01;
/// FD flag: error state indicator.
const FD_ESI: u8 = 0x02;

/// The content of one read from the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Wire {
    Frame(Frame),
    /// An error frame, given by its class bits.
    Error(u32),
    /// Invalid bytes: wrong size or impossible length.
    Malformed,
}

pub(super) fn decode(bytes: &[u8]) -> Wire {
    if bytes.len() != CLASSIC_BYTES && bytes.len() != FD_BYTES {
        return Wire::Malformed;
    }
    let word = u32::from_ne_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    if word & ERROR_FLAG != 0 {
        return Wire::Error(word & EXTENDED_MASK);
    }
    let id = if word & EXTENDED_FLAG != 0 {
        CanId::Extended(word & EXTENDED_MASK)
    } else {
        CanId::Standard((word & STANDARD_MASK) as u16)
    };
    let (len, flags) = (bytes[4], bytes[5]);
    let Some(data) = bytes.get(DATA_AT..DATA_AT + usize::from(len)) else { return Wire::Malformed };
    let frame = match bytes.len() {
        FD_BYTES => Frame::fd(id, flags & FD_BRS != 0, flags & FD_ESI != 0, data),
        _ if word & REMOTE_FLAG != 0 => Frame::remote(id, len),
        _ => Frame::classic(id, data),
    };
    frame.map_or(Wire::Malformed, Wire::Frame)
}

/// Encodes a frame for the kernel; returns the used part of `buffer`.
pub(super) fn encode<'a>(frame: &Frame, buffer: &'a mut [u8; FD_BYTES]) -> &'a [u8] {
    buffer.fill(0);
    let mut word = id_word(frame.id());
    let bytes = match frame.kind() {
        FrameKind::Classic => CLASSIC_BYTES,
        FrameKind::Remote => {
            word |= REMOTE_FLAG;
            CLASSIC_BYTES
        }
        FrameKind::Fd { brs, esi } => {
            buffer[5] = if brs { FD_BRS } else { 0 } | if esi { FD_ESI } else { 0 };
            FD_BYTES
        }
    };
    buffer[..4].copy_from_slice(&word.to_ne_bytes());
    buffer[4] = frame.len() as u8; // at most 64
    buffer[DATA_AT..DATA_AT + frame.data().len()].copy_from_slice(frame.data());
    &buffer[..bytes]
}

/// The identifier with the bit that marks its kind.
pub(super) fn id_word(id: CanId) -> u32 {
    match id {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id | EXTENDED_FLAG,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn round_trip(frame: Frame) {
        let mut buffer = [0xAA; FD_BYTES];
        assert_eq!(decode(encode(&frame, &mut buffer)), Wire::Frame(frame));
    }

    #[test]
    fn every_frame_kind_round_trips() {
        let (standard, extended) = (CanId::Standard(0x7FF), CanId::Extended(0x123));
        round_trip(Frame::classic(standard, &[1, 2, 3]).unwrap());
        round_trip(Frame::classic(extended, &[]).unwrap());
        round_trip(Frame::remote(standard, 5).unwrap());
        round_trip(Frame::fd(extended, true, false, &[7; 64]).unwrap());
        round_trip(Frame::fd(standard, false, true, &[7; 12]).unwrap());
    }

    #[test]
    fn error_frame_decodes_to_class() {
        let mut bytes = [0; CLASSIC_BYTES];
        bytes[..4].copy_from_slice(&(ERROR_FLAG | 0x44).to_ne_bytes());
        assert_eq!(decode(&bytes), Wire::Error(0x44));
    }

    proptest! {
        #[test]
        fn any_bytes_decode_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            let _ = decode(&bytes);
        }
    }
}
