//! Limits the bytes of one row, because a compressed file of a few kilobytes may expand to one line of gigabytes.
//!
//! In: the source of the table. Out: the same bytes, or an error after more than [`MAX_ROW_BYTES`] without the end of a
//! row.

use std::cell::Cell;
use std::io::{Error, ErrorKind, Read, Result};
use std::rc::Rc;

/// Maximum length of a row in bytes, including bytes that are read ahead. The largest pack has 3,000 columns of 20
/// bytes.
pub(super) const MAX_ROW_BYTES: usize = 1 << 20;

pub(super) struct RowLimit {
    source: Box<dyn Read>,
    since_row: Rc<Cell<usize>>,
}

impl RowLimit {
    /// Limits a source. The caller resets the counter to 0 after every row.
    pub(super) fn new(source: Box<dyn Read>) -> (Self, Rc<Cell<usize>>) {
        let since_row = Rc::new(Cell::new(0));
        (Self { source, since_row: Rc::clone(&since_row) }, since_row)
    }
}

pub(super) fn too_long() -> Error {
    Error::new(ErrorKind::InvalidData, format!("row too long, must be at most {MAX_ROW_BYTES} bytes"))
}

impl Read for RowLimit {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize> {
        if self.since_row.get() > MAX_ROW_BYTES {
            return Err(too_long());
        }
        let read = self.source.read(buffer)?;
        self.since_row.set(self.since_row.get() + read);
        Ok(read)
    }
}
