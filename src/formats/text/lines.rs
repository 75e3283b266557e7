//! Reads the lines of a text log.
//!
//! In: the bytes of a log in ASCII, UTF-8, Latin-1 or UTF-16; a byte-order mark is skipped. Out: lines without their line
//! ends, borrowed from a buffer of fixed size. A line ends with a line feed, a carriage return, or both. A line that is
//! longer than the buffer is skipped ([`Line::TooLong`]).

use std::borrow::Cow;
use std::io::{self, Cursor, Read};

/// Length of the buffer and longest accepted line, bytes. Logs of `candump -l` have their own reader in packwatch-host,
/// with the same limit.
const MAX_LINE: usize = 256 * 1024;

/// Byte-order marks of UTF-8, and of UTF-16 in both byte orders.
const UTF8_MARK: &[u8] = &[0xEF, 0xBB, 0xBF];
const UTF16_LE_MARK: &[u8] = &[0xFF, 0xFE];
const UTF16_BE_MARK: &[u8] = &[0xFE, 0xFF];

/// One line without its line end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Line<'a> {
    /// A whole line.
    Whole(&'a [u8]),
    /// The last line of a log if it has no line end. Such a line may be incomplete.
    Last(&'a [u8]),
    /// A line longer than 256 KiB; it was skipped.
    TooLong,
}

/// A source that is read line by line.
pub(super) struct Lines {
    source: Box<dyn Read>,
    buffer: Vec<u8>,
    /// Start of the unread part of the buffer.
    start: usize,
    end: usize,
    number: u64,
    has_ended: bool,
    /// Whether the last line ended with a carriage return. A line feed that follows belongs to the same line end.
    after_return: bool,
    /// Error of the source. It is reported after the lines that were read before it.
    error: Option<io::Error>,
}

impl Lines {
    /// Creates a reader of the lines of `source`.
    ///
    /// # Errors
    /// Returns the errors of the source.
    pub(super) fn new(source: Box<dyn Read>) -> io::Result<Self> {
        let source = decoded(source)?;
        let buffer = vec![0; MAX_LINE];
        Ok(Self { source, buffer, start: 0, end: 0, number: 0, has_ended: false, after_return: false, error: None })
    }

    /// Number of the line last returned, from 1.
    pub(super) fn number(&self) -> u64 {
        self.number
    }

    /// Returns the first bytes of the log, at most `len`, without consuming them. Must be called before the first line
    /// is read.
    pub(super) fn head(&mut self, len: usize) -> &[u8] {
        while self.end < len && self.fill() {}
        &self.buffer[..self.end.min(len)]
    }

    /// The next line, or `None` at the end.
    ///
    /// # Errors
    /// Returns the errors of the source. Later calls return `None`.
    pub(super) fn next_line(&mut self) -> io::Result<Option<Line<'_>>> {
        let (mut searched, mut is_too_long) = (self.start, false);
        loop {
            if self.after_return && self.start < self.end {
                self.after_return = false;
                self.start += usize::from(self.buffer[self.start] == b'\n');
                searched = self.start;
            }
            if let Some(offset) = memchr::memchr2(b'\n', b'\r', &self.buffer[searched..self.end]) {
                let line = self.start..searched + offset;
                self.start = line.end + 1;
                self.number += 1;
                self.after_return = self.buffer[line.end] == b'\r';
                return Ok(Some(if is_too_long { Line::TooLong } else { Line::Whole(&self.buffer[line]) }));
            }
            if self.end - self.start == self.buffer.len() {
                is_too_long = true;
                self.start = self.end;
            }
            self.buffer.copy_within(self.start..self.end, 0);
            (self.start, self.end) = (0, self.end - self.start);
            searched = self.end;
            if !self.fill() {
                return self.last(is_too_long);
            }
        }
    }

    /// Reads more bytes. Returns `false` at the end of the source, or if it fails.
    fn fill(&mut self) -> bool {
        while !self.has_ended {
            match self.source.read(&mut self.buffer[self.end..]) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => (self.has_ended, self.error) = (true, Some(error)),
                Ok(count) => {
                    self.end += count;
                    self.has_ended = count == 0;
                    return count > 0;
                }
            }
        }
        false
    }

    /// Returns the rest of the buffer as the last line. If the source has failed, the line is incomplete, so the error
    /// is returned instead.
    fn last(&mut self, is_too_long: bool) -> io::Result<Option<Line<'_>>> {
        let line = self.start..self.end;
        self.start = self.end;
        if let Some(error) = self.error.take() {
            return Err(error);
        }
        if line.is_empty() && !is_too_long {
            return Ok(None);
        }
        self.number += 1;
        Ok(Some(if is_too_long { Line::TooLong } else { Line::Last(&self.buffer[line]) }))
    }
}

/// The first bytes of a log as text with one byte per character, without a byte-order mark.
pub(super) fn decoded_head(head: &[u8]) -> Cow<'_, [u8]> {
    if let Some(text) = head.strip_prefix(UTF8_MARK) {
        return Cow::Borrowed(text);
    }
    if !head.starts_with(UTF16_LE_MARK) && !head.starts_with(UTF16_BE_MARK) {
        return Cow::Borrowed(head);
    }
    let mut text = Vec::with_capacity(head.len() / 2);
    let mut reader = Utf16 { source: &head[2..], is_big_endian: head.starts_with(UTF16_BE_MARK), first: None };
    match reader.read_to_end(&mut text) {
        Ok(_) => Cow::Owned(text),
        Err(_) => Cow::Borrowed(head),
    }
}

/// Skips a byte-order mark, and converts UTF-16 to one byte per character.
fn decoded(mut source: Box<dyn Read>) -> io::Result<Box<dyn Read>> {
    let mut mark = Vec::with_capacity(UTF8_MARK.len());
    (&mut source).take(UTF8_MARK.len() as u64).read_to_end(&mut mark)?;
    let is_big_endian = mark.starts_with(UTF16_BE_MARK);
    if mark == UTF8_MARK {
        Ok(source)
    } else if is_big_endian || mark.starts_with(UTF16_LE_MARK) {
        let source = Cursor::new(mark.split_off(UTF16_LE_MARK.len())).chain(source);
        Ok(Box::new(Utf16 { source, is_big_endian, first: None }))
    } else {
        Ok(Box::new(Cursor::new(mark).chain(source)))
    }
}

/// Reads UTF-16 as Latin-1. Other characters become question marks.
struct Utf16<R> {
    source: R,
    is_big_endian: bool,
    /// First byte of a character whose second byte is still to be read.
    first: Option<u8>,
}

impl<R: Read> Read for Utf16<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut raw = [0; 4096];
        let mut len = 0;
        while len == 0 && !buffer.is_empty() {
            // Two raw bytes give one byte, so `buffer` cannot overflow.
            let wanted = raw.len().min(buffer.len());
            let count = self.source.read(&mut raw[..wanted])?;
            if count == 0 {
                return Ok(0);
            }
            for &byte in &raw[..count] {
                let Some(first) = self.first.take() else {
                    self.first = Some(byte);
                    continue;
                };
                let (high, low) = if self.is_big_endian { (first, byte) } else { (byte, first) };
                buffer[len] = if high == 0 { low } else { b'?' };
                len += 1;
            }
        }
        Ok(len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(text: &[u8]) -> Vec<(String, bool)> {
        let mut lines = Lines::new(Box::new(Cursor::new(text.to_vec()))).expect("memory reads");
        let mut seen = Vec::new();
        while let Some(line) = lines.next_line().expect("memory reads") {
            seen.push(match line {
                Line::Whole(bytes) => (String::from_utf8_lossy(bytes).into_owned(), true),
                Line::Last(bytes) => (String::from_utf8_lossy(bytes).into_owned(), false),
                Line::TooLong => ("too long".to_owned(), true),
            });
        }
        seen
    }

    /// Returns one byte per call, so that each line end is split.
    struct Trickle(Cursor<Vec<u8>>);

    impl Read for Trickle {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            self.0.read(&mut buffer[..1])
        }
    }

    #[test]
    fn mixed_line_ends_give_the_same_lines() {
        let expected = ["a", "b", "", "c", "d"].map(|line| (line.to_owned(), line != "d"));
        assert_eq!(all(b"a\r\nb\n\rc\rd"), expected);
        let mut lines = Lines::new(Box::new(Trickle(Cursor::new(b"a\r\nb\n\rc\rd".to_vec())))).expect("reads");
        let mut count = 0;
        while lines.next_line().expect("reads").is_some() {
            count += 1;
        }
        assert_eq!((count, lines.number()), (5, 5), "a split line end counts once");
    }

    #[test]
    fn byte_order_marks_are_skipped_and_utf16_decoded() {
        let utf16 = |mark: &[u8], big: bool| {
            let units = "date M\u{e4}r\u{20ac}\r\nx".encode_utf16();
            let bytes = units.flat_map(|unit| if big { unit.to_be_bytes() } else { unit.to_le_bytes() });
            mark.iter().copied().chain(bytes).collect::<Vec<u8>>()
        };
        let expected = [("date M\u{fffd}r?".to_owned(), true), ("x".to_owned(), false)];
        assert_eq!(all(&utf16(UTF16_LE_MARK, false)), expected);
        assert_eq!(all(&utf16(UTF16_BE_MARK, true)), expected);
        assert_eq!(all(b"\xEF\xBB\xBFdate"), [("date".to_owned(), false)]);
        assert_eq!(*decoded_head(&utf16(UTF16_LE_MARK, false)), b"date M\xE4r?\r\nx"[..]);
    }

    /// Returns its text, then an error.
    struct Damaged(Cursor<Vec<u8>>);

    impl Read for Damaged {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            match self.0.read(buffer)? {
                0 => Err(io::Error::other("damaged")),
                count => Ok(count),
            }
        }
    }

    #[test]
    fn damaged_source_gives_lines_before_the_damage() {
        let mut lines = Lines::new(Box::new(Damaged(Cursor::new(b"a\nb\nincomplete".to_vec())))).expect("reads");
        assert_eq!(lines.head(100), b"a\nb\nincomplete");
        assert_eq!(lines.next_line().expect("reads"), Some(Line::Whole(b"a")));
        assert_eq!(lines.next_line().expect("reads"), Some(Line::Whole(b"b")));
        assert_eq!(lines.next_line().expect_err("damaged").to_string(), "damaged");
        assert_eq!(lines.next_line().expect("ended"), None);
    }

    #[test]
    fn line_longer_than_buffer_is_skipped() {
        let text = [b"a\n".to_vec(), vec![b'x'; 3 * MAX_LINE], b"\nb\n".to_vec()].concat();
        assert_eq!(all(&text), [("a".to_owned(), true), ("too long".to_owned(), true), ("b".to_owned(), true)]);
    }
}
