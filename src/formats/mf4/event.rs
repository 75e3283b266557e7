//! Decodes the records of CAN bus events, and turns them into frames and error frames.

use packwatch_core::quantity::Timestamp;

use super::field::Field;
use crate::Item;
use crate::raw_frame::{RawFrame, length_of_code};

/// Flag in the identifier that marks a 29-bit identifier. It is used if the record has no field for this mark.
const EXTENDED: u64 = 1 << 31;
/// Identifier without flags.
const ID_BITS: u64 = 0x1FFF_FFFF;
/// Classes of errors in SocketCAN: violation of the protocol, no acknowledgement.
const PROTOCOL_ERROR: u32 = 8;
const NO_ACKNOWLEDGEMENT: u32 = 0x20;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum EventKind {
    Data,
    Remote,
    Error,
}

impl EventKind {
    /// The kind of the event that a channel of this name belongs to.
    pub(super) fn of_channel(name: &str) -> Option<Self> {
        match name.split('.').next()? {
            "CAN_DataFrame" => Some(Self::Data),
            "CAN_RemoteFrame" => Some(Self::Remote),
            "CAN_ErrorFrame" => Some(Self::Error),
            _ => None,
        }
    }
}

/// Where the payload of an event is.
#[derive(Debug, Clone, Copy)]
pub(super) enum Payload {
    None,
    /// In the record: first byte and length.
    Fixed(usize, usize),
    /// In a block of signal data: the record's field with the offset of the payload in the block, and the link to the
    /// block.
    Signal(Field, u64),
    /// In the records of another channel group in the same data block: the record's field with the offset of the
    /// payload, and the address of this group.
    Group(Field, u64),
}

/// Fields of an event. A field that the file does not have is `None`.
#[derive(Debug)]
pub(super) struct Event {
    pub(super) kind: EventKind,
    pub(super) time: Field,
    pub(super) id: Option<Field>,
    pub(super) extended: Option<Field>,
    pub(super) code: Option<Field>,
    pub(super) len: Option<Field>,
    pub(super) channel: Option<Field>,
    pub(super) is_fd: Option<Field>,
    pub(super) brs: Option<Field>,
    pub(super) esi: Option<Field>,
    pub(super) error: Option<Field>,
    pub(super) payload: Payload,
    /// Start of the recording, Unix time.
    pub(super) start_ns: i64,
}

impl Event {
    /// Time of a record, ns of Unix time. Floating-point seconds are rounded to a microsecond.
    #[inline]
    pub(super) fn time_ns(&self, record: &[u8]) -> i64 {
        let nanos = self.start_ns.saturating_add(self.time.nanos(record));
        if !self.time.is_float_seconds() {
            return nanos;
        }
        nanos.saturating_add(500).div_euclid(1000).saturating_mul(1000)
    }

    /// Channel number as written; 1 if the record has no field for it.
    #[inline]
    pub(super) fn channel(&self, record: &[u8]) -> u32 {
        self.channel.map_or(1, |field| u32::try_from(field.number(record)).unwrap_or(u32::MAX))
    }

    /// Converts a record to an item. `values` is the payload if it is outside of the record.
    #[inline]
    pub(super) fn item(&self, record: &[u8], values: Option<&[u8]>, time_ns: i64, channel: u8) -> Item {
        let time = Timestamp::from_nanos(time_ns);
        if self.kind == EventKind::Error {
            let class = self.error.map_or(0, |field| error_class(field.number(record)));
            return Item::ErrorFrame { time, channel, class };
        }
        match self.frame(record, values).map(RawFrame::check) {
            Ok(Ok(frame)) => Item::Frame { time, channel, frame },
            Ok(Err(text)) | Err(text) => Item::Bad(text),
        }
    }

    #[inline]
    fn frame<'a>(&self, record: &'a [u8], values: Option<&'a [u8]>) -> Result<RawFrame<'a>, String> {
        let is_set = |field: Option<Field>| field.is_some_and(|field| field.number(record) != 0);
        let id = self.id.map_or(0, |field| field.number(record));
        let extended = match self.extended {
            Some(field) => field.number(record) != 0,
            None => id & EXTENDED != 0 || id & ID_BITS > 0x7FF,
        };
        let remote = self.kind == EventKind::Remote;
        let stored = match self.payload {
            Payload::Fixed(first, len) => &record[first..first + len],
            _ => values.unwrap_or(&[]),
        };
        let is_fd = is_set(self.is_fd) || (self.is_fd.is_none() && stored.len() > 8 && values.is_some());
        let code = self.code.map(|field| length_of_code(field.number(record).min(15) as u8, is_fd));
        let stated = self.len.map(|field| usize::try_from(field.number(record)).unwrap_or(usize::MAX));
        let fd = is_fd.then(|| (is_set(self.brs), is_set(self.esi)));
        let id = (id & ID_BITS) as u32;
        if remote {
            // Some writers state the requested length only in the length code, and write a data length of 0.
            let len = code.or(stated).unwrap_or(0).min(8);
            return Ok(RawFrame { id, extended, remote, fd: None, data: &[0; 8][..len] });
        }
        let len = match (values, stated.or(code)) {
            (Some(values), None) => values.len(),
            (Some(values), Some(len)) => len.min(values.len()),
            (None, Some(len)) if len <= stored.len() => len,
            (None, len) => {
                let stored = stored.len();
                return Err(format!("frame of {} bytes in a record with {stored}", len.unwrap_or(0)));
            }
        };
        Ok(RawFrame { id, extended, remote, fd, data: &stored[..len] })
    }
}

/// SocketCAN class of an error type in the file: 1 bit, 2 form, 3 stuffing, 4 checksum, 5 acknowledgement.
fn error_class(error: u64) -> u32 {
    match error {
        1..=4 => PROTOCOL_ERROR,
        5 => NO_ACKNOWLEDGEMENT,
        _ => 0,
    }
}
