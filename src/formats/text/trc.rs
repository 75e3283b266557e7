//! Reads trace files (`.trc`) of PEAK tools, versions 1.0 to 3.0.
//!
//! Comment lines begin with `;`. The header contains `;$FILEVERSION=2.1`, `;$STARTTIME=45244.925` (days since 30
//! December 1899) and, from version 2.0, `;$COLUMNS=N,O,T,B,I,d,R,L,D`. If the file version is missing, it is 1.0, and
//! the comment `Start time:` states the start. Each row has its offset from the start in milliseconds. An identifier
//! with more than four digits is extended.
//!
//! A date in a file is local time without a zone; it is read as UTC. The start time in days is read as a 64-bit float,
//! which resolves about a microsecond. If the written digits can be a rounded whole millisecond, this millisecond is
//! the start. Otherwise, the start is rounded to a microsecond.

use std::io;

use packwatch_core::can::{CanId, Frame, MAX_DATA};
use packwatch_core::quantity::Timestamp;

use super::cursor::{Base, Cursor, Fault, fd_length, hex_byte, identifier, number, scaled};
use super::{CHANNEL, Channels, Grammar, date, time};
use crate::Item;

/// 1 January 1970 in days since 30 December 1899.
const UNIX_DAYS: i128 = 25_569;
const DAY_NS: i128 = 86_400_000_000_000;
/// Number of bits used for the fraction of the day in a start time. A 64-bit float has 53 significant bits. For dates
/// from 1911, the whole days (4096 or more) take at least 13 of them, so the fraction has at most 40 bits.
const FRACTION_BITS: i32 = 40;
/// Largest number of columns. The newest version has 15.
const MAX_COLUMNS: usize = 32;

pub(super) struct Trc {
    /// The columns, by the letters of `$COLUMNS`. `1` stands for the type column of versions 1.1 to 1.3, which also
    /// contains the direction.
    columns: Vec<u8>,
    start_ns: i64,
    has_start: bool,
}

impl Grammar for Trc {
    fn new(_head: &[u8]) -> io::Result<Self> {
        Ok(Self { columns: b"NOILD".to_vec(), start_ns: 0, has_start: false })
    }

    fn recognises(line: &[u8]) -> bool {
        let line = line.trim_ascii();
        if line.starts_with(b";$FILEVERSION=") || line.starts_with(b";$COLUMNS=") {
            return true;
        }
        // Version 1.0: `1)  1841  0001 8 00 ...`
        let mut line = Cursor::new(line);
        let [count, offset, id, len] = [line.word(), line.word(), line.word(), line.word()];
        let is_count = count.strip_suffix(b")").is_some_and(|count| number(count, Base::Dec).is_some());
        let is_id = matches!(id.len(), 4 | 8) && number(id, Base::Hex).is_some();
        is_count && is_id && number(offset, Base::Dec).is_some() && matches!(length(len), Some(0..=8))
    }

    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        match line.rest() {
            [] => Ok(Item::Other),
            [b';', ..] => self.header(line),
            _ => self.row(line, channels),
        }
    }
}

/// The parts of a row that have been read.
struct Row<'a> {
    offset_ns: i64,
    kind: &'a [u8],
    channel: Option<u8>,
    id: Option<CanId>,
    len: usize,
    is_code: bool,
}

impl Trc {
    fn header(&mut self, line: Cursor<'_>) -> Result<Item, Fault> {
        let text = &line.rest()[1..];
        if let Some(version) = text.strip_prefix(b"$FILEVERSION=") {
            self.columns = match version.trim_ascii() {
                b"1.0" => b"NOILD".to_vec(),
                b"1.1" => b"NO1ILD".to_vec(),
                b"1.2" => b"NOB1ILD".to_vec(),
                b"1.3" => b"NOB1IRLD".to_vec(),
                b"2.0" => b"NOTIdlD".to_vec(),
                b"2.1" => b"NOTBIdRLD".to_vec(),
                [b'2' | b'3', b'.', ..] => b"NOTBIdRVSArsLD".to_vec(),
                _ => return Err(line.fault("version 1.0 to 3.0")),
            };
        } else if let Some(columns) = text.strip_prefix(b"$COLUMNS=") {
            let letters = columns.split(|byte| matches!(byte, b',' | b';' | b' ')).filter_map(<[u8]>::first);
            self.columns = letters.copied().take(MAX_COLUMNS).collect();
        } else if let Some(days) = text.strip_prefix(b"$STARTTIME=") {
            let days = days.trim_ascii().trim_ascii_end();
            let days = days.strip_suffix(b";").unwrap_or(days);
            self.start_ns = start_ns(days).ok_or_else(|| line.fault("days since 30 December 1899"))?;
            self.has_start = true;
        } else if let Some(text) = text.trim_ascii().strip_prefix(b"Start time:")
            && !self.has_start
            && let Some(start_ns) = date::parse(text)
        {
            self.start_ns = start_ns;
        }
        Ok(Item::Other)
    }

    fn row(&self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let mut row = Row { offset_ns: 0, kind: b"DT", channel: None, id: None, len: 0, is_code: true };
        for &column in &self.columns {
            let at = line;
            match column {
                b'O' => row.offset_ns = line.parse("an offset in ms", |word| scaled(word, 6))?,
                b'T' | b'1' => row.kind = line.word(),
                b'B' => row.channel = Some(line.parse(CHANNEL, |word| bus(word, channels))?),
                b'I' => {
                    // A row without a frame has other columns after the bus column.
                    if let Some(item) = self.without_identifier(&row, at, channels)? {
                        return Ok(item);
                    }
                    row.id = Some(line.parse("an identifier of 4 or 8 hex digits", id)?);
                }
                b'l' | b'L' => {
                    row.len = line.parse("a length", length)?;
                    row.is_code = column == b'L';
                }
                b'D' => return self.frame(row, line, channels),
                _ => drop(line.word()),
            }
        }
        Err(line.fault("a column D in $COLUMNS"))
    }

    /// Reads a row without a frame. `None` = the row has a frame.
    fn without_identifier(
        &self,
        row: &Row<'_>,
        at: Cursor<'_>,
        channels: &mut Channels,
    ) -> Result<Option<Item>, Fault> {
        let is_warning = at.peek().eq_ignore_ascii_case(b"FFFFFFFF");
        match row.kind {
            b"XL" => Ok(Some(Item::Xl)),
            b"ER" | b"Error" => {
                let time = self.time(row, at)?;
                Ok(Some(Item::ErrorFrame { time, channel: row.channel_or_first(at, channels)?, class: 0 }))
            }
            b"ST" | b"EC" | b"EV" | b"Warng" => Ok(Some(Item::Other)),
            b"DT" | b"FD" | b"FB" | b"FE" | b"BI" | b"RR" | b"Rx" | b"Tx" => Ok(is_warning.then_some(Item::Other)),
            _ => Err(at.fault("a row of type DT, FD, FB, FE, BI, RR, ER, ST, EC, EV, Rx, Tx, Warng or Error")),
        }
    }

    fn time(&self, row: &Row<'_>, at: Cursor<'_>) -> Result<Timestamp, Fault> {
        time(self.start_ns, row.offset_ns).ok_or_else(|| at.fault("a time below 9223372036 s"))
    }

    fn frame(&self, row: Row<'_>, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let time = self.time(&row, line)?;
        let channel = row.channel_or_first(line, channels)?;
        let fd = match row.kind {
            b"FD" => Some((false, false)),
            b"FB" => Some((true, false)),
            b"FE" => Some((false, true)),
            b"BI" => Some((true, true)),
            _ => None,
        };
        let id = row.id.ok_or_else(|| line.fault("a column I in $COLUMNS"))?;
        let first = line.peek();
        if first == b"ERROR" {
            return Ok(Item::ErrorFrame { time, channel, class: 0 });
        }
        if row.kind == b"RR" || first == b"RTR" {
            let frame = Frame::remote(id, row.len.min(8) as u8).ok_or_else(|| line.fault("a remote frame"))?;
            return Ok(Item::Frame { time, channel, frame });
        }
        let len = match (fd, row.is_code) {
            (Some(_), true) => fd_length(row.len as u32).ok_or_else(|| line.fault("a length code of 0 to 15"))?,
            (Some(_), false) => row.len,
            (None, _) => row.len.min(8),
        };
        if len > MAX_DATA {
            return Err(line.fault("at most 64 data bytes"));
        }
        let (data, rest) = data(line, len)?;
        if row.len > 8 && fd.is_none() && hex_byte(rest.peek()).is_some() {
            // A message of a transport protocol, which some tools reassemble.
            return Ok(Item::Other);
        }
        let frame = match fd {
            Some((brs, esi)) => Frame::fd_padded(id, brs, esi, len, &data),
            None => Frame::classic(id, &data[..len]),
        };
        let frame = frame.ok_or_else(|| line.fault("at most 64 data bytes"))?;
        Ok(Item::Frame { time, channel, frame })
    }
}

impl Row<'_> {
    /// The channel of the row, or channel 1 if the file has no such column.
    fn channel_or_first(&self, at: Cursor<'_>, channels: &mut Channels) -> Result<u8, Fault> {
        self.channel.or_else(|| channels.number(1, 1)).ok_or_else(|| at.fault(CHANNEL))
    }
}

/// Takes data bytes. Spaces between them may be missing. Also returns the position after them.
fn data(mut line: Cursor<'_>, len: usize) -> Result<([u8; MAX_DATA], Cursor<'_>), Fault> {
    let mut data = [0; MAX_DATA];
    for byte in &mut data[..len] {
        let digits = line.rest().get(..2).and_then(hex_byte);
        *byte = digits.ok_or_else(|| line.fault("a data byte of 2 hex digits"))?;
        line.at = line.text.len() - line.rest().len() + 2;
    }
    Ok((data, line))
}

fn bus(word: &[u8], channels: &mut Channels) -> Option<u8> {
    channels.number(if word == b"-" { 1 } else { number(word, Base::Dec)? }, 1)
}

fn id(word: &[u8]) -> Option<CanId> {
    identifier(number(word, Base::Hex)?, word.len() > 4)
}

/// Parses the length of a row. Reassembled messages are longer than frames.
fn length(word: &[u8]) -> Option<usize> {
    number(word, Base::Dec).map(|len| len as usize)
}

/// Converts days since 30 December 1899 to ns since 1970.
fn start_ns(days: &[u8]) -> Option<i64> {
    let text = String::from_utf8_lossy(days).replace(',', ".");
    let value: f64 = text.parse().ok().filter(|days: &f64| (0.0..200_000.0).contains(days))?;
    // Multiplies as integers, because a floating-point product would be rounded.
    let scale = 2_f64.powi(FRACTION_BITS);
    let exact_ns = ((value * scale) as i128 * DAY_NS) >> FRACTION_BITS;
    let digits = text.split_once('.').map_or(0, |(_, digits)| digits.len().min(17) as u32);
    // Half a unit of the last written digit, but at least half of the float's last bit (315 ns).
    let tolerance_ns = (DAY_NS / 2 / 10_i128.pow(digits)).max(315);
    let nearest = |unit_ns: i128| (exact_ns + unit_ns / 2) / unit_ns * unit_ns;
    let whole_ms = nearest(1_000_000);
    let start_ns = if (whole_ms - exact_ns).abs() <= tolerance_ns { whole_ms } else { nearest(1_000) };
    i64::try_from(start_ns - UNIX_DAYS * DAY_NS).ok()
}
