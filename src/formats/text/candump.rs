//! Reads candump's screen text, and logs of `candump -L` whose stamps are the times since the previous frame.
//!
//! Screen text: ` (1700000000.000000)  can0  RX B -  100   [8]  05 00 ...`. All options are accepted: stamps of `-ta`,
//! `-tA` (local time, read as UTC), `-tz` and `-td`; direction and flags of `-x`; colours of `-c`; data of `-i` (binary)
//! and `-S` (swapped); the ASCII column of `-a`; raw length codes of `-8`; error classes of `-e`. Two digits in the
//! brackets mark a CAN FD frame. Text without stamps cannot be used and is refused.
//!
//! If stamps are the times since the previous frame (`-td`), they are added up, and the log begins at 0.

use std::io;

use packwatch_core::can::{Frame, MAX_DATA};
use packwatch_core::quantity::Timestamp;

use super::cursor::{Base, Cursor, Fault, frame, hex_byte, identifier, joined_bytes, number, scaled};
use super::{CHANNEL, Channels, Grammar, date, time};
use crate::Item;

/// Bit of an identifier that marks an error frame, and mask of the error class in such an identifier.
const ERROR_FLAG: u32 = 0x2000_0000;
const ERROR_MASK: u32 = 0x1FFF_FFFF;

const STAMP: &str = "a time in parentheses";
const IDENTIFIER: &str = "an identifier of at most 8 hex digits";
const LENGTH: &str = "a length of 0 to 64 in brackets";

/// Reads screen text whose lines have time stamps.
pub(super) struct Candump {
    /// A line without its escape sequences.
    plain: Vec<u8>,
}

/// Reads screen text or a log whose stamps are the times since the previous frame.
pub(super) struct CandumpDeltas {
    text: Candump,
    sum_ns: i64,
}

impl Grammar for Candump {
    fn new(head: &[u8]) -> io::Result<Self> {
        let first = head.split(|&byte| byte == b'\n').map(without_escapes).find(|line| is_screen_line(line));
        if first.is_some_and(|line| !line.trim_ascii_start().starts_with(b"(")) {
            let message = "this text of candump has no times, so it cannot be used. Record with `candump -L can0 > FILE`, \
                           or print times with `candump -ta can0`";
            return Err(io::Error::new(io::ErrorKind::InvalidData, message));
        }
        Ok(Self { plain: Vec::new() })
    }

    fn recognises(line: &[u8]) -> bool {
        is_screen_line(line)
    }

    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        self.with_stamp(line, channels, Some)
    }
}

impl Grammar for CandumpDeltas {
    fn new(head: &[u8]) -> io::Result<Self> {
        Ok(Self { text: Candump::new(head)?, sum_ns: 0 })
    }

    fn recognises(_line: &[u8]) -> bool {
        false
    }

    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let sum_ns = &mut self.sum_ns;
        self.text.with_stamp(line, channels, |delta_ns| {
            *sum_ns = sum_ns.checked_add(delta_ns)?;
            Some(*sum_ns)
        })
    }
}

impl Candump {
    /// Reads a line. `place` converts its stamp to a time in ns; `None` = out of range.
    fn with_stamp(
        &mut self,
        line: Cursor<'_>,
        channels: &mut Channels,
        place: impl FnOnce(i64) -> Option<i64>,
    ) -> Result<Item, Fault> {
        if !line.text.contains(&0x1B) {
            return stamped(line, channels, place);
        }
        self.plain = without_escapes(line.text);
        stamped(Cursor { text: &self.plain, ..line }, channels, place)
    }
}

fn stamped(
    mut line: Cursor<'_>,
    channels: &mut Channels,
    place: impl FnOnce(i64) -> Option<i64>,
) -> Result<Item, Fault> {
    let start = line;
    let [b'(', rest @ ..] = line.rest() else {
        // Shell prompts, drop counts and the second line of an error frame are not errors.
        return if is_screen_line(line.text) { Err(line.fault(STAMP)) } else { Ok(Item::Other) };
    };
    let end = memchr::memchr(b')', rest).ok_or_else(|| start.fault(STAMP))?;
    line.at = line.text.len() - rest.len() + end + 1;
    let written = &rest[..end];
    let stamp_ns = if written.contains(&b':') { date::parse(written) } else { scaled(written, 9) };
    let at_ns = stamp_ns.and_then(place).and_then(|at_ns| time(0, at_ns)).ok_or_else(|| start.fault(STAMP))?;
    let channel = line.parse(CHANNEL, |name| channels.name(name))?;
    if line.peek().contains(&b'#') { logged(at_ns, channel, line) } else { shown(at_ns, channel, line) }
}

/// Reads the part of a screen line after the interface's name.
fn shown(time: Timestamp, channel: u8, mut line: Cursor<'_>) -> Result<Item, Fault> {
    let (mut brs, mut esi) = (false, false);
    if matches!(line.peek(), b"RX" | b"TX") {
        line.word();
        if line.peek().len() == 1 {
            (brs, esi) = (line.word() == b"B", line.word() == b"E");
        }
    }
    let at_id = line;
    let word = line.word();
    let raw = number(word, Base::Hex).filter(|_| word.len() <= 8);
    let raw = raw.ok_or_else(|| at_id.fault(IDENTIFIER))?;
    let at_len = line;
    let (len, digits) = bracketed(line.word()).ok_or_else(|| at_len.fault(LENGTH))?;
    if digits == 4 {
        return Ok(Item::Xl);
    }
    if word.len() == 8 && raw & ERROR_FLAG != 0 {
        return Ok(Item::ErrorFrame { time, channel, class: raw & ERROR_MASK });
    }
    let id = identifier(raw, word.len() > 3).ok_or_else(|| at_id.fault(IDENTIFIER))?;
    let is_fd = digits == 2;
    let len = if is_fd { len } else { len.min(8) };
    if line.peek() == b"remote" {
        let frame = Frame::remote(id, len as u8).ok_or_else(|| at_len.fault("a length of 0 to 8"))?;
        return Ok(Item::Frame { time, channel, frame });
    }
    let data = shown_data(line, len)?;
    let frame = if is_fd { Frame::fd_padded(id, brs, esi, len, &data) } else { Frame::classic(id, &data[..len]) };
    let frame = frame.ok_or_else(|| at_len.fault(LENGTH))?;
    Ok(Item::Frame { time, channel, frame })
}

/// Reads data bytes of two hex digits or eight bits. A grave accent between them marks swapped data.
fn shown_data(mut line: Cursor<'_>, len: usize) -> Result<[u8; MAX_DATA], Fault> {
    let mut data = [0; MAX_DATA];
    let mut is_swapped = false;
    for byte in &mut data[..len] {
        let before = line;
        let rest = line.rest();
        let digits = rest.iter().take_while(|byte| byte.is_ascii_hexdigit()).count();
        *byte = byte_of(&rest[..digits]).ok_or_else(|| before.fault("a data byte of 2 hex digits or 8 bits"))?;
        let has_accent = rest.get(digits) == Some(&b'`');
        is_swapped |= has_accent;
        line.at = line.text.len() - rest.len() + digits + usize::from(has_accent);
    }
    if is_swapped {
        data[..len].reverse();
    }
    Ok(data)
}

fn byte_of(digits: &[u8]) -> Option<u8> {
    if digits.len() == 8 {
        let bits =
            digits.iter().try_fold(0, |value, byte| matches!(byte, b'0' | b'1').then_some(value << 1 | (byte & 1)));
        return bits;
    }
    hex_byte(digits)
}

/// Parses `[8]`, `[12]` or `{9}` (a raw length code). Returns the length and its number of digits.
fn bracketed(word: &[u8]) -> Option<(usize, usize)> {
    match word {
        [b'[', digits @ .., b']'] if matches!(digits.len(), 1 | 2 | 4) => {
            let len = number(digits, Base::Dec)? as usize;
            (len <= MAX_DATA || digits.len() == 4).then_some((len, digits.len()))
        }
        [b'{', digit, b'}'] => Some((number(&[*digit], Base::Hex)? as usize, 1)),
        _ => None,
    }
}

/// Reads the part of a log line after the interface's name: `100#0500`, `100##10500`, `100#R8`, all as candump -L
/// writes them.
fn logged(time: Timestamp, channel: u8, mut line: Cursor<'_>) -> Result<Item, Fault> {
    let at_id = line;
    let word = line.word();
    let hash = memchr::memchr(b'#', word).unwrap_or(word.len());
    let (digits, body) = word.split_at(hash);
    let raw = number(digits, Base::Hex).filter(|_| matches!(digits.len(), 3 | 5 | 8));
    let raw = raw.ok_or_else(|| at_id.fault(IDENTIFIER))?;
    if digits.len() == 5 {
        return Ok(Item::Xl);
    }
    if digits.len() == 8 && raw & ERROR_FLAG != 0 {
        return Ok(Item::ErrorFrame { time, channel, class: raw & ERROR_MASK });
    }
    let id = identifier(raw, digits.len() == 8).ok_or_else(|| at_id.fault(IDENTIFIER))?;
    let bytes = |text: &[u8]| {
        let text = text.split(|&byte| byte == b'_').next().unwrap_or_default();
        let digits: Vec<u8> = text.iter().copied().filter(|&byte| byte != b'.').collect();
        joined_bytes(&digits)
    };
    let found = match body {
        [b'#', b'#', flags, data @ ..] => number(&[*flags], Base::Hex)
            .zip(bytes(data))
            .and_then(|(flags, (data, len))| Frame::fd_padded(id, flags & 1 != 0, flags & 2 != 0, len, &data)),
        [b'#', b'R' | b'r', len @ ..] => {
            let len = len.first().map_or(Some(0), |digit| number(&[*digit], Base::Dec));
            len.and_then(|len| Frame::remote(id, u8::try_from(len).ok()?))
        }
        [b'#', data @ ..] => bytes(data).filter(|(_, len)| *len <= 8).and_then(|(data, len)| frame(id, len, &data)),
        _ => None,
    };
    let frame = found.ok_or_else(|| at_id.fault("a frame such as 100#0102"))?;
    Ok(Item::Frame { time, channel, frame })
}

/// Whether a line is a frame in the form of `candump -L`.
pub(super) fn is_log_line(line: &[u8]) -> bool {
    let mut line = Cursor::new(line);
    let stamp = line.word();
    let (_, frame) = (line.word(), line.word());
    stamp.starts_with(b"(") && stamp.ends_with(b")") && matches!(memchr::memchr(b'#', frame), Some(3 | 5 | 8))
}

/// Whether a line is a frame as candump shows it, with or without a stamp.
pub(super) fn is_screen_line(line: &[u8]) -> bool {
    let plain = without_escapes(line);
    let mut line = Cursor::new(&plain);
    if line.rest().starts_with(b"(") {
        let Some(end) = memchr::memchr(b')', &plain) else { return false };
        line.at = end + 1;
    }
    line.word();
    if matches!(line.peek(), b"RX" | b"TX") {
        line.word();
        while line.peek().len() == 1 {
            line.word();
        }
    }
    let id = line.word();
    id.len() <= 8 && number(id, Base::Hex).is_some() && bracketed(line.word()).is_some()
}

/// Whether the stamps of a log are the times since the previous frames (`-td`).
///
/// Only stamps with fewer than ten digits of seconds are considered, because longer stamps count from 1970. The
/// function returns true in two cases: more than a quarter of the stamps are smaller than the previous stamp, or the
/// stamps do not grow from the first half of the text to the second half.
///
/// Stamps of `-tz` count from the first frame, so they grow. They decrease only where the frames of several interfaces
/// are out of order. Equal stamps do not count as decreases, because recorders with a coarse clock write them too. For
/// the same reason, stamps that are all whole seconds and do not grow do not count as times since the previous frame.
pub(super) fn has_deltas(head: &[u8]) -> bool {
    /// Minimum number of stamps to conclude that stamps do not grow.
    const FEWEST_STAMPS: usize = 16;
    let stamp = |line: &[u8]| {
        let plain = without_escapes(line);
        let rest = plain.trim_ascii_start().strip_prefix(b"(")?;
        let stamp = &rest[..memchr::memchr(b')', rest)?];
        let seconds = memchr::memchr(b'.', stamp)?;
        scaled(stamp, 9).filter(|_| seconds < 10)
    };
    let stamps: Vec<i64> = head.split(|&byte| byte == b'\n').filter_map(stamp).collect();
    let decreases = stamps.windows(2).filter(|pair| pair[1] < pair[0]).count();
    let (first, last) = stamps.split_at(stamps.len() / 2);
    let grow = first.iter().max() < last.iter().max();
    let is_coarse = stamps.iter().all(|stamp| stamp % 1_000_000_000 == 0);
    4 * decreases > stamps.len() || stamps.len() >= FEWEST_STAMPS && !grow && !is_coarse
}

fn without_escapes(line: &[u8]) -> Vec<u8> {
    let mut plain = Vec::with_capacity(line.len());
    let mut bytes = line.iter().copied();
    while let Some(byte) = bytes.next() {
        if byte == 0x1B {
            let _ = bytes.by_ref().skip(1).find(|byte| byte.is_ascii_alphabetic());
        } else {
            plain.push(byte);
        }
    }
    plain
}
