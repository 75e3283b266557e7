//! Reads CAN logs of BUSMASTER.
//!
//! Header lines are enclosed in `***`: `***START DATE AND TIME 14:11:2023 22:13:20:000***`, `***HEX***` or `***DEC***`,
//! and the mode of the times. A row: `00:00:01:0000 Rx 1 0x100 s 8 05 00 ...`, with a time in hours, minutes, seconds
//! and units of 100 us. Types: s standard, x extended, sr and xr remote.
//!
//! In absolute mode, times count from the start; in relative mode, from the previous row; in system mode, they are times
//! of day, and the day increases at midnight. The start is local time without a zone; it is read as UTC.

use std::io;

use packwatch_core::can::{Frame, MAX_DATA};
use packwatch_core::quantity::Timestamp;

use super::cursor::{Base, Cursor, Fault, identifier, number};
use super::{CHANNEL, Channels, Grammar, date, time};
use crate::Item;

const MS_NS: i64 = 1_000_000;
const DAY_NS: i64 = 86_400_000 * MS_NS;

/// The origin of the times of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    Absolute,
    Relative,
    System,
}

pub(super) struct Busmaster {
    mode: Mode,
    base: Base,
    start_ns: i64,
    /// The latest time since the start or, in system mode, since the midnight before the start, ns.
    latest_ns: i64,
}

impl Grammar for Busmaster {
    fn new(_head: &[u8]) -> io::Result<Self> {
        Ok(Self { mode: Mode::Absolute, base: Base::Hex, start_ns: 0, latest_ns: 0 })
    }

    fn recognises(line: &[u8]) -> bool {
        line.trim_ascii_start().starts_with(b"***BUSMASTER Ver")
    }

    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        match line.rest() {
            [] => Ok(Item::Other),
            [b'*', b'*', b'*', text @ ..] => self.header(text, line),
            _ => self.row(line, channels),
        }
    }
}

impl Busmaster {
    fn header(&mut self, text: &[u8], line: Cursor<'_>) -> Result<Item, Fault> {
        match text.strip_suffix(b"***").unwrap_or(text).trim_ascii() {
            b"HEX" => self.base = Base::Hex,
            b"DEC" => self.base = Base::Dec,
            b"ABSOLUTE MODE" => self.mode = Mode::Absolute,
            b"RELATIVE MODE" => self.mode = Mode::Relative,
            b"SYSTEM MODE" => self.mode = Mode::System,
            text => {
                if let Some(text) = text.strip_prefix(b"START DATE AND TIME") {
                    let start_ns = start_ns(text);
                    self.start_ns =
                        start_ns.ok_or_else(|| line.fault("START DATE AND TIME day:month:year h:m:s:ms"))?;
                    self.latest_ns = 0;
                }
            }
        }
        Ok(Item::Other)
    }

    fn row(&mut self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let written = line.parse("a time h:m:s:100us", clock_ns)?;
        let time = self.place(written).ok_or_else(|| line.fault("a time below 9223372036 s"))?;
        line.parse("Rx or Tx", |word| matches!(word, b"Rx" | b"Tx").then_some(()))?;
        let channel = line.parse(CHANNEL, |word| channels.number(number(word, Base::Dec)?, 1))?;
        let at_id = line;
        let id = line.word();
        let kind = line.word().to_ascii_lowercase();
        let is_extended = kind.starts_with(b"x");
        let id = number(id, self.base).and_then(|raw| identifier(raw, is_extended));
        let id = id.ok_or_else(|| at_id.fault("an identifier of at most 7FF (s) or 1FFFFFFF (x)"))?;
        let len = line.parse("a length of 0 to 64", |word| {
            number(word, Base::Dec).map(|len| len as usize).filter(|len| *len <= MAX_DATA)
        })?;
        let frame = match kind.as_slice() {
            b"s" | b"x" => super::cursor::frame(id, len, &line.data(len, self.base)?),
            b"sr" | b"xr" => Frame::remote(id, len.min(8) as u8),
            _ => None,
        };
        let frame = frame.ok_or_else(|| at_id.fault("an identifier and a type: s, x, sr or xr"))?;
        Ok(Item::Frame { time, channel, frame })
    }

    /// Returns the time of a row. `None` if it is out of range.
    fn place(&mut self, written_ns: i64) -> Option<Timestamp> {
        let midnight_ns = self.start_ns - self.start_ns.rem_euclid(DAY_NS);
        match self.mode {
            Mode::Absolute => return time(self.start_ns, written_ns),
            Mode::Relative => self.latest_ns = self.latest_ns.checked_add(written_ns)?,
            Mode::System => {
                let day_ns = self.latest_ns - self.latest_ns.rem_euclid(DAY_NS);
                let is_next_day = day_ns.checked_add(written_ns)? < self.latest_ns - DAY_NS / 2;
                self.latest_ns = day_ns.checked_add(written_ns)?.checked_add(if is_next_day { DAY_NS } else { 0 })?;
            }
        }
        time(if self.mode == Mode::System { midnight_ns } else { self.start_ns }, self.latest_ns)
    }
}

/// Parses `h:m:s:f`, where `f` is in ms (three digits) or units of 100 us (four digits). Hours may exceed 24.
fn clock_ns(word: &[u8]) -> Option<i64> {
    let mut fields = word.split(|&byte| byte == b':');
    let mut field = || fields.next();
    let (hours, minutes, seconds, fraction) = (field()?, field()?, field()?, field()?);
    let seconds = [hours, minutes, seconds].iter().try_fold(0, |sum, field| Some(sum * 60 + date::integer(field)?))?;
    let unit_ns = if fraction.len() > 3 { MS_NS / 10 } else { MS_NS };
    let is_end = fields.next().is_none();
    i64::checked_mul(seconds, 1000 * MS_NS)?.checked_add(date::integer(fraction)? * unit_ns).filter(|_| is_end)
}

/// Parses `14:11:2023 22:13:20:000`, ns since 1970.
fn start_ns(text: &[u8]) -> Option<i64> {
    let mut line = Cursor::new(text);
    let (day, clock) = (line.word(), line.word());
    let mut fields = day.split(|&byte| byte == b':').map(date::integer);
    let (day, month, year) = (fields.next()??, fields.next()??, fields.next()??);
    date::midnight(year, month, day)?.checked_add(clock_ns(clock)?)
}
