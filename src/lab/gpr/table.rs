//! Columns of CSV files by name, for regressions: any column may be an output or an input.
//!
//! In: CSV, plain, gzip or zstd, one heading line; numbers in the columns asked for. Out: those columns, row after row,
//! with the file and line of each row. An empty field or NaN is a missing value: refused with its place, or its row left
//! out and counted. Anything else that is no finite number is always refused.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::GprError;
use crate::io::lines;

/// Endings of column names that are units: `voltage` finds `voltage_v`.
const UNITS: [&str; 36] = [
    "a", "ma", "ah", "mah", "v", "mv", "w", "kw", "wh", "kwh", "c", "k", "f", "s", "ms", "us", "ns", "min", "h", "d",
    "days", "cycles", "hz", "ohm", "mohm", "percent", "pct", "ppm", "kg", "m", "mm", "pa", "bar", "n", "nm", "rpm",
];
/// Most rows of a regression: its numbers then take some gigabytes.
const MAX_ROWS: usize = 5_000_000;
/// Most columns told in an error.
const MAX_TOLD: usize = 40;

/// What is to be done with a row that lacks a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MissingPolicy {
    /// The whole work is refused, with file and line.
    Refused,
    /// The row is left out and counted.
    Skipped,
}

/// What to read.
#[derive(Debug, Clone)]
pub struct ColumnSelection<'a> {
    /// Columns that every row must have, as their reader calls them.
    pub columns: &'a [String],
    /// Columns that need not be there, nor have a value in every row (NaN then).
    pub optional: &'a [String],
    /// Rows that lack a value.
    pub missing: MissingPolicy,
}

/// Which column says what belongs together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PartColumn {
    /// None: every file is one run of rows.
    None,
    /// This one.
    Named(String),
    /// The first of `cycle`, `segment` and `ref` that is there.
    Usual,
}

/// Columns at whose values time usually starts again.
const USUAL_PARTS: [&str; 3] = ["cycle", "segment", "ref"];

impl PartColumn {
    fn find(&self, header: &[String]) -> Result<Option<usize>, String> {
        match self {
            Self::None => Ok(None),
            Self::Named(name) => find(header, name).map(Some),
            Self::Usual => Ok(USUAL_PARTS.iter().find_map(|name| header.iter().position(|column| column == name))),
        }
    }
}

/// Columns of one or more files, one after the other.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Table {
    /// Full names of the columns, in the order asked for; an optional one that is not there has the name asked for.
    pub names: Vec<String>,
    /// Values, row after row.
    pub values: Vec<f64>,
    /// Line of each row in its file.
    pub lines: Vec<u64>,
    /// The files, and the rows up to the end of each.
    pub files: Vec<(PathBuf, usize)>,
    /// Rows left out because a value is missing.
    pub skipped: usize,
    /// Whether each optional column is in every file.
    pub has: Vec<bool>,
    /// Row at which each run of rows begins that belong together: files, and values of the part column.
    pub parts: Vec<usize>,
}

impl Table {
    /// Reads files one after the other.
    ///
    /// # Errors
    /// A file cannot be read, a column is unknown or ambiguous, a value is missing or no number, there are too many rows:
    /// with file, line, column, what was found and what is allowed.
    pub fn read(paths: &[PathBuf], wanted: &ColumnSelection<'_>, part: &PartColumn) -> Result<Self, GprError> {
        let mut table = Self { has: vec![true; wanted.optional.len()], ..Self::default() };
        for path in paths {
            table.read_file(path, wanted, part).map_err(|what| GprError(format!("{}{what}", path.display())))?;
            table.files.push((path.clone(), table.lines.len()));
        }
        table.mend_parts(part);
        Ok(table)
    }

    /// A usual part column that differs from row to row counts the rows: it cuts nothing.
    fn mend_parts(&mut self, part: &PartColumn) {
        if *part == PartColumn::Usual && self.parts.len() == self.len() {
            let begins = [0].into_iter().chain(self.files.iter().map(|(_, end)| *end));
            self.parts = begins.filter(|begin| *begin < self.lines.len()).collect();
            self.parts.dedup();
        }
    }

    /// Rows.
    pub fn len(&self) -> usize {
        self.lines.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.lines.is_empty()
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.names.len()
    }

    /// One row.
    pub fn row(&self, row: usize) -> &[f64] {
        &self.values[row * self.width()..][..self.width()]
    }

    /// One column.
    pub fn column(&self, column: usize) -> impl Iterator<Item = f64> + Clone + '_ {
        self.values.iter().skip(column).step_by(self.width().max(1)).copied()
    }

    /// File of a row.
    pub fn file_of(&self, row: usize) -> &Path {
        let at = self.files.partition_point(|(_, end)| *end <= row);
        self.files.get(at).map_or(Path::new(""), |(path, _)| path)
    }

    /// Place of a row, for people.
    pub fn place(&self, row: usize) -> String {
        format!("{}:{}", self.file_of(row).display(), self.lines[row])
    }

    /// The row so many after this one, in the same part.
    pub fn after(&self, row: usize, steps: usize) -> Option<usize> {
        let at = self.parts.partition_point(|begin| *begin <= row);
        let end = self.parts.get(at).copied().unwrap_or(self.len());
        Some(row + steps).filter(|later| *later < end)
    }

    /// Every n-th row of each part, the first one included.
    pub fn every(&self, n: usize) -> Self {
        let mut thin = Self { values: vec![], lines: vec![], files: vec![], parts: vec![], ..self.clone() };
        let mut end_of_file = self.files.iter();
        let mut file = end_of_file.next();
        for (k, &begin) in self.parts.iter().enumerate() {
            thin.parts.push(thin.lines.len());
            let end = self.parts.get(k + 1).copied().unwrap_or(self.len());
            for row in (begin..end).step_by(n.max(1)) {
                thin.values.extend(self.row(row));
                thin.lines.push(self.lines[row]);
            }
            while let Some((path, _)) = file.filter(|(_, last)| *last <= end) {
                thin.files.push((path.clone(), thin.lines.len()));
                file = end_of_file.next();
            }
        }
        thin
    }

    /// One file; errors begin with the colon after its name.
    fn read_file(&mut self, path: &Path, wanted: &ColumnSelection<'_>, part: &PartColumn) -> Result<(), String> {
        let source = lines::open(path, &Arc::default()).map_err(|error| format!(": {error}"))?;
        let mut reader = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(source);
        let fail = |error: csv::Error| format!(": {error}");
        let header = reader.headers().map_err(fail)?;
        let header: Vec<String> = header.iter().map(|name| name.trim_start_matches('\u{feff}').to_owned()).collect();
        let columns = self.columns(&header, wanted).map_err(|what| format!(":1: {what}"))?;
        let part = part.find(&header).map_err(|what| format!(":1: {what}"))?;
        let mut record = csv::ByteRecord::new();
        let mut key: Option<Vec<u8>> = None;
        while reader.read_byte_record(&mut record).map_err(fail)? {
            let line = record.position().map_or(0, csv::Position::line);
            let values = row(&header, &columns, wanted.columns.len(), &record);
            let Some(values) = values.map_err(|bad| bad.told(line, wanted.missing)).or_else(RowError::skipped)? else {
                self.skipped += 1;
                continue;
            };
            let new_key = part.and_then(|column| record.get(column)).map(<[u8]>::to_vec).unwrap_or_default();
            if key.as_ref() != Some(&new_key) {
                self.parts.push(self.lines.len());
                key = Some(new_key);
            }
            self.values.extend(values);
            self.lines.push(line);
            if self.lines.len() > MAX_ROWS {
                return Err(format!(":{line}: more than {MAX_ROWS} rows in all, must be at most as many"));
            }
        }
        Ok(())
    }

    /// Where the columns are; those of later files must have the names that the first one has.
    fn columns(&mut self, header: &[String], wanted: &ColumnSelection<'_>) -> Result<Vec<Option<usize>>, String> {
        let first = self.names.is_empty();
        let mut columns = Vec::new();
        for (k, name) in wanted.columns.iter().chain(wanted.optional).enumerate() {
            let name = if first { name } else { &self.names[k] };
            let found = match find(header, name) {
                Err(_) if k >= wanted.columns.len() => {
                    self.has[k - wanted.columns.len()] = false;
                    None
                }
                found => Some(found?),
            };
            columns.push(found);
        }
        if first {
            let asked = wanted.columns.iter().chain(wanted.optional);
            let name = |(found, asked): (&Option<usize>, &String)| found.map_or(asked, |at| &header[at]).clone();
            self.names = columns.iter().zip(asked).map(name).collect();
        }
        Ok(columns)
    }
}

/// A row that cannot be used.
enum RowError {
    Missing(String),
    Wrong(String),
}

impl RowError {
    /// As an error that begins with the line; a missing value that may be skipped stays one.
    fn told(self, line: u64, missing: MissingPolicy) -> Self {
        match (self, missing) {
            (Self::Missing(what), MissingPolicy::Skipped) => Self::Missing(what),
            (Self::Missing(what), MissingPolicy::Refused) => {
                Self::Wrong(format!(":{line}: {what}; --skip-missing leaves such rows out"))
            }
            (Self::Wrong(what), _) => Self::Wrong(format!(":{line}: {what}")),
        }
    }

    /// A row that may be skipped is no row, anything else an error.
    fn skipped(self) -> Result<Option<Vec<f64>>, String> {
        match self {
            Self::Missing(_) => Ok(None),
            Self::Wrong(what) => Err(what),
        }
    }
}

/// Values of one row; the first `needed` must be there.
fn row(
    header: &[String],
    columns: &[Option<usize>],
    needed: usize,
    record: &csv::ByteRecord,
) -> Result<Option<Vec<f64>>, RowError> {
    let mut values = Vec::with_capacity(columns.len());
    for (k, column) in columns.iter().enumerate() {
        let text = column.and_then(|column| record.get(column)).unwrap_or_default();
        let name = column.map_or("", |column| &header[column]);
        let shown = || String::from_utf8_lossy(text).into_owned();
        let value = if text.is_empty() {
            f64::NAN
        } else {
            let number = std::str::from_utf8(text).ok().and_then(|text| text.parse::<f64>().ok());
            let number = number.filter(|value| !value.is_infinite());
            let wrong = || RowError::Wrong(format!("column {name}: found {:?}, must be a finite number", shown()));
            number.ok_or_else(wrong)?
        };
        if value.is_nan() && k < needed {
            return Err(RowError::Missing(format!("column {name}: found {:?}, must be a finite number", shown())));
        }
        values.push(value);
    }
    Ok(Some(values))
}

/// A column by its name, or by its name without the unit.
fn find(header: &[String], name: &str) -> Result<usize, String> {
    let all = |fits: &dyn Fn(&str) -> bool| -> Vec<usize> {
        header.iter().enumerate().filter(|(_, column)| fits(column)).map(|(at, _)| at).collect()
    };
    let exact = all(&|column| column == name);
    let found = if exact.is_empty() { all(&|column| stem(column) == Some(name)) } else { exact };
    let told = |columns: &mut dyn Iterator<Item = &String>| {
        let names: Vec<&str> = columns.map(String::as_str).collect();
        let more = names.len().saturating_sub(MAX_TOLD);
        let list = names[..names.len() - more].join(", ");
        if more > 0 { format!("{list} and {more} more") } else { list }
    };
    match found[..] {
        [only] => Ok(only),
        [] => Err(format!("no column {name:?}, must be one of {}", told(&mut header.iter()))),
        _ => Err(format!(
            "column {name:?} is ambiguous, found {}, must be one of them by its whole name",
            told(&mut found.iter().map(|at| &header[*at]))
        )),
    }
}

/// The name without its unit.
fn stem(column: &str) -> Option<&str> {
    split(column).map(|(stem, _)| stem)
}

fn split(column: &str) -> Option<(&str, &str)> {
    column.rsplit_once('_').filter(|(stem, unit)| !stem.is_empty() && UNITS.contains(&unit.to_lowercase().as_str()))
}

/// A name made of a column's name and a word, the unit last: `voltage_mean_v`.
pub(super) fn derived(column: &str, word: &str) -> String {
    split(column).map_or_else(|| format!("{column}_{word}"), |(stem, unit)| format!("{stem}_{word}_{unit}"))
}

/// Name and unit for people: `voltage, V`.
pub(super) fn label(column: &str) -> String {
    let Some((stem, unit)) = split(column) else { return column.replace('_', " ") };
    let unit = match unit {
        "a" | "v" | "w" | "c" | "k" | "f" | "n" => unit.to_uppercase(),
        "ah" => "Ah".to_owned(),
        "mah" => "mAh".to_owned(),
        "mv" => "mV".to_owned(),
        "ma" => "mA".to_owned(),
        "wh" => "Wh".to_owned(),
        "kwh" => "kWh".to_owned(),
        "kw" => "kW".to_owned(),
        "hz" => "Hz".to_owned(),
        "percent" | "pct" => "%".to_owned(),
        other => other.to_owned(),
    };
    let unit = if unit == "C" { "degrees C".to_owned() } else { unit };
    format!("{}, {unit}", stem.replace('_', " "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str, columns: &[&str], missing: MissingPolicy) -> Result<Table, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        std::fs::write(&path, text).expect("written");
        let columns: Vec<String> = columns.iter().map(|name| (*name).to_owned()).collect();
        let wanted = ColumnSelection { columns: &columns, optional: &[], missing };
        let found = Table::read(std::slice::from_ref(&path), &wanted, &PartColumn::None);
        found.map_err(|e| e.0.replace(&format!("{}/", folder.path().display()), ""))
    }

    const TEXT: &str = "time_s,voltage_v,voltage_mv\n0,3.5,3500\n1,,3400\n2,nan,3300\n3,3.2,3200\n";

    #[test]
    fn columns_are_found_with_and_without_their_unit() {
        let table = read(TEXT, &["voltage_mv", "time"], MissingPolicy::Refused).expect("reads");
        assert_eq!(table.names, ["voltage_mv", "time_s"]);
        assert_eq!((table.row(3), table.lines[3], table.parts.clone()), (&[3200.0, 3.0][..], 5, vec![0]));
        let ambiguous = read(TEXT, &["voltage"], MissingPolicy::Refused).expect_err("two");
        assert_eq!(
            ambiguous,
            "cell.csv:1: column \"voltage\" is ambiguous, found voltage_v, voltage_mv, must be one of them by its whole name"
        );
        let unknown = read(TEXT, &["current"], MissingPolicy::Refused).expect_err("none");
        assert_eq!(unknown, "cell.csv:1: no column \"current\", must be one of time_s, voltage_v, voltage_mv");
    }

    #[test]
    fn missing_values_are_refused_with_their_line_or_skipped_and_counted() {
        let refused = read(TEXT, &["voltage_v"], MissingPolicy::Refused).expect_err("a hole");
        let expected =
            "cell.csv:3: column voltage_v: found \"\", must be a finite number; --skip-missing leaves such rows out";
        assert_eq!(refused, expected);
        let table = read(TEXT, &["voltage_v"], MissingPolicy::Skipped).expect("reads");
        assert_eq!((table.len(), table.skipped, table.lines.clone()), (2, 2, vec![2, 5]));
        for wrong in ["x", "inf", "1e999"] {
            let text = format!("a\n1\n{wrong}\n");
            let refused = read(&text, &["a"], MissingPolicy::Skipped).expect_err(wrong);
            assert_eq!(refused, format!("cell.csv:3: column a: found {wrong:?}, must be a finite number"));
        }
    }

    #[test]
    fn rows_that_a_part_column_counts_belong_together() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        let parts = |text: &str, part: &PartColumn| {
            std::fs::write(&path, text).expect("written");
            let columns = ["a".to_owned()];
            let wanted = ColumnSelection { columns: &columns, optional: &[], missing: MissingPolicy::Refused };
            let table = Table::read(&[path.clone(), path.clone()], &wanted, part).expect("reads");
            assert_eq!((table.after(0, 1).is_some(), table.file_of(3)), (table.parts.len() < 6, path.as_path()));
            (table.every(2).lines, table.parts)
        };
        let counted = "ref,a\n1,1\n2,1\n3,1\n";
        assert_eq!(parts(counted, &PartColumn::Usual), (vec![2, 4, 2, 4], vec![0, 3]));
        assert_eq!(parts(counted, &PartColumn::Named("ref".into())).1, [0, 1, 2, 3, 4, 5]);
        assert_eq!(parts("ref,a\n1,1\n1,1\n2,1\n", &PartColumn::Usual), (vec![2, 4, 2, 4], vec![0, 2, 3, 5]));
    }

    #[test]
    fn derived_names_keep_the_unit_last() {
        assert_eq!(
            (derived("voltage_v", "mean"), derived("soc", "low_95")),
            ("voltage_mean_v".into(), "soc_low_95".into())
        );
        assert_eq!((label("capacity_ah"), label("state_of_charge")), ("capacity, Ah".into(), "state of charge".into()));
    }
}
