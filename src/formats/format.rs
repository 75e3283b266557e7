//! Finds the format of a log from its first bytes.

use std::fs::File;
use std::io::{self, Read};

use crate::LogReader;

/// A log format of another tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {}

/// An open log.
pub struct Source {
    /// The decompressed bytes from the start of the file.
    pub reader: Box<dyn Read>,
    /// The file itself if it is a regular file and not compressed. Formats that are not read from start to end use it.
    pub file: Option<File>,
}

impl Format {
    /// Number of bytes from which [`recognise`](Self::recognise) finds every format.
    pub const HEAD_BYTES: usize = 16 * 1024;

    /// Finds the format from the first bytes of a log (at most [`HEAD_BYTES`](Self::HEAD_BYTES) are needed). `None` =
    /// none of these formats.
    pub fn recognise(head: &[u8]) -> Option<Self> {
        let _ = head;
        None
    }

    /// Opens a log of this format.
    ///
    /// # Errors
    /// Fails if the source cannot be read or its header is damaged.
    pub fn open(self, source: Source) -> io::Result<Box<dyn LogReader>> {
        let _ = source;
        match self {}
    }

    /// Name of the format, for messages: "Vector ASC".
    pub fn name(self) -> &'static str {
        match self {}
    }
}
