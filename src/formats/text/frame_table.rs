//! Reads tables of frames: a header line that names the columns, then a row per frame.
//!
//! Many tools write such tables: SavvyCAN and GVRET devices (`Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,...`), USB
//! adapters (`NO  Direction  Time Scale  Frame Type  Frame Format  Frame ID  Length  Data`), and CARBUS and CANHacker
//! (`@ TEXT @`, always the same columns). The header decides the order of the columns and the separator.
//!
//! Times with colons are times of day. All other times have the unit that the header states. If the header states no
//! unit, the first 16 KiB of the log decide. Times with a decimal point are then seconds. Whole numbers are Unix times,
//! or have the usual unit of their column. [`Grammar::remark`] names a unit that was assumed.
//!
//! Identifiers and data bytes are hexadecimal, or decimal if the first rows show it. An identifier above 7FF counts as
//! extended, even if the table says otherwise. SavvyCAN does the same.

use std::io;

use packwatch_core::can::{Frame, MAX_DATA};

use super::cursor::{Base, Cursor, Fault, fd_length, frame, identifier, joined_bytes, number, scaled};
use super::{CHANNEL, Channels, Grammar, time};
use crate::{Format, Item};

/// Beginning of a log of CARBUS or CANHacker, and its columns.
const CARBUS: &[u8] = b"@ TEXT @";
const CARBUS_COLUMNS: &[u8] = b"time(s)\tbus\tflags\tid\tlen\tdata";
/// Units as powers of ten of a nanosecond.
const MICROSECONDS: i32 = 3;
const MILLISECONDS: i32 = 6;
const SECONDS: i32 = 9;
/// Minimum number of rows whose times are compared with [`FRAME_NS`] to find the unit.
const FEWEST_ROWS: usize = 20;
/// Smallest and largest plausible mean time between frames. Even if four buses at 1 Mbit/s carry the shortest frames
/// without a pause, the mean is above the lower limit. At the upper limit, a bus carries six frames per minute.
const FRAME_NS: [i64; 2] = [10_000, 10_000_000_000];
const DAY_NS: i64 = 86_400_000_000_000;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Column {
    /// The time, with its unit if the header states it.
    Time(Option<i32>),
    /// The time of GVRET devices, in microseconds unless the rows contradict.
    TimeStamp,
    Id,
    Extended,
    Kind,
    Bus,
    Length,
    Byte,
    Data,
    Other,
}

pub(super) struct FrameTable {
    /// Empty before the header line.
    columns: Vec<Column>,
    has_bytes: bool,
    has_length: bool,
    separator: u8,
    base: Base,
    unit: i32,
    is_unit_assumed: bool,
    /// For times of day: start of the present day, and latest time of day.
    day_ns: i64,
    latest_ns: i64,
}

impl Grammar for FrameTable {
    fn new(head: &[u8]) -> io::Result<Self> {
        let mut log = Self {
            columns: Vec::new(),
            has_bytes: false,
            has_length: false,
            separator: b',',
            base: Base::Hex,
            unit: SECONDS,
            is_unit_assumed: false,
            day_ns: 0,
            latest_ns: 0,
        };
        let whole = if head.len() < Format::HEAD_BYTES {
            head.len()
        } else {
            memchr::memrchr2(b'\n', b'\r', head).unwrap_or(0)
        };
        let mut first = FirstRows::default();
        for line in head[..whole].split(|byte| matches!(byte, b'\n' | b'\r')) {
            match log.columns.is_empty() {
                true => log.read_header(line),
                false => first.note(&log, line),
            }
        }
        log.base = first.base();
        for column in std::mem::take(&mut log.columns) {
            match column {
                Column::Time(Some(unit)) => log.unit = unit,
                Column::Time(None) => (log.unit, log.is_unit_assumed) = first.unit(MILLISECONDS),
                Column::TimeStamp => (log.unit, log.is_unit_assumed) = first.unit(MICROSECONDS),
                _ => {}
            }
        }
        Ok(log)
    }

    fn recognises(line: &[u8]) -> bool {
        header(line).is_some()
    }

    fn remark(&self) -> Option<&'static str> {
        self.is_unit_assumed.then_some(match self.unit {
            MICROSECONDS => "times without a unit are read as microseconds",
            MILLISECONDS => "times without a unit are read as milliseconds",
            SECONDS => "times without a unit are read as seconds",
            _ => "times without a unit are read as nanoseconds",
        })
    }

    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        if self.columns.is_empty() || matches!(line.text, [] | [b'#', ..]) {
            self.read_header(line.text);
            return Ok(Item::Other);
        }
        self.row(line, channels)
    }
}

/// What the first rows show about unit and base.
#[derive(Default)]
struct FirstRows {
    times: Vec<i64>,
    decimals: usize,
    has_three_digits: bool,
    has_hex: bool,
    /// Whether an identifier is marked as standard, but would exceed 7FF if it were hexadecimal.
    has_decimal_id: bool,
}

impl FirstRows {
    fn note(&mut self, log: &FrameTable, line: &[u8]) {
        let mut line = Cursor::new(line);
        let (mut id, mut is_standard) = (None, false);
        for index in 0.. {
            let Some(field) = line.field(log.separator) else { break };
            match log.column(index) {
                Column::Byte => self.has_three_digits |= field.len() == 3 && field.iter().all(u8::is_ascii_digit),
                Column::Time(None) | Column::TimeStamp => {
                    let Some(time) = scaled(field, 0) else { continue };
                    self.times.push(time);
                    self.decimals += usize::from(field.iter().any(|byte| matches!(byte, b'.' | b',')));
                }
                Column::Extended => is_standard = !is_extended(field),
                Column::Id => {
                    self.has_hex |= !field.iter().all(u8::is_ascii_digit);
                    id = number(field, Base::Hex);
                }
                _ => {}
            }
        }
        self.has_decimal_id |= is_standard && id.is_some_and(|id| id > 0x7FF);
    }

    fn base(&self) -> Base {
        let is_decimal = self.has_three_digits || self.has_decimal_id && !self.has_hex;
        if is_decimal { Base::Dec } else { Base::Hex }
    }

    /// The unit of the times if the header states none, and whether this unit is only assumed.
    fn unit(&self, usual: i32) -> (i32, bool) {
        if self.decimals * 2 > self.times.len() || self.times.is_empty() {
            return (SECONDS, false);
        }
        let (first, last) = (self.times.iter().min(), self.times.iter().max());
        let (first, last) = first.zip(last).map_or((0, 0), |(first, last)| (*first, *last));
        let steps = i64::try_from(self.times.len()).unwrap_or(i64::MAX);
        let mean_ns = |unit: i32| last.saturating_sub(first).saturating_mul(10_i64.pow(unit.unsigned_abs())) / steps;
        let is_usual = |unit: &i32| (FRAME_NS[0]..=FRAME_NS[1]).contains(&mean_ns(*unit));
        let is_possible = |unit: &i32| self.times.len() < FEWEST_ROWS || is_usual(unit);
        // Unix times have ten digits of seconds.
        let is_unix = |unit: &i32| {
            first
                .checked_div(10_i64.pow((SECONDS - unit).unsigned_abs()))
                .is_some_and(|s| (1_000_000_000..10_000_000_000).contains(&s))
        };
        let unix = [SECONDS, MILLISECONDS, MICROSECONDS, 0].into_iter().find(is_unix).filter(is_usual);
        let unit = unix.or_else(|| [usual, MILLISECONDS, MICROSECONDS].into_iter().find(is_possible));
        (unit.unwrap_or(usual), unit != Some(MICROSECONDS) || usual != MICROSECONDS)
    }
}

impl FrameTable {
    fn read_header(&mut self, line: &[u8]) {
        if let Some((separator, columns)) = header(line) {
            self.has_bytes = columns.contains(&Column::Byte);
            self.has_length = columns.contains(&Column::Length);
            (self.separator, self.columns) = (separator, columns);
        }
    }

    /// The meaning of a column. Columns after those of the header are data bytes, except for a last empty column.
    fn column(&self, index: usize) -> Column {
        let beyond = if self.has_bytes { Column::Byte } else { Column::Other };
        self.columns.get(index).copied().unwrap_or(beyond)
    }

    fn row(&mut self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let start = line;
        let (mut at_ns, mut raw, mut extended, mut bus, mut len) = (None, None, false, 0, None);
        let (mut data, mut count, mut kind) = ([0; MAX_DATA], 0, RowKind::Data);
        for index in 0.. {
            let at = line;
            let Some(field) = line.field(self.separator) else { break };
            let missing = |expected| at.fault(expected);
            // A field at the end of a line without a line end may be incomplete.
            let is_cut = !line.is_whole && line.at > line.text.len();
            match self.column(index) {
                Column::Time(_) | Column::TimeStamp if is_cut => return Err(missing("a line end after the time")),
                Column::Time(_) | Column::TimeStamp => {
                    at_ns = Some(self.time_ns(field).ok_or_else(|| missing("a time"))?);
                }
                Column::Id => raw = Some(number(field, self.base).ok_or_else(|| missing("an identifier"))?),
                Column::Extended => extended = is_extended(field),
                Column::Kind => kind = RowKind::of(field),
                Column::Bus => bus = number(field, Base::Dec).ok_or_else(|| missing("the number of a bus"))?,
                Column::Length => {
                    let found = number(field, Base::Dec).map(|len| len as usize).filter(|len| *len <= MAX_DATA);
                    len = Some(found.ok_or_else(|| missing("a length of 0 to 64"))?);
                }
                Column::Byte if len.is_none_or(|len| count < len) && count < MAX_DATA && !field.is_empty() => {
                    let byte = number(field, self.base).filter(|_| !is_cut || field.len() >= 2);
                    data[count] =
                        byte.and_then(|byte| u8::try_from(byte).ok()).ok_or_else(|| missing("a data byte"))?;
                    count += 1;
                }
                Column::Data if is_cut && !self.has_length => return Err(missing("a line end after the data")),
                Column::Data => {
                    (data, count) = bytes(field).ok_or_else(|| missing("at most 64 data bytes"))?;
                    // The length may be a CAN FD length code (DLC) instead of a number of bytes.
                    let code_len = len.and_then(|len| fd_length(len as u32));
                    len = if code_len == Some(count) { code_len } else { len.or(Some(count)) };
                    len.filter(|len| *len == count || kind != RowKind::Data).ok_or_else(|| missing(LENGTH))?;
                }
                Column::Byte | Column::Other => {}
            }
        }
        let time = at_ns.and_then(|ns| time(0, ns)).ok_or_else(|| start.fault("a time"))?;
        let channel = channels.number(bus, 0).ok_or_else(|| start.fault(CHANNEL))?;
        if kind == RowKind::Error {
            return Ok(Item::ErrorFrame { time, channel, class: 0 });
        }
        let len = len.filter(|len| *len <= count || kind == RowKind::Remote).ok_or_else(|| start.fault(LENGTH))?;
        let id = raw.and_then(|raw| identifier(raw, extended || raw > 0x7FF));
        let id = id.ok_or_else(|| start.fault("an identifier of at most 1FFFFFFF"))?;
        let is_remote = kind == RowKind::Remote;
        let frame = if is_remote { Frame::remote(id, len.min(8) as u8) } else { frame(id, len, &data) };
        let frame = frame.ok_or_else(|| start.fault("a length of 0 to 64"))?;
        Ok(Item::Frame { time, channel, frame })
    }

    /// The time of a row. A time of day far before the latest time belongs to the next day.
    fn time_ns(&mut self, field: &[u8]) -> Option<i64> {
        if !field.contains(&b':') {
            return scaled(field, self.unit);
        }
        let at_ns = time_of_day_ns(field)?;
        let ahead_ns = at_ns - self.latest_ns;
        if ahead_ns > DAY_NS / 2 && self.day_ns > 0 {
            // The frame belongs to the previous day and was recorded late.
            return at_ns.checked_add(self.day_ns - DAY_NS);
        }
        if ahead_ns < -DAY_NS / 2 {
            self.day_ns = self.day_ns.checked_add(DAY_NS)?;
        }
        self.latest_ns = at_ns;
        at_ns.checked_add(self.day_ns)
    }
}

/// Expected content of the row, for the message about a length that contradicts the data.
const LENGTH: &str = "as many data bytes as the row's length states";

/// Kind of a row, as its column `Frame Type` states it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RowKind {
    Data,
    Remote,
    Error,
}

impl RowKind {
    fn of(field: &[u8]) -> Self {
        match field.to_ascii_lowercase().as_slice() {
            [b'r', b'e' | b't', ..] => Self::Remote,
            [b'e', b'r', ..] => Self::Error,
            _ => Self::Data,
        }
    }
}

fn is_extended(field: &[u8]) -> bool {
    matches!(field.to_ascii_lowercase().as_slice(), [b't' | b'1' | b'e' | b'y' | b'x', ..] | [b'2', b'9', ..])
}

/// Reads `h:m:s`, `h:m:s.f`, `h:m:s:ms` or `m:s.f`.
fn time_of_day_ns(field: &[u8]) -> Option<i64> {
    let parts: Vec<&[u8]> = field.split(|byte| *byte == b':').collect();
    let whole = |part: &[u8]| number(part, Base::Dec).map(i64::from);
    let (hours, minutes, seconds_ns) = match parts[..] {
        [minutes, seconds] => (0, whole(minutes)?, scaled(seconds, SECONDS)?),
        [hours, minutes, seconds] => (whole(hours)?, whole(minutes)?, scaled(seconds, SECONDS)?),
        [hours, minutes, seconds, fraction] => {
            (whole(hours)?, whole(minutes)?, scaled(&[seconds, b".", fraction].concat(), SECONDS)?)
        }
        _ => return None,
    };
    let is_time = hours < 24 && minutes < 60 && (0..61_000_000_000).contains(&seconds_ns);
    is_time.then(|| (hours * 60 + minutes) * 60_000_000_000 + seconds_ns)
}

/// Separator and columns of a header line; `None` for any other line, and for a table of currents and voltages.
fn header(line: &[u8]) -> Option<(u8, Vec<Column>)> {
    let line = if line.starts_with(CARBUS) { CARBUS_COLUMNS } else { line };
    let separator = [b'\t', b',', b';'].into_iter().find(|byte| line.contains(byte));
    let text = String::from_utf8_lossy(line).to_lowercase();
    let names: Vec<&str> = match separator {
        Some(separator) => text.split(char::from(separator)).collect(),
        // Columns of fixed width: zero bytes or at least two blanks separate the names; zero bytes separate the fields
        // of the rows.
        None => text.split('\0').flat_map(|part| part.split("  ")).filter(|name| !name.trim().is_empty()).collect(),
    };
    let is_of_battery = names.iter().any(|name| ["volt", "current"].iter().any(|word| name.contains(word)));
    let columns: Vec<Column> = names.iter().map(|name| column(name)).collect::<Option<_>>()?;
    let has = |wanted: Column| columns.contains(&wanted);
    let has_time = columns.iter().any(|column| matches!(column, Column::Time(_) | Column::TimeStamp));
    let has_data =
        has(Column::Data) && (has(Column::Length) || has(Column::Bus)) || has(Column::Byte) && has(Column::Length);
    (has_time && has(Column::Id) && has_data && !is_of_battery).then(|| (separator.unwrap_or(0), columns))
}

/// The meaning of a column's name in lower case. A unit in brackets may follow it. `None` = a time in an unknown unit.
fn column(name: &str) -> Option<Column> {
    let name = name.trim_matches([' ', '"', '\u{feff}', '\r']);
    let (name, unit) = name.split_once(['(', '[']).map_or((name, ""), |(name, unit)| (name.trim(), unit));
    Some(match name {
        "time stamp" if unit.is_empty() => Column::TimeStamp,
        "time" | "time stamp" | "timestamp" | "time scale" | "abs time" | "system time" => {
            Column::Time(match unit.trim_matches([')', ']', ' ', '"']) {
                "" => None,
                "ns" | "nanoseconds" => Some(0),
                // The micro sign is one of two Unicode letters, or a Latin-1 byte that was replaced.
                "us" | "\u{b5}s" | "\u{3bc}s" | "\u{fffd}s" | "microseconds" => Some(MICROSECONDS),
                "ms" | "milliseconds" => Some(MILLISECONDS),
                "s" | "sec" | "seconds" => Some(SECONDS),
                _ => return None,
            })
        }
        "id" | "can id" | "frame id" | "identifier" | "addr" => Column::Id,
        "extended" | "frame format" => Column::Extended,
        "frame type" => Column::Kind,
        "bus" | "ch" | "channel" => Column::Bus,
        "len" | "dlc" | "length" | "data length" => Column::Length,
        "data" | "data bytes" => Column::Data,
        _ if name.strip_prefix('d').is_some_and(|digits| digits.parse::<u8>().is_ok()) => Column::Byte,
        _ => Column::Other,
    })
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
