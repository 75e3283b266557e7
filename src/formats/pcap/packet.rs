//! Decodes packets of SocketCAN, with or without the cooked header of Linux.

use packwatch_core::quantity::Timestamp;

use crate::byte_stream::{u16_at, u32_at};
use crate::channel_list::ChannelList;
use crate::raw_frame::RawFrame;
use crate::{Channel, Item};

/// What precedes a CAN frame in a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LinkType {
    /// Nothing (LINKTYPE_CAN_SOCKETCAN).
    SocketCan,
    /// The cooked header of Linux (LINKTYPE_LINUX_SLL).
    Cooked,
    /// The cooked header with the interface's number (LINKTYPE_LINUX_SLL2).
    CookedTwo,
}

impl LinkType {
    /// The link type with this number, if it can carry CAN frames.
    pub(super) fn of_number(number: u32) -> Option<Self> {
        match number {
            227 => Some(Self::SocketCan),
            113 => Some(Self::Cooked),
            276 => Some(Self::CookedTwo),
            _ => None,
        }
    }
}

pub(super) fn other_link_type(number: u32) -> String {
    format!("capture of link type {number}, must be 227 (SocketCAN), 113 or 276 (cooked capture of Linux)")
}

/// Hardware type of CAN interfaces.
const HARDWARE_CAN: u16 = 280;
/// Protocols in the cooked header.
const PROTOCOL_CAN: u16 = 0x000C;
const PROTOCOL_CAN_FD: u16 = 0x000D;
const PROTOCOL_CAN_XL: u16 = 0x000E;

/// Flags of the identifier.
const EXTENDED: u32 = 1 << 31;
const REMOTE: u32 = 1 << 30;
const ERROR: u32 = 1 << 29;
/// Flags of CAN FD and CAN XL.
const BRS: u8 = 1;
const ESI: u8 = 2;
const FD: u8 = 4;
const XL: u8 = 0x80;
/// Size of the head of a frame, bytes.
const FRAME_HEAD: usize = 8;

/// Decodes the packets of a file.
#[derive(Debug, Default)]
pub(super) struct PacketDecoder {
    pub(super) channels: ChannelList,
    /// Number of frames whose identifier shows the byte order that the file should have, minus the number of frames
    /// whose identifier shows the other byte order.
    right_order: i32,
}

impl PacketDecoder {
    /// Decodes a packet. `channel` is the interface that the file names. `big_endian` is the byte order of the file.
    pub(super) fn decode(
        &mut self,
        link: Option<LinkType>,
        packet: &[u8],
        big_endian: bool,
        time: Timestamp,
        channel: Option<&Channel>,
    ) -> Item {
        let (cooked, number_at) = match link {
            None => return Item::Other,
            Some(LinkType::SocketCan) => (None, None),
            Some(LinkType::Cooked) => (Some((16, 2, 14)), None),
            Some(LinkType::CookedTwo) => (Some((20, 8, 0)), Some(4)),
        };
        let (mut head, mut protocol) = (0, None);
        if let Some((len, hardware_at, protocol_at)) = cooked {
            if packet.len() < len {
                return Item::Bad(format!("packet of {} bytes, must have a cooked header of {len}", packet.len()));
            }
            if u16_at(packet, hardware_at, true) != HARDWARE_CAN {
                return Item::Other;
            }
            (head, protocol) = (len, Some(u16_at(packet, protocol_at, true)));
        }
        let is_fd = match protocol {
            None => false,
            Some(PROTOCOL_CAN) => false,
            Some(PROTOCOL_CAN_FD) => true,
            Some(PROTOCOL_CAN_XL) => return Item::Xl,
            Some(_) => return Item::Other,
        };
        let channel = match channel {
            Some(channel) => self.channels.index_of(channel),
            None => self.channels.of_label(number_at.map_or(0, |at| u32_at(packet, at, true))),
        };
        let Some(channel) = channel else { return Item::Bad("more than 256 channels".to_owned()) };
        // Without a cooked header, the identifier is big-endian. With this header, the identifier has the byte order of
        // the recorder.
        let is_big_endian = protocol.is_none() || big_endian;
        self.frame(&packet[head..], is_big_endian, is_fd, time, channel).unwrap_or_else(Item::Bad)
    }

    fn frame(
        &mut self,
        bytes: &[u8],
        big_endian: bool,
        is_fd: bool,
        time: Timestamp,
        channel: u8,
    ) -> Result<Item, String> {
        if bytes.len() < FRAME_HEAD {
            return Err(format!("CAN frame of {} bytes, must have at least {FRAME_HEAD}", bytes.len()));
        }
        let (len, flags) = (usize::from(bytes[4]), bytes[5]);
        // A CAN XL frame has its flags where other frames have their length. A length is at most 64, so this bit marks
        // CAN XL.
        if bytes[4] & XL != 0 {
            return Ok(Item::Xl);
        }
        let id = self.identifier(bytes, big_endian);
        if id & ERROR != 0 {
            return Ok(Item::ErrorFrame { time, channel, class: id & (ERROR - 1) });
        }
        let remote = id & REMOTE != 0;
        let fd = (is_fd || flags & FD != 0 || len > 8).then_some((flags & BRS != 0, flags & ESI != 0));
        let data = if remote { &[0; 8][..len.min(8)] } else { bytes.get(FRAME_HEAD..FRAME_HEAD + len).unwrap_or(&[]) };
        if data.len() < len && !remote {
            return Err(format!("CAN frame of {len} bytes in a packet with {}", bytes.len() - FRAME_HEAD));
        }
        let extended = id & EXTENDED != 0;
        let frame = RawFrame { id: id & (ERROR - 1), extended, remote, fd: fd.filter(|_| !remote), data }.check()?;
        Ok(Item::Frame { time, channel, frame })
    }

    /// The identifier with its flags. Some recorders write it in the other byte order.
    fn identifier(&mut self, bytes: &[u8], big_endian: bool) -> u32 {
        let [right, other] = [big_endian, !big_endian].map(|order| u32_at(bytes, 0, order));
        self.right_order = self.right_order.saturating_add(i32::from(is_plain(right)) - i32::from(is_plain(other)));
        if self.right_order < 0 { other } else { right }
    }

    /// Only counts the byte order of a frame.
    pub(super) fn note_order(&mut self, frame: &[u8], big_endian: bool) {
        if frame.len() >= FRAME_HEAD && frame[4] & XL == 0 {
            self.identifier(frame, big_endian);
        }
    }
}

/// Whether this is the identifier of a usual frame: an 11-bit identifier, or a flagged 29-bit identifier whose lower 16
/// bits are not zero.
fn is_plain(id: u32) -> bool {
    id <= 0x7FF || id & (EXTENDED | REMOTE | ERROR) == EXTENDED && id & 0xFFFF != 0
}
