//! Reads PCAP and PCAPNG files: packet captures of SocketCAN by tcpdump, Wireshark and others.
//!
//! Packets of the link type SocketCAN become frames. Packets of the cooked link types of Linux become frames if their
//! protocol is CAN or CAN FD. For other packets, the reader returns an item without a frame. Sources: the capture file
//! formats and link types as published by the tcpdump group.

mod next_generation;
mod packet;

use std::io::{self, Read};

use packwatch_core::quantity::Timestamp;

pub(crate) use self::next_generation::{PcapNgReader, SECTION_HEADER};
use self::packet::{LinkType, PacketDecoder};
use crate::byte_stream::{ByteStream, WINDOW, cut, damaged, u32_at};
use crate::{Channel, Format, Item, LogReader, Position, Source};

/// Size of the file header, and of the header of a packet, bytes.
const FILE_HEAD: usize = 24;
const PACKET_HEAD: usize = 16;

/// Byte order and time unit, as stated by a file's first bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Form {
    big_endian: bool,
    nanoseconds: bool,
}

impl Form {
    /// The form that a file's first bytes state.
    pub(crate) fn of_magic(head: &[u8]) -> Option<Self> {
        let form = |big_endian, nanoseconds| Some(Self { big_endian, nanoseconds });
        match head.first_chunk()? {
            [0xD4, 0xC3, 0xB2, 0xA1] => form(false, false),
            [0x4D, 0x3C, 0xB2, 0xA1] => form(false, true),
            [0xA1, 0xB2, 0xC3, 0xD4] => form(true, false),
            [0xA1, 0xB2, 0x3C, 0x4D] => form(true, true),
            _ => None,
        }
    }
}

pub(crate) struct PcapReader {
    packets: ByteStream<Box<dyn Read>>,
    form: Form,
    link: Option<LinkType>,
    decoder: PacketDecoder,
    at: u64,
}

impl PcapReader {
    /// Reads the file header.
    ///
    /// # Errors
    /// Fails if the source cannot be read or its header is damaged.
    pub(crate) fn open(source: Source) -> io::Result<Self> {
        let mut packets = ByteStream::new(source.reader);
        let head = packets.fill(FILE_HEAD)?;
        let form = Form::of_magic(head).ok_or_else(|| damaged("the first bytes are not those of a PCAP file"))?;
        if head.len() < FILE_HEAD {
            return Err(cut(format!("the file ends in its header after {} bytes, must have {FILE_HEAD}", head.len())));
        }
        // The upper 16 bits describe a frame check sequence; the lower 16 bits are the link type.
        let number = u32_at(head, 20, form.big_endian) & 0xFFFF;
        let link = LinkType::of_number(number);
        if link.is_none() {
            return Err(damaged(packet::other_link_type(number)));
        }
        packets.consume(FILE_HEAD);
        let mut decoder = PacketDecoder::default();
        if link == Some(LinkType::SocketCan) {
            note_orders(packets.fill(Format::HEAD_BYTES)?, form, &mut decoder);
        }
        Ok(Self { packets, form, link, decoder, at: 0 })
    }

    fn next_packet(&mut self) -> io::Result<Option<Item>> {
        self.at = self.packets.offset();
        let head = self.packets.fill(PACKET_HEAD)?;
        if head.is_empty() {
            return Ok(None);
        }
        if head.len() < PACKET_HEAD {
            return Err(cut("the file ends in the head of a packet"));
        }
        let [seconds, fraction, len, _] = [0, 4, 8, 12].map(|at| u32_at(head, at, self.form.big_endian));
        let len = len as usize;
        if len > WINDOW {
            return Err(damaged(format!("packet of {len} bytes, must be at most {WINDOW}")));
        }
        let unit_ns = if self.form.nanoseconds { 1 } else { 1000 };
        let time = Timestamp::from_nanos(i64::from(seconds) * 1_000_000_000 + i64::from(fraction) * unit_ns);
        self.packets.consume(PACKET_HEAD);
        let held = self.packets.fill(len)?;
        let Some(bytes) = held.get(..len) else {
            return Err(cut(format!("the file ends in a packet of {len} bytes after {}", held.len())));
        };
        let item = self.decoder.decode(self.link, bytes, self.form.big_endian, time, None);
        self.packets.consume(len);
        Ok(Some(item))
    }
}

/// Passes the first packets to the decoder, which infers the byte order of the identifiers.
fn note_orders(mut packets: &[u8], form: Form, decoder: &mut PacketDecoder) {
    while let Some((head, rest)) = packets.split_at_checked(PACKET_HEAD)
        && let Some((packet, rest)) = rest.split_at_checked(u32_at(head, 8, form.big_endian) as usize)
    {
        decoder.note_order(packet, true);
        packets = rest;
    }
}

impl LogReader for PcapReader {
    fn next_item(&mut self) -> io::Result<Option<Item>> {
        self.next_packet()
    }

    fn position(&self) -> Position {
        Position::Byte(self.at)
    }

    fn channels(&self) -> &[Channel] {
        self.decoder.channels.as_slice()
    }
}

#[cfg(test)]
mod tests;
