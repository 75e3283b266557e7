//! Reads ASAM MDF 4 files with bus logging, as CANedge and other tools write them. A file has a group of records for
//! each kind of frame and each channel.
//!
//! Sorted groups are read in parallel and merged by their times. Unsorted data contain the records of several groups
//! one after another; these are returned in the order of the file. Unfinalized files, whose recorder lost its supply,
//! are read up to their end. If the data of one group are damaged, the other groups are still read, and the damage is
//! reported after the last frame. Source: files of CANedge, asammdf and python-can, which show the parts of
//! ASAM MDF 4.1 and of its bus-logging standard that this reader needs.

mod blocks;
mod data;
mod event;
mod field;
mod group;
mod layout;
mod values;
mod writer;

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::io::{self, Seek, SeekFrom};
use std::rc::Rc;

use self::blocks::MdfFile;
use self::group::{GroupReader, Stamped};
pub use self::writer::Mf4Writer;
use crate::channel_list::ChannelList;
use crate::{Channel, Item, LogReader, Position, Source};

/// First bytes of a finalized and of an unfinalized file.
pub(crate) const MAGICS: [&[u8]; 2] = [b"MDF     4", b"UnFinMF 4"];

/// Reads an MF4 file.
pub(crate) struct Mf4Reader {
    groups: Vec<GroupReader>,
    /// Next item of each group.
    next: Vec<Option<Stamped>>,
    /// Groups by the time of their next item. The current group is not in the queue.
    queue: BinaryHeap<Reverse<(i64, usize)>>,
    current: Option<usize>,
    channels: ChannelList,
    /// First damage, reported at the end.
    damage: Option<io::Error>,
    /// Groups that cannot be read, reported first.
    notes: Vec<String>,
    at: u64,
}

impl Mf4Reader {
    /// Reads the description of the groups.
    ///
    /// # Errors
    /// Fails if the source cannot be read, if its description is damaged, or if it has no frames of a CAN bus.
    pub(crate) fn open(source: Source) -> io::Result<Self> {
        let file = match source.file {
            Some(file) => file,
            None => {
                // This anonymous file is deleted by the system.
                let mut file = tempfile::tempfile()?;
                let mut reader = source.reader;
                io::copy(&mut reader, &mut file)?;
                file.seek(SeekFrom::Start(0))?;
                file
            }
        };
        let layout = layout::read(Rc::new(MdfFile::open(file)?))?;
        let mut groups = Vec::new();
        let (mut damage, mut lowest) = (layout.damage, None);
        for group in layout.groups {
            let data = group.data;
            match GroupReader::open(group) {
                Ok(group) => {
                    lowest = [lowest, group.lowest_channel(data)].into_iter().flatten().min();
                    groups.push(group);
                }
                Err(error) => damage = damage.or(Some(error)),
            }
        }
        // Most recorders count channels from 1, some from 0.
        groups.iter_mut().for_each(|group| group.set_first_channel(lowest.unwrap_or(1).min(1)));
        let mut reader = Self {
            next: groups.iter().map(|_| None).collect(),
            groups,
            queue: BinaryHeap::new(),
            current: None,
            channels: ChannelList::default(),
            damage,
            notes: layout.notes,
            at: 0,
        };
        for index in 0..reader.groups.len() {
            reader.advance(index);
        }
        Ok(reader)
    }

    /// Reads the next item of a group and enqueues the group.
    fn advance(&mut self, index: usize) {
        match self.groups[index].next_item(&mut self.channels) {
            Ok(Some(stamped)) => {
                self.queue.push(Reverse((stamped.time_ns, index)));
                self.next[index] = Some(stamped);
            }
            Ok(None) => {}
            Err(error) => {
                self.at = self.groups[index].position();
                self.damage.get_or_insert(error);
            }
        }
    }

    /// Returns the next item in order of time. The current group is put into the queue only when another group is
    /// earlier.
    fn next_stamped(&mut self) -> Option<Stamped> {
        if let Some(index) = self.current {
            let group = &mut self.groups[index];
            match group.next_item(&mut self.channels) {
                Ok(Some(stamped)) => {
                    let first = self.queue.peek();
                    if first.is_none_or(|Reverse(first)| (stamped.time_ns, index) <= *first) {
                        self.at = group.position();
                        return Some(stamped);
                    }
                    self.queue.push(Reverse((stamped.time_ns, index)));
                    self.next[index] = Some(stamped);
                }
                Ok(None) => {}
                Err(error) => {
                    self.at = group.position();
                    self.damage.get_or_insert(error);
                }
            }
            self.current = None;
        }
        let Reverse((_, index)) = self.queue.pop()?;
        self.current = Some(index);
        self.at = self.groups[index].position();
        self.next[index].take()
    }
}

impl LogReader for Mf4Reader {
    fn next_item(&mut self) -> io::Result<Option<Item>> {
        if let Some(note) = self.notes.pop() {
            return Ok(Some(Item::Bad(note)));
        }
        match self.next_stamped() {
            Some(stamped) => Ok(Some(stamped.item)),
            None => self.damage.take().map_or(Ok(None), Err),
        }
    }

    fn position(&self) -> Position {
        Position::Byte(self.at)
    }

    fn channels(&self) -> &[Channel] {
        self.channels.as_slice()
    }
}

#[cfg(test)]
mod tests;
