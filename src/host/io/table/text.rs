//! Finds the form of a text table: encoding, separator, and the line of the header.
//!
//! In: the source. Out: its first megabyte as UTF-8, the rest as a reader, and the [`Form`]. If a read fails, the
//! bytes before the failure are returned first.

use std::collections::VecDeque;
use std::io::{self, Cursor, Read};

/// Maximum number of bytes that are examined before the first row is returned. It equals the maximum length of a row.
const HEAD_BYTES: usize = super::MAX_ROW_BYTES;

/// Maximum number of lines before the header. The longest known preamble (EC-Lab with many techniques) has some
/// hundred lines.
const MAX_PREAMBLE_LINES: usize = 1000;

/// Separators in the order of preference.
const SEPARATORS: [u8; 4] = *b",;\t|";

pub(super) struct Head {
    /// The first bytes as UTF-8, without a byte order mark.
    pub(super) bytes: Vec<u8>,
    pub(super) rest: Box<dyn Read>,
    pub(super) is_whole: bool,
}

impl Head {
    pub(super) fn read(source: Box<dyn Read>) -> Self {
        let mut source = source;
        let mut mark = Vec::new();
        if let Err(error) = source.by_ref().take(4).read_to_end(&mut mark) {
            return Self { bytes: Vec::new(), rest: Box::new(FailedRead(Some(error))), is_whole: false };
        }
        let little = mark.starts_with(&[0xFF, 0xFE]) || matches!(mark[..], [1..=0x7F, 0, 1..=0x7F, 0]);
        let big = mark.starts_with(&[0xFE, 0xFF]) || matches!(mark[..], [0, 1..=0x7F, 0, 1..=0x7F]);
        let whole: Box<dyn Read> = Box::new(Cursor::new(mark).chain(source));
        let mut text: Box<dyn Read> = if little || big {
            Box::new(Utf16 { source: io::BufReader::new(whole), little, pending: None, text: VecDeque::new() })
        } else {
            whole
        };
        let mut bytes = Vec::new();
        let result = text.by_ref().take(HEAD_BYTES as u64 + 1).read_to_end(&mut bytes);
        if bytes.starts_with("\u{feff}".as_bytes()) {
            bytes.drain(..3);
        }
        match result {
            Ok(_) => {
                let is_whole = bytes.len() < HEAD_BYTES - 3;
                Self { bytes, rest: text, is_whole }
            }
            Err(error) => Self { bytes, rest: Box::new(FailedRead(Some(error))), is_whole: false },
        }
    }
}

/// A source that fails once.
struct FailedRead(Option<io::Error>);

impl Read for FailedRead {
    fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
        self.0.take().map_or(Ok(0), Err)
    }
}

struct Utf16 {
    source: io::BufReader<Box<dyn Read>>,
    little: bool,
    /// First half of a surrogate pair.
    pending: Option<u16>,
    /// Converted bytes that did not fit into the reader's buffer.
    text: VecDeque<u8>,
}

impl Utf16 {
    fn next_char(&mut self) -> io::Result<Option<char>> {
        loop {
            let mut pair = [0; 2];
            match self.source.read_exact(&mut pair) {
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
                    return Ok(self.pending.take().map(|_| char::REPLACEMENT_CHARACTER));
                }
                result => result?,
            }
            let unit = if self.little { u16::from_le_bytes(pair) } else { u16::from_be_bytes(pair) };
            if self.pending.is_none() && (0xD800..0xDC00).contains(&unit) {
                self.pending = Some(unit);
                continue;
            }
            let units = self.pending.take().into_iter().chain([unit]);
            return Ok(Some(char::decode_utf16(units).next().and_then(Result::ok).unwrap_or('\u{fffd}')));
        }
    }
}

impl Read for Utf16 {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        while self.text.len() < buffer.len() {
            let Some(character) = self.next_char()? else { break };
            let mut bytes = [0; 4];
            self.text.extend(character.encode_utf8(&mut bytes).as_bytes());
        }
        self.text.read(buffer)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Form {
    pub(super) separator: u8,
    /// Offset of the header line in the head.
    pub(super) start: usize,
    /// Whether the header line was recognised. If not, `start` is the first line.
    pub(super) is_known: bool,
}

/// Finds the header line. `score` rates the fields of a line: 0 = not a header, higher = more known columns. If no
/// line is a header, the first line counts as the header.
pub(super) fn form(head: &[u8], score: &dyn Fn(&[String]) -> usize) -> Form {
    let mut start = 0;
    let mut first = None;
    let mut announced = None;
    for number in 1..=MAX_PREAMBLE_LINES {
        let Some(rest) = head.get(start..).filter(|rest| !rest.is_empty()) else { break };
        let len = memchr::memchr2(b'\n', b'\r', rest).unwrap_or(rest.len());
        let line = &rest[..len];
        if let [b's', b'e', b'p', b'=', separator] = line.to_ascii_lowercase()[..]
            && number == 1
        {
            first = Some(Form { separator, start: len + 1, is_known: false });
        } else {
            first = first.or_else(|| Some(Form { separator: most_frequent(line), start, is_known: false }));
            let rated = SEPARATORS.iter().filter(|separator| line.contains(separator)).map(|&separator| {
                let fields = split(line, separator);
                (score(&fields), separator)
            });
            // If several separators have the highest score, the first of them is used.
            let best = rated.rev().max_by_key(|&(score, _)| score);
            if let Some((_, separator)) = best.filter(|&(score, _)| score > 0 || announced == Some(number)) {
                return Form { separator, start, is_known: true };
            }
        }
        announced = announced.or_else(|| announced_header(line));
        let is_pair = rest[len..].starts_with(b"\r\n");
        start += len + if is_pair { 2 } else { 1 };
    }
    first.unwrap_or(Form { separator: b',', start: 0, is_known: false })
}

/// Parses the line `Nb header lines : 98` of an EC-Lab preamble. Returns the number, which is the line number of the
/// header.
fn announced_header(line: &[u8]) -> Option<usize> {
    let text = String::from_utf8_lossy(line);
    text.trim().strip_prefix("Nb header lines")?.trim_start_matches([' ', ':', '\t']).trim().parse().ok()
}

fn most_frequent(line: &[u8]) -> u8 {
    let count = |separator: u8| line.iter().filter(|&&byte| byte == separator).count();
    SEPARATORS.into_iter().rev().max_by_key(|&separator| count(separator)).unwrap_or(b',')
}

/// Splits a line that may be a header. Quotes around a field are removed.
fn split(line: &[u8], separator: u8) -> Vec<String> {
    let parts: Vec<&[u8]> = line.split(|&byte| byte == separator).collect();
    let text = |field: Vec<u8>| String::from_utf8_lossy(&field).trim().trim_matches('"').to_owned();
    join_quoted(&parts, separator).into_iter().map(text).collect()
}

/// Whether a part of a line begins a quoted field that contains separators. Quotes inside the field are doubled.
pub(super) fn opens_quote(part: &[u8]) -> bool {
    part.trim_ascii_start().starts_with(b"\"") && has_odd_quotes(part)
}

fn has_odd_quotes(part: &[u8]) -> bool {
    memchr::memchr_iter(b'"', part).count() % 2 == 1
}

/// Joins the parts of quoted fields that contain separators. A quote without an end is kept.
pub(super) fn join_quoted(parts: &[&[u8]], separator: u8) -> Vec<Vec<u8>> {
    let mut fields = Vec::new();
    let mut rest = parts;
    while let [first, after @ ..] = rest {
        // The search ends at the next part with an odd number of quotes, so the total time is linear.
        let end = opens_quote(first).then(|| after.iter().position(|part| has_odd_quotes(part))).flatten();
        let end = end.filter(|&end| after[end].trim_ascii_end().ends_with(b"\""));
        let (field, after) = rest.split_at(end.map_or(1, |end| end + 2));
        fields.push(field.join(&separator));
        rest = after;
    }
    fields
}
