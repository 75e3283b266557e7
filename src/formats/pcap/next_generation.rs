//! Reads PCAPNG files. A file has blocks with their length, sections with their own byte order, and interfaces with
//! names and time units.

use std::io::{self, Read};

use packwatch_core::quantity::Timestamp;

use super::packet::{LinkType, PacketDecoder};
use crate::byte_stream::{ByteStream, WINDOW, cut, damaged, u16_at, u32_at};
use crate::{Channel, Item, LogReader, Position, Source};

/// First bytes of a section, the same in both byte orders.
pub(crate) const SECTION_HEADER: &[u8] = &[0x0A, 0x0D, 0x0D, 0x0A];

const INTERFACE: u32 = 1;
const OLD_PACKET: u32 = 2;
const SIMPLE_PACKET: u32 = 3;
const PACKET: u32 = 6;
/// Options of an interface.
const IF_NAME: u16 = 2;
const IF_TSRESOL: u16 = 9;
const IF_TSOFFSET: u16 = 14;

/// Size of the fields before a block's content (kind and length), bytes.
const BLOCK_HEAD: usize = 8;
/// Size of all fields around a block's content (kind and length before it, length after it), bytes.
const BLOCK_FRAME: usize = 12;
/// Maximum number of interfaces of a section. Usual captures have fewer than ten.
const MAX_INTERFACES: usize = 1024;

struct Interface {
    link: Option<LinkType>,
    channel: Channel,
    /// Number of time units per second.
    per_second: u64,
    offset_s: i64,
}

pub(crate) struct PcapNgReader {
    blocks: ByteStream<Box<dyn Read>>,
    big_endian: bool,
    interfaces: Vec<Interface>,
    decoder: PacketDecoder,
    at: u64,
}

impl PcapNgReader {
    pub(crate) fn open(source: Source) -> Self {
        Self {
            blocks: ByteStream::new(source.reader),
            big_endian: false,
            interfaces: Vec::new(),
            decoder: PacketDecoder::default(),
            at: 0,
        }
    }

    fn next_block(&mut self) -> io::Result<Option<Item>> {
        self.at = self.blocks.offset();
        let head = self.blocks.fill(BLOCK_FRAME)?;
        if head.is_empty() {
            return Ok(None);
        }
        if head.len() < BLOCK_FRAME {
            return Err(cut("the file ends in the head of a block"));
        }
        let is_section = head.starts_with(SECTION_HEADER);
        if is_section {
            self.big_endian = match head[8..12] {
                [0x1A, 0x2B, 0x3C, 0x4D] => true,
                [0x4D, 0x3C, 0x2B, 0x1A] => false,
                _ => return Err(damaged(format!("byte-order mark {:02X?}, must be 1A2B3C4D", &head[8..12]))),
            };
            self.interfaces.clear();
        }
        let [kind, len] = [0, 4].map(|at| u32_at(head, at, self.big_endian));
        let len = len as usize;
        if len < BLOCK_FRAME || !len.is_multiple_of(4) {
            return Err(damaged(format!("block of {len} bytes, must be a multiple of 4 and at least {BLOCK_FRAME}")));
        }
        if is_section || len > WINDOW || !matches!(kind, INTERFACE | OLD_PACKET | SIMPLE_PACKET | PACKET) {
            return match self.blocks.skip(len as u64)? {
                true => Ok(Some(Item::Other)),
                false => Err(cut(format!("the file ends in a block of {len} bytes"))),
            };
        }
        self.read_block(kind, len).map(Some)
    }

    /// Reads a block that fits into the window.
    fn read_block(&mut self, kind: u32, len: usize) -> io::Result<Item> {
        let big_endian = self.big_endian;
        let held = self.blocks.fill(len)?;
        let Some(block) = held.get(..len) else {
            return Err(cut(format!("the file ends in a block of {len} bytes after {}", held.len())));
        };
        let end = u32_at(block, len - 4, big_endian) as usize;
        if end != len {
            return Err(damaged(format!("block of {len} bytes that ends with the length {end}, must be the same")));
        }
        let content = &block[BLOCK_HEAD..len - 4];
        let item = match kind {
            INTERFACE if self.interfaces.len() >= MAX_INTERFACES => {
                return Err(damaged(format!("more than {MAX_INTERFACES} interfaces")));
            }
            INTERFACE => match interface(content, big_endian, self.interfaces.len()) {
                Ok(interface) => {
                    self.interfaces.push(interface);
                    Item::Other
                }
                Err(text) => return Err(damaged(text)),
            },
            // A packet without a time cannot become a frame.
            SIMPLE_PACKET => Item::Other,
            _ => packet(content, kind == OLD_PACKET, big_endian, &self.interfaces, &mut self.decoder)
                .unwrap_or_else(Item::Bad),
        };
        self.blocks.consume(len);
        Ok(item)
    }
}

impl LogReader for PcapNgReader {
    fn next_item(&mut self) -> io::Result<Option<Item>> {
        self.next_block()
    }

    fn position(&self) -> Position {
        Position::Byte(self.at)
    }

    fn channels(&self) -> &[Channel] {
        self.decoder.channels.as_slice()
    }
}

fn interface(content: &[u8], big_endian: bool, index: usize) -> Result<Interface, String> {
    if content.len() < 8 {
        return Err(format!("interface with {} bytes, must have at least 8", content.len()));
    }
    let link = LinkType::of_number(u32::from(u16_at(content, 0, big_endian)));
    let number = u32::try_from(index).unwrap_or(u32::MAX);
    let channel = Channel::Number { written: number, index: number };
    let mut interface = Interface { link, channel, per_second: 1_000_000, offset_s: 0 };
    let mut options = &content[8..];
    while options.len() >= 4 {
        let [code, len] = [0, 2].map(|at| u16_at(options, at, big_endian));
        let len = usize::from(len);
        let Some(value) = options.get(4..4 + len).filter(|_| code != 0) else { break };
        match (code, value) {
            (IF_NAME, name) => {
                let name = String::from_utf8_lossy(name);
                interface.channel = Channel::Name(name.trim_end_matches('\0').to_owned());
            }
            (IF_TSRESOL, &[exponent]) => {
                let (base, power) = if exponent & 0x80 == 0 { (10_u64, exponent) } else { (2, exponent & 0x7F) };
                let per_second = base.checked_pow(u32::from(power));
                interface.per_second = per_second.ok_or_else(|| format!("time unit {exponent} is too small"))?;
            }
            (IF_TSOFFSET, value) if len == 8 => {
                let [first, second] = [0, 4].map(|at| u32_at(value, at, big_endian));
                let (high, low) = if big_endian { (first, second) } else { (second, first) };
                interface.offset_s = (u64::from(high) << 32 | u64::from(low)).cast_signed();
            }
            _ => {}
        }
        options = options.get(4 + len.next_multiple_of(4)..).unwrap_or(&[]);
    }
    Ok(interface)
}

fn packet(
    content: &[u8],
    is_old: bool,
    big_endian: bool,
    interfaces: &[Interface],
    decoder: &mut PacketDecoder,
) -> Result<Item, String> {
    if content.len() < 20 {
        return Err(format!("packet block with {} bytes, must have at least 20", content.len()));
    }
    let [number, high, low, len] = [0, 4, 8, 12].map(|at| u32_at(content, at, big_endian));
    let number = if is_old { usize::from(u16_at(content, 0, big_endian)) } else { number as usize };
    let interface = interfaces
        .get(number)
        .ok_or_else(|| format!("packet of interface {number}, but the section has {} interfaces", interfaces.len()))?;
    let bytes = usize::try_from(len).ok().and_then(|len| content[20..].get(..len));
    let bytes = bytes.ok_or_else(|| format!("packet of {len} bytes in a block with {}", content.len() - 20))?;
    let ticks = u64::from(high) << 32 | u64::from(low);
    let (seconds, rest) = (ticks / interface.per_second, ticks % interface.per_second);
    let nanos = u128::from(rest) * 1_000_000_000 / u128::from(interface.per_second);
    let seconds = i64::try_from(seconds).unwrap_or(i64::MAX).saturating_add(interface.offset_s);
    let nanos = seconds.saturating_mul(1_000_000_000).saturating_add(i64::try_from(nanos).unwrap_or(0));
    let time = Timestamp::from_nanos(nanos);
    Ok(decoder.decode(interface.link, bytes, big_endian, time, channel_of(interface)))
}

/// The channel that the file states for an interface. `None` in two cases: the interface is `any`, which captures all
/// interfaces, or the file states no name and each packet contains the number of its interface
/// ([`LinkType::CookedTwo`]).
fn channel_of(interface: &Interface) -> Option<&Channel> {
    match (&interface.channel, interface.link) {
        (Channel::Number { .. }, Some(LinkType::CookedTwo)) => None,
        (Channel::Name(name), Some(LinkType::Cooked | LinkType::CookedTwo)) if name == "any" => None,
        (channel, _) => Some(channel),
    }
}
