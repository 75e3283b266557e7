//! Reads tables: finds columns by name, streams rows, and reports the position of every fault.
//!
//! In: text with a header line, uncompressed or as gzip or zstd; with the feature `formats` also Parquet files. Out:
//! [`Row`]s whose fields are read as text, numbers or stamps.
//!
//! The text is UTF-8 or UTF-16. Fields are separated by commas, semicolons, tabs or bars. If the separator is not a
//! comma, a number may have a decimal comma. Blanks around fields and a byte order mark are removed. A second header
//! line may state the units. Rows may be shorter or longer than the header; a missing field counts as empty.
//!
//! A row of more than a megabyte ends the reading. Other faults do not, so the caller may skip the row. The message
//! of a fault is `FILE:LINE: column NAME: found X, must be ALLOWED`. Control characters in names are escaped.

use std::borrow::Cow;
use std::cell::Cell;
use std::io::{Cursor, Read};
use std::ops::RangeInclusive;
use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;

#[cfg(feature = "formats")]
mod parquet;
mod text;

use super::row_limit::{MAX_ROW_BYTES, RowLimit};
use super::units::Unit;
use super::{lines, stamp};
use crate::quantity::Timestamp;

/// Default section columns: time restarts at each new value of such a column.
pub const PART_COLUMNS: [&str; 3] = ["cycle", "segment", "ref"];

/// Allowed forms of a point in time, for messages.
const STAMP: &str = "like 2008-04-02T13:08:17.921 or seconds";

/// A table that cannot be read or a field that cannot be used, with its position.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TableError {
    /// Content that cannot be used.
    #[error("{0}")]
    Data(String),
    /// The operating system cannot read the file.
    #[error("{0}")]
    File(String),
}

impl TableError {
    /// Converts a failed read. The result is [`File`](Self::File) if the operating system reported the error, else
    /// [`Data`](Self::Data), for example for a damaged compressed file.
    pub fn of_io(text: String, error: &std::io::Error) -> Self {
        if error.raw_os_error().is_some() { Self::File(text) } else { Self::Data(text) }
    }
}

/// Whether `"` encloses fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quotes {
    /// Quotes may enclose fields that hold commas or line breaks.
    Enclose,
    /// Every line is a row, so a stray quote cannot swallow later rows. Within a line, quotes may enclose fields that
    /// contain separators. Quotes around a whole number or column name are removed.
    Literal,
}

const MAX_LISTED_COLUMNS: usize = 64;

/// A table being read.
pub struct Table {
    rows: Rows,
    record: csv::ByteRecord,
    next: csv::ByteRecord,
    /// Line of `next`, or why it could not be read; `None` = `next` has not been read.
    ahead: Option<Result<Option<u64>, TableError>>,
    header: Header,
}

enum Rows {
    Text {
        reader: csv::Reader<RowLimit>,
        since_row: Rc<Cell<usize>>,
        lines_before: u64,
        /// The separator, if quotes enclose fields only within a line.
        rejoined: Option<u8>,
    },
    #[cfg(feature = "formats")]
    Parquet(parquet::ParquetRows),
}

/// The file's name and its columns.
#[derive(Debug, Clone)]
pub struct Header {
    file: String,
    line: u64,
    names: Vec<String>,
    /// Units from a separate line; empty = no such line.
    units: Vec<String>,
    has_decimal_comma: bool,
}

pub(super) struct FirstRows {
    pub(super) header: Header,
    records: Vec<csv::ByteRecord>,
}

impl FirstRows {
    pub(super) fn rows(&self) -> impl Iterator<Item = Row<'_>> {
        self.records.iter().map(|record| Row { line: 0, record, header: &self.header })
    }
}

/// One row.
#[derive(Debug, Clone, Copy)]
pub struct Row<'t> {
    /// Line of the file, from 1.
    pub line: u64,
    record: &'t csv::ByteRecord,
    header: &'t Header,
}

impl Table {
    /// Opens a file and reads its header. `-` is standard input.
    pub fn open(path: &Path) -> Result<Self, TableError> {
        let file = path.display().to_string();
        let source = lines::open(path, &Arc::default());
        let source = source.map_err(|error| TableError::of_io(format!("{file}: cannot be read: {error}"), &error))?;
        Self::new(source, file, Quotes::Enclose)
    }

    /// Reads the header of decompressed text, which is its first line. `file` is the name in messages.
    pub fn new(source: Box<dyn Read>, file: String, quotes: Quotes) -> Result<Self, TableError> {
        Self::find(source, file, quotes, &|_| 0).map(|(table, _)| table)
    }

    /// Reads the header of decompressed text. Other lines may precede the header. `score` rates the fields of a line:
    /// 0 = not a header, higher = more known columns. Also returns a second table for a look at the first rows, which
    /// does not consume rows of the first table.
    pub(super) fn find(
        source: Box<dyn Read>,
        file: String,
        quotes: Quotes,
        score: &dyn Fn(&[String]) -> usize,
    ) -> Result<(Self, Self), TableError> {
        let mut head = text::Head::read(source);
        let form = text::form(&head.bytes, score);
        let mut builder = csv::ReaderBuilder::new();
        let trim = if quotes == Quotes::Enclose { csv::Trim::All } else { csv::Trim::None };
        builder.quoting(quotes == Quotes::Enclose).flexible(true).trim(trim).has_headers(false);
        builder.delimiter(form.separator);
        let before = &head.bytes[form.start.min(head.bytes.len())..];
        if !head.is_whole && memchr::memchr2(b'\n', b'\r', before).is_none() {
            let failed = head.rest.read(&mut [0]).err();
            let error = failed.unwrap_or_else(super::row_limit::too_long);
            return Err(TableError::of_io(format!("{file}: damaged: {error}"), &error));
        }
        let before = &head.bytes[form.start.min(head.bytes.len())..];
        let mut reader = builder.from_reader(before);
        let mut names = csv::ByteRecord::new();
        reader.read_byte_record(&mut names).map_err(|error| damaged(&file, &error))?;
        let line =
            lines_in(&head.bytes[..form.start.min(head.bytes.len())]) + names.position().map_or(1, csv::Position::line);
        let mut start = form.start + reader.position().byte() as usize;
        let mut units = csv::ByteRecord::new();
        let rejoined = (quotes == Quotes::Literal).then_some(form.separator);
        rejoined.iter().for_each(|&separator| join_quoted(&mut names, separator));
        let has_second = matches!(reader.read_byte_record(&mut units), Ok(true));
        rejoined.iter().for_each(|&separator| join_quoted(&mut units, separator));
        let has_units = has_second && is_unit_row(&units);
        if has_units {
            start = form.start + reader.position().byte() as usize;
        } else {
            units.clear();
        }
        let text_of = |record: &csv::ByteRecord| record.iter().map(name_of).collect();
        let has_decimal_comma = form.separator != b',';
        let header =
            Header { file, line: line.max(1), names: text_of(&names), units: text_of(&units), has_decimal_comma };
        let data = head.bytes.split_off(start.min(head.bytes.len()));
        let lines_before = lines_in(&head.bytes);
        let whole_rows =
            if head.is_whole { data.len() } else { memchr::memrchr(b'\n', &data).map_or(0, |end| end + 1) };
        let preview = Box::new(Cursor::new(data[..whole_rows].to_vec()));
        let open = |source: Box<dyn Read>| {
            let (source, since_row) = RowLimit::new(source);
            let rows = Rows::Text { reader: builder.from_reader(source), since_row, lines_before, rejoined };
            Self::of(rows, header.clone())
        };
        Ok((open(Box::new(Cursor::new(data).chain(head.rest))), open(preview)))
    }

    fn of(rows: Rows, header: Header) -> Self {
        let [record, next] = [csv::ByteRecord::new(), csv::ByteRecord::new()];
        Self { rows, record, next, ahead: None, header }
    }

    /// Opens a Parquet file twice: once for reading it, once for a look at its first rows.
    #[cfg(feature = "formats")]
    pub(super) fn open_parquet(path: &Path) -> Result<(Self, Self), TableError> {
        let open = || {
            let (rows, names) = parquet::ParquetRows::open(path)?;
            let names = names.iter().map(|name| escaped(name)).collect();
            let file = path.display().to_string();
            let header = Header { file, line: 1, names, units: Vec::new(), has_decimal_comma: false };
            Ok(Self::of(Rows::Parquet(rows), header))
        };
        Ok((open()?, open()?))
    }

    /// The file's name and its columns.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Reads the first rows, at most `most`, up to the first fault.
    pub(super) fn first_rows(mut self, most: usize) -> FirstRows {
        let mut records = Vec::new();
        while records.len() < most && matches!(self.next_row(), Ok(Some(_))) {
            records.push(self.record.clone());
        }
        FirstRows { header: self.header, records }
    }

    /// The next row; `None` at the end.
    ///
    /// # Errors
    /// Fails if the source fails, for example because a compressed file is damaged.
    pub fn next_row(&mut self) -> Result<Option<Row<'_>>, TableError> {
        let Some(line) = self.ahead.take().unwrap_or_else(|| self.read())? else { return Ok(None) };
        std::mem::swap(&mut self.record, &mut self.next);
        Ok(Some(Row { line, record: &self.record, header: &self.header }))
    }

    /// The next row, and the row after it, if it can be read.
    pub(super) fn next_rows(&mut self) -> Result<Option<(Row<'_>, Option<Row<'_>>)>, TableError> {
        let Some(line) = self.next_row()?.map(|row| row.line) else { return Ok(None) };
        self.ahead = Some(self.read());
        let row = |line, record| Row { line, record, header: &self.header };
        let after = matches!(self.ahead, Some(Ok(Some(_)))).then(|| row(line + 1, &self.next));
        Ok(Some((row(line, &self.record), after)))
    }

    fn read(&mut self) -> Result<Option<u64>, TableError> {
        let (more, line) = match &mut self.rows {
            Rows::Text { reader, since_row, lines_before, rejoined } => {
                since_row.set(0);
                let more = reader.read_byte_record(&mut self.next).map_err(|e| damaged(&self.header.file, &e))?;
                let line = *lines_before + self.next.position().map_or(0, csv::Position::line);
                rejoined.iter().for_each(|&separator| join_quoted(&mut self.next, separator));
                (more, line)
            }
            #[cfg(feature = "formats")]
            Rows::Parquet(rows) => {
                let more = rows.next(&mut self.next);
                (
                    more.map_err(|what| TableError::Data(format!("{}: damaged: {what}", self.header.file)))?,
                    rows.number(),
                )
            }
        };
        Ok(more.then_some(line))
    }
}

/// Whether the first bytes of a text contain a header line.
pub(super) fn has_header(head: &[u8], score: &dyn Fn(&[String]) -> usize) -> bool {
    text::form(head, score).is_known
}

/// Joins the parts of quoted fields that contain separators, and removes blanks around fields. A quote without an end
/// is kept.
fn join_quoted(record: &mut csv::ByteRecord, separator: u8) {
    if record.iter().any(text::opens_quote) {
        let parts: Vec<&[u8]> = record.iter().collect();
        *record = text::join_quoted(&parts, separator).iter().collect();
    }
    record.trim();
}

fn lines_in(bytes: &[u8]) -> u64 {
    memchr::memchr_iter(b'\n', bytes).count() as u64
}

/// The name of a column without quotes, for messages and as a key.
fn name_of(field: &[u8]) -> String {
    let text = String::from_utf8_lossy(field);
    escaped(text.trim_start_matches('\u{feff}').trim_matches('"'))
}

/// Escapes characters that control a terminal or reverse the text.
pub(super) fn escaped(text: &str) -> String {
    let acts = |c: char| {
        c.is_control()
            || matches!(c, '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{feff}')
    };
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        if acts(c) { out.extend(c.escape_unicode()) } else { out.push(c) }
    }
    out
}

/// Whether a row states units, such as `s,mA,[V]`: it has at least two units and no digits.
fn is_unit_row(record: &csv::ByteRecord) -> bool {
    let has_digit = record.iter().any(|field| field.iter().any(u8::is_ascii_digit));
    let bare = |field: &[u8]| String::from_utf8_lossy(field).trim_matches(['[', ']', '(', ')', '"', ' ']).to_owned();
    !has_digit && record.iter().filter(|field| Unit::find(&bare(field)).is_some()).count() >= 2
}

fn damaged(file: &str, error: &csv::Error) -> TableError {
    let text = format!("{file}: damaged: {error}");
    match error.kind() {
        csv::ErrorKind::Io(error) => TableError::of_io(text, error),
        _ => TableError::Data(text),
    }
}

impl Header {
    /// Name of the file.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// The columns' names.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The unit of a column from a separate line of units; empty if unknown.
    pub(super) fn unit_text(&self, column: usize) -> &str {
        self.units.get(column).map_or("", String::as_str)
    }

    pub(super) fn listed(&self) -> String {
        let mut text = self.names[..self.names.len().min(MAX_LISTED_COLUMNS)].join(",");
        if self.names.len() > MAX_LISTED_COLUMNS {
            text += &format!(" and {} more", self.names.len() - MAX_LISTED_COLUMNS);
        }
        text
    }

    /// Index of the column called `name`.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|known| known == name)
    }

    /// Index of the first of these columns that the table has.
    pub fn find_any(&self, names: &[&str]) -> Option<usize> {
        names.iter().find_map(|name| self.find(name))
    }

    /// Index of the first of these columns that the table has; an error if it has none of them.
    pub fn required(&self, names: &[&str]) -> Result<usize, TableError> {
        let missing = || self.fault(format!("no column {}, found {}", names.join(" or "), self.listed()));
        self.find_any(names).ok_or_else(missing)
    }

    /// A fault of the header line.
    pub fn fault(&self, what: impl std::fmt::Display) -> TableError {
        TableError::Data(format!("{}:{}: {what}", self.file, self.line))
    }

    /// A fault of the whole file.
    pub fn file_fault(&self, what: impl std::fmt::Display) -> TableError {
        TableError::Data(format!("{}: {what}", self.file))
    }
}

impl<'t> Row<'t> {
    /// A field as written; `None` if the row is too short.
    pub fn bytes(&self, column: usize) -> Option<&'t [u8]> {
        self.record.get(column)
    }

    /// A field as text; empty if the row is too short.
    pub fn text(&self, column: usize) -> Cow<'t, str> {
        self.bytes(column).map_or(Cow::Borrowed(""), String::from_utf8_lossy)
    }

    /// A finite number; `None` for an empty field.
    pub fn number(&self, column: usize) -> Result<Option<f64>, TableError> {
        self.number_in(column, f64::MIN..=f64::MAX, "a finite number, empty, - or n/a")
    }

    /// A number in `range`; `None` for an empty field.
    ///
    /// # Errors
    /// Fails if the field is neither a number in `range` nor empty; the message contains `allowed`.
    pub fn number_in(
        &self,
        column: usize,
        range: RangeInclusive<f64>,
        allowed: &str,
    ) -> Result<Option<f64>, TableError> {
        let value = self.parsed(column);
        let value = value.filter(|value| value.is_none_or(|value| range.contains(&value)));
        value.ok_or_else(|| self.fault(column, allowed))
    }

    /// A finite number: `Some(None)` if the field is empty or missing, `None` if it is not a finite number.
    pub(super) fn parsed(&self, column: usize) -> Option<Option<f64>> {
        let field = self.bytes(column).unwrap_or_default();
        let value = parse_field(field);
        if value.is_some() || !self.header.has_decimal_comma || !field.contains(&b',') {
            return value;
        }
        // Read a comma as a decimal comma. A text with several commas (thousands separators) does not count as a number
        // here.
        parse_field(&field.iter().map(|&byte| if byte == b',' { b'.' } else { byte }).collect::<Vec<_>>())
    }

    /// A point in time: a date, or seconds.
    pub fn stamp(&self, column: usize) -> Result<Timestamp, TableError> {
        stamp::parse_stamp(&self.text(column)).ok_or_else(|| self.fault(column, STAMP))
    }

    /// A fault of a field. The message states the found text, and that it must be `allowed`.
    pub fn fault(&self, column: usize, allowed: &str) -> TableError {
        let found = self.bytes(column).map(String::from_utf8_lossy);
        let found = found.map_or("no such field".to_owned(), |found| format!("{found:?}"));
        let name = self.header.names.get(column).map_or("", String::as_str);
        self.row_fault(format_args!("column {name}: found {found}, must be {allowed}"))
    }

    /// A fault of the row.
    pub fn row_fault(&self, what: impl std::fmt::Display) -> TableError {
        TableError::Data(format!("{}:{}: {what}", self.header.file, self.line))
    }
}

/// Texts that programs write if there is no value, in lower case.
const NO_VALUE: [&str; 10] = ["", "-", "--", "---", "nan", "n/a", "#n/a", "na", "null", "none"];

/// Parses a field: `Some(None)` if the field has no value, `None` if it is not a finite number.
pub(super) fn parse_field(field: &[u8]) -> Option<Option<f64>> {
    let field = field.strip_prefix(b"\"").and_then(|field| field.strip_suffix(b"\"")).unwrap_or(field).trim_ascii();
    if NO_VALUE.iter().any(|text| field.eq_ignore_ascii_case(text.as_bytes())) {
        return Some(None);
    }
    let value: f64 = std::str::from_utf8(field).ok()?.parse().ok()?;
    value.is_finite().then_some(Some(value))
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    const TEXT: &str = "\u{feff}time, \"soc\" ,name\n2008-04-02T13:08:17, 0.5,a\n1,,b\n2,x\n";

    fn table(text: &str, quotes: Quotes) -> Table {
        Table::new(Box::new(std::io::Cursor::new(text.to_owned())), "t.csv".to_owned(), quotes).expect("memory reads")
    }

    #[test]
    fn fields_are_found_by_column_name() {
        let mut table = table(TEXT, Quotes::Enclose);
        assert_eq!(table.header().names(), ["time", "soc", "name"]);
        let [time, soc] = ["time", "soc"].map(|name| table.header().find(name).expect("there"));
        let row = table.next_row().expect("reads").expect("a row");
        assert_eq!((row.line, row.number(soc), row.text(2)), (2, Ok(Some(0.5)), "a".into()));
        assert_eq!(row.stamp(time), Ok(Timestamp::from_secs(1_207_141_697.0)));
        let row = table.next_row().expect("reads").expect("a row");
        assert_eq!((row.line, row.number(soc), row.stamp(time)), (3, Ok(None), Ok(Timestamp::from_secs(1.0))));
    }

    #[test]
    fn fault_states_position_and_reading_continues() {
        let mut table = table(TEXT, Quotes::Enclose);
        let missing = table.header().required(&["ah", "capacity_ah"]).expect_err("missing");
        assert_eq!(missing.to_string(), "t.csv:1: no column ah or capacity_ah, found time,soc,name");
        let mut faults = Vec::new();
        while let Some(row) = table.next_row().expect("reads") {
            faults.extend(row.number_in(1, 0.0..=0.4, "a fraction").err().map(|fault| fault.to_string()));
            faults.extend((row.bytes(2).is_none()).then(|| row.fault(2, "a name").to_string()));
        }
        assert_eq!(
            faults,
            [
                "t.csv:2: column soc: found \"0.5\", must be a fraction",
                "t.csv:4: column soc: found \"x\", must be a fraction",
                "t.csv:4: column name: found no such field, must be a name",
            ]
        );
    }

    #[test]
    fn endless_row_is_an_error() {
        for (start, quotes) in [("a\n", Quotes::Literal), ("a\n\"", Quotes::Enclose), ("", Quotes::Literal)] {
            let endless = Box::new(start.as_bytes().chain(std::io::repeat(b'7')));
            let error = match Table::new(endless, "t.csv".to_owned(), quotes) {
                Ok(mut table) => table.next_row().expect_err("never ends"),
                Err(error) => error,
            };
            assert_eq!(error.to_string(), "t.csv: damaged: row too long, must be at most 1048576 bytes");
        }
        // Rows of the allowed length follow each other.
        let row = format!("{}\n", "7".repeat(crate::io::row_limit::MAX_ROW_BYTES - 10_000));
        let mut table = table(&row.repeat(4), Quotes::Literal);
        for _ in 0..3 {
            assert!(table.next_row().expect("reads").is_some());
        }
    }

    #[test]
    fn literal_stray_quote_costs_one_row() {
        let mut quoted = table("a,\"b, of c\",d\n\"x,y,\",\"2\",3\n", Quotes::Literal);
        assert_eq!(quoted.header().names(), ["a", "b, of c", "d"]);
        let row = quoted.next_row().expect("reads").expect("a row");
        assert_eq!((row.number(1), row.number(2), row.line), (Ok(Some(2.0)), Ok(Some(3.0)), 2));
        let mut doubled = table("a,b,c\n\"note \"\"x\"\", y\",1,3.7\n", Quotes::Literal);
        assert_eq!(doubled.next_row().expect("reads").expect("a row").number(2), Ok(Some(3.7)));
        let open = "\"a,".repeat(200_000);
        assert_eq!(text::join_quoted(&open.split(',').map(str::as_bytes).collect::<Vec<_>>(), b',').len(), 200_001);
        let mut table = table("a,b\n1,\"2\n3,\"4\"\n", Quotes::Literal);
        assert!(table.next_row().expect("reads").expect("a row").number(1).is_err());
        assert_eq!(table.next_row().expect("reads").expect("a row").number(1), Ok(Some(4.0)));
        assert!(table.next_row().expect("reads").is_none());
    }

    #[test]
    fn compressed_table_is_read_damage_reported() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("t.csv.gz");
        let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        packed.write_all(b"a\n7\n").expect("packed");
        let packed = packed.finish().expect("packed");
        std::fs::write(&path, &packed).expect("written");
        let mut table = Table::open(&path).expect("opens");
        assert_eq!(table.next_row().expect("reads").expect("a row").number(0), Ok(Some(7.0)));
        std::fs::write(&path, &packed[..packed.len() - 4]).expect("written");
        let mut table = Table::open(&path).expect("opens");
        let _ = table.next_row();
        let error = table.next_row().expect_err("torn");
        assert!(error.to_string().contains("t.csv.gz: damaged: "), "{error}");
    }
}
