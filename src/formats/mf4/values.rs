//! Reads payloads outside of the records: values of variable length, each preceded by its length.

use std::collections::VecDeque;
use std::io::{self, Read};
use std::rc::Rc;

use super::blocks::MdfFile;
use super::data::DataBlocks;
use crate::byte_stream::{ByteStream, cut, damaged, u32_at};

/// Longest value, bytes: the payload of a CAN frame.
const MAX_VALUE: usize = 64;
/// Size of the length before a value, bytes.
const LENGTH: usize = 4;
/// Maximum number of values without a record, and of records without a value, in unsorted data. A sound file needs few,
/// because recorders write a record and its value next to each other.
const MAX_WAITING: usize = 16_384;
/// If an offset is smaller than the offset before it, the signal data are read from the start again. Maximum number of
/// such restarts.
const MAX_RESTARTS: usize = 1000;

/// Values of sorted groups, in blocks of their own.
pub(super) struct SignalValues {
    file: Rc<MdfFile>,
    link: u64,
    stream: ByteStream<DataBlocks>,
    restarts: usize,
}

impl SignalValues {
    pub(super) fn open(file: &Rc<MdfFile>, link: u64) -> io::Result<Self> {
        let stream = ByteStream::new(DataBlocks::open(file, link)?);
        Ok(Self { file: Rc::clone(file), link, stream, restarts: 0 })
    }

    /// Returns the value at an offset. The inner error means that the value is longer than any payload of a frame.
    ///
    /// # Errors
    /// Fails if the data cannot be read or end before the value.
    pub(super) fn value(&mut self, offset: u64) -> io::Result<Result<&[u8], String>> {
        if offset < self.stream.offset() {
            self.restarts += 1;
            if self.restarts > MAX_RESTARTS {
                return Err(damaged(format!("the offsets of the data go back more than {MAX_RESTARTS} times")));
            }
            self.stream = ByteStream::new(DataBlocks::open(&self.file, self.link)?);
        }
        self.stream.skip(offset - self.stream.offset())?;
        let head = self.stream.fill(LENGTH)?;
        if head.len() < LENGTH {
            return Err(cut(format!("the signal data end before the value at offset {offset}")));
        }
        let len = u32_at(head, 0, false) as usize;
        if len > MAX_VALUE {
            return Ok(Err(too_long(len)));
        }
        let bytes = self.stream.fill(LENGTH + len)?;
        let value = bytes.get(LENGTH..LENGTH + len);
        value.map(Ok).ok_or_else(|| cut(format!("the signal data end in the value at offset {offset}")))
    }
}

/// Values of unsorted data. Each value and its record may come in any order.
pub(super) struct ValueGroup {
    has_offsets: bool,
    /// Offset of the next value.
    end: u64,
    values: VecDeque<Value>,
    records: VecDeque<Vec<u8>>,
    /// The value returned last, if values have no offsets.
    current: Value,
}

/// A value. If it is longer than a frame, only its length is known.
#[derive(Clone, Copy)]
struct Value {
    offset: u64,
    len: u32,
    bytes: [u8; MAX_VALUE],
}

impl Value {
    fn get(&self) -> Result<&[u8], String> {
        self.bytes.get(..self.len as usize).ok_or_else(|| too_long(self.len as usize))
    }
}

impl ValueGroup {
    /// If `has_offsets` is true, the records state valid offsets. Otherwise values and records are matched by their
    /// order.
    pub(super) fn new(has_offsets: bool) -> Self {
        let current = Value { offset: 0, len: 0, bytes: [0; MAX_VALUE] };
        Self { has_offsets, end: 0, values: VecDeque::new(), records: VecDeque::new(), current }
    }

    /// Reads a value of `len` bytes.
    ///
    /// # Errors
    /// Fails if the data cannot be read or end in the value, or if too many values wait.
    pub(super) fn push<R: Read>(&mut self, stream: &mut ByteStream<R>, len: usize) -> io::Result<()> {
        let mut value = Value { offset: self.end, len: len as u32, bytes: [0; MAX_VALUE] };
        if len <= MAX_VALUE {
            let bytes = stream.fill(len)?;
            if bytes.len() < len {
                return Err(cut(format!("the file ends in a value of {len} bytes")));
            }
            value.bytes[..len].copy_from_slice(&bytes[..len]);
        }
        if !stream.skip(len as u64)? {
            return Err(cut(format!("the file ends in a value of {len} bytes")));
        }
        self.end += (LENGTH + len) as u64;
        if self.values.len() == MAX_WAITING {
            return Err(damaged(format!("more than {MAX_WAITING} values without a record")));
        }
        self.values.push_back(value);
        Ok(())
    }

    /// The value of a record; `None` = the value has not been read, and the record waits for it.
    ///
    /// # Errors
    /// Fails if too many records wait.
    #[inline]
    pub(super) fn take(&mut self, offset: u64, record: &[u8]) -> io::Result<Option<Result<&[u8], String>>> {
        if self.records.is_empty() && self.is_known(offset) {
            return Ok(self.find(offset));
        }
        if self.records.len() == MAX_WAITING {
            return Err(damaged(format!("more than {MAX_WAITING} records without their data")));
        }
        self.records.push_back(record.to_vec());
        Ok(None)
    }

    fn is_known(&self, offset: u64) -> bool {
        if self.has_offsets { offset < self.end } else { !self.values.is_empty() }
    }

    /// The value at an offset; `None` = it has not been read. Earlier values are dropped.
    pub(super) fn find(&mut self, offset: u64) -> Option<Result<&[u8], String>> {
        if !self.is_known(offset) {
            return None;
        }
        if !self.has_offsets {
            self.current = self.values.pop_front()?;
            return Some(self.current.get());
        }
        while self.values.front().is_some_and(|value| value.offset < offset) {
            self.values.pop_front();
        }
        match self.values.front() {
            Some(value) if value.offset == offset => Some(value.get()),
            _ => Some(Err(format!("no data of variable length at offset {offset}"))),
        }
    }

    /// The record that has waited longest.
    pub(super) fn pop_waiting(&mut self) -> Option<Vec<u8>> {
        self.records.pop_front()
    }

    /// Puts back the record that has waited longest.
    pub(super) fn wait_again(&mut self, record: Vec<u8>) {
        self.records.push_front(record);
    }

    /// Number of records without their value.
    pub(super) fn waiting_records(&self) -> usize {
        self.records.len()
    }
}

fn too_long(len: usize) -> String {
    format!("data of {len} bytes, must be at most {MAX_VALUE}")
}
