//! Reads Vector BLF files (binary logging format). A file has a header with the start date, then objects, which are
//! usually in compressed containers.
//!
//! The containers make up one stream of objects: an object may continue in the next container. After a damaged
//! container or object, reading continues at the next object mark. Sources: the field layout that Vector publishes with
//! its `binlog` interface, compared with the files that python-can writes.

mod container;
mod object;

use std::io;

use packwatch_core::quantity::Timestamp;

use self::container::Containers;
use crate::byte_stream::{ByteStream, WINDOW, cut, damaged, u16_at, u32_at};
use crate::channel_list::ChannelList;
use crate::text::date::midnight;
use crate::{Channel, Item, LogReader, Position, Source};

/// First bytes of a file.
pub(crate) const MAGIC: &[u8] = b"LOGG";
/// First bytes of an object.
const MARK: &[u8] = b"LOBJ";
/// Number of header bytes that are used here. It is also the size of the smallest possible header.
const HEADER_FIELDS: usize = 56;
/// Size of an object's first part, bytes.
const OBJECT_HEAD: usize = 16;
/// Maximum size of an object, bytes. A longer object must be damaged, because recorders write images and packets of at
/// most a few MiB.
const MAX_OBJECT: usize = 16 << 20;

pub(crate) struct BlfReader {
    objects: ByteStream<Containers>,
    start_ns: i64,
    channels: ChannelList,
    /// Whether the next object must be searched for, because the bytes before it are damaged.
    is_lost: bool,
}

impl BlfReader {
    /// Reads the header.
    ///
    /// # Errors
    /// Fails if the source cannot be read or its header is damaged.
    pub(crate) fn open(source: Source) -> io::Result<Self> {
        let mut file = ByteStream::new(source.reader);
        let head = file.fill(HEADER_FIELDS)?;
        if head.len() < HEADER_FIELDS {
            return Err(cut(format!("the file ends in its header after {} bytes, must have 144", head.len())));
        }
        let size = u32_at(head, 4, false) as usize;
        if !(HEADER_FIELDS..=WINDOW).contains(&size) {
            return Err(damaged(format!("header of {size} bytes, must be {HEADER_FIELDS} to {WINDOW} (usual: 144)")));
        }
        let date = std::array::from_fn(|part| u16_at(head, 40 + 2 * part, false));
        let start_ns = unix_ns(date).unwrap_or(0);
        file.skip(size as u64)?;
        let objects = ByteStream::new(Containers::new(file));
        Ok(Self { objects, start_ns, channels: ChannelList::default(), is_lost: false })
    }

    /// Reads the next object; `None` at the end.
    fn next_object(&mut self) -> io::Result<Option<Item>> {
        if self.is_lost {
            self.is_lost = false;
            if !self.objects.find(0, MARK)? {
                return Ok(None);
            }
        }
        let mut head = self.objects.fill(OBJECT_HEAD)?;
        if !head.starts_with(MARK) {
            // Writers pad objects with zeros, most of them to a multiple of four bytes.
            let first = &head[..head.len().min(OBJECT_HEAD)];
            let padding = first.iter().take_while(|byte| **byte == 0).count();
            if padding == first.len() {
                self.objects.consume(padding);
                return Ok((padding == OBJECT_HEAD).then_some(Item::Other));
            }
            self.objects.consume(padding);
            head = self.objects.fill(OBJECT_HEAD)?;
            if !head.starts_with(MARK) && head.len() >= MARK.len() {
                self.is_lost = true;
                return Ok(Some(Item::Bad("no object mark LOBJ at the end of the object before".to_owned())));
            }
        }
        if head.len() < OBJECT_HEAD {
            return Err(cut("the file ends in the head of an object"));
        }
        let [size, kind] = [8, 12].map(|at| u32_at(head, at, false));
        let size = size as usize;
        let largest = if object::is_of_can(kind) { object::MAX_CAN_OBJECT } else { MAX_OBJECT };
        if !(OBJECT_HEAD..=largest).contains(&size) {
            self.objects.consume(MARK.len());
            self.is_lost = true;
            let text = format!("object of kind {kind} and {size} bytes, must be {OBJECT_HEAD} to {largest} bytes");
            return Ok(Some(Item::Bad(text)));
        }
        if !object::is_of_can(kind) {
            let is_whole = self.objects.skip(size as u64)?;
            return if is_whole { Ok(Some(Item::Other)) } else { Err(cut("the file ends in an object")) };
        }
        let bytes = self.objects.fill(size)?;
        let Some(bytes) = bytes.get(..size) else {
            return Err(cut(format!("the file ends in an object of {size} bytes after {}", bytes.len())));
        };
        let item = object::decode(kind, bytes, self.start_ns, &mut self.channels);
        self.objects.consume(size);
        Ok(Some(item.unwrap_or_else(Item::Bad)))
    }
}

impl LogReader for BlfReader {
    fn next_item(&mut self) -> io::Result<Option<Item>> {
        match self.next_object() {
            // If a container is damaged, an object that continues in it is lost. The next container may be intact.
            Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                self.objects.clear();
                self.is_lost = true;
                Ok(Some(Item::Bad(error.to_string())))
            }
            result => result,
        }
    }

    fn position(&self) -> Position {
        Position::Byte(self.objects.source().position())
    }

    fn channels(&self) -> &[Channel] {
        self.channels.as_slice()
    }
}

/// Nanoseconds from 1970 to a date: year, month, day of the week, day, hour, minute, second, millisecond. The date has
/// no time zone and is read as UTC, as other readers do. `None` = not a date.
fn unix_ns([year, month, _, day, hour, minute, second, millisecond]: [u16; 8]) -> Option<i64> {
    if hour >= 24 || minute >= 60 || second > 60 || millisecond >= 1000 {
        return None;
    }
    let midnight_ns = midnight(year.into(), month.into(), day.into())?;
    let seconds = (i64::from(hour) * 60 + i64::from(minute)) * 60 + i64::from(second);
    midnight_ns.checked_add((seconds * 1000 + i64::from(millisecond)) * 1_000_000)
}

/// Time of an object, rounded to a microsecond: writers compute the offset from floating-point Unix times.
fn stamp(start_ns: i64, offset_ns: i64) -> Timestamp {
    let nanos = start_ns.saturating_add(offset_ns);
    Timestamp::from_nanos(nanos.saturating_add(500).div_euclid(1000).saturating_mul(1000))
}

#[cfg(test)]
mod tests;
