//! Parses candump lines.
//!
//! In: text that begins with a line; the parser ignores what follows the line feed. Out: the line, or the first
//! violation of the grammar. The parser allocates no memory while it reads lines. Nearly all lines have the same whole
//! seconds as the previous line, a known interface, and a payload of eight bytes. These three parts have fast paths,
//! which convert several bytes at a time.

use super::digits::{HEX, eight_digits, eight_hex_bytes, six_decimals, word};
use super::{Line, LineError};
use crate::can::{CanId, Frame, MAX_DATA};
use crate::quantity::{BusIndex, Timestamp};

/// Largest 29-bit identifier, and the mask of an error frame's class bits.
const MAX_EXTENDED: u32 = 0x1FFF_FFFF;
/// Initial value of `LineParser::head`. It matches no line, because the overlapping bytes of its two words differ.
const NO_HEAD: [u64; 2] = [0, u64::MAX];

#[derive(Debug, Clone, Copy)]
struct Interface {
    /// The name and the space after it, as a word. Different names have different words.
    name: u64,
    /// Mask that selects the bytes of the name and the space in a word of text.
    mask: u64,
    len: usize,
    bus: BusIndex,
}

impl Interface {
    fn new(name: &[u8], bus: BusIndex) -> Option<Self> {
        if !(1..=7).contains(&name.len()) || name.contains(&b' ') || name.contains(&b'\n') {
            return None;
        }
        let mut bytes = [0; 8];
        bytes[..name.len()].copy_from_slice(name);
        bytes[name.len()] = b' ';
        Some(Self {
            name: u64::from_le_bytes(bytes),
            mask: u64::MAX >> (56 - 8 * name.len()),
            len: name.len() + 1,
            bus,
        })
    }
}

/// Parses lines one after another. The parser remembers the whole seconds of the previous stamp, because thousands of
/// lines share them.
#[derive(Debug, Clone)]
pub struct LineParser {
    interfaces: Vec<Interface>,
    /// The first twelve bytes of the latest line whose stamp has ten digits of seconds: `(`, the digits and the decimal
    /// point, as two overlapping words.
    head: [u64; 2],
    /// The whole seconds that `head` encodes, ns.
    second_ns: i64,
}

/// A parsed line and its length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParsedLine<'a> {
    /// The line.
    pub line: Line<'a>,
    /// Number of bytes before the line feed, or of the whole text if there is no line feed. The length is 0 for
    /// [`Line::Other`] and [`Line::Dropped`].
    pub len: usize,
}

/// The beginning of a line with a stamp, up to its frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LineHead<'a> {
    pub time: Timestamp,
    pub interface: &'a [u8],
    /// Number of the interface. `None` if the parser does not know the name, or if the name has more than seven
    /// bytes. May also be `None` if more than one space precedes the name.
    pub bus: Option<BusIndex>,
    pub rest: Cursor<'a>,
}

/// The part of a line after the interface's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Body {
    Frame(Frame),
    Error(u32),
    Xl,
}

impl LineParser {
    /// Creates a parser that knows these interfaces, numbered in this order.
    pub fn new(interfaces: &[String]) -> Self {
        let known = (0..u8::MAX).map(BusIndex).zip(interfaces);
        let interfaces = known.filter_map(|(bus, name)| Interface::new(name.as_bytes(), bus)).collect();
        Self { interfaces, head: NO_HEAD, second_ns: 0 }
    }

    /// Parses the line at the start of `text`.
    ///
    /// # Errors
    /// Fails if the line begins with `(` and violates the grammar.
    pub fn parse<'a>(&mut self, text: &'a [u8]) -> Result<ParsedLine<'a>, LineError> {
        if text.first() != Some(&b'(') {
            return Ok(ParsedLine { line: drop_count(text).unwrap_or(Line::Other), len: 0 });
        }
        let LineHead { time, interface, rest, .. } = self.parse_head(text)?;
        let (body, transmitted, len) = rest.frame_and_end()?;
        let line = match body {
            Body::Frame(frame) => Line::Frame { time, interface, frame, transmitted },
            Body::Error(class) => Line::ErrorFrame { time, interface, class },
            Body::Xl => Line::Xl { time, interface },
        };
        Ok(ParsedLine { line, len })
    }

    #[inline(always)]
    pub(crate) fn parse_head<'a>(&mut self, text: &'a [u8]) -> Result<LineHead<'a>, LineError> {
        let mut rest = Cursor { text, at: 0 };
        let time = self.stamp(&mut rest)?;
        let (interface, bus) = self.interface(&mut rest)?;
        Ok(LineHead { time, interface, bus, rest })
    }

    #[inline(always)]
    fn stamp(&mut self, cursor: &mut Cursor<'_>) -> Result<Timestamp, LineError> {
        if let Some(text) = cursor.text.first_chunk::<24>()
            && [word(text, 0), word(text, 4)] == self.head
            && let Some((fraction_ns, len)) = fraction(text)
        {
            cursor.at = len;
            return Ok(Timestamp::from_nanos(self.second_ns + fraction_ns));
        }
        let (time, at) = self.other_stamp(*cursor)?;
        cursor.at = at;
        Ok(time)
    }

    #[inline(never)]
    fn other_stamp(&mut self, mut cursor: Cursor<'_>) -> Result<(Timestamp, usize), LineError> {
        let time = cursor.stamp()?;
        let (text, second_ns) = (cursor.text, time.nanos() - time.nanos().rem_euclid(1_000_000_000));
        // A stamp is remembered only if it is not negative, has ten digits of seconds, and cannot overflow when a
        // fraction of a second is added.
        if text.get(11) == Some(&b'.') && text.get(1) != Some(&b'-') && second_ns.checked_add(1_000_000_000).is_some() {
            (self.head, self.second_ns) = ([word(text, 0), word(text, 4)], second_ns);
        }
        cursor.spaces("a space after the stamp")?;
        Ok((time, cursor.at))
    }

    #[inline(always)]
    fn interface<'a>(&self, cursor: &mut Cursor<'a>) -> Result<(&'a [u8], Option<BusIndex>), LineError> {
        // The position after the name depends on the name's length. If the name is compared with known names, the
        // processor can predict this position. If the bytes were counted, the processor would have to wait for the
        // count.
        let ahead = cursor.ahead().unwrap_or(&[0; 8]);
        let name = u64::from_le_bytes(*ahead);
        let is_known = |known: &&Interface| name & known.mask == known.name;
        // Most logs have one interface, so the first known name is compared without a loop.
        let known = self.interfaces.first().filter(is_known);
        if let Some(known) = known.or_else(|| self.interfaces.iter().skip(1).find(is_known)) {
            cursor.at += known.len;
            return Ok((&ahead[..known.len - 1], Some(known.bus)));
        }
        let (interface, at) = cursor.interface()?;
        cursor.at = at;
        Ok((interface, None))
    }
}

/// Parses the fraction of a stamp with ten digits of seconds. Returns the fraction in nanoseconds, and the length of
/// the stamp with the space after it.
#[inline(always)]
fn fraction(text: &[u8; 24]) -> Option<(i64, usize)> {
    if text[18] == b')' {
        return six_decimals(word(text, 12)).map(|nanos| (nanos, 20));
    }
    let last = text[20].wrapping_sub(b'0');
    let nanos = eight_digits(word(text, 12))? * 10 + i64::from(last);
    (last <= 9 && text[21] == b')' && text[22] == b' ').then_some((nanos, 23))
}

fn drop_count(line: &[u8]) -> Option<Line<'_>> {
    let rest = line.strip_prefix(b"DROPCOUNT: dropped ")?;
    let digits = rest.iter().take_while(|b| b.is_ascii_digit()).count();
    let frames = std::str::from_utf8(&rest[..digits]).ok()?.parse().ok()?;
    let open = memchr::memchr(b'\'', rest)?;
    let name = &rest[open + 1..];
    let interface = &name[..memchr::memchr(b'\'', name)?];
    Some(Line::Dropped { interface, frames })
}

/// A position in a line. Functions for rare forms take a copy of the cursor, so that the original stays in registers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cursor<'a> {
    pub(super) text: &'a [u8],
    pub(super) at: usize,
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
        self.text.get(self.at).copied().filter(|&byte| byte != b'\n')
    }

    #[inline(always)]
    fn ahead<const N: usize>(&self) -> Option<&'a [u8; N]> {
        self.text.get(self.at..)?.first_chunk()
    }

    fn take(&mut self, byte: u8) -> bool {
        let found = self.text.get(self.at) == Some(&byte);
        self.at += usize::from(found);
        found
    }

    /// Value of the hex digit at `offset` from this position; above 15 if the byte is not a hex digit.
    fn hex_at(&self, offset: usize) -> u32 {
        self.text.get(self.at + offset).map_or(u32::MAX, |&b| HEX[usize::from(b)])
    }

    /// Parses `(` seconds `.` six or nine digits `)`. A minus sign before the seconds is accepted, because
    /// [`super::write_stamp`] writes one for times before the clock's origin.
    pub(super) fn stamp(&mut self) -> Result<Timestamp, LineError> {
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

    /// Parses decimal digits. Returns the number and the count of digits. A number that is too large saturates at a
    /// value far above any stamp.
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

    #[inline(never)]
    pub(super) fn interface(mut self) -> Result<(&'a [u8], usize), LineError> {
        while self.take(b' ') {}
        let start = self.at;
        while self.peek().is_some_and(|b| b != b' ') {
            self.at += 1;
        }
        let name = &self.text[start..self.at];
        self.spaces("a space after the interface's name")?;
        Ok((name, self.at))
    }

    /// Parses a frame with a standard identifier and eight bytes, and the line's end after it. Also returns the
    /// position of the line's end. `None` = the frame has another form.
    #[inline(always)]
    pub(crate) fn usual_frame_and_end(&self) -> Option<(Frame, usize)> {
        let text: &[u8; 21] = self.ahead()?;
        let [high, middle, low] = [0, 1, 2].map(|place: usize| HEX[usize::from(text[place])]);
        let id = CanId::standard(high << 8 | middle << 4 | low)?;
        if text[3] != b'#' || text[20] != b'\n' {
            return None;
        }
        Some((Frame::of_word(id, eight_hex_bytes(*text[4..].first_chunk()?)?, 8), self.at + 20))
    }

    /// Parses any frame and the line's end after it. Returns the content, whether the recording machine sent the frame,
    /// and the position of the line's end.
    #[inline(never)]
    pub(crate) fn frame_and_end(mut self) -> Result<(Body, bool, usize), LineError> {
        let body = self.frame()?;
        let transmitted = self.suffix()?;
        Ok((body, transmitted, self.at))
    }

    pub(super) fn frame(&mut self) -> Result<Body, LineError> {
        while self.take(b' ') {}
        let is_delimited = |digits: usize| self.text.get(self.at + digits) == Some(&b'#');
        if is_delimited(3) {
            let raw = self.number::<3>()?;
            let Some(id) = CanId::standard(raw) else {
                self.at -= 3;
                return self.fail("a standard identifier of at most 7FF");
            };
            self.at += 1;
            self.payload(id).map(Body::Frame)
        } else if is_delimited(8) {
            self.extended()
        } else if is_delimited(5) {
            self.xl()?;
            Ok(Body::Xl)
        } else {
            self.fail("an identifier of 3 or 8 hex digits and #")
        }
    }

    fn extended(&mut self) -> Result<Body, LineError> {
        let raw = self.number::<8>()?;
        self.at += 1;
        if let Some(id) = CanId::extended(raw) {
            return self.payload(id).map(Body::Frame);
        }
        // Bit 0x20000000 marks an error frame.
        if raw & !MAX_EXTENDED != 0x2000_0000 {
            self.at -= 9;
            return self.fail("an identifier of at most 1FFFFFFF, or an error frame's (bit 20000000)");
        }
        let class = raw & MAX_EXTENDED;
        self.classic(CanId::Extended(class))?;
        Ok(Body::Error(class))
    }

    fn number<const N: usize>(&mut self) -> Result<u32, LineError> {
        let mut value = 0;
        for _ in 0..N {
            let digit = self.hex_at(0);
            if digit > 15 {
                return self.fail("a hex digit");
            }
            value = value << 4 | digit;
            self.at += 1;
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
        let mut data = [0; 8];
        let len = self.bytes(&mut data)?;
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

    /// Parses `_9` to `_F`, which may follow a length of 8. They state the length code (DLC) on the wire. The payload
    /// still has 8 bytes.
    fn raw_length_code(&mut self, len: usize) -> Result<(), LineError> {
        if len != 8 || !self.take(b'_') {
            return Ok(());
        }
        let is_code = (9..=15).contains(&self.hex_at(0));
        self.at += usize::from(is_code);
        if is_code { Ok(()) } else { self.fail("a raw length code of 9 to F") }
    }

    fn fd(&mut self, id: CanId) -> Result<Frame, LineError> {
        let flags = self.hex_at(0);
        if flags > 15 {
            return self.fail("one hex digit of FD flags");
        }
        self.at += 1;
        let mut data = [0; MAX_DATA];
        let len = self.bytes(&mut data)?;
        self.expect(Frame::fd_padded(id, flags & 1 != 0, flags & 2 != 0, len, &data), "at most 64 bytes")
    }

    /// Parses bytes of two hex digits, optionally separated by dots, until `data` is full.
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
            data[len] = (high << 4 | low) as u8;
            len += 1;
            self.at += dot + 2;
        }
        if len == data.len() && self.hex_at(0) < 16 {
            return self.fail("no more bytes (at most 8, with ## at most 64)");
        }
        Ok(len)
    }

    /// Parses a CAN XL frame: vcid(2) prio(3) # flags(2) : sdt(2) : af(8) # bytes. Numbers in parentheses count hex
    /// digits.
    fn xl(&mut self) -> Result<(), LineError> {
        const HEADER: &str = "CAN XL's flags:sdt:af#";
        self.number::<5>()?;
        self.at += 1;
        for _ in 0..2 {
            self.number::<2>()?;
            self.demand(b':', HEADER)?;
        }
        self.number::<8>()?;
        self.demand(b'#', HEADER)?;
        match self.bytes(&mut [0; 2048])? {
            0 => self.fail("1 to 2048 bytes of CAN XL data"),
            _ => Ok(()),
        }
    }

    /// Parses the direction that `candump -x` appends, and blanks. Returns whether the frame was sent by the recording
    /// machine.
    fn suffix(&mut self) -> Result<bool, LineError> {
        let blank = |b: Option<u8>| matches!(b, None | Some(b' ' | b'\r' | b'\t'));
        if !blank(self.peek()) {
            return self.fail("the frame's end");
        }
        self.skip_blanks();
        let transmitted = self.take(b'T');
        if !transmitted {
            self.take(b'R');
        }
        self.skip_blanks();
        if self.peek().is_some() {
            return self.fail("R, T or the line's end after the frame");
        }
        Ok(transmitted)
    }

    fn skip_blanks(&mut self) {
        while matches!(self.peek(), Some(b' ' | b'\r' | b'\t')) {
            self.at += 1;
        }
    }
}

#[cfg(test)]
mod tests;
