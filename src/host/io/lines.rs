//! Reads the lines of a plain, gzip or zstd file in large blocks. The lines are borrowed without copying.
//!
//! The compression is detected from the content, not from the file name. A line longer than the block is returned as
//! [`RawLine::TooLong`] and skipped to its end. Bytes read from the file are counted for the progress bar. Compressed
//! files are decompressed on a separate thread.

mod read_ahead;

use std::io::{self, Cursor, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::segments::JoinedFiles;
use read_ahead::ReadAhead;

/// Number of bytes read at once from the file or the decompressor, and longest accepted line. A CAN XL line has 4,200
/// bytes.
const BLOCK: usize = 256 * 1024;

/// Maximum number of lines per byte of a compressed log. In a log, each line has its own time, so even logs of parked
/// vehicles have at most 7 lines per byte. A file that contains only line feeds has 30,000 lines per byte.
const MAX_LINES_PER_BYTE: u64 = 50;
/// A compressed file smaller than this (bytes) may have as many lines as a file of this size.
const MIN_PACKED: u64 = 4096;

/// One line without its line feed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RawLine<'a> {
    /// A whole line.
    Whole(&'a [u8]),
    /// The file's last line if it has no line feed. Such a line may be incomplete.
    Last(&'a [u8]),
    /// A line longer than 256 KiB; it was skipped.
    TooLong,
}

/// Opens a log. `-` is standard input; gzip and zstd are decompressed. `read_bytes` counts the bytes read from the
/// file.
///
/// # Errors
/// Fails if the file cannot be opened or its first bytes cannot be read.
pub fn open(path: &Path, read_bytes: &Arc<AtomicU64>) -> io::Result<Box<dyn Read>> {
    open_parts(&[path.to_owned()], read_bytes)
}

/// Like [`open`], for several files that together form one log.
pub(super) fn open_parts(paths: &[PathBuf], read_bytes: &Arc<AtomicU64>) -> io::Result<Box<dyn Read>> {
    let is_standard_input = paths.iter().any(|path| path == Path::new("-"));
    let raw: Box<dyn Read + Send> =
        if is_standard_input { Box::new(io::stdin()) } else { Box::new(JoinedFiles::open(paths)?) };
    let mut counted = CountingReader { inner: raw, bytes: Arc::clone(read_bytes) };
    let mut magic = Vec::with_capacity(4);
    (&mut counted).take(4).read_to_end(&mut magic)?;
    let (gzip, zstd) = (magic.starts_with(&[0x1F, 0x8B]), magic == [0x28, 0xB5, 0x2F, 0xFD]);
    let packed = Arc::<AtomicU64>::default();
    let whole = CountingReader { inner: Box::new(Cursor::new(magic).chain(counted)), bytes: Arc::clone(&packed) };
    let decoder: Box<dyn Read + Send> = if gzip {
        Box::new(flate2::bufread::MultiGzDecoder::new(io::BufReader::with_capacity(BLOCK, whole)))
    } else if zstd {
        Box::new(zstd::stream::read::Decoder::new(whole)?)
    } else {
        return Ok(Box::new(whole));
    };
    Ok(Box::new(ReadAhead::new(ExpansionLimit { decoder, packed, lines: 0 }, BLOCK)?))
}

/// Stops reading a compressed file that has far more lines than a log can have. Otherwise, a file of a few bytes
/// could occupy the reader for minutes.
struct ExpansionLimit {
    decoder: Box<dyn Read + Send>,
    packed: Arc<AtomicU64>,
    lines: u64,
}

impl Read for ExpansionLimit {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.decoder.read(buffer)?;
        self.lines += memchr::memchr_iter(b'\n', &buffer[..count]).count() as u64;
        let packed = self.packed.load(Ordering::Relaxed);
        if self.lines > MAX_LINES_PER_BYTE * packed.max(MIN_PACKED) {
            let what = format!(
                "{packed} compressed bytes contain more than {} lines, must be a log of at most {MAX_LINES_PER_BYTE} lines per byte",
                self.lines
            );
            return Err(io::Error::new(io::ErrorKind::InvalidData, what));
        }
        Ok(count)
    }
}

struct CountingReader {
    inner: Box<dyn Read + Send>,
    bytes: Arc<AtomicU64>,
}

impl Read for CountingReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.inner.read(buffer)?;
        self.bytes.fetch_add(count as u64, Ordering::Relaxed);
        Ok(count)
    }
}

/// Reads a source line by line.
pub struct Lines {
    source: Box<dyn Read>,
    buffer: Vec<u8>,
    /// Start of the unread part of the buffer.
    start: usize,
    end: usize,
    number: u64,
    ended: bool,
}

impl Lines {
    /// Creates a reader of the lines of `source`.
    pub fn new(source: Box<dyn Read>) -> Self {
        Self { source, buffer: vec![0; BLOCK], start: 0, end: 0, number: 0, ended: false }
    }

    /// Number of the line last returned, from 1.
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Bytes read but not yet returned. These bytes may end within a line, and may be empty although the source has not
    /// ended.
    #[inline]
    pub(super) fn unread(&self) -> &[u8] {
        &self.buffer[self.start..self.end]
    }

    /// Consumes the first `len` bytes of [`unread`](Self::unread), which are `count` lines with their line feeds.
    #[inline]
    pub(super) fn take_lines(&mut self, len: usize, count: u64) {
        debug_assert_eq!(memchr::memchr_iter(b'\n', &self.unread()[..len]).count() as u64, count, "whole lines");
        debug_assert!(len == 0 || self.unread()[len - 1] == b'\n', "the last line is complete too");
        self.start += len;
        self.number += count;
    }

    /// The next line, or `None` at the end.
    ///
    /// # Errors
    /// Returns the errors of the source, such as a damaged compressed file.
    pub fn next_line(&mut self) -> io::Result<Option<RawLine<'_>>> {
        let mut searched = self.start;
        let mut too_long = false;
        loop {
            if let Some(offset) = memchr::memchr(b'\n', &self.buffer[searched..self.end]) {
                let line = self.start..searched + offset;
                self.start = line.end + 1;
                self.number += 1;
                return Ok(Some(if too_long { RawLine::TooLong } else { RawLine::Whole(&self.buffer[line]) }));
            }
            if self.end - self.start == self.buffer.len() {
                too_long = true;
                self.start = self.end;
            }
            self.make_room();
            searched = self.end;
            if !self.fill()? {
                return Ok(self.last(too_long));
            }
        }
    }

    /// Returns the first line, without its line feed, and does not consume it. Must be called before any line is
    /// consumed. If the line is longer than the buffer, returns its beginning.
    pub fn peek(&mut self) -> io::Result<&[u8]> {
        loop {
            let unread = self.start..self.end;
            if let Some(offset) = memchr::memchr(b'\n', &self.buffer[unread.clone()]) {
                return Ok(&self.buffer[unread.start..unread.start + offset]);
            }
            if unread.len() == self.buffer.len() || !self.fill()? {
                return Ok(&self.buffer[self.start..self.end]);
            }
        }
    }

    /// Returns the first bytes and does not consume them: at least `len` (at most 256 KiB) bytes, or the whole source
    /// if it is shorter. Must be called before any line is consumed.
    #[cfg(feature = "formats")]
    pub(super) fn peek_bytes(&mut self, len: usize) -> io::Result<&[u8]> {
        while self.unread().len() < len.min(self.buffer.len()) && self.fill()? {}
        Ok(self.unread())
    }

    /// The unread bytes and the rest of the source as one reader.
    pub fn into_reader(self) -> impl Read {
        Cursor::new(self.buffer[self.start..self.end].to_vec()).chain(self.source)
    }

    fn make_room(&mut self) {
        self.buffer.copy_within(self.start..self.end, 0);
        self.end -= self.start;
        self.start = 0;
    }

    fn fill(&mut self) -> io::Result<bool> {
        if self.ended {
            return Ok(false);
        }
        let count = loop {
            match self.source.read(&mut self.buffer[self.end..]) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => {
                    self.ended = true;
                    return Err(error);
                }
                Ok(count) => break count,
            }
        };
        self.end += count;
        self.ended = count == 0;
        Ok(count > 0)
    }

    fn last(&mut self, too_long: bool) -> Option<RawLine<'_>> {
        let line = self.start..self.end;
        self.start = self.end;
        if line.is_empty() && !too_long {
            return None;
        }
        self.number += 1;
        Some(if too_long { RawLine::TooLong } else { RawLine::Last(&self.buffer[line]) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(text: &[u8]) -> Vec<(usize, bool)> {
        let mut lines = Lines::new(Box::new(Cursor::new(text.to_vec())));
        let mut seen = Vec::new();
        while let Some(line) = lines.next_line().expect("memory reads") {
            seen.push(match line {
                RawLine::Whole(bytes) => (bytes.len(), true),
                RawLine::Last(bytes) => (bytes.len(), false),
                RawLine::TooLong => (usize::MAX, false),
            });
        }
        seen
    }

    #[test]
    fn last_line_without_line_feed_is_marked() {
        assert_eq!(all(b"ab\n\nc"), [(2, true), (0, true), (1, false)]);
        assert_eq!(all(b""), []);
    }

    #[test]
    fn overlong_line_is_skipped() {
        let mut text = vec![b'x'; 3 * BLOCK + 5];
        text.extend(b"\nshort\n");
        assert_eq!(all(&text), [(usize::MAX, false), (5, true)]);
    }

    #[test]
    fn endless_expansion_ends_with_error() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("bomb.log.zst");
        for (line, is_log) in [("\n", false), ("(1.000000) can0 123#00\n", false), ("", true)] {
            let text = match is_log {
                true => (0..400_000).map(|n| format!("({n}.000000) can0 123#00\n")).collect(),
                false => line.repeat((32 << 20) / line.len()),
            };
            std::fs::write(&path, zstd::bulk::compress(text.as_bytes(), 1).expect("compressed")).expect("written");
            let mut lines = Lines::new(open(&path, &Arc::default()).expect("opened"));
            let error = loop {
                match lines.next_line() {
                    Ok(Some(_)) => {}
                    Ok(None) => break None,
                    Err(error) => break Some(error.to_string()),
                }
            };
            assert_eq!(error.is_none(), is_log, "{error:?}");
            assert!(is_log || lines.number() < 20_000_000, "{}", lines.number());
        }
    }

    #[test]
    fn lines_across_blocks_are_whole() {
        let text: Vec<u8> = (0..100_000).flat_map(|n| format!("{n}\n").into_bytes()).collect();
        let lengths: Vec<_> = (0..100_000).map(|n| (n.to_string().len(), true)).collect();
        assert_eq!(all(&text), lengths);
    }
}
