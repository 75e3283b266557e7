//! Reads text logs of Kvaser CanKing.
//!
//! Header: `Chn Identifier Flg   DLC  D0...1...2...3...4...5...6..D7       Time     Dir`. A row:
//! ` 0    00002102 X       8  60  00  00  5F  60  60  E2  F2   46055.090598 R`. Flags: X extended, R remote; F, B and E are
//! the flags of CAN FD frames. Times are seconds since the start. Identifiers and data are hexadecimal; they are decimal
//! if a data byte in the first 16 KiB has three digits.

use std::io;

use packwatch_core::can::{Frame, MAX_DATA};
use packwatch_core::quantity::Timestamp;

use super::cursor::{Base, Cursor, Fault, identifier, number};
use super::{CHANNEL, Channels, Grammar, time};
use crate::Item;

pub(super) struct CanKing {
    base: Base,
}

impl Grammar for CanKing {
    fn new(head: &[u8]) -> io::Result<Self> {
        let mut rows = head.split(|byte| matches!(byte, b'\n' | b'\r')).filter(|row| row.trim_ascii_end().len() > 40);
        let has_three_digits = |row: &[u8]| {
            let words = row.split(|byte| byte.is_ascii_whitespace()).filter(|word| !word.is_empty());
            words.skip(2).any(|word| word.len() == 3 && word.iter().all(u8::is_ascii_digit))
        };
        Ok(Self { base: if rows.any(has_three_digits) { Base::Dec } else { Base::Hex } })
    }

    fn recognises(line: &[u8]) -> bool {
        let mut line = Cursor::new(line);
        [&b"Chn"[..], b"Identifier", b"Flg"].iter().all(|name| line.word() == *name)
    }

    fn item(&mut self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        // Other lines are headers, and events such as the start of logging.
        if !line.rest().first().is_some_and(u8::is_ascii_digit) {
            return Ok(Item::Other);
        }
        let start = line;
        let channel = line.parse(CHANNEL, |word| channels.number(number(word, Base::Dec)?, 0))?;
        let at_id = line;
        let id = line.word();
        let flags = if line.rest().first().is_some_and(u8::is_ascii_alphabetic) { line.word() } else { b"" };
        let has = |flag: u8| flags.contains(&flag);
        if flags == b"ErrorFrame" || line.peek() == b"ErrorFrame" {
            if flags != b"ErrorFrame" {
                line.word();
            }
            return Ok(Item::ErrorFrame { time: end(line, start)?, channel, class: 0 });
        }
        let id = number(id, self.base).and_then(|raw| identifier(raw, has(b'X') || raw > 0x7FF));
        let id = id.ok_or_else(|| at_id.fault("an identifier of at most 1FFFFFFF"))?;
        let len = line.parse("a length of 0 to 64", |word| {
            number(word, Base::Dec).map(|len| len as usize).filter(|len| *len <= MAX_DATA)
        })?;
        let is_fd = has(b'F') || len > 8;
        let data = line.data(if has(b'R') { 0 } else { len }, self.base)?;
        let frame = if has(b'R') {
            Frame::remote(id, len.min(8) as u8)
        } else if is_fd {
            Frame::fd_padded(id, has(b'B'), has(b'E'), len, &data)
        } else {
            Frame::classic(id, &data[..len])
        };
        let frame = frame.ok_or_else(|| start.fault("a length that the frame can have"))?;
        Ok(Item::Frame { time: end(line, start)?, channel, frame })
    }
}

/// Reads the end of a row: the time and the direction, which shows that the time is complete.
fn end(mut line: Cursor<'_>, start: Cursor<'_>) -> Result<Timestamp, Fault> {
    let written = line.time(9)?;
    if !matches!(line.word(), b"R" | b"T" | b"Rx" | b"Tx") {
        return Err(line.fault("R or T after the time"));
    }
    time(0, written).ok_or_else(|| start.fault("a time below 9223372036 s"))
}
