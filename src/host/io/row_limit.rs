//! Bounds what a table's reader takes for one row: a packed file of a few kilobytes may unpack to one line of gigabytes.
//!
//! In: the source of the table. Out: the same bytes, or an error once more than [`MAX_ROW_BYTES`] came since the last row.

use std::cell::Cell;
use std::io::{Error, ErrorKind, Read, Result};
use std::rc::Rc;

/// Longest row, bytes, with what is read ahead: the largest pack has 3,000 columns of 20 bytes.
pub(super) const MAX_ROW_BYTES: usize = 1 << 20;

/// A source that ends with an error where a row is too long.
pub(super) struct RowLimit {
    source: Box<dyn Read>,
    since_row: Rc<Cell<usize>>,
}

impl RowLimit {
    /// Limits a source. The caller sets the counter to 0 with every row.
    pub(super) fn new(source: Box<dyn Read>) -> (Self, Rc<Cell<usize>>) {
        let since_row = Rc::new(Cell::new(0));
        (Self { source, since_row: Rc::clone(&since_row) }, since_row)
    }
}

impl Read for RowLimit {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize> {
        if self.since_row.get() > MAX_ROW_BYTES {
            let error = format!("a row of more than {MAX_ROW_BYTES} bytes, must be at most that many");
            return Err(Error::new(ErrorKind::InvalidData, error));
        }
        let read = self.source.read(buffer)?;
        self.since_row.set(self.since_row.get() + read);
        Ok(read)
    }
}
