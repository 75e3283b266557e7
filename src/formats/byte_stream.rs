//! A window over a stream of bytes. Parsers read the next bytes from it without copying them.

use std::io::{self, Read};

/// Size of the window, bytes. Longer parts of a file can only be skipped.
pub(crate) const WINDOW: usize = 128 * 1024;

pub(crate) struct ByteStream<R> {
    source: R,
    window: Box<[u8]>,
    start: usize,
    end: usize,
    offset: u64,
}

impl<R: Read> ByteStream<R> {
    pub(crate) fn new(source: R) -> Self {
        Self { source, window: vec![0; WINDOW].into_boxed_slice(), start: 0, end: 0, offset: 0 }
    }

    /// Returns at least the next `len` bytes, or fewer at the end of the source. `len` must be at most [`WINDOW`].
    ///
    /// # Errors
    /// Fails if the source cannot be read. The bytes already in the window remain.
    #[inline]
    pub(crate) fn fill(&mut self, len: usize) -> io::Result<&[u8]> {
        if self.end - self.start < len {
            self.refill(len)?;
        }
        Ok(&self.window[self.start..self.end])
    }

    #[cold]
    fn refill(&mut self, len: usize) -> io::Result<()> {
        self.window.copy_within(self.start..self.end, 0);
        (self.start, self.end) = (0, self.end - self.start);
        while self.end < len.min(WINDOW) {
            match self.source.read(&mut self.window[self.end..]) {
                Ok(0) => break,
                Ok(count) => self.end += count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Moves past `len` bytes of the window.
    #[inline]
    pub(crate) fn consume(&mut self, len: usize) {
        debug_assert!(len <= self.end - self.start, "only bytes of the window can be consumed");
        self.start += len;
        self.offset += len as u64;
    }

    /// Moves past `len` bytes. Returns whether the source had them all.
    pub(crate) fn skip(&mut self, mut len: u64) -> io::Result<bool> {
        while len > 0 {
            let held = self.fill(1)?.len();
            if held == 0 {
                return Ok(false);
            }
            let step = held.min(usize::try_from(len).unwrap_or(held));
            self.consume(step);
            len -= step as u64;
        }
        Ok(true)
    }

    /// Moves to the next position, at least `from` bytes ahead, where the stream contains `mark`. Returns whether there
    /// is one.
    pub(crate) fn find(&mut self, from: usize, mark: &[u8]) -> io::Result<bool> {
        self.skip(from as u64)?;
        loop {
            let held = self.fill(mark.len())?;
            if held.len() < mark.len() {
                return Ok(false);
            }
            if let Some(at) = held.windows(mark.len()).position(|part| part == mark) {
                self.consume(at);
                return Ok(true);
            }
            let step = held.len() + 1 - mark.len();
            self.consume(step);
        }
    }

    /// Skips the bytes in the window.
    pub(crate) fn clear(&mut self) {
        self.consume(self.end - self.start);
    }

    /// Number of bytes consumed.
    pub(crate) fn offset(&self) -> u64 {
        self.offset
    }

    pub(crate) fn source(&self) -> &R {
        &self.source
    }
}

/// Little-endian or big-endian number of 2 bytes at `at`. The caller has checked the length.
pub(crate) fn u16_at(bytes: &[u8], at: usize, big_endian: bool) -> u16 {
    let part = [bytes[at], bytes[at + 1]];
    if big_endian { u16::from_be_bytes(part) } else { u16::from_le_bytes(part) }
}

/// Little-endian or big-endian number of 4 bytes at `at`. The caller has checked the length.
pub(crate) fn u32_at(bytes: &[u8], at: usize, big_endian: bool) -> u32 {
    let part = [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
    if big_endian { u32::from_be_bytes(part) } else { u32::from_le_bytes(part) }
}

/// Little-endian number of 8 bytes at `at`. The caller has checked the length.
pub(crate) fn u64_at(bytes: &[u8], at: usize) -> u64 {
    let mut part = [0; 8];
    part.copy_from_slice(&bytes[at..at + 8]);
    u64::from_le_bytes(part)
}

pub(crate) fn damaged(what: impl Into<String>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what.into())
}

pub(crate) fn cut(what: impl Into<String>) -> io::Error {
    io::Error::new(io::ErrorKind::UnexpectedEof, what.into())
}
