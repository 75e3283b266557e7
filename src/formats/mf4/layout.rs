//! Reads the description of an MF4 file: which groups have CAN frames, and where the fields of their records are.

use std::collections::HashSet;
use std::io;
use std::rc::Rc;

use super::blocks::{Block, FIRST_BLOCK, MdfFile};
use super::event::{Event, EventKind, Payload};
use super::field::{ChannelBlock, Field};
use crate::byte_stream::{WINDOW, cut, damaged, u16_at, u32_at, u64_at};

/// Maximum number of groups and channels of a file. Usual bus logs have fewer than 5,000.
const MAX_BLOCKS: usize = 200_000;
/// Maximum number of groups with frames. Each group is read through its own window of the file. Sorted files have three
/// groups per CAN channel.
const MAX_OPEN_GROUPS: usize = 128;
/// Number of channel names in the message about a file without frames.
const MAX_NAMES: usize = 5;
/// Flag of a group whose records are variable-length values of another group.
const VARIABLE_LENGTH: u16 = 1;
/// Types of a channel: value of variable length, master, virtual master.
const VARIABLE: u8 = 1;
const MASTER: u8 = 2;
const VIRTUAL_MASTER: u8 = 3;
/// Synchronisation of a master channel: time.
const TIME: u8 = 1;

pub(super) struct Layout {
    pub(super) groups: Vec<DataGroup>,
    /// Groups that cannot be read.
    pub(super) notes: Vec<String>,
    /// Damage that hides further groups.
    pub(super) damage: Option<io::Error>,
}

/// Groups that share their data.
pub(super) struct DataGroup {
    pub(super) file: Rc<MdfFile>,
    pub(super) data: u64,
    /// Size of the number before each record, bytes; 0 = sorted data of one group.
    pub(super) id_len: usize,
    /// Sorted by the number before each record.
    pub(super) records: Vec<RecordGroup>,
}

/// A group of records.
pub(super) struct RecordGroup {
    pub(super) id: u64,
    pub(super) address: u64,
    /// Length of a record, bytes.
    pub(super) len: usize,
    /// Number of records; `None` = unknown.
    pub(super) cycles: Option<u64>,
    pub(super) content: Content,
}

/// What the records of a group contain.
pub(super) enum Content {
    Event(Box<Event>),
    /// Variable-length values.
    Values,
    Other,
}

/// Reads the description of a file.
///
/// # Errors
/// Fails if the header is damaged or no group has frames of a CAN bus.
pub(super) fn read(file: Rc<MdfFile>) -> io::Result<Layout> {
    let header = file.block(FIRST_BLOCK, &[b"##HD"])?;
    let start_ns = u64_at(&file.description(&header, 8)?, 0).try_into().unwrap_or(i64::MAX);
    let first = file.link(&header, 0)?;
    let mut scan = Scan { file, start_ns, visited: HashSet::new(), names: Vec::new(), notes: Vec::new() };
    let mut groups = Vec::new();
    let damage = scan.data_groups(first, &mut groups).err();
    if groups.is_empty() {
        let none = scan.without_frames();
        return Err(match damage {
            Some(error) => io::Error::new(error.kind(), format!("{error}; before that, no group with CAN frames")),
            None => none,
        });
    }
    Ok(Layout { groups, notes: scan.notes, damage })
}

struct Scan {
    file: Rc<MdfFile>,
    start_ns: i64,
    /// Addresses of all blocks read. If a block is linked twice, the links form a circle.
    visited: HashSet<u64>,
    /// Names of the first channels of groups without frames.
    names: Vec<String>,
    notes: Vec<String>,
}

#[derive(Default)]
struct Channels {
    time: Option<ChannelBlock>,
    fields: Vec<(String, ChannelBlock, u64)>,
    kind: Option<EventKind>,
}

impl Scan {
    /// Reads the block at a link and notes it as visited.
    fn visit(&mut self, link: u64, id: &[u8; 4]) -> io::Result<Block> {
        let block = self.file.block(link, &[id])?;
        if !self.visited.insert(link) {
            return Err(damaged(format!("the block at byte {link} is linked twice: the links form a circle")));
        }
        if self.visited.len() > MAX_BLOCKS {
            return Err(damaged(format!("more than {MAX_BLOCKS} groups and channels")));
        }
        Ok(block)
    }

    fn data_groups(&mut self, first: u64, groups: &mut Vec<DataGroup>) -> io::Result<()> {
        let mut link = first;
        while link != 0 {
            let block = self.visit(link, b"##DG")?;
            let [next, first, data] = [0, 1, 2].map(|index| self.file.link(&block, index));
            let id_len = usize::from(self.file.description(&block, 1)?[0]);
            if !matches!(id_len, 0 | 1 | 2 | 4 | 8) {
                return Err(damaged(format!("record numbers of {id_len} bytes, must be 0, 1, 2, 4 or 8")));
            }
            let mut group = DataGroup { file: Rc::clone(&self.file), data: data?, id_len, records: Vec::new() };
            let result = self.record_groups(first?, &mut group.records);
            let has_events = group.records.iter().any(|records| matches!(records.content, Content::Event(_)));
            if has_events {
                if groups.len() == MAX_OPEN_GROUPS {
                    return Err(damaged(format!("more than {MAX_OPEN_GROUPS} data groups with CAN frames")));
                }
                group.records.sort_by_key(|records| records.id);
                groups.push(group);
            }
            result?;
            link = next?;
        }
        Ok(())
    }

    fn record_groups(&mut self, first: u64, records: &mut Vec<RecordGroup>) -> io::Result<()> {
        let mut link = first;
        while link != 0 {
            let block = self.visit(link, b"##CG")?;
            let (next, channels) = (self.file.link(&block, 0)?, self.file.link(&block, 1)?);
            let data = self.file.description(&block, 32)?;
            let [id, cycles] = [0, 8].map(|at| u64_at(&data, at));
            let flags = u16_at(&data, 16, false);
            let [bytes, invalid] = [24, 28].map(|at| u32_at(&data, at, false) as usize);
            let cycles = self.file.has_cycle_counts().then_some(cycles);
            let mut group = RecordGroup { id, address: link, len: bytes + invalid, cycles, content: Content::Other };
            if flags & VARIABLE_LENGTH != 0 {
                group.content = Content::Values;
            } else if group.len > WINDOW {
                return Err(damaged(format!("records of {} bytes, must be at most {WINDOW}", group.len)));
            } else {
                let mut found = Channels::default();
                self.channels(channels, 0, &mut found)?;
                match self.event(found, bytes) {
                    Ok(Some(event)) => group.content = Content::Event(Box::new(event)),
                    Ok(None) => {}
                    Err(error) => self.notes.push(format!("group at byte {link} is left out: {error}")),
                }
            }
            records.push(group);
            link = next;
        }
        Ok(())
    }

    /// Reads a list of channels, and the channels that they consist of.
    fn channels(&mut self, first: u64, depth: usize, found: &mut Channels) -> io::Result<()> {
        let mut link = first;
        while link != 0 && depth < 4 {
            let block = self.visit(link, b"##CN")?;
            let [next, composition, name, data] = [0, 1, 2, 5].map(|index| self.file.link(&block, index));
            let channel = ChannelBlock::read(&self.file, &block)?;
            let name = self.file.text(name?)?;
            let sync = self.file.description(&block, 2)?[1];
            if matches!(channel.kind, MASTER | VIRTUAL_MASTER) && sync == TIME {
                found.time = Some(channel);
            } else if let Some(kind) = EventKind::of_channel(&name) {
                found.kind = Some(kind);
                found.fields.push((name, channel, data?));
            } else if self.names.len() < MAX_NAMES {
                self.names.push(name);
            }
            let composition = composition?;
            // Arrays and attachments may follow instead of channels.
            if composition != 0 && self.file.block(composition, &[b"##CN"]).is_ok() {
                self.channels(composition, depth + 1, found)?;
            }
            link = next?;
        }
        Ok(())
    }

    /// The event whose fields these channels are; `None` = the group has no frames.
    fn event(&self, found: Channels, record_len: usize) -> io::Result<Option<Event>> {
        let Some(kind) = found.kind else { return Ok(None) };
        let time = found.time.ok_or_else(|| damaged("it has no time"))?;
        let time = Field::read(&self.file, &time, record_len)?;
        let time = time.ok_or_else(|| damaged("the conversion of its time is not linear"))?;
        let channel_of = |suffix: &str| found.fields.iter().find(|(name, ..)| name.split('.').nth(1) == Some(suffix));
        let field = |suffix: &str| match channel_of(suffix) {
            Some((_, channel, _)) => Field::read(&self.file, channel, record_len),
            None => Ok(None),
        };
        let plain = |suffix: &str| field(suffix).map(|field| field.filter(Field::is_plain));
        let payload = match channel_of("DataBytes") {
            Some((_, channel, link)) if kind == EventKind::Data => self.payload(channel, *link, record_len)?,
            _ => Payload::None,
        };
        let id = plain("ID")?;
        if id.is_none() && kind != EventKind::Error {
            return Err(damaged("it has no identifier"));
        }
        Ok(Some(Event {
            kind,
            time,
            id,
            extended: plain("IDE")?,
            code: plain("DLC")?,
            // `DataLength` is ignored if a table converts it. Its stored number is then the length code, which `DLC`
            // also contains.
            len: plain("DataLength")?,
            channel: plain("BusChannel")?,
            is_fd: plain("EDL")?,
            brs: plain("BRS")?,
            esi: plain("ESI")?,
            error: plain("ErrorType")?,
            payload,
            start_ns: self.start_ns,
        }))
    }

    fn payload(&self, channel: &ChannelBlock, link: u64, record_len: usize) -> io::Result<Payload> {
        if channel.kind != VARIABLE {
            let (first, len) = (channel.byte as usize, channel.bits as usize / 8);
            if first + len > record_len {
                let end = first + len;
                return Err(damaged(format!("data that end at byte {end} of a record of {record_len} bytes")));
            }
            return Ok(Payload::Fixed(first, len));
        }
        // The record has the offset of the value, an unsigned number of 8 bytes.
        let offset = ChannelBlock { kind: 0, data_type: 0, bit: 0, bits: channel.bits, conversion: 0, ..*channel };
        let offset = Field::read(&self.file, &offset, record_len)?;
        let offset = offset.ok_or_else(|| damaged("the offset of its data is not a number"))?;
        if link != 0 && self.file.block(link, &[b"##CG"]).is_ok() {
            return Ok(Payload::Group(offset, link));
        }
        Ok(Payload::Signal(offset, link))
    }

    /// Error about a file whose groups have no frames.
    fn without_frames(&self) -> io::Error {
        if let Some(note) = self.notes.first() {
            return damaged(format!("no readable group with CAN frames: {note}"));
        }
        let names = self.names.join(", ");
        match self.visited.is_empty() {
            true => cut("the file has no groups"),
            false => damaged(format!(
                "no CAN frames (channel CAN_DataFrame), only signals ({names}, ...): export the signals as CSV, for \
                 example with asammdf, or record the bus"
            )),
        }
    }
}
