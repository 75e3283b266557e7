//! Reads the records of one data group of an MF4 file. The record groups in it share one stream of data.

use std::collections::VecDeque;
use std::io;
use std::rc::Rc;

use super::blocks::MdfFile;
use super::data::DataBlocks;
use super::event::{Event, Payload};
use super::layout::{Content, DataGroup, RecordGroup};
use super::values::{SignalValues, ValueGroup};
use crate::Item;
use crate::byte_stream::{ByteStream, cut, damaged, u32_at};
use crate::channel_list::ChannelList;

/// Number of records in which the lowest channel is searched before the channels are numbered.
const CHANNEL_RECORDS: usize = 1000;

/// An item with the time by which groups are merged.
pub(super) struct Stamped {
    pub(super) time_ns: i64,
    pub(super) item: Item,
}

pub(super) struct GroupReader {
    file: Rc<MdfFile>,
    stream: ByteStream<DataBlocks>,
    id_len: usize,
    records: Vec<RecordGroup>,
    /// For each record group, the place of the payloads that its records do not contain.
    outside: Vec<Outside>,
    /// Number of records still to be read, if the data contain records of only one group; `None` = unknown.
    left: Option<u64>,
    /// Number of the first channel.
    first_channel: u32,
    /// Items whose payload came after their record.
    ready: VecDeque<Stamped>,
    latest_ns: i64,
    has_ended: bool,
}

/// Place of the payloads that the records of a group do not contain.
enum Outside {
    /// The records contain their payloads.
    None,
    Signal(SignalValues),
    /// The payloads are records of the group with this index.
    Group(usize, ValueGroup),
}

impl GroupReader {
    /// Opens the data of a group.
    ///
    /// # Errors
    /// Fails if the data's first block is damaged.
    pub(super) fn open(group: DataGroup) -> io::Result<Self> {
        let outside = |records: &RecordGroup| -> io::Result<Outside> {
            let Content::Event(event) = &records.content else { return Ok(Outside::None) };
            Ok(match event.payload {
                Payload::None | Payload::Fixed(..) => Outside::None,
                Payload::Signal(_, link) => Outside::Signal(SignalValues::open(&group.file, link)?),
                Payload::Group(_, address) => {
                    let index = group.records.iter().position(|records| records.address == address);
                    let index = index.ok_or_else(|| damaged("the group of the frames' data has other data"))?;
                    Outside::Group(index, ValueGroup::new(group.file.has_value_offsets()))
                }
            })
        };
        Ok(Self {
            stream: ByteStream::new(DataBlocks::open(&group.file, group.data)?),
            outside: group.records.iter().map(outside).collect::<io::Result<_>>()?,
            left: group.records.first().filter(|_| group.id_len == 0).and_then(|records| records.cycles),
            id_len: group.id_len,
            records: group.records,
            file: group.file,
            first_channel: 1,
            ready: VecDeque::new(),
            latest_ns: i64::MIN,
            has_ended: false,
        })
    }

    /// Numbers the channels from this number.
    pub(super) fn set_first_channel(&mut self, first: u32) {
        self.first_channel = first;
    }

    /// Address of the block read last.
    pub(super) fn position(&self) -> u64 {
        self.stream.source().position()
    }

    /// Lowest channel in the first records. Damage does not matter here: it is reported when the records are read.
    pub(super) fn lowest_channel(&self, data: u64) -> Option<u32> {
        let mut stream = ByteStream::new(DataBlocks::open(&self.file, data).ok()?);
        let mut lowest = None;
        for _ in 0..CHANNEL_RECORDS {
            let Ok(Some((index, len))) = self.next_record(&mut stream) else { break };
            if let Content::Event(event) = &self.records[index].content
                && let Ok(bytes) = stream.fill(len)
                && let Some(record) = bytes.get(self.id_len..len)
            {
                let channel = event.channel(record);
                lowest = Some(lowest.map_or(channel, |lowest: u32| lowest.min(channel)));
            }
            if !stream.skip(len as u64).is_ok_and(|is_whole| is_whole) {
                break;
            }
        }
        lowest
    }

    /// Index of the next record's group, and length of the record including its ID; `None` at the end.
    #[inline]
    fn next_record(&self, stream: &mut ByteStream<DataBlocks>) -> io::Result<Option<(usize, usize)>> {
        record_of(&self.records, self.id_len, stream)
    }

    /// The next item; `None` at the end.
    ///
    /// # Errors
    /// Fails if the data cannot be read or are damaged so that the next record cannot be found. Later calls return
    /// `None`.
    pub(super) fn next_item(&mut self, channels: &mut ChannelList) -> io::Result<Option<Stamped>> {
        loop {
            if let Some(stamped) = self.ready.pop_front() {
                return Ok(Some(stamped));
            }
            if self.has_ended {
                return Ok(None);
            }
            match self.read_record(channels) {
                Ok(Some(stamped)) => return Ok(Some(stamped)),
                Ok(None) => {}
                Err(error) => {
                    self.has_ended = true;
                    return Err(error);
                }
            }
        }
    }

    /// Reads a record. `None` if it contains no item, if its item still waits for a payload, or at the end.
    #[inline]
    fn read_record(&mut self, channels: &mut ChannelList) -> io::Result<Option<Stamped>> {
        let next = if self.left == Some(0) { None } else { record_of(&self.records, self.id_len, &mut self.stream)? };
        let Some((index, len)) = next else {
            self.has_ended = true;
            return self.check_waiting().map(|()| None);
        };
        if let Some(left) = &mut self.left {
            *left -= 1;
        }
        let event = match &self.records[index].content {
            Content::Event(event) => event,
            Content::Values => return self.read_value(index, len, channels).map(|()| None),
            Content::Other => {
                let is_whole = self.stream.skip(len as u64)?;
                let time_ns = self.latest_ns;
                return if is_whole { Ok(Some(Stamped { time_ns, item: Item::Other })) } else { Err(cut_record(len)) };
            }
        };
        let bytes = self.stream.fill(len)?;
        let record = bytes.get(self.id_len..len).ok_or_else(|| cut_record(len))?;
        let values = match (&mut self.outside[index], event.payload) {
            (Outside::Signal(values), Payload::Signal(offset, _)) => Some(values.value(offset.number(record))?),
            (Outside::Group(_, values), Payload::Group(offset, _)) => {
                match values.take(offset.number(record), record)? {
                    Some(value) => Some(value),
                    None => {
                        self.stream.consume(len);
                        return Ok(None);
                    }
                }
            }
            _ => None,
        };
        let stamped = stamped(event, record, values, self.first_channel, channels);
        self.latest_ns = stamped.time_ns;
        self.stream.consume(len);
        Ok(Some(stamped))
    }

    /// Reads a value of variable length, and makes the items of the records that waited for it.
    fn read_value(&mut self, group: usize, head: usize, channels: &mut ChannelList) -> io::Result<()> {
        let bytes = self.stream.fill(head)?;
        if bytes.len() < head {
            return Err(cut_record(head));
        }
        let len = u32_at(bytes, self.id_len, false) as usize;
        self.stream.consume(head);
        let is_of_group = |outside: &Outside| matches!(outside, Outside::Group(values, _) if *values == group);
        let Some(index) = self.outside.iter().position(is_of_group) else {
            return if self.stream.skip(len as u64)? { Ok(()) } else { Err(cut_record(len)) };
        };
        let (Outside::Group(_, values), Content::Event(event)) =
            (&mut self.outside[index], &self.records[index].content)
        else {
            return Ok(());
        };
        values.push(&mut self.stream, len)?;
        let Payload::Group(offset, _) = event.payload else { return Ok(()) };
        while let Some(record) = values.pop_waiting() {
            let Some(value) = values.find(offset.number(&record)) else {
                values.wait_again(record);
                break;
            };
            self.ready.push_back(stamped(event, &record, Some(value), self.first_channel, channels));
        }
        Ok(())
    }

    /// Fails if a record still waits for its payload at the end.
    fn check_waiting(&self) -> io::Result<()> {
        let waiting = |outside: &Outside| match outside {
            Outside::Group(_, values) => values.waiting_records(),
            _ => 0,
        };
        match self.outside.iter().map(waiting).sum::<usize>() {
            0 => Ok(()),
            count => Err(cut(format!("the file ends before the data of {count} frames"))),
        }
    }
}

/// Index of the next record's group, and length of the record including its ID. For a value of variable length, the
/// length covers only the ID and the length field, not the value. `None` at the end.
#[inline]
fn record_of(
    records: &[RecordGroup],
    id_len: usize,
    stream: &mut ByteStream<DataBlocks>,
) -> io::Result<Option<(usize, usize)>> {
    let head = stream.fill(id_len.max(1))?;
    if head.is_empty() {
        return Ok(None);
    }
    let index = if id_len == 0 {
        0
    } else {
        let mut id = [0; 8];
        let found = head.get(..id_len).ok_or_else(|| cut_record(id_len))?;
        id[..id_len].copy_from_slice(found);
        let id = u64::from_le_bytes(id);
        let index = records.binary_search_by_key(&id, |records| records.id);
        index.map_err(|_| damaged(format!("record of group {id}, which the file does not describe")))?
    };
    let records = &records[index];
    let len = if matches!(records.content, Content::Values) { 4 } else { records.len };
    match id_len + len {
        0 => Err(damaged("records without bytes")),
        len => Ok(Some((index, len))),
    }
}

#[inline]
fn stamped(
    event: &Event,
    record: &[u8],
    values: Option<Result<&[u8], String>>,
    first_channel: u32,
    channels: &mut ChannelList,
) -> Stamped {
    let time_ns = event.time_ns(record);
    let item = match (channels.of_number(event.channel(record), first_channel), values) {
        (None, _) => Item::Bad("more than 256 channels".to_owned()),
        (_, Some(Err(text))) => Item::Bad(text),
        (Some(channel), Some(Ok(values))) => event.item(record, Some(values), time_ns, channel),
        (Some(channel), None) => event.item(record, None, time_ns, channel),
    };
    Stamped { time_ns, item }
}

fn cut_record(len: usize) -> io::Error {
    cut(format!("the file ends in a record of {len} bytes"))
}
