//! Measured files: CSV (plain, gzip or zstd) of time, current, voltage, temperature and ampere-hours from a cycler.
//!
//! Columns by name: `time_s`, `current_a` (positive = discharge), `voltage_v`, and where they exist `temperature_c`,
//! `discharged_ah` (positive = taken out), `type` or `status`, and a part column (`cycle`, `segment` or `ref`) at each
//! of whose values the time starts again. An empty field is NaN. A field that is no number is an error with its line.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::io::lines;

/// Columns at whose values time starts again.
const PART_COLUMNS: [&str; 3] = ["cycle", "segment", "ref"];

/// A stretch of rows over which time runs on.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredPart {
    /// Its key in the part column; empty where there is none.
    pub key: String,
    /// Value of the `type` column in its first row: `charge`, `discharge`; empty where there is none.
    pub kind: String,
    /// Seconds since the part's own beginning.
    pub time_s: Vec<f64>,
    /// Current, A, positive = discharge.
    pub current_a: Vec<f64>,
    /// Terminal voltage, V.
    pub voltage_v: Vec<f64>,
    /// Cell temperature, degrees C; NaN where there is none.
    pub temperature_c: Vec<f64>,
    /// The cycler's own counter, Ah taken out; NaN where there is none.
    pub discharged_ah: Vec<f64>,
}

impl MeasuredPart {
    /// Rows.
    pub fn len(&self) -> usize {
        self.time_s.len()
    }

    /// Whether it has no rows.
    pub fn is_empty(&self) -> bool {
        self.time_s.is_empty()
    }
}

/// One measured file.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredFile {
    /// Where it was read from.
    pub path: PathBuf,
    /// Its parts in the file's order; one where there is no part column.
    pub parts: Vec<MeasuredPart>,
}

/// Why a measured file cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct MeasuredError(pub String);

/// Where the columns are.
struct Columns {
    time: usize,
    current: usize,
    voltage: usize,
    temperature: Option<usize>,
    discharged: Option<usize>,
    part: Option<usize>,
    kind: Option<usize>,
}

impl MeasuredFile {
    /// Reads a whole file.
    ///
    /// # Errors
    /// The file cannot be read, a column is missing, a field is no number, or there are no rows: with place and what was found.
    pub fn read(path: &Path) -> Result<Self, MeasuredError> {
        let name = path.display();
        let source = lines::open(path, &Arc::default()).map_err(|e| MeasuredError(format!("{name}: {e}")))?;
        let mut reader = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(source);
        let fail = |e: csv::Error| MeasuredError(format!("{name}: {e}"));
        let headers = reader.headers().map_err(fail)?.clone();
        let columns = Columns::find(&headers).map_err(|what| MeasuredError(format!("{name}:1: {what}")))?;
        let mut parts: Vec<MeasuredPart> = Vec::new();
        let mut record = csv::ByteRecord::new();
        while reader.read_byte_record(&mut record).map_err(fail)? {
            let line = record.position().map_or(0, csv::Position::line);
            take_row(&columns, &headers, &record, &mut parts)
                .map_err(|what| MeasuredError(format!("{name}:{line}: {what}")))?;
        }
        if parts.is_empty() {
            return Err(MeasuredError(format!("{name}: no rows after the header")));
        }
        Ok(Self { path: path.to_owned(), parts })
    }

    /// File name without folders and endings, for tables and plots.
    pub fn short_name(&self) -> String {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        name.split('.').next().unwrap_or_default().to_owned()
    }

    /// Rows of all parts.
    pub fn rows(&self) -> usize {
        self.parts.iter().map(MeasuredPart::len).sum()
    }
}

impl Columns {
    fn find(headers: &csv::StringRecord) -> Result<Self, String> {
        let find = |name: &str| headers.iter().position(|h| h.trim_start_matches('\u{feff}') == name);
        let needed = |name: &str| {
            let found = headers.iter().collect::<Vec<_>>().join(",");
            find(name).ok_or_else(|| format!("no column {name}, found {found}"))
        };
        Ok(Self {
            time: needed("time_s")?,
            current: needed("current_a")?,
            voltage: needed("voltage_v")?,
            temperature: find("temperature_c"),
            discharged: find("discharged_ah"),
            part: PART_COLUMNS.iter().find_map(|name| find(name)),
            kind: find("type"),
        })
    }
}

fn take_row(
    columns: &Columns,
    headers: &csv::StringRecord,
    record: &csv::ByteRecord,
    parts: &mut Vec<MeasuredPart>,
) -> Result<(), String> {
    let text = |column: usize| record.get(column).map_or_else(Default::default, String::from_utf8_lossy);
    let number = |column: usize| match record.get(column) {
        Some(b"") | None => Ok(f64::NAN),
        Some(field) => std::str::from_utf8(field)
            .ok()
            .and_then(|field| field.parse::<f64>().ok())
            .filter(|value| value.is_finite())
            .ok_or_else(|| {
                format!("column {}: found {:?}, expected a finite number or nothing", &headers[column], text(column))
            }),
    };
    let optional = |column: Option<usize>| column.map_or(Ok(f64::NAN), number);
    let key = columns.part.map_or_else(Default::default, text);
    let time_s = number(columns.time)?;
    if time_s.is_nan() {
        return Err(format!("column {}: empty, expected seconds", &headers[columns.time]));
    }
    if parts.last().is_none_or(|part| part.key != key) {
        let kind = columns.kind.map_or_else(Default::default, text).into_owned();
        parts.push(MeasuredPart { key: key.into_owned(), kind, ..MeasuredPart::default() });
    }
    let Some(part) = parts.last_mut() else { return Ok(()) };
    let values = (number(columns.current)?, number(columns.voltage)?);
    let more = (optional(columns.temperature)?, optional(columns.discharged)?);
    part.time_s.push(time_s);
    part.current_a.push(values.0);
    part.voltage_v.push(values.1);
    part.temperature_c.push(more.0);
    part.discharged_ah.push(more.1);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<MeasuredFile, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        std::fs::write(&path, text).expect("written");
        MeasuredFile::read(&path).map_err(|e| e.0.replace(&format!("{}/", folder.path().display()), ""))
    }

    #[test]
    fn parts_begin_where_the_key_changes_and_an_empty_field_is_unknown() {
        let file =
            read("cycle,type,time_s,current_a,voltage_v\n3,charge,0,-1,3.5\n3,charge,1,-1,\n4,discharge,0,2,4\n");
        let file = file.expect("reads");
        assert_eq!((file.parts.len(), file.rows()), (2, 3));
        assert_eq!((file.parts[1].key.as_str(), file.parts[1].kind.as_str()), ("4", "discharge"));
        assert!(file.parts[0].voltage_v[1].is_nan() && file.parts[0].temperature_c[0].is_nan());
        assert_eq!(file.short_name(), "cell");
    }

    #[test]
    fn a_fault_names_its_line_and_what_was_found() {
        let found = read("time_s,current_a,voltage_v\n0,1,3.5\n1,x,3.5\n");
        assert_eq!(found, Err("cell.csv:3: column current_a: found \"x\", expected a finite number or nothing".into()));
        let found = read("time_s,voltage_v\n0,3.5\n");
        assert_eq!(found, Err("cell.csv:1: no column current_a, found time_s,voltage_v".into()));
        assert_eq!(read("time_s,current_a,voltage_v\n"), Err("cell.csv: no rows after the header".into()));
    }
}
