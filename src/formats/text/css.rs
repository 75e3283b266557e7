//! Reads the text logs of the CSS Electronics loggers CL1000, CL2000 and CL3000.
//!
//! Header: `# Time: 20231005T071031` (start) and further settings, then `Timestamp;Type;ID;Data` with any separator. A
//! row: `05T071031805;0;326;0000000000000100`. Types of received frames: 0 standard, 1 extended. Types of frames that
//! the logger has sent: 8 standard, 9 extended.
//!
//! A stamp consists of year, month, day, hour, minute, second and millisecond, with or without separators. Its first
//! parts can be missing; they come from the header's time. If a stamp is far before the previous stamp, the last of the
//! missing parts has increased by one: in the row above, this is the month.

use std::io;

use super::cursor::{Base, Cursor, Fault, frame, identifier, joined_bytes, number, scaled};
use super::{CHANNEL, Channels, Grammar, date, time};
use crate::Item;

/// Largest number of columns. The loggers write at most 7.
const MAX_COLUMNS: usize = 16;
/// Number of digits of the parts of a stamp, from the year to the millisecond.
const PART_DIGITS: [usize; 7] = [4, 2, 2, 2, 2, 2, 3];
const HOUR_NS: i64 = 3_600_000_000_000;
/// Length of the parts in ns, from the hour to the millisecond.
const PART_NS: [i64; 4] = [HOUR_NS, 60_000_000_000, 1_000_000_000, 1_000_000];

#[derive(Debug, Clone, Copy)]
enum Column {
    Time,
    Kind,
    Id,
    Length,
    Data,
    Other,
}

pub(super) struct Css {
    /// Start as stated by the header: year, month, day, hour, minute, second, millisecond.
    start: [i64; 7],
    separator: u8,
    /// Empty before the line of column names.
    columns: Vec<Column>,
    latest_ns: Option<i64>,
    /// Sum of the increases of the parts that the stamps do not contain, ns.
    carry_ns: i64,
}

impl Grammar for Css {
    fn new(_head: &[u8]) -> io::Result<Self> {
        let start = [1970, 1, 1, 0, 0, 0, 0];
        Ok(Self { start, separator: b';', columns: Vec::new(), latest_ns: None, carry_ns: 0 })
    }

    fn recognises(line: &[u8]) -> bool {
        line.starts_with(b"# Logger type: CL") || column_separator(line).is_some()
    }

    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        if let Some(start) = line.text.strip_prefix(b"# Time:") {
            let mut parts = [1970, 1, 1, 0, 0, 0, 0];
            let found = read_parts(start, 6, &mut parts);
            found.filter(|found| *found == 6).ok_or_else(|| line.fault("# Time: YYYYMMDDThhmmss"))?;
            self.start = parts;
        }
        if line.text.is_empty() || line.text.starts_with(b"#") {
            return Ok(Item::Other);
        }
        if let Some(separator) = column_separator(line.text) {
            self.separator = separator;
            self.columns = line.text.split(|&byte| byte == separator).take(MAX_COLUMNS).map(column).collect();
            return Ok(Item::Other);
        }
        self.row(line, channels)
    }
}

impl Css {
    fn row(&mut self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let start = line;
        let (mut at_ns, mut kind, mut raw, mut len, mut data) = (None, None, None, None, None);
        for index in 0..self.columns.len() {
            let Some(field) = line.field(self.separator) else { break };
            match self.columns[index] {
                Column::Time => at_ns = self.stamp_ns(field),
                Column::Kind => kind = number(field, Base::Dec),
                Column::Id => raw = number(field, Base::Hex),
                Column::Length => len = number(field, Base::Dec),
                Column::Data => data = joined_bytes(field),
                Column::Other => {}
            }
        }
        let time = at_ns.and_then(|ns| time(0, ns)).ok_or_else(|| start.fault("a row that begins with a time"))?;
        let is_extended = |raw: u32| kind.map_or(raw > 0x7FF, |kind| kind & 1 != 0);
        let id = raw.and_then(|raw| identifier(raw, is_extended(raw)));
        let id = id.ok_or_else(|| start.fault("an identifier of at most 7FF (type 0, 8) or 1FFFFFFF (type 1, 9)"))?;
        let data = data.filter(|(_, found)| len.is_none_or(|len| len as usize == *found));
        let (data, len) = data.ok_or_else(|| start.fault("data bytes of 2 hex digits, as many as Length states"))?;
        let channel = channels.number(1, 1).ok_or_else(|| start.fault(CHANNEL))?;
        let frame = frame(id, len, &data).ok_or_else(|| start.fault("at most 64 data bytes"))?;
        Ok(Item::Frame { time, channel, frame })
    }

    /// Converts a stamp to ns since 1970. `None` if it does not consist of whole parts.
    fn stamp_ns(&mut self, field: &[u8]) -> Option<i64> {
        if field.iter().take_while(|byte| byte.is_ascii_digit()).count() >= 9 && field.contains(&b'.') {
            return scaled(field, 9);
        }
        let mut parts = self.start;
        let first = 7 - read_parts(field, 7, &mut parts)?;
        let at_ns = total_ns(&parts)?.checked_add(self.carry_ns)?;
        // The length of the last missing part, in ns. If the stamp starts again at a small value, this part has
        // increased by one.
        let period_ns = match first {
            0 => None,
            1 | 2 => Some((total_ns(&next_month(parts, first))? - total_ns(&parts)?).max(0)),
            3 => Some(24 * HOUR_NS),
            part => Some(PART_NS[part - 4]),
        };
        let has_restarted = |period_ns: &i64| self.latest_ns.is_some_and(|latest| at_ns < latest - period_ns / 2);
        let carry_ns = period_ns.filter(has_restarted).unwrap_or(0);
        self.carry_ns += carry_ns;
        let at_ns = at_ns.checked_add(carry_ns)?;
        self.latest_ns = Some(at_ns);
        Some(at_ns)
    }
}

/// The same point in time one year later (if `first` is 1, because the year is missing) or one month later.
fn next_month(mut parts: [i64; 7], first: usize) -> [i64; 7] {
    parts[first - 1] += 1;
    if parts[1] > 12 {
        (parts[0], parts[1]) = (parts[0] + 1, 1);
    }
    parts
}

fn total_ns(parts: &[i64; 7]) -> Option<i64> {
    let &[year, month, day, ref of_day @ ..] = parts;
    let of_day_ns: i64 = of_day.iter().zip(PART_NS).map(|(part, ns)| part * ns).sum();
    date::midnight(year, month, day)?.checked_add(of_day_ns)
}

/// Reads a stamp that ends with part number `last` into `parts`. Returns how many parts the stamp contains. `None` if
/// the digits do not form whole parts.
fn read_parts(field: &[u8], last: usize, parts: &mut [i64; 7]) -> Option<usize> {
    let mut digits = [0; 17];
    let mut count = 0;
    for &byte in field.iter().filter(|byte| byte.is_ascii_digit()) {
        *digits.get_mut(count)? = byte;
        count += 1;
    }
    let mut end = count;
    for place in (0..last).rev() {
        if end == 0 {
            return (place < last - 1).then_some(last - 1 - place);
        }
        let start = end.checked_sub(PART_DIGITS[place])?;
        parts[place] = date::integer(&digits[start..end])?;
        end = start;
    }
    (end == 0).then_some(last)
}

fn column(name: &[u8]) -> Column {
    match name {
        b"Timestamp" => Column::Time,
        b"Type" => Column::Kind,
        b"ID" => Column::Id,
        b"Length" => Column::Length,
        b"Data" => Column::Data,
        _ => Column::Other,
    }
}

/// The separator of the line of column names; `None` for any other line.
fn column_separator(line: &[u8]) -> Option<u8> {
    let rest = line.strip_prefix(b"Timestamp")?;
    let separator = *rest.first().filter(|byte| byte.is_ascii() && !byte.is_ascii_alphanumeric())?;
    let has = |name: &[u8]| rest.split(|&byte| byte == separator).any(|column| column.trim_ascii() == name);
    (has(b"ID") && has(b"Data")).then_some(separator)
}
