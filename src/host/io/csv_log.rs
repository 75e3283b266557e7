//! CSV logs: one row per sample, columns found by name, values in the program's units.
//!
//! Positive current is discharge unless [`CsvOptions::charge_positive`]. An empty field is no reading. A row with a
//! field that is no finite number, or with a field missing, is a bad line. Where a section column exists (`cycle`,
//! `segment` or `ref` unless named), time starts again at each of its values: with a table of start times the
//! stamps become absolute, without one the gap between sections is unknown.

use std::collections::HashMap;
use std::io::Read;
use std::path::PathBuf;

use super::log::LogError;
use super::stamp;
use crate::can::decode::{Channel, SensorIndex};
use crate::quantity::{CellIndex, Timestamp};

/// Columns that begin a new section where time starts again, when none is named.
const SECTION_COLUMNS: [&str; 3] = ["cycle", "segment", "ref"];

/// How CSV files are to be read.
#[derive(Debug, Clone, Default)]
pub struct CsvOptions {
    /// Role to column: `time`, `current`, `voltage`, `temperature`, `section`, or with `{n}` in role and column for
    /// one column per cell or sensor, counted from 1.
    pub columns: Vec<(String, String)>,
    /// The file's positive current is charge.
    pub charge_positive: bool,
    /// Table of absolute start times per section.
    pub start_times: Option<PathBuf>,
    /// Cells the configuration has.
    pub cells: u16,
    /// The voltage is the pack's total.
    pub pack_total: bool,
}

/// One row's time, and whether a section begins with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Row {
    pub time: Timestamp,
    /// The time between this row and the one before is unknown.
    pub after_unknown_gap: bool,
}

/// What reading one row came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RowResult {
    Row(Row),
    Bad { line: u64, what: String },
    End,
}

/// A CSV file being read.
pub struct CsvLog {
    reader: csv::Reader<Box<dyn Read>>,
    record: csv::ByteRecord,
    time_column: usize,
    section_column: Option<usize>,
    /// What each used column feeds.
    channels: Vec<(Channel, usize)>,
    headers: Vec<String>,
    charge_positive: bool,
    starts: Option<HashMap<Vec<u8>, Timestamp>>,
    section: Option<Vec<u8>>,
    /// Start of the present section; `None` = unknown.
    start: Option<Timestamp>,
    /// Values of the last row.
    pub values: Vec<(Channel, Option<f64>)>,
}

impl CsvLog {
    /// Reads the header line and finds the columns; `name` is the file's, for messages.
    pub fn open(source: Box<dyn Read>, name: &str, options: &CsvOptions) -> Result<Self, LogError> {
        // No quoting: one stray quote would swallow every row after it. A field that is quoted whole is still read.
        let mut builder = csv::ReaderBuilder::new();
        let mut reader = builder.quoting(false).flexible(true).trim(csv::Trim::All).from_reader(source);
        let header = reader.byte_headers().map_err(|e| LogError(format!("{name}:1: {e}")))?;
        let headers: Vec<String> = header
            .iter()
            .map(|h| String::from_utf8_lossy(h).trim_start_matches('\u{feff}').trim_matches('"').to_owned())
            .collect();
        let columns = Columns { headers: &headers, options, name };
        let time_column = columns.required("time", "time_s")?;
        let section_column = columns.section()?;
        let channels = columns.channels()?;
        let starts = match (&options.start_times, section_column) {
            (Some(path), Some(column)) => Some(read_starts(path, &headers[column])?),
            (Some(path), None) => {
                return Err(LogError(format!("{name}:1: no section column for the start times of {}", path.display())));
            }
            (None, _) => None,
        };
        let values = Vec::with_capacity(channels.len());
        let charge_positive = options.charge_positive;
        let record = csv::ByteRecord::new();
        let (section, start) = (None, None);
        Ok(Self {
            reader,
            record,
            time_column,
            section_column,
            channels,
            headers,
            charge_positive,
            starts,
            section,
            start,
            values,
        })
    }

    /// Reads one row into [`values`](Self::values).
    pub fn next(&mut self) -> Result<RowResult, csv::Error> {
        if !self.reader.read_byte_record(&mut self.record)? {
            return Ok(RowResult::End);
        }
        let line = self.record.position().map_or(0, csv::Position::line);
        Ok(match self.read_row() {
            Ok(row) => RowResult::Row(row),
            Err((column, expected)) => {
                let found = self.record.get(column).map(String::from_utf8_lossy);
                let found = found.map_or("no such field".to_owned(), |f| format!("{f:?}"));
                RowResult::Bad {
                    line,
                    what: format!("column {}: found {found}, expected {expected}", self.headers[column]),
                }
            }
        })
    }

    fn read_row(&mut self) -> Result<Row, (usize, &'static str)> {
        const NUMBER: &str = "a finite number or an empty field";
        let time_text = self.record.get(self.time_column).unwrap_or_default();
        let time = stamp::parse_seconds(time_text).ok_or((self.time_column, "seconds as a finite number"))?;
        self.values.clear();
        for &(channel, column) in &self.channels {
            let field = self.record.get(column).ok_or((column, NUMBER))?;
            let value = parse_field(field).ok_or((column, NUMBER))?;
            let flip = channel == Channel::Current && self.charge_positive;
            self.values.push((channel, if flip { value.map(|v| -v) } else { value }));
        }
        let after_unknown_gap = self.enter_section()?;
        let time = self.start.map_or(time, |start| start.plus_nanos(time.nanos()));
        Ok(Row { time, after_unknown_gap })
    }

    /// Notes a new section; whether the gap before it is unknown.
    fn enter_section(&mut self) -> Result<bool, (usize, &'static str)> {
        let Some(column) = self.section_column else { return Ok(false) };
        let value = self.record.get(column).ok_or((column, "a section"))?;
        if self.section.as_deref() == Some(value) {
            return Ok(false);
        }
        let first = self.section.is_none();
        self.section = Some(value.to_vec());
        self.start = self.starts.as_ref().and_then(|starts| starts.get(value)).copied();
        Ok(!first && self.start.is_none())
    }
}

/// An empty field is `Some(None)`, no finite number is `None`.
fn parse_field(field: &[u8]) -> Option<Option<f64>> {
    let field = field.strip_prefix(b"\"").and_then(|field| field.strip_suffix(b"\"")).unwrap_or(field);
    if field.is_empty() {
        return Some(None);
    }
    let value: f64 = std::str::from_utf8(field).ok()?.parse().ok()?;
    value.is_finite().then_some(Some(value))
}

/// The header line against what is wanted of it.
struct Columns<'a> {
    headers: &'a [String],
    options: &'a CsvOptions,
    name: &'a str,
}

impl Columns<'_> {
    fn mapped(&self, role: &str) -> Option<&str> {
        self.options.columns.iter().rev().find(|(r, _)| r == role).map(|(_, column)| column.as_str())
    }

    fn find(&self, column: &str) -> Option<usize> {
        self.headers.iter().position(|h| h == column)
    }

    fn missing<T>(&self, role: &str, column: &str) -> Result<T, LogError> {
        let (name, found) = (self.name, self.headers.join(","));
        Err(LogError(format!(
            "{name}:1: no column {column} for {role}, found {found} (map it with --column {role}=NAME)"
        )))
    }

    fn required(&self, role: &str, default: &str) -> Result<usize, LogError> {
        let column = self.mapped(role).unwrap_or(default);
        self.find(column).map_or_else(|| self.missing(role, column), Ok)
    }

    fn section(&self) -> Result<Option<usize>, LogError> {
        match self.mapped("section") {
            Some("") => Ok(None),
            Some(column) => self.find(column).map_or_else(|| self.missing("section", column), |c| Ok(Some(c))),
            None => Ok(SECTION_COLUMNS.iter().find_map(|column| self.find(column))),
        }
    }

    fn channels(&self) -> Result<Vec<(Channel, usize)>, LogError> {
        let mut channels = vec![(Channel::Current, self.required("current", "current_a")?)];
        self.temperatures(&mut channels)?;
        self.voltages(&mut channels)?;
        channels.sort_by_key(|&(channel, _)| channel);
        Ok(channels)
    }

    /// One column for the first sensor, or a pattern with as many as the file has; none is allowed.
    fn temperatures(&self, channels: &mut Vec<(Channel, usize)>) -> Result<(), LogError> {
        if let Some(pattern) = self.mapped("temperature{n}") {
            let found = (0..u16::MAX).map_while(|n| Some((n, self.find(&numbered(pattern, n))?)));
            let before = channels.len();
            channels.extend(found.map(|(n, column)| (Channel::Temperature(SensorIndex(n)), column)));
            return if channels.len() > before { Ok(()) } else { self.missing("temperature{n}", pattern) };
        }
        let column = match self.mapped("temperature") {
            Some(column) => Some(self.find(column).map_or_else(|| self.missing("temperature", column), Ok)?),
            None => self.find("temperature_c"),
        };
        channels.extend(column.map(|c| (Channel::Temperature(SensorIndex(0)), c)));
        Ok(())
    }

    fn voltages(&self, channels: &mut Vec<(Channel, usize)>) -> Result<(), LogError> {
        let cells = self.options.cells;
        let pattern = self.mapped("voltage{n}");
        if self.options.pack_total {
            channels.push((Channel::PackVoltage, self.required("voltage", "voltage_v")?));
        } else if cells == 1 && pattern.is_none() {
            channels.push((Channel::CellVoltage(CellIndex(0)), self.required("voltage", "voltage_v")?));
        } else {
            let pattern = pattern.unwrap_or("voltage{n}_v");
            for n in 0..cells {
                let column = numbered(pattern, n);
                let index = self.find(&column).map_or_else(|| self.missing("voltage{n}", &column), Ok)?;
                channels.push((Channel::CellVoltage(CellIndex(n)), index));
            }
        }
        Ok(())
    }
}

fn numbered(pattern: &str, index: u16) -> String {
    pattern.replace("{n}", &(u32::from(index) + 1).to_string())
}

/// Start time per section: the column named like the section column, and `start` (ISO or seconds).
fn read_starts(path: &std::path::Path, section: &str) -> Result<HashMap<Vec<u8>, Timestamp>, LogError> {
    let name = path.display();
    let error = |line: u64, what: String| LogError(format!("{name}:{line}: {what}"));
    let bytes = std::fs::read(path).map_err(|e| LogError(format!("{name}: cannot be read: {e}")))?;
    let mut reader = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(bytes.as_slice());
    let headers = reader.byte_headers().map_err(|e| error(1, e.to_string()))?.clone();
    let column = |wanted: &str| {
        let found = headers.iter().position(|h| h == wanted.as_bytes());
        found.ok_or_else(|| {
            error(1, format!("no column {wanted}, found {}", String::from_utf8_lossy(headers.as_slice())))
        })
    };
    let (section_column, start_column) = (column(section)?, column("start")?);
    let mut starts = HashMap::new();
    for record in reader.byte_records() {
        let record = record.map_err(|e| LogError(format!("{name}: {e}")))?;
        let line = record.position().map_or(0, csv::Position::line);
        let text = String::from_utf8_lossy(record.get(start_column).unwrap_or_default()).into_owned();
        let start = stamp::parse_stamp(&text)
            .ok_or_else(|| error(line, format!("start = {text:?}, must be like 2008-04-02T13:08:17.921 or seconds")))?;
        starts.insert(record.get(section_column).unwrap_or_default().to_vec(), start);
    }
    Ok(starts)
}
