//! Reads columns of CSV files by name, for regressions.
//!
//! Input: CSV (plain, gzip or zstd) with one header line. An empty field or NaN is a missing value. In a required
//! column, [`MissingPolicy`] decides whether it is an error or the row is left out and counted. Any other field that is
//! not a finite number is an error.

use std::path::{Path, PathBuf};

use crate::error::LabError;
use crate::io::table::{PART_COLUMNS, Row, Table as CsvTable, TableError};

/// Units at the end of a column name that may be omitted. For example, the name `voltage` matches the column
/// `voltage_v`.
const UNITS: [&str; 36] = [
    "a", "ma", "ah", "mah", "v", "mv", "w", "kw", "wh", "kwh", "c", "k", "f", "s", "ms", "us", "ns", "min", "h", "d",
    "days", "cycles", "hz", "ohm", "mohm", "percent", "pct", "ppm", "kg", "m", "mm", "pa", "bar", "n", "nm", "rpm",
];
/// Maximum number of rows of a regression. More rows need several gigabytes of memory.
const MAX_ROWS: usize = 5_000_000;

/// Treatment of rows in which a required value is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MissingPolicy {
    /// Reading fails with an error that names file and line.
    Rejected,
    /// The row is left out and counted.
    Skipped,
}

/// Columns to read.
#[derive(Debug, Clone)]
pub struct ColumnSelection<'a> {
    /// Required columns, by name with or without the unit.
    pub columns: &'a [String],
    /// Optional columns. The column, or values in it, may be missing (NaN).
    pub optional: &'a [String],
    /// Treatment of rows in which a required value is missing.
    pub missing: MissingPolicy,
}

/// The column whose values divide the rows into parts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PartColumn {
    /// No column: every file is one part.
    None,
    /// The column with this name.
    Named(String),
    /// The first of `cycle`, `segment` and `ref` that exists.
    Default,
}

impl PartColumn {
    fn find(&self, header: &[String]) -> Result<Option<usize>, String> {
        match self {
            Self::None => Ok(None),
            Self::Named(name) => find(header, name).map(Some),
            Self::Default => Ok(PART_COLUMNS.iter().find_map(|name| header.iter().position(|column| column == name))),
        }
    }
}

/// Columns of one or more files. The rows of the files follow each other.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ColumnTable {
    /// Full names of the columns in the requested order. A missing optional column has the requested name.
    pub names: Vec<String>,
    /// Values, row by row.
    pub values: Vec<f64>,
    /// Line of each row in its file.
    pub lines: Vec<u64>,
    /// Each file with the number of the table's rows up to the end of this file.
    pub files: Vec<(PathBuf, usize)>,
    /// Number of rows left out because a value is missing.
    pub skipped: usize,
    /// For each optional column, whether every file has it.
    pub has: Vec<bool>,
    /// First row of each part. A new part starts with each file and with each new value of the part column.
    pub parts: Vec<usize>,
}

impl ColumnTable {
    /// Reads files and appends their rows.
    ///
    /// # Errors
    /// A file cannot be read, a column is unknown or ambiguous, a value is missing or not a number, or there are too
    /// many rows.
    pub fn read(paths: &[PathBuf], wanted: &ColumnSelection<'_>, part: &PartColumn) -> Result<Self, LabError> {
        let mut table = Self { has: vec![true; wanted.optional.len()], ..Self::default() };
        for path in paths {
            table.read_file(path, wanted, part)?;
            table.files.push((path.clone(), table.lines.len()));
        }
        table.ignore_row_counter(part);
        Ok(table)
    }

    /// Ignores the default part column if it changes in every row, because it then only counts the rows.
    fn ignore_row_counter(&mut self, part: &PartColumn) {
        if *part == PartColumn::Default && self.parts.len() == self.len() {
            let begins = [0].into_iter().chain(self.files.iter().map(|(_, end)| *end));
            self.parts = begins.filter(|begin| *begin < self.lines.len()).collect();
            self.parts.dedup();
        }
    }

    /// Returns the number of rows.
    pub fn len(&self) -> usize {
        self.lines.len()
    }

    /// Whether the table is empty.
    pub fn is_empty(&self) -> bool {
        self.lines.is_empty()
    }

    /// Returns the number of columns.
    pub fn width(&self) -> usize {
        self.names.len()
    }

    /// Returns the values of one row.
    pub fn row(&self, row: usize) -> &[f64] {
        &self.values[row * self.width()..][..self.width()]
    }

    /// Returns the values of one column.
    pub fn column(&self, column: usize) -> impl Iterator<Item = f64> + Clone + '_ {
        self.values.iter().skip(column).step_by(self.width().max(1)).copied()
    }

    /// Returns the file of a row.
    pub fn file_of(&self, row: usize) -> &Path {
        let at = self.files.partition_point(|(_, end)| *end <= row);
        self.files.get(at).map_or(Path::new(""), |(path, _)| path)
    }

    /// Returns file and line of a row, for messages.
    pub fn place(&self, row: usize) -> String {
        format!("{}:{}", self.file_of(row).display(), self.lines[row])
    }

    /// Returns the number of the row `steps` after this row; `None` = that row is not in the same part.
    pub fn after(&self, row: usize, steps: usize) -> Option<usize> {
        let at = self.parts.partition_point(|begin| *begin <= row);
        let end = self.parts.get(at).copied().unwrap_or(self.len());
        Some(row + steps).filter(|later| *later < end)
    }

    /// Returns a table with the first row of each part and every n-th row after it.
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

    fn read_file(&mut self, path: &Path, wanted: &ColumnSelection<'_>, part: &PartColumn) -> Result<(), TableError> {
        let mut file = CsvTable::open(path)?;
        let header = file.header();
        let columns = self.columns(header.names(), wanted).map_err(|what| header.fault(what))?;
        let part = part.find(header.names()).map_err(|what| header.fault(what))?;
        let mut key: Option<Vec<u8>> = None;
        while let Some(row) = file.next_row()? {
            let Some(values) = row_values(&row, &columns, wanted)? else {
                self.skipped += 1;
                continue;
            };
            let new_key = part.and_then(|column| row.bytes(column)).map(<[u8]>::to_vec).unwrap_or_default();
            if key.as_ref() != Some(&new_key) {
                self.parts.push(self.lines.len());
                key = Some(new_key);
            }
            self.values.extend(values);
            self.lines.push(row.line);
            if self.lines.len() > MAX_ROWS {
                return Err(row.row_fault(format_args!("more than {MAX_ROWS} rows in all, must be at most as many")));
            }
        }
        Ok(())
    }

    /// Returns the indices of the columns. Later files must have the same names as the first file.
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
            let requested = wanted.columns.iter().chain(wanted.optional);
            let name =
                |(found, requested): (&Option<usize>, &String)| found.map_or(requested, |at| &header[at]).clone();
            self.names = columns.iter().zip(requested).map(name).collect();
        }
        Ok(columns)
    }
}

/// Returns the values of a row; `None` = the row is left out because a required value is missing.
fn row_values(
    row: &Row<'_>,
    columns: &[Option<usize>],
    wanted: &ColumnSelection<'_>,
) -> Result<Option<Vec<f64>>, TableError> {
    let mut values = Vec::with_capacity(columns.len());
    for (k, &column) in columns.iter().enumerate() {
        let value = column.map_or(Ok(f64::NAN), |column| number(row, column))?;
        match (column, wanted.missing) {
            (Some(column), MissingPolicy::Rejected) if value.is_nan() && k < wanted.columns.len() => {
                return Err(row.fault(column, "a finite number; --skip-missing leaves such rows out"));
            }
            (Some(_), MissingPolicy::Skipped) if value.is_nan() && k < wanted.columns.len() => return Ok(None),
            _ => values.push(value),
        }
    }
    Ok(Some(values))
}

fn number(row: &Row<'_>, column: usize) -> Result<f64, TableError> {
    let text = row.text(column);
    if text.is_empty() {
        return Ok(f64::NAN);
    }
    let number = text.parse::<f64>().ok().filter(|value| !value.is_infinite());
    number.ok_or_else(|| row.fault(column, "a finite number"))
}

fn find(header: &[String], name: &str) -> Result<usize, String> {
    let all = |fits: &dyn Fn(&str) -> bool| -> Vec<usize> {
        header.iter().enumerate().filter(|(_, column)| fits(column)).map(|(at, _)| at).collect()
    };
    let exact = all(&|column| column == name);
    let found = if exact.is_empty() { all(&|column| stem(column) == Some(name)) } else { exact };
    let list = |columns: &mut dyn Iterator<Item = &String>| {
        let names: Vec<&str> = columns.map(String::as_str).collect();
        // An error lists at most 40 column names.
        let more = names.len().saturating_sub(40);
        let shown = names[..names.len() - more].join(", ");
        if more > 0 { format!("{shown} and {more} more") } else { shown }
    };
    match found[..] {
        [only] => Ok(only),
        [] => Err(format!("no column {name:?}, must be one of {}", list(&mut header.iter()))),
        _ => Err(format!(
            "column {name:?} is ambiguous, found {}, must be one of them by its whole name",
            list(&mut found.iter().map(|at| &header[*at]))
        )),
    }
}

fn stem(column: &str) -> Option<&str> {
    split(column).map(|(stem, _)| stem)
}

fn split(column: &str) -> Option<(&str, &str)> {
    column.rsplit_once('_').filter(|(stem, unit)| !stem.is_empty() && UNITS.contains(&unit.to_lowercase().as_str()))
}

/// Combines the name of a column with a word; the unit stays last: `voltage_mean_v`.
pub(super) fn derived(column: &str, word: &str) -> String {
    split(column).map_or_else(|| format!("{column}_{word}"), |(stem, unit)| format!("{stem}_{word}_{unit}"))
}

/// Formats a column's name and unit: `voltage, V`.
pub(super) fn label(column: &str) -> String {
    let Some((stem, unit)) = split(column) else { return column.replace('_', " ") };
    let symbols = ["A", "V", "W", "K", "F", "N", "Ah", "mAh", "mV", "mA", "Wh", "kWh", "kW", "Hz"];
    let unit = match unit {
        "c" => "degrees C",
        "percent" | "pct" => "%",
        other => symbols.into_iter().find(|symbol| symbol.to_lowercase() == other).unwrap_or(other),
    };
    format!("{}, {unit}", stem.replace('_', " "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str, columns: &[&str], missing: MissingPolicy) -> Result<ColumnTable, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        std::fs::write(&path, text).expect("written");
        let columns: Vec<String> = columns.iter().map(|name| (*name).to_owned()).collect();
        let wanted = ColumnSelection { columns: &columns, optional: &[], missing };
        let found = ColumnTable::read(std::slice::from_ref(&path), &wanted, &PartColumn::None);
        found.map_err(|e| e.to_string().replace(&format!("{}/", folder.path().display()), ""))
    }

    const TEXT: &str = "time_s,voltage_v,voltage_mv\n0,3.5,3500\n1,,3400\n2,nan,3300\n3,3.2,3200\n";

    #[test]
    fn columns_are_found_with_and_without_unit() {
        let table = read(TEXT, &["voltage_mv", "time"], MissingPolicy::Rejected).expect("reads");
        assert_eq!(table.names, ["voltage_mv", "time_s"]);
        assert_eq!((table.row(3), table.lines[3], table.parts.clone()), (&[3200.0, 3.0][..], 5, vec![0]));
        let ambiguous = read(TEXT, &["voltage"], MissingPolicy::Rejected).expect_err("two");
        assert_eq!(
            ambiguous,
            "cell.csv:1: column \"voltage\" is ambiguous, found voltage_v, voltage_mv, must be one of them by its whole name"
        );
        let unknown = read(TEXT, &["current"], MissingPolicy::Rejected).expect_err("none");
        assert_eq!(unknown, "cell.csv:1: no column \"current\", must be one of time_s, voltage_v, voltage_mv");
    }

    #[test]
    fn missing_values_are_rejected_or_skipped() {
        let refused = read(TEXT, &["voltage_v"], MissingPolicy::Rejected).expect_err("a hole");
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
    fn column_that_counts_rows_makes_no_parts() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        let parts = |text: &str, part: &PartColumn| {
            std::fs::write(&path, text).expect("written");
            let columns = ["a".to_owned()];
            let wanted = ColumnSelection { columns: &columns, optional: &[], missing: MissingPolicy::Rejected };
            let table = ColumnTable::read(&[path.clone(), path.clone()], &wanted, part).expect("reads");
            assert_eq!((table.after(0, 1).is_some(), table.file_of(3)), (table.parts.len() < 6, path.as_path()));
            (table.every(2).lines, table.parts)
        };
        let counted = "ref,a\n1,1\n2,1\n3,1\n";
        assert_eq!(parts(counted, &PartColumn::Default), (vec![2, 4, 2, 4], vec![0, 3]));
        assert_eq!(parts(counted, &PartColumn::Named("ref".into())).1, [0, 1, 2, 3, 4, 5]);
        assert_eq!(parts("ref,a\n1,1\n1,1\n2,1\n", &PartColumn::Default), (vec![2, 4, 2, 4], vec![0, 2, 3, 5]));
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
