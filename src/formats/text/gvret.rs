//! Reads the CSV of SavvyCAN and of GVRET devices: `Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,...`.
//!
//! The header line decides the order of the columns, so that the older form without `Dir` and reordered files are read
//! too. Times are in microseconds, or in seconds if they have a decimal point. Identifiers and data bytes are
//! hexadecimal; they are decimal if a data byte in the first 16 KiB has three digits. An identifier above 7FF is
//! extended whatever the column `Extended` contains, as in SavvyCAN.

use std::io;

use packwatch_core::can::MAX_DATA;

use super::cursor::{Base, Cursor, Fault, frame, identifier, number, scaled};
use super::{CHANNEL, Channels, Grammar, time};
use crate::Item;

/// Meaning of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Column {
    Time,
    Id,
    Extended,
    Bus,
    Length,
    Byte,
    Other,
}

/// State of a log.
pub(super) struct Gvret {
    /// Empty before the header line.
    columns: Vec<Column>,
    separator: u8,
    base: Base,
}

impl Grammar for Gvret {
    fn new(head: &[u8]) -> io::Result<Self> {
        let mut log = Self { columns: Vec::new(), separator: b',', base: Base::Hex };
        for line in head.split(|byte| matches!(byte, b'\n' | b'\r')) {
            if log.columns.is_empty() && Self::recognises(line) {
                log.read_header(line);
            }
            let mut line = Cursor::new(line);
            let bytes = (0..).map_while(|index| Some((log.column(index), line.field(log.separator)?)));
            if bytes.filter(|(column, _)| *column == Column::Byte).any(|(_, byte)| is_three_digits(byte)) {
                log.base = Base::Dec;
            }
        }
        log.columns.clear();
        Ok(log)
    }

    fn recognises(line: &[u8]) -> bool {
        let line = line.to_ascii_lowercase();
        let contains = |word: &[u8]| memchr::memmem::find(&line, word).is_some();
        let first = line.trim_ascii_start();
        let first = first.strip_prefix(b"\"").unwrap_or(first);
        first.starts_with(b"time stamp") && contains(b"extended") && contains(b"d1")
    }

    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        if line.text.is_empty() {
            return Ok(Item::Other);
        }
        if self.columns.is_empty() {
            if Self::recognises(line.text) {
                self.read_header(line.text);
            }
            return Ok(Item::Other);
        }
        self.row(line, channels)
    }
}

impl Gvret {
    fn read_header(&mut self, line: &[u8]) {
        self.separator = [b',', b';', b'\t'].into_iter().find(|byte| line.contains(byte)).unwrap_or(b',');
        let mut line = Cursor::new(line);
        self.columns.clear();
        while let Some(name) = line.field(self.separator) {
            self.columns.push(match name.to_ascii_lowercase().as_slice() {
                b"time stamp" => Column::Time,
                b"id" => Column::Id,
                b"extended" => Column::Extended,
                b"bus" => Column::Bus,
                b"len" => Column::Length,
                [b'd', b'0'..=b'9', ..] => Column::Byte,
                _ => Column::Other,
            });
        }
    }

    /// The meaning of a column. Columns after those of the header are data bytes, except for a last empty column.
    fn column(&self, index: usize) -> Column {
        self.columns.get(index).copied().unwrap_or(Column::Byte)
    }

    fn row(&self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let start = line;
        let (mut at_ns, mut raw, mut is_extended, mut bus, mut len) = (None, None, false, 0, None);
        let (mut data, mut count) = ([0; MAX_DATA], 0);
        for index in 0.. {
            let at = line;
            let Some(field) = line.field(self.separator) else { break };
            let missing = |expected| at.fault(expected);
            match self.column(index) {
                Column::Time => at_ns = Some(stamp_ns(field).ok_or_else(|| missing("a time in microseconds"))?),
                Column::Id => raw = Some(number(field, self.base).ok_or_else(|| missing("an identifier"))?),
                Column::Extended => is_extended = matches!(field, [b't' | b'T' | b'1', ..]),
                Column::Bus => bus = number(field, Base::Dec).ok_or_else(|| missing("the number of a bus"))?,
                Column::Length => {
                    let found = number(field, Base::Dec).map(|len| len as usize).filter(|len| *len <= MAX_DATA);
                    len = Some(found.ok_or_else(|| missing("a length of 0 to 64"))?);
                }
                Column::Byte if len.is_none_or(|len| count < len) && count < MAX_DATA && !field.is_empty() => {
                    let is_cut = !line.is_whole && line.at > line.text.len() && field.len() < 2;
                    let byte = number(field, self.base).filter(|_| !is_cut).and_then(|byte| u8::try_from(byte).ok());
                    data[count] = byte.ok_or_else(|| missing("a data byte"))?;
                    count += 1;
                }
                Column::Byte | Column::Other => {}
            }
        }
        let len = len.filter(|len| *len <= count).ok_or_else(|| start.fault("as many data bytes as LEN states"))?;
        let id = raw.and_then(|raw| identifier(raw, is_extended || raw > 0x7FF));
        let id = id.ok_or_else(|| start.fault("an identifier of at most 1FFFFFFF"))?;
        let time = at_ns.and_then(|ns| time(0, ns)).ok_or_else(|| start.fault("a time in microseconds"))?;
        let channel = channels.number(bus, 0).ok_or_else(|| start.fault(CHANNEL))?;
        let frame = frame(id, len, &data).ok_or_else(|| start.fault("a length of 0 to 64"))?;
        Ok(Item::Frame { time, channel, frame })
    }
}

fn stamp_ns(field: &[u8]) -> Option<i64> {
    scaled(field, if field.contains(&b'.') { 9 } else { 3 })
}

fn is_three_digits(field: &[u8]) -> bool {
    field.len() == 3 && field.iter().all(u8::is_ascii_digit)
}
