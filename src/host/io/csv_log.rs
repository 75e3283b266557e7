//! Reads tables of samples: the exports of cyclers, applications and battery management systems, and packwatch's own
//! CSV.
//!
//! In: a table and the options. Out: rows of values in packwatch's units; a positive current is a discharge. The
//! columns are found by name in a [dictionary](dictionary), or the user names them. Units come from the header, from a
//! second header row, or from the user. From the first rows, [judge] finds the sign of the current and units that the
//! header does not state. It rejects values that cannot be in the stated unit. An empty or missing field, `-` and `n/a`
//! mean "no reading". A row is bad if its time cannot be read. It is also bad if another field is not a finite number
//! and does not mean "no reading".
//!
//! A section column (`cycle`, `segment`, `ref`, or the column that the user names) divides a file into sections. Time
//! restarts in each section. If a table states the start times of the sections, the times are absolute. Otherwise,
//! the gaps between the sections are unknown. [`TableReading`] reports how the table was understood.

use std::collections::HashMap;
use std::io::Read;
use std::path::{Path, PathBuf};

mod column_name;
mod dictionary;
mod judge;
mod layout;
mod reading;
mod state;
mod time_text;

use super::plausible::{PackSize, probable_stamp_unit};
use super::table::{Header, Quotes, Row, Table, TableError};
use crate::can::decode::Channel;
use crate::quantity::Timestamp;
pub use dictionary::BDF_COLUMNS;
use judge::Judgement;
use layout::{Column, Layout};
pub use reading::TableReading;
use state::{CurrentSign, is_rest};
use time_text::TimeText;

/// Maximum number of rows that are judged before the first row is returned.
const MAX_JUDGED_ROWS: usize = 50_000;

/// Options for reading tables of samples.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CsvOptions {
    /// Maps a role to a column: `time`, `current`, `voltage`, `temperature`, `state`, `section`. If role and column
    /// contain `{n}`, there is one column per cell or sensor, counted from 1. A unit in brackets may follow the name.
    pub columns: Vec<(String, String)>,
    /// Whether the file counts a charging current as positive; `None` = the format, the state column or the voltage
    /// decides.
    pub charge_positive: Option<bool>,
    /// Table with the absolute start time of each section.
    pub start_times: Option<PathBuf>,
    /// Number of cells in the configuration.
    pub cells: u16,
    /// Number of cells in series. A total voltage is divided by this number before it is judged.
    pub series: u16,
    /// Number of temperature sensors in the configuration.
    pub sensors: u16,
    /// Whether the voltage is the pack's total.
    pub pack_total: bool,
    /// Whether the configuration has an input for the SOC that the pack reports.
    pub reported_soc: bool,
    /// Capacity of the pack (Ah), to judge currents; `None` = unknown.
    pub capacity_ah: Option<f64>,
}

/// Time of a row, and whether an unknown gap precedes the row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RowTime {
    /// Line of the file, from 1.
    pub line: u64,
    /// Time of the row.
    pub time: Timestamp,
    /// Whether an unknown time has passed between this row and the previous row.
    pub after_unknown_gap: bool,
}

/// A table of samples being read.
pub struct CsvLog {
    table: Table,
    time_column: usize,
    time: TimeText,
    last_time: Option<Timestamp>,
    is_first_time_late: bool,
    channels: Vec<(Channel, Column)>,
    sign: CurrentSign,
    max_current_a: f64,
    state: Option<usize>,
    discharged: Option<(Column, f64)>,
    sections: Option<Sections>,
    kind: Option<usize>,
    is_bdf: bool,
    reading: TableReading,
    /// Values of the last row.
    pub values: Vec<(Channel, Option<f64>)>,
    /// Charge taken out until the last row (Ah); NaN = not in the table.
    pub discharged_ah: f64,
    /// Kind of the last row: the column `type`.
    pub kind_text: Vec<u8>,
}

struct Sections {
    column: usize,
    starts: Option<HashMap<Vec<u8>, Timestamp>>,
    current: Option<Vec<u8>>,
    start: Option<Timestamp>,
}

/// Whether the file name of a log has an ending that tables of samples have.
pub fn has_table_name(path: &Path) -> bool {
    const ENDINGS: [&str; 7] = [".csv", ".tsv", ".mpt", ".bdf", ".parquet", ".pq", ".parq"];
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let name = name.trim_end_matches(".gz").trim_end_matches(".zst");
    ENDINGS.iter().any(|ending| name.ends_with(ending))
}

pub(super) fn is_table(path: &Path, head: &[u8]) -> bool {
    let first_line = after_remarks(head).split(|&byte| byte == b'\n').next().unwrap_or_default();
    let is_utf16 = head.starts_with(&[0xFF, 0xFE]) || head.starts_with(&[0xFE, 0xFF]);
    has_table_name(path)
        || (!first_line.starts_with(b"(")
            && (is_parquet(head)
                || is_utf16
                || first_line.contains(&b',')
                || super::table::has_header(head, &dictionary::score)))
}

/// The first bytes of a log without the comments (`#`) at its beginning, because a comment may contain commas like a
/// table.
fn after_remarks(mut head: &[u8]) -> &[u8] {
    while head.starts_with(b"#")
        && let Some(end) = memchr::memchr(b'\n', head)
    {
        head = &head[end + 1..];
    }
    head
}

fn is_parquet(head: &[u8]) -> bool {
    head.starts_with(b"PAR1")
}

impl CsvLog {
    /// Reads a whole file: text, uncompressed or as gzip or zstd, or Parquet.
    pub fn open_path(path: &Path, options: &CsvOptions) -> Result<Self, TableError> {
        let file = path.display();
        let source = super::lines::open(path, &std::sync::Arc::default());
        let source = source.map_err(|error| TableError::of_io(format!("{file}: cannot be read: {error}"), &error))?;
        let mut lines = super::lines::Lines::new(source);
        lines.peek().map_err(|error| TableError::of_io(format!("{file}: damaged: {error}"), &error)).map(|_| ())?;
        Self::open(Box::new(lines.into_reader()), path, options)
    }

    /// Reads the header and the first rows. `path` names the file in messages. A Parquet file is read from `path`,
    /// not from `source`.
    ///
    /// # Errors
    /// Fails if the source cannot be read, a column is missing, values contradict the stated unit, or the table of
    /// start times is faulty.
    pub fn open(source: Box<dyn Read>, path: &Path, options: &CsvOptions) -> Result<Self, TableError> {
        let (table, preview) = open_table(source, path, options)?;
        let first = preview.first_rows(MAX_JUDGED_ROWS);
        let mut layout = Layout::find(&first, options)?;
        let judgement = judge::judge(&first, &mut layout, options)?;
        let sections = sections(table.header(), layout.section, options)?;
        let reading = TableReading::new(table.header(), &layout, &judgement, options);
        let Judgement { time, sign, is_first_time_late, .. } = judgement;
        Ok(Self {
            time_column: layout.time.index,
            time,
            last_time: None,
            is_first_time_late: is_first_time_late && sections.is_none(),
            values: Vec::with_capacity(layout.channels.len()),
            channels: layout.channels,
            sign,
            max_current_a: PackSize { capacity_ah: options.capacity_ah }.max_current_a(),
            state: layout.state,
            discharged: layout.discharged,
            sections,
            kind: table.header().find("type"),
            is_bdf: layout.format == dictionary::Format::Bdf,
            reading,
            table,
            discharged_ah: f64::NAN,
            kind_text: Vec::new(),
        })
    }

    /// Name of the file and its columns.
    pub fn header(&self) -> &Header {
        self.table.header()
    }

    /// Whether the file is in the Battery Data Format.
    pub fn is_bdf(&self) -> bool {
        self.is_bdf
    }

    /// How the table was understood, and how many rows have been read.
    pub fn reading(&self) -> &TableReading {
        &self.reading
    }

    /// The section of the last row; empty without a section column.
    pub fn section(&self) -> &[u8] {
        self.sections.as_ref().and_then(|sections| sections.current.as_deref()).unwrap_or_default()
    }

    /// Reads one row into [`values`](Self::values). Returns `None` at the end of the file, and an inner error if the
    /// row cannot be used.
    pub fn next_row(&mut self) -> Result<Option<Result<RowTime, TableError>>, TableError> {
        let Some((row, after)) = self.table.next_rows()? else { return Ok(None) };
        self.values.clear();
        self.reading.rows += 1;
        let is_possible = |time: &Timestamp| probable_stamp_unit(time.secs()).is_none();
        let Some(time) = self.time.parse(row.bytes(self.time_column).unwrap_or_default()).filter(is_possible) else {
            return Ok(Some(Err(row.fault(self.time_column, "a time before the year 2100"))));
        };
        if std::mem::take(&mut self.is_first_time_late) {
            return Ok(Some(Err(row.fault(self.time_column, "before the times of the rows after it"))));
        }
        let before = self.last_time.filter(|_| self.sections.is_none());
        if let (Some(before), Some(after)) =
            (before, after.and_then(|row| self.time.clone().parse(row.bytes(self.time_column).unwrap_or_default())))
            && before <= after
            && !(before..=after).contains(&time)
            && is_possible(&after)
        {
            return Ok(Some(Err(row.fault(self.time_column, "between the times of the rows around it"))));
        }
        self.last_time = Some(time);
        for &(channel, column) in &self.channels {
            // The last line of a file may be cut off, and so may its last number.
            let is_torn = after.is_none() && row.bytes(column.index).is_none();
            let Some(value) = row.parsed(column.index).filter(|_| !is_torn) else {
                return Ok(Some(Err(row.fault(column.index, NUMBER))));
            };
            let value = value.map(|value| column.unit.convert(value));
            let value = match (channel, value) {
                (Channel::Current, Some(current_a)) => {
                    let state = self.state.filter(|_| self.sign.noise_a > 0.0);
                    if let Some(fault) = state.and_then(|state| unknown_state(&self.sign, &row, state, current_a)) {
                        return Ok(Some(Err(fault)));
                    }
                    let direction = state.and_then(|state| self.sign.direction(row.bytes(state).unwrap_or_default()));
                    self.reading.check(self.sign.discharge(current_a, direction), self.max_current_a)
                }
                (_, value) => value,
            };
            self.values.push((channel, value));
        }
        self.discharged_ah = f64::NAN;
        if let Some((column, factor)) = &self.discharged {
            let Some(value) = row.parsed(column.index) else {
                return Ok(Some(Err(row.fault(column.index, NUMBER))));
            };
            self.discharged_ah = value.map_or(f64::NAN, |value| factor * column.unit.convert(value) + 0.0);
        }
        if let Some(kind) = self.kind {
            self.kind_text.clear();
            self.kind_text.extend_from_slice(row.bytes(kind).unwrap_or_default());
        }
        self.reading.read += 1;
        let Some(sections) = &mut self.sections else {
            return Ok(Some(Ok(RowTime { line: row.line, time, after_unknown_gap: false })));
        };
        Ok(Some(sections.place(&row, time)))
    }
}

/// Allowed values of a field, for messages.
const NUMBER: &str = "a finite number, empty, - or n/a";

/// The fault of a row whose current is a magnitude and whose state is unknown.
fn unknown_state(sign: &CurrentSign, row: &Row<'_>, state: usize, current_a: f64) -> Option<TableError> {
    let text = row.bytes(state).unwrap_or_default();
    let is_known =
        !sign.is_by_state || current_a.abs() <= sign.noise_a || sign.direction(text).is_some() || is_rest(text);
    (!is_known).then(|| row.fault(state, "charge, discharge or rest, because the current has no sign"))
}

/// Opens the same table twice: once for reading it, once for a look at the first rows.
fn open_table(source: Box<dyn Read>, path: &Path, options: &CsvOptions) -> Result<(Table, Table), TableError> {
    let mut magic = Vec::with_capacity(4);
    let mut source = source;
    let file = path.display().to_string();
    let read = source.by_ref().take(4).read_to_end(&mut magic);
    read.map_err(|error| TableError::of_io(format!("{file}: cannot be read: {error}"), &error))?;
    if magic.is_empty() {
        return Err(TableError::Data(format!("{file}: is empty")));
    }
    if is_parquet(&magic) {
        return open_parquet(path);
    }
    let whole = Box::new(std::io::Cursor::new(magic).chain(source));
    let bare = |name: &str| name.rsplit_once('[').map_or(name, |of| of.0).trim().to_owned();
    let named: Vec<(&str, String)> = options.columns.iter().map(|(_, name)| (name.as_str(), bare(name))).collect();
    let score = |fields: &[String]| {
        let is_named =
            |field: &String| named.iter().any(|(name, bare)| field == name || (!bare.is_empty() && field == bare));
        let count = fields.iter().filter(|field| is_named(field)).count();
        count + dictionary::score(fields)
    };
    Table::find(whole, file, Quotes::Literal, &score)
}

#[cfg(feature = "formats")]
fn open_parquet(path: &Path) -> Result<(Table, Table), TableError> {
    Table::open_parquet(path)
}

#[cfg(not(feature = "formats"))]
fn open_parquet(path: &Path) -> Result<(Table, Table), TableError> {
    let file = path.display();
    Err(TableError::Data(format!("{file}: is a Parquet file, which this program does not read; convert it to CSV")))
}

impl Sections {
    /// Returns the time of a row. If the row begins a section, starts this section.
    fn place(&mut self, row: &Row<'_>, time: Timestamp) -> Result<RowTime, TableError> {
        let section = row.bytes(self.column).ok_or_else(|| row.fault(self.column, "a section"))?;
        let is_new = self.current.as_deref() != Some(section);
        let is_first = self.current.is_none();
        if is_new {
            self.current = Some(section.to_vec());
            self.start = self.starts.as_ref().and_then(|starts| starts.get(section)).copied();
        }
        let after_unknown_gap = is_new && !is_first && self.start.is_none();
        let time = self.start.map_or(time, |start| start.plus_nanos(time.nanos()));
        Ok(RowTime { line: row.line, time, after_unknown_gap })
    }
}

fn sections(header: &Header, column: Option<usize>, options: &CsvOptions) -> Result<Option<Sections>, TableError> {
    let starts = match (&options.start_times, column) {
        (Some(path), Some(column)) => Some(read_starts(path, &header.names()[column])?),
        (Some(path), None) => {
            return Err(header.fault(format_args!(
                "no section column (cycle, segment or ref), which --start-times {} needs; name it with --column \
                 section=NAME",
                path.display()
            )));
        }
        (None, _) => None,
    };
    Ok(column.map(|column| Sections { column, starts, current: None, start: None }))
}

/// Reads the start of each section from a table with two columns: the section column, and `start` (ISO 8601 or
/// seconds).
fn read_starts(path: &Path, section: &str) -> Result<HashMap<Vec<u8>, Timestamp>, TableError> {
    let mut table = Table::open(path)?;
    let [section, start] = [table.header().required(&[section])?, table.header().required(&["start"])?];
    let mut starts = HashMap::new();
    while let Some(row) = table.next_row()? {
        starts.insert(row.bytes(section).unwrap_or_default().to_vec(), row.stamp(start)?);
    }
    Ok(starts)
}

#[cfg(test)]
mod tests;
