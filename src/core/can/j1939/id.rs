//! The 29-bit identifier in J1939: priority, parameter group number (PGN), destination, source.

use crate::can::CanId;

/// Requests a parameter group from one address or from all.
pub const PGN_REQUEST: u32 = 59_904;
/// Acknowledges a request. This node sends only negative acknowledgements.
pub const PGN_ACKNOWLEDGEMENT: u32 = 59_392;
/// Claims an address. Sent from [`NULL_ADDRESS`], it means "cannot claim".
pub const PGN_ADDRESS_CLAIMED: u32 = 60_928;
/// Transport protocol, connection management: announces a broadcast in packets.
pub const PGN_TRANSPORT_CONTROL: u32 = 60_416;
/// Transport protocol, data: one packet.
pub const PGN_TRANSPORT_DATA: u32 = 60_160;
/// Active trouble codes.
pub const PGN_DM1: u32 = 65_226;
/// Previously active trouble codes.
pub const PGN_DM2: u32 = 65_227;

/// Destination of frames to all nodes.
pub const GLOBAL_ADDRESS: u8 = 255;
/// Source address of a node without an address.
pub const NULL_ADDRESS: u8 = 254;
/// Largest address a node may claim.
pub const MAX_ADDRESS: u8 = 253;

/// Default priority of claims, requests, acknowledgements and diagnostic messages.
pub(super) const PRIORITY: u8 = 6;
/// Default priority of the transport protocol: the lowest, because a transfer takes many frames.
pub(super) const TRANSPORT_PRIORITY: u8 = 7;

pub(super) const WITHOUT_PRIORITY: u32 = 0x03FF_FFFF;
/// First PDU format without a destination. Its PDU-specific byte belongs to the PGN.
const FIRST_BROADCAST_FORMAT: u8 = 240;

/// An identifier without its priority.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    /// 18 bits.
    pub(super) pgn: u32,
    /// [`GLOBAL_ADDRESS`] for a group without destination.
    pub(super) destination: u8,
    pub(super) source: u8,
}

impl Header {
    /// Splits an extended identifier; `None` for a standard identifier.
    pub(super) fn of(id: CanId) -> Option<Self> {
        let CanId::Extended(raw) = id else { return None };
        let [page, format, specific, source] = (raw & WITHOUT_PRIORITY).to_be_bytes();
        let (low, destination) =
            if format < FIRST_BROADCAST_FORMAT { (0, specific) } else { (specific, GLOBAL_ADDRESS) };
        Some(Self { pgn: u32::from_be_bytes([0, page, format, low]), destination, source })
    }
}

/// The identifier of a frame. `destination` is used only for groups with a destination.
pub(super) fn can_id(priority: u8, pgn: u32, destination: u8, source: u8) -> CanId {
    let [_, page, format, low] = pgn.to_be_bytes();
    let specific = if format < FIRST_BROADCAST_FORMAT { destination } else { low };
    // The masks change nothing, because callers pass 3 bits of priority and 2 bits of page.
    CanId::Extended(u32::from_be_bytes([((priority & 7) << 2) | (page & 3), format, specific, source]))
}

/// Identifier and mask of a group from any source with any priority.
pub(super) fn filter(pgn: u32, destination: u8) -> (u32, u32) {
    (can_id(0, pgn, destination, 0).raw(), WITHOUT_PRIORITY & !0xFF)
}

/// Parameter group number of an extended identifier; `None` for a standard identifier.
pub fn parameter_group(id: CanId) -> Option<u32> {
    Header::of(id).map(|header| header.pgn)
}

/// Whether frames of a group have a destination.
pub(crate) fn has_destination(pgn: u32) -> bool {
    pgn >> 8 & 0xFF < u32::from(FIRST_BROADCAST_FORMAT)
}

/// Identifier and mask of a group without a destination.
pub(crate) fn any_source(pgn: u32) -> (u32, u32) {
    filter(pgn, 0)
}

pub(super) fn pgn_bytes(pgn: u32) -> [u8; 3] {
    let [low, middle, high, _] = pgn.to_le_bytes();
    [low, middle, high]
}

pub(super) fn pgn_of(bytes: [u8; 3]) -> u32 {
    u32::from_le_bytes([bytes[0], bytes[1], bytes[2], 0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifiers_match_the_standard() {
        let id = |priority, pgn| can_id(priority, pgn, GLOBAL_ADDRESS, 0xF9).raw();
        assert_eq!(id(PRIORITY, PGN_DM1), 0x18FE_CAF9);
        assert_eq!(id(PRIORITY, PGN_DM2), 0x18FE_CBF9);
        assert_eq!(id(PRIORITY, PGN_ADDRESS_CLAIMED), 0x18EE_FFF9);
        assert_eq!(id(PRIORITY, PGN_REQUEST), 0x18EA_FFF9);
        assert_eq!(id(PRIORITY, PGN_ACKNOWLEDGEMENT), 0x18E8_FFF9);
        assert_eq!(id(TRANSPORT_PRIORITY, PGN_TRANSPORT_CONTROL), 0x1CEC_FFF9);
        assert_eq!(id(TRANSPORT_PRIORITY, PGN_TRANSPORT_DATA), 0x1CEB_FFF9);
    }

    #[test]
    fn identifiers_split_into_their_parts() {
        for (pgn, destination, read) in
            [(PGN_REQUEST, 0x21, 0x21), (PGN_DM1, 0x21, GLOBAL_ADDRESS), (0x3_EF00, 0x21, 0x21), (0x1_FECA, 7, 255)]
        {
            let header = Header::of(can_id(3, pgn, destination, 0x80));
            assert_eq!(header, Some(Header { pgn, destination: read, source: 0x80 }), "{pgn:#X}");
        }
        assert_eq!(Header::of(CanId::Standard(0x7FF)), None);
    }

    #[test]
    fn filter_ignores_priority_and_source() {
        let (id, mask) = filter(PGN_REQUEST, 0x21);
        for priority in 0..8 {
            assert_eq!(can_id(priority, PGN_REQUEST, 0x21, 0xF3).raw() & mask, id);
            assert_ne!(can_id(priority, PGN_REQUEST, 0x22, 0xF3).raw() & mask, id);
        }
    }
}
