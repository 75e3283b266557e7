//! candump log lines: the grammar that `candump -L` writes and `canplayer` reads, both ways.
//!
//! Input is one line without its line feed; output is a [`Line`] that borrows the interface name. Nothing is
//! allocated and nothing is read twice. Accepted, beyond the usual `(1700000000.123456) can0 123#1122`:
//! nanosecond and relative stamps, padded names, the direction suffix of `-x`, remote frames, raw length codes,
//! CAN FD, error frames, bytes separated by dots, drop counts of `-d`. CAN XL is recognised and not decoded.
//! A line that does not begin with `(` is no frame line ([`Line::Other`]), as for canplayer; a line that does
//! and breaks the grammar is a [`LineError`] with its column.
//!
//! FD payloads of a length the bus cannot carry are padded with zeros to the next one, as canplayer does.

pub(super) mod fast_line;

use std::io::{self, Write};

use crate::can::{CanId, Frame, FrameKind, MAX_DATA};
use crate::quantity::Timestamp;

/// Most payload bytes of a CAN XL frame.
const MAX_XL_DATA: usize = 2048;
/// Payload lengths above 8 that CAN FD can carry.
const FD_STEPS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];
/// Bit of an 8-digit identifier that marks an error frame.
const ERROR_FLAG: u32 = 0x2000_0000;
/// Largest 29-bit identifier, and the mask of an error frame's class bits.
const MAX_EXTENDED: u32 = 0x1FFF_FFFF;

/// A line of a candump log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Line<'a> {
    /// A frame.
    Frame {
        /// Its stamp.
        time: Timestamp,
        /// The interface's name as written.
        interface: &'a [u8],
        /// The frame.
        frame: Frame,
        /// Marked ` T`: sent by the machine that recorded the log.
        transmitted: bool,
    },
    /// An error frame.
    ErrorFrame {
        /// Its stamp.
        time: Timestamp,
        /// The interface's name.
        interface: &'a [u8],
        /// CAN_ERR_* class bits.
        class: u32,
    },
    /// A CAN XL frame: well formed, not supported.
    Xl {
        /// Its stamp.
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
    /// Anything that does not begin with `(`: comment, blank, another tool's line.
    Other,
}

/// Position and reason at which a line breaks the grammar.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("column {column}: expected {expected}")]
pub struct LineError {
    /// Byte position in the line, from 1.
    pub column: usize,
    /// Input that the grammar allows there.
    pub expected: &'static str,
}

impl LineError {
    /// The error with what was found in `line`, the line that was parsed.
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

/// Hex digit values; 0xFF for anything else.
const HEX: [u8; 256] = {
    let mut table = [0xFF; 256];
    let mut digit = 0;
    while digit < 16 {
        table[b"0123456789ABCDEF"[digit] as usize] = digit as u8;
        table[b"0123456789abcdef"[digit] as usize] = digit as u8;
        digit += 1;
    }
    table
};

/// Reads one line (without its line feed; a carriage return at its end is ignored).
///
/// # Errors
/// When the line begins with `(` and breaks the grammar.
pub fn parse_line(line: &[u8]) -> Result<Line<'_>, LineError> {
    if line.first() != Some(&b'(') {
        return Ok(parse_drop_count(line).unwrap_or(Line::Other));
    }
    let mut cursor = Cursor { text: line, at: 0 };
    let time = cursor.stamp()?;
    cursor.spaces("a space after the stamp")?;
    let interface = cursor.word();
    cursor.spaces("a space after the interface's name")?;
    let body = cursor.frame()?;
    let transmitted = cursor.suffix()?;
    Ok(match body {
        Body::Frame(frame) => Line::Frame { time, interface, frame, transmitted },
        Body::Error(class) => Line::ErrorFrame { time, interface, class },
        Body::Xl => Line::Xl { time, interface },
    })
}

/// Reads a stamp `(seconds.fraction)` at the start of `text`; the rest of the text with it.
///
/// # Errors
/// When there is none.
pub fn parse_stamp(text: &[u8]) -> Result<(Timestamp, &[u8]), LineError> {
    let mut cursor = Cursor { text, at: 0 };
    let time = cursor.stamp()?;
    Ok((time, &text[cursor.at..]))
}

/// Reads an interface's name and a frame at the start of `text`; the rest of the text with them. `None` = they are not there.
pub fn parse_frame(text: &[u8]) -> Option<(&[u8], Frame, &[u8])> {
    let mut cursor = Cursor { text, at: 0 };
    let interface = cursor.word();
    cursor.spaces("").ok()?;
    match cursor.frame().ok()? {
        Body::Frame(frame) => Some((interface, frame, &text[cursor.at..])),
        Body::Error(_) | Body::Xl => None,
    }
}

fn parse_drop_count(line: &[u8]) -> Option<Line<'_>> {
    let rest = line.strip_prefix(b"DROPCOUNT: dropped ")?;
    let digits = rest.iter().take_while(|b| b.is_ascii_digit()).count();
    let frames = std::str::from_utf8(&rest[..digits]).ok()?.parse().ok()?;
    let open = memchr::memchr(b'\'', rest)?;
    let name = &rest[open + 1..];
    let interface = &name[..memchr::memchr(b'\'', name)?];
    Some(Line::Dropped { interface, frames })
}

/// The part of a line after the interface's name.
enum Body {
    Frame(Frame),
    Error(u32),
    Xl,
}

/// A place in a line.
struct Cursor<'a> {
    text: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    fn fail<T>(&self, expected: &'static str) -> Result<T, LineError> {
        Err(LineError { column: self.at + 1, expected })
    }

    fn expect<T>(&self, found: Option<T>, expected: &'static str) -> Result<T, LineError> {
        found.ok_or(LineError { column: self.at + 1, expected })
    }

    fn demand(&mut self, byte: u8, expected: &'static str) -> Result<(), LineError> {
        if self.take(byte) { Ok(()) } else { self.fail(expected) }
    }

    fn peek(&self) -> Option<u8> {
        self.text.get(self.at).copied()
    }

    fn take(&mut self, byte: u8) -> bool {
        let found = self.peek() == Some(byte);
        self.at += usize::from(found);
        found
    }

    /// Value of the hex digit at `offset` from here; above 15 when there is none.
    fn hex_at(&self, offset: usize) -> u8 {
        self.text.get(self.at + offset).map_or(0xFF, |&b| HEX[usize::from(b)])
    }

    fn hex(&mut self) -> Option<u8> {
        let value = self.hex_at(0);
        (value < 16).then(|| {
            self.at += 1;
            value
        })
    }

    /// `(` seconds `.` six or nine digits `)`, to nanoseconds. A minus sign is taken too: it is what
    /// [`write_stamp`] writes for a time before the clock's origin.
    fn stamp(&mut self) -> Result<Timestamp, LineError> {
        self.demand(b'(', "a stamp in parentheses")?;
        let negative = self.take(b'-');
        let (seconds, digits) = self.decimal();
        if !(1..=10).contains(&digits) {
            return self.fail("seconds of 1 to 10 digits");
        }
        self.demand(b'.', "a decimal point")?;
        let (fraction, digits) = self.decimal();
        let nanos = match digits {
            6 => fraction * 1000,
            9 => fraction,
            _ => return self.fail("a fraction of 6 or 9 digits"),
        };
        self.demand(b')', "a closing parenthesis after the stamp")?;
        let total = seconds.checked_mul(1_000_000_000).and_then(|s| s.checked_add(nanos));
        let total = self.expect(total, "a stamp below 9223372036 s")?;
        Ok(Timestamp::from_nanos(if negative { -total } else { total }))
    }

    /// Decimal digits (saturating far above what a stamp may be) and how many there were.
    fn decimal(&mut self) -> (i64, usize) {
        let start = self.at;
        let mut value: i64 = 0;
        while let Some(digit) = self.peek().map(|b| b.wrapping_sub(b'0')).filter(|&d| d < 10) {
            value = value.saturating_mul(10).saturating_add(i64::from(digit));
            self.at += 1;
        }
        (value, self.at - start)
    }

    fn spaces(&mut self, expected: &'static str) -> Result<(), LineError> {
        self.demand(b' ', expected)?;
        while self.take(b' ') {}
        Ok(())
    }

    fn word(&mut self) -> &'a [u8] {
        let start = self.at;
        while self.peek().is_some_and(|b| b != b' ') {
            self.at += 1;
        }
        &self.text[start..self.at]
    }

    fn frame(&mut self) -> Result<Body, LineError> {
        let delimiter = |offset: usize| self.text.get(self.at + offset) == Some(&b'#');
        if delimiter(3) {
            let raw = self.number(3)?;
            let Some(id) = CanId::standard(raw) else {
                self.at -= 3;
                return self.fail("a standard identifier of at most 7FF");
            };
            self.at += 1;
            self.payload(id).map(Body::Frame)
        } else if delimiter(8) {
            self.extended()
        } else if delimiter(5) {
            self.xl().map(|()| Body::Xl)
        } else {
            self.fail("an identifier of 3 or 8 hex digits and #")
        }
    }

    fn extended(&mut self) -> Result<Body, LineError> {
        let raw = self.number(8)?;
        self.at += 1;
        if let Some(id) = CanId::extended(raw) {
            return self.payload(id).map(Body::Frame);
        }
        if raw & !MAX_EXTENDED != ERROR_FLAG {
            self.at -= 9;
            return self.fail("an identifier of at most 1FFFFFFF, or an error frame's (bit 20000000)");
        }
        let class = raw & MAX_EXTENDED;
        self.classic(CanId::Extended(class))?;
        Ok(Body::Error(class))
    }

    /// `digits` hex digits.
    fn number(&mut self, digits: usize) -> Result<u32, LineError> {
        let mut value = 0;
        for _ in 0..digits {
            let digit = self.hex();
            value = value << 4 | u32::from(self.expect(digit, "a hex digit")?);
        }
        Ok(value)
    }

    fn payload(&mut self, id: CanId) -> Result<Frame, LineError> {
        if self.take(b'#') { self.fd(id) } else { self.classic(id) }
    }

    fn classic(&mut self, id: CanId) -> Result<Frame, LineError> {
        if self.take(b'R') || self.take(b'r') {
            return self.remote(id);
        }
        let mut data = [0; MAX_DATA];
        let len = self.bytes(&mut data[..8])?;
        self.raw_length_code(len)?;
        self.expect(Frame::classic(id, &data[..len]), "at most 8 bytes")
    }

    fn remote(&mut self, id: CanId) -> Result<Frame, LineError> {
        let len = match self.peek() {
            Some(digit @ b'0'..=b'8') => {
                self.at += 1;
                digit - b'0'
            }
            _ => 0,
        };
        self.raw_length_code(usize::from(len))?;
        self.expect(Frame::remote(id, len), "a length of 0 to 8")
    }

    /// `_9` to `_F` after a length of 8: the length code that was on the wire; the payload is 8 bytes all the same.
    fn raw_length_code(&mut self, len: usize) -> Result<(), LineError> {
        if len != 8 || !self.take(b'_') {
            return Ok(());
        }
        let is_code = (9..=15).contains(&self.hex_at(0));
        self.at += usize::from(is_code);
        if is_code { Ok(()) } else { self.fail("a raw length code of 9 to F") }
    }

    fn fd(&mut self, id: CanId) -> Result<Frame, LineError> {
        let Some(flags) = self.hex() else { return self.fail("one hex digit of FD flags") };
        let mut data = [0; MAX_DATA];
        let len = self.bytes(&mut data)?;
        let padded = if len <= 8 { len } else { FD_STEPS.into_iter().find(|&step| step >= len).unwrap_or(MAX_DATA) };
        self.expect(Frame::fd(id, flags & 1 != 0, flags & 2 != 0, &data[..padded]), "at most 64 bytes")
    }

    /// Bytes of two hex digits, dots between them allowed, as many as there are up to the room in `data`.
    fn bytes(&mut self, data: &mut [u8]) -> Result<usize, LineError> {
        let mut len = 0;
        while len < data.len() {
            let dot = usize::from(len > 0 && self.peek() == Some(b'.'));
            let (high, low) = (self.hex_at(dot), self.hex_at(dot + 1));
            if high > 15 {
                break;
            }
            if low > 15 {
                self.at += dot;
                return self.fail("two hex digits per byte");
            }
            data[len] = high << 4 | low;
            len += 1;
            self.at += dot + 2;
        }
        if len == data.len() && self.hex_at(0) < 16 {
            return self.fail("no more bytes (at most 8, with ## at most 64)");
        }
        Ok(len)
    }

    /// vcid(2) prio(3) # flags(2) : sdt(2) : af(8) # bytes.
    fn xl(&mut self) -> Result<(), LineError> {
        self.number(5)?;
        self.at += 1;
        for (digits, end) in [(2, b':'), (2, b':'), (8, b'#')] {
            self.number(digits)?;
            self.demand(end, "CAN XL's flags:sdt:af#")?;
        }
        let mut data = [0; MAX_XL_DATA];
        match self.bytes(&mut data)? {
            0 => self.fail("1 to 2048 bytes of CAN XL data"),
            _ => Ok(()),
        }
    }

    /// The direction that `-x` adds, then nothing but blanks. Whether the frame was sent here.
    fn suffix(&mut self) -> Result<bool, LineError> {
        let blank = |b: Option<u8>| matches!(b, None | Some(b' ' | b'\r' | b'\t'));
        if !blank(self.peek()) {
            return self.fail("the frame's end");
        }
        self.skip_blanks();
        let transmitted = self.peek() == Some(b'T');
        if transmitted || self.peek() == Some(b'R') {
            self.at += 1;
        }
        self.skip_blanks();
        if self.peek().is_some() { self.fail("R, T or the line's end after the frame") } else { Ok(transmitted) }
    }

    fn skip_blanks(&mut self) {
        while matches!(self.peek(), Some(b' ' | b'\r' | b'\t')) {
            self.at += 1;
        }
    }
}

/// Decimals of a written stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StampDigits {
    /// Six, as `candump -L` (the rest is cut off).
    Micros,
    /// Nine, as `candump -L -N`.
    Nanos,
}

/// Writes one line as `candump -L` does, line feed included.
///
/// # Errors
/// Those of `out`.
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

/// A frame as [`write_line`] writes it.
pub fn frame_text(frame: &Frame) -> String {
    let mut text = FrameText { bytes: [0; 8 + 3 + 2 * MAX_DATA + 1], len: 0 };
    text.frame(frame);
    String::from_utf8_lossy(&text.bytes[..text.len]).into_owned()
}

/// Writes `(seconds.fraction)`.
///
/// # Errors
/// Those of `out`.
pub fn write_stamp(out: &mut impl Write, time: Timestamp, digits: StampDigits) -> io::Result<()> {
    let (sign, nanos) = (if time.nanos() < 0 { "-" } else { "" }, time.nanos().unsigned_abs());
    let (seconds, fraction) = (nanos / 1_000_000_000, nanos % 1_000_000_000);
    match digits {
        StampDigits::Micros => write!(out, "({sign}{seconds:010}.{:06})", fraction / 1000),
        StampDigits::Nanos => write!(out, "({sign}{seconds:010}.{fraction:09})"),
    }
}

/// A frame's text on the stack: identifier, `##`, flags, 64 bytes in hex, line feed.
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
