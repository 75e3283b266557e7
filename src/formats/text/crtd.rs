//! Reads CRTD logs of the Open Vehicle Monitoring System: `1524311386.811100 1R11 100 01 02 ...`.
//!
//! A line is a time in seconds, an optional bus from 1 to 9 with a record type, and its content. Types R11, R29, T11 and
//! T29 are received and sent frames with 11-bit and 29-bit identifiers. All other types are comments, events and
//! settings.

use std::io;

use packwatch_core::can::MAX_DATA;

use super::cursor::{Base, Cursor, Fault, frame, hex_byte, identifier, number, scaled};
use super::{CHANNEL, Channels, Grammar, time};
use crate::Item;

/// The reader of a log. It has no state, because each line is complete.
pub(super) struct Crtd;

impl Grammar for Crtd {
    fn new(_head: &[u8]) -> io::Result<Self> {
        Ok(Self)
    }

    fn recognises(line: &[u8]) -> bool {
        let mut line = Cursor::new(line);
        let stamp = line.word();
        let (_, kind) = bus_and_kind(line.word());
        let is_time = stamp.contains(&b'.') && scaled(stamp, 9).is_some();
        let is_frame = is_extended(kind).is_some() && number(line.word(), Base::Hex).is_some();
        is_time && (is_frame || matches!(kind, b"CXX" | b"CEV" | b"CBC" | b"CDP" | b"CDR" | b"CVR"))
    }

    fn item(&mut self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        if matches!(line.rest(), [] | [b'#', ..]) {
            return Ok(Item::Other);
        }
        let start = line;
        let time = line.time(9).ok().and_then(|ns| time(0, ns));
        let time = time.ok_or_else(|| start.fault("a time in seconds"))?;
        let at_kind = line;
        let (bus, kind) = bus_and_kind(line.word());
        let Some(is_extended) = is_extended(kind) else {
            let is_other = kind.len() == 3 && kind[0] == b'C';
            return if is_other { Ok(Item::Other) } else { Err(at_kind.fault("R11, R29, T11, T29 or C..")) };
        };
        let id = line.parse("an identifier of at most 7FF (11) or 1FFFFFFF (29)", |word| {
            identifier(number(word, Base::Hex)?, is_extended)
        })?;
        let (mut data, mut len) = ([0; MAX_DATA], 0);
        while !line.rest().is_empty() {
            let byte = line.parse("a data byte of 2 hex digits", hex_byte)?;
            *data.get_mut(len).ok_or_else(|| line.fault("at most 64 data bytes"))? = byte;
            len += 1;
        }
        if len == 0 && !line.is_whole {
            return Err(line.fault("a data byte or a line end, because the identifier may have been cut"));
        }
        let channel = channels.number(bus, 1).ok_or_else(|| at_kind.fault(CHANNEL))?;
        let frame = frame(id, len, &data).ok_or_else(|| line.fault("at most 64 data bytes"))?;
        Ok(Item::Frame { time, channel, frame })
    }
}

/// Splits `1R11` into the bus and the type. Without a number, the bus is 1.
fn bus_and_kind(word: &[u8]) -> (u32, &[u8]) {
    match word {
        [digit @ b'0'..=b'9', kind @ ..] => (u32::from(digit - b'0'), kind),
        kind => (1, kind),
    }
}

/// Whether the identifiers of a type have 29 bits; `None` = not a frame.
fn is_extended(kind: &[u8]) -> Option<bool> {
    match kind {
        b"R11" | b"T11" => Some(false),
        b"R29" | b"T29" => Some(true),
        _ => None,
    }
}
