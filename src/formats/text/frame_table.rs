//! Reads tables of frames: a header line that names the columns, then a row per frame.
//!
//! Many tools write such tables: SavvyCAN and GVRET devices (`Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,...`), USB adapters
//! (`NO  Direction  Time Scale  Frame Type  Frame Format  Frame ID  Length  Data`), CARBUS and CANHacker (`@ TEXT @`,
//! always the same columns). The header decides the order of the columns and the separator.
//!
//! Times with a decimal point are seconds, times with colons are times of day. Whole numbers have the unit that the header
//! states; without one, they are microseconds in a column `Time Stamp` and milliseconds in any other. If more frames than
//! any bus carries would lie in the first microseconds, these are milliseconds. Identifiers and data bytes are hexadecimal; they are decimal if a data byte in the first 16 KiB has three digits. An identifier above 7FF is
//! extended whatever the table says, as in SavvyCAN.

use std::io;

use packwatch_core::can::{Frame, MAX_DATA};

use super::cursor::{Base, Cursor, Fault, frame, identifier, joined_bytes, number, scaled};
use super::{CHANNEL, Channels, Grammar, time};
use crate::Item;

/// Beginning of a log of CARBUS or CANHacker, and its columns.
const CARBUS: &[u8] = b"@ TEXT @";
const CARBUS_COLUMNS: &[u8] = b"time(ms)\tbus\tflags\tid\tlen\tdata";
/// Units as powers of ten of a nanosecond.
const MICROSECONDS: i32 = 3;
const MILLISECONDS: i32 = 6;
const SECONDS: i32 = 9;
/// Number of rows from which their times tell the unit.
const FEWEST_ROWS: usize = 20;
const DAY_NS: i64 = 86_400_000_000_000;
/// Smallest mean time between frames: four buses at 1 Mbit/s carry the shortest frames without a pause.
const SHORTEST_FRAME_NS: i64 = 10_000;

/// Meaning of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Column {
    /// Whole numbers times 10 to this power are nanoseconds. `None` = the rows show the unit.
    Time(Option<i32>),
    Id,
    Extended,
    Kind,
    Bus,
    Length,
    Byte,
    Data,
    Other,
}

/// State of a log.
pub(super) struct FrameTable {
    /// Empty before the header line.
    columns: Vec<Column>,
    separator: u8,
    base: Base,
    /// The power of [`Column::Time`] if the header states no unit.
    unstated: i32,
    /// Start of the present day, and the latest time, for times of day.
    day_ns: i64,
    latest_ns: i64,
}

impl Grammar for FrameTable {
    fn new(head: &[u8]) -> io::Result<Self> {
        let mut log = Self {
            columns: Vec::new(),
            separator: b',',
            base: Base::Hex,
            unstated: MICROSECONDS,
            day_ns: 0,
            latest_ns: 0,
        };
        let mut times = Vec::new();
        for line in head.split(|byte| matches!(byte, b'\n' | b'\r')) {
            if log.columns.is_empty() {
                log.read_header(line);
                continue;
            }
            let mut line = Cursor::new(line);
            for index in 0.. {
                let Some(field) = line.field(log.separator) else { break };
                match log.column(index) {
                    Column::Byte if is_three_digits(field) => log.base = Base::Dec,
                    Column::Time(None) if !field.contains(&b'.') => times.extend(scaled(field, MICROSECONDS)),
                    _ => {}
                }
            }
        }
        let span_ns = times.iter().max().zip(times.iter().min()).map_or(0, |(last, first)| last.saturating_sub(*first));
        let is_too_fast = times.len() >= FEWEST_ROWS && span_ns < times.len() as i64 * SHORTEST_FRAME_NS;
        Ok(Self { columns: Vec::new(), unstated: if is_too_fast { MILLISECONDS } else { MICROSECONDS }, ..log })
    }

    fn recognises(line: &[u8]) -> bool {
        header(line).is_some()
    }

    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        if self.columns.is_empty() || matches!(line.text, [] | [b'#', ..]) {
            self.read_header(line.text);
            return Ok(Item::Other);
        }
        self.row(line, channels)
    }
}

impl FrameTable {
    fn read_header(&mut self, line: &[u8]) {
        if let Some((separator, columns)) = header(line) {
            (self.separator, self.columns) = (separator, columns);
        }
    }

    /// The meaning of a column. Columns after those of the header are data bytes, except for a last empty column.
    fn column(&self, index: usize) -> Column {
        let has_bytes = self.columns.contains(&Column::Byte);
        let beyond = if has_bytes { Column::Byte } else { Column::Other };
        self.columns.get(index).copied().unwrap_or(beyond)
    }

    fn row(&mut self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let start = line;
        let (mut at_ns, mut raw, mut is_extended, mut bus, mut len) = (None, None, false, 0, None);
        let (mut data, mut count, mut is_remote) = ([0; MAX_DATA], 0, false);
        for index in 0.. {
            let at = line;
            let Some(field) = line.field(self.separator) else { break };
            let missing = |expected| at.fault(expected);
            match self.column(index) {
                Column::Time(power) => {
                    at_ns = Some(self.time_ns(field, power).ok_or_else(|| missing("a time"))?);
                }
                Column::Id => raw = Some(number(field, self.base).ok_or_else(|| missing("an identifier"))?),
                Column::Extended => is_extended = matches!(field, [b't' | b'T' | b'1' | b'e' | b'E', ..]),
                Column::Kind => is_remote = matches!(field, [b'r' | b'R', b'e' | b'E' | b't' | b'T', ..]),
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
                Column::Data => (data, count) = bytes(field).ok_or_else(|| missing("at most 64 data bytes"))?,
                Column::Byte | Column::Other => {}
            }
        }
        let is_complete = |len: &usize| is_remote || *len <= count;
        let len = len.or_else(|| self.columns.contains(&Column::Data).then_some(count)).filter(is_complete);
        let len = len.ok_or_else(|| start.fault("as many data bytes as the row's length states"))?;
        let id = raw.and_then(|raw| identifier(raw, is_extended || raw > 0x7FF));
        let id = id.ok_or_else(|| start.fault("an identifier of at most 1FFFFFFF"))?;
        let time = at_ns.and_then(|ns| time(self.day_ns, ns)).ok_or_else(|| start.fault("a time"))?;
        let channel = channels.number(bus, 0).ok_or_else(|| start.fault(CHANNEL))?;
        let frame = if is_remote { Frame::remote(id, len.min(8) as u8) } else { frame(id, len, &data) };
        let frame = frame.ok_or_else(|| start.fault("a length of 0 to 64"))?;
        Ok(Item::Frame { time, channel, frame })
    }

    /// The time of a row; for a time of day, the time since midnight.
    fn time_ns(&mut self, field: &[u8], power: Option<i32>) -> Option<i64> {
        if !field.contains(&b':') {
            let is_whole = !field.iter().any(|byte| matches!(byte, b'.' | b','));
            return scaled(field, if is_whole { power.unwrap_or(self.unstated) } else { SECONDS });
        }
        let mut parts = field.splitn(4, |byte| matches!(byte, b':' | b'.' | b','));
        let mut whole = || number(parts.next()?, Base::Dec).map(i64::from);
        let (hours, minutes, seconds) = (whole()?, whole()?, whole()?);
        // The digits after the seconds are a decimal fraction, whatever separates them.
        let fraction_ns = parts.next().map_or(Some(0), |digits| scaled(&[b"0.", digits].concat(), 9))?;
        if hours >= 24 || minutes >= 60 || seconds > 60 {
            return None;
        }
        let at_ns = ((hours * 60 + minutes) * 60 + seconds) * 1_000_000_000 + fraction_ns;
        if at_ns < self.latest_ns - DAY_NS / 2 {
            self.day_ns = self.day_ns.checked_add(DAY_NS)?;
        }
        self.latest_ns = at_ns;
        Some(at_ns)
    }
}

/// Separator and columns of a header line; `None` for any other line.
fn header(line: &[u8]) -> Option<(u8, Vec<Column>)> {
    let line = if line.starts_with(CARBUS) { CARBUS_COLUMNS } else { line };
    let separator = [b'\t', b',', b';'].into_iter().find(|byte| line.contains(byte));
    let columns: Vec<Column> = match separator {
        Some(separator) => line.split(|byte| *byte == separator).map(column).collect(),
        // Columns of fixed width. The rows separate them by zero bytes.
        None => String::from_utf8_lossy(line)
            .replace('\0', "  ")
            .split("  ")
            .filter(|name| !name.trim().is_empty())
            .map(|name| column(name.as_bytes()))
            .collect(),
    };
    let has = |wanted: Column| columns.contains(&wanted);
    let has_time = columns.iter().any(|column| matches!(column, Column::Time(_)));
    let has_data =
        has(Column::Data) && (has(Column::Length) || has(Column::Bus)) || has(Column::Byte) && has(Column::Length);
    (has_time && has(Column::Id) && has_data).then(|| (separator.unwrap_or(0), columns))
}

/// The meaning of a column's name. A unit in brackets may follow it.
fn column(name: &[u8]) -> Column {
    let name = String::from_utf8_lossy(name).trim_matches([' ', '"', '\u{feff}']).to_ascii_lowercase();
    let (name, unit) = name.split_once(['(', '[']).map_or((name.as_str(), ""), |(name, unit)| (name.trim(), unit));
    match name {
        "time" | "time stamp" | "timestamp" | "time scale" | "abs time" | "system time" => Column::Time(match unit {
            _ if unit.starts_with("us") || unit.starts_with('µ') => Some(MICROSECONDS),
            _ if unit.starts_with('s') => Some(SECONDS),
            "" if name == "time stamp" => None,
            _ => Some(MILLISECONDS),
        }),
        "id" | "can id" | "frame id" | "identifier" | "addr" => Column::Id,
        "extended" | "frame format" => Column::Extended,
        "frame type" => Column::Kind,
        "bus" | "ch" | "channel" => Column::Bus,
        "len" | "dlc" | "length" | "data length" => Column::Length,
        "data" | "data bytes" => Column::Data,
        _ if matches!(name.as_bytes(), [b'd', b'0'..=b'9', ..]) => Column::Byte,
        _ => Column::Other,
    }
}

/// Hexadecimal data bytes in one field, with or without blanks between them, and their number.
fn bytes(field: &[u8]) -> Option<([u8; MAX_DATA], usize)> {
    let field = field.strip_prefix(b"0x").unwrap_or(field);
    if !field.contains(&b' ') && field.len() > 2 {
        return joined_bytes(field);
    }
    let (mut data, mut count) = ([0; MAX_DATA], 0);
    for byte in field.split(u8::is_ascii_whitespace).filter(|byte| !byte.is_empty()) {
        *data.get_mut(count)? = number(byte, Base::Hex).and_then(|byte| u8::try_from(byte).ok())?;
        count += 1;
    }
    Some((data, count))
}

fn is_three_digits(field: &[u8]) -> bool {
    field.len() == 3 && field.iter().all(u8::is_ascii_digit)
}
