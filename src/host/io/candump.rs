//! Parses and writes candump log lines, the format that `candump -L` writes and `canplayer` reads.
//!
//! In: text that begins with a line. Out: a [`Line`] that borrows the interface's name from the text. The usual form of
//! a line is `(1700000000.123456) can0 123#1122`. The parser also accepts nanosecond and relative stamps, interface
//! names padded with spaces, the direction that `candump -x` appends, and the drop counts that `candump -d` writes. It
//! accepts remote frames, raw length codes, CAN FD, error frames, and bytes separated by dots. CAN XL is recognised but
//! not decoded. Except for drop counts, the parser ignores lines that do not begin with `(`, as canplayer does
//! ([`Line::Other`]). If a line begins with `(` and violates the grammar, the result is a [`LineError`], which states
//! the column.
//!
//! If a CAN FD payload has a length that FD frames cannot have, the parser pads it with zeros to the next valid length,
//! as canplayer does.

mod digits;
mod parser;

use std::io::{self, Write};

use crate::can::{CanId, Frame, FrameKind, MAX_DATA};
use crate::quantity::Timestamp;

use parser::Cursor;
pub(super) use parser::{Body, LineHead};
pub use parser::{LineParser, ParsedLine};

/// A line of a candump log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Line<'a> {
    /// A frame.
    Frame {
        /// Stamp of the frame.
        time: Timestamp,
        /// The interface's name as written.
        interface: &'a [u8],
        /// The frame.
        frame: Frame,
        /// Whether the line ends with ` T`: the recording machine sent the frame.
        transmitted: bool,
    },
    /// An error frame.
    ErrorFrame {
        /// Stamp of the frame.
        time: Timestamp,
        /// The interface's name.
        interface: &'a [u8],
        /// CAN_ERR_* class bits.
        class: u32,
    },
    /// A CAN XL frame: valid but not supported.
    Xl {
        /// Stamp of the frame.
        time: Timestamp,
        /// The interface's name.
        interface: &'a [u8],
    },
    /// `DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 5)`.
    Dropped {
        /// The interface's name.
        interface: &'a [u8],
        /// Frames lost since the last such line.
        frames: u64,
    },
    /// Any other line that does not begin with `(`: a comment, a blank line, another tool's line.
    Other,
}

/// Where and why a line violates the grammar.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("column {column}: expected {expected}")]
pub struct LineError {
    /// Byte position in the line, from 1.
    pub column: usize,
    /// What the grammar allows at this column.
    pub expected: &'static str,
}

impl LineError {
    /// Formats the error. `line` is the line that was parsed; the result quotes the text at the column of the error.
    pub fn describe(&self, line: &[u8]) -> String {
        const SHOWN: usize = 24;
        let rest = line.get(self.column - 1..).unwrap_or_default();
        let found = match rest.len() {
            0 => "the end of the line".to_owned(),
            len => {
                let shown = String::from_utf8_lossy(&rest[..len.min(SHOWN)]);
                format!("{shown:?}{}", if len > SHOWN { "..." } else { "" })
            }
        };
        format!("column {}: found {found}, expected {}", self.column, self.expected)
    }
}

/// Parses one line (without its line feed; a carriage return at its end is ignored).
///
/// # Errors
/// Fails if the line begins with `(` and violates the grammar.
pub fn parse_line(line: &[u8]) -> Result<Line<'_>, LineError> {
    LineParser::new(&[]).parse(line).map(|parsed| parsed.line)
}

/// Parses a stamp `(seconds.fraction)` at the start of `text`. Also returns the rest of the text.
pub fn parse_stamp(text: &[u8]) -> Result<(Timestamp, &[u8]), LineError> {
    let mut cursor = Cursor { text, at: 0 };
    let time = cursor.stamp()?;
    Ok((time, &text[cursor.at..]))
}

/// Parses an interface's name and a frame at the start of `text`. Also returns the rest of the text. `None` = the text
/// begins with something else.
pub fn parse_frame(text: &[u8]) -> Option<(&[u8], Frame, &[u8])> {
    let (interface, at) = Cursor { text, at: 0 }.interface().ok()?;
    let mut cursor = Cursor { text, at };
    match cursor.frame() {
        Ok(Body::Frame(frame)) => Some((interface, frame, &text[cursor.at..])),
        _ => None,
    }
}

/// Number of decimals of a written stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StampDigits {
    /// Six decimals, like `candump -L`. Further digits are cut off.
    Micros,
    /// Nine decimals, like `candump -L -N`.
    Nanos,
}

/// Writes one line like `candump -L`, including the line feed.
pub fn write_line(
    out: &mut impl Write,
    time: Timestamp,
    digits: StampDigits,
    interface: &str,
    frame: &Frame,
) -> io::Result<()> {
    write_stamp(out, time, digits)?;
    out.write_all(b" ")?;
    out.write_all(interface.as_bytes())?;
    out.write_all(b" ")?;
    let mut text = FrameText { bytes: [0; 8 + 3 + 2 * MAX_DATA + 1], len: 0 };
    text.frame(frame);
    text.push(b'\n');
    out.write_all(&text.bytes[..text.len])
}

/// A frame in the notation of [`write_line`].
pub fn frame_text(frame: &Frame) -> String {
    let mut text = FrameText { bytes: [0; 8 + 3 + 2 * MAX_DATA + 1], len: 0 };
    text.frame(frame);
    String::from_utf8_lossy(&text.bytes[..text.len]).into_owned()
}

/// Writes `(seconds.fraction)`.
pub fn write_stamp(out: &mut impl Write, time: Timestamp, digits: StampDigits) -> io::Result<()> {
    let (sign, nanos) = (if time.nanos() < 0 { "-" } else { "" }, time.nanos().unsigned_abs());
    let (seconds, fraction) = (nanos / 1_000_000_000, nanos % 1_000_000_000);
    match digits {
        StampDigits::Micros => write!(out, "({sign}{seconds:010}.{:06})", fraction / 1000),
        StampDigits::Nanos => write!(out, "({sign}{seconds:010}.{fraction:09})"),
    }
}

/// Buffer on the stack for the text of a frame: identifier, `##`, flags, 64 bytes in hex, line feed.
struct FrameText {
    bytes: [u8; 8 + 3 + 2 * MAX_DATA + 1],
    len: usize,
}

impl FrameText {
    fn push(&mut self, byte: u8) {
        self.bytes[self.len] = byte;
        self.len += 1;
    }

    fn hex(&mut self, value: u32, digits: u32) {
        for digit in (0..digits).rev() {
            self.push(b"0123456789ABCDEF"[(value >> (4 * digit) & 15) as usize]);
        }
    }

    fn frame(&mut self, frame: &Frame) {
        match frame.id() {
            CanId::Standard(id) => self.hex(u32::from(id), 3),
            CanId::Extended(id) => self.hex(id, 8),
        }
        self.push(b'#');
        match frame.kind() {
            FrameKind::Classic => {}
            FrameKind::Remote => {
                self.push(b'R');
                if let len @ 1..=8 = frame.len() {
                    self.push(b'0' + len as u8);
                }
            }
            FrameKind::Fd { brs, esi } => {
                self.push(b'#');
                self.hex(u32::from(brs) | u32::from(esi) << 1, 1);
            }
        }
        for &byte in frame.data() {
            self.hex(u32::from(byte), 2);
        }
    }
}
