//! Reads CSV logs: one row per sample, columns found by name, values in packwatch's units.
//!
//! Files in the Battery Data Format are recognised by the columns of that format ([`BDF_COLUMNS`]). A positive current
//! is a discharge, except with [`CsvOptions::charge_positive`] and in the Battery Data Format. An empty field means "no
//! reading". A row is bad if a field is missing or is not a finite number. A section column (`cycle`, `segment`, `ref`,
//! or the column that the user names) divides a file into sections; time restarts in each section. If a table states
//! the start times of the sections, the stamps are absolute. Otherwise, the gaps between the sections are unknown.

use std::collections::HashMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::stamp;
use super::table::{self, Header, PART_COLUMNS, Quotes, Row, Table, TableError};
use crate::can::decode::{Channel, SensorIndex};
use crate::quantity::{CellIndex, Timestamp};

/// Options for reading CSV files.
#[derive(Debug, Clone, Default)]
pub struct CsvOptions {
    /// Maps a role to a column: `time`, `current`, `voltage`, `temperature`, `section`. If role and column contain
    /// `{n}`, there is one column per cell or sensor, counted from 1.
    pub columns: Vec<(String, String)>,
    /// Whether the file counts a charging current as positive.
    pub charge_positive: bool,
    /// Table with the absolute start time of each section.
    pub start_times: Option<PathBuf>,
    /// Number of cells in the configuration.
    pub cells: u16,
    /// Whether the voltage is the pack's total.
    pub pack_total: bool,
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

/// A CSV file being read.
pub struct CsvLog {
    table: Table,
    time_column: usize,
    /// The channel of each used column.
    channels: Vec<(Channel, usize)>,
    charge_positive: bool,
    sections: Option<Sections>,
    /// Values of the last row.
    pub values: Vec<(Channel, Option<f64>)>,
}

/// The section column and the current section.
struct Sections {
    column: usize,
    starts: Option<HashMap<Vec<u8>, Timestamp>>,
    current: Option<Vec<u8>>,
    /// Start of the current section; `None` = unknown.
    start: Option<Timestamp>,
}

impl CsvLog {
    /// Reads the header line and finds the columns. `name` is the file name for messages.
    ///
    /// # Errors
    /// Fails if the source cannot be read, a column is missing, or the table of start times is faulty.
    pub fn open(source: Box<dyn Read>, name: &str, options: &CsvOptions) -> Result<Self, TableError> {
        let table = Table::new(source, name.to_owned(), Quotes::Literal)?;
        let columns = Columns { named: SampleColumns::new(table.header(), Some(&options.columns)), options };
        let time_column = columns.named.required("time", "time_s")?;
        let (sections, channels) = (columns.sections()?, columns.channels()?);
        let charge_positive = options.charge_positive || columns.named.is_bdf;
        let values = Vec::with_capacity(channels.len());
        Ok(Self { table, time_column, channels, charge_positive, sections, values })
    }

    /// Reads one row into [`values`](Self::values). Returns `None` at the end of the file, and an inner error if the
    /// row cannot be used.
    ///
    /// # Errors
    /// Fails if the source fails.
    pub fn next_row(&mut self) -> Result<Option<Result<RowTime, TableError>>, TableError> {
        let Some(row) = self.table.next_row()? else { return Ok(None) };
        self.values.clear();
        let time_text = row.bytes(self.time_column).unwrap_or_default();
        let Some(time) = stamp::parse_seconds(time_text) else {
            return Ok(Some(Err(row.fault(self.time_column, "seconds as a finite number"))));
        };
        for &(channel, column) in &self.channels {
            let Some(value) = row.bytes(column).and_then(table::parse_field) else {
                return Ok(Some(Err(row.fault(column, "a finite number or an empty field"))));
            };
            let flip = channel == Channel::Current && self.charge_positive;
            self.values.push((channel, if flip { value.map(|v| -v) } else { value }));
        }
        let Some(sections) = &mut self.sections else {
            return Ok(Some(Ok(RowTime { line: row.line, time, after_unknown_gap: false })));
        };
        Ok(Some(sections.place(&row, time)))
    }
}

impl Sections {
    /// Returns the time of a row. The row may be the first of a section.
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

/// Columns of the Battery Data Format: packwatch's name, the format's label, and the format's machine-readable name.
/// The first name that exists in the file is used.
pub const BDF_COLUMNS: [(&str, &str, &str); 6] = [
    ("time_s", "Test Time / s", "test_time_second"),
    ("current_a", "Current / A", "current_ampere"),
    ("voltage_v", "Voltage / V", "voltage_volt"),
    ("temperature_c", "Surface Temperature T1 / degC", "temperature_t1_celsius"),
    ("temperature_c", "Ambient Temperature / degC", "ambient_temperature_celsius"),
    // The sign of this column is opposite to packwatch's, like the sign of the current.
    ("discharged_ah", "Net Capacity / Ah", "net_capacity_ah"),
];

/// Finds the columns of samples. A column has the name that the user maps, else packwatch's name or the name in the
/// Battery Data Format.
pub struct SampleColumns<'a> {
    header: &'a Header,
    /// Maps a role to a column; `None` = the user cannot map columns.
    mapping: Option<&'a [(String, String)]>,
    /// Whether the file is in the Battery Data Format. A positive current in this format is a charge. The format does
    /// not state the sign, but net capacity in this format is charged minus discharged capacity, and cyclers use this
    /// sign.
    pub is_bdf: bool,
}

impl<'a> SampleColumns<'a> {
    /// Columns of a header line.
    pub fn new(header: &'a Header, mapping: Option<&'a [(String, String)]>) -> Self {
        let is_bdf = header.find("time_s").is_none() && header.find_any(&bdf_names("time_s")).is_some();
        Self { header, mapping, is_bdf }
    }

    fn mapped(&self, role: &str) -> Option<&'a str> {
        self.mapping?.iter().rev().find(|(r, _)| r == role).map(|(_, column)| column.as_str())
    }

    fn usual(&self, ours: &'a str) -> Vec<&'a str> {
        if self.is_bdf { bdf_names(ours) } else { vec![ours] }
    }

    fn find(&self, role: &str, names: &[&str]) -> Result<usize, TableError> {
        let missing = || {
            let (name, found) = (names.join(" or "), self.header.names().join(","));
            let (of, hint) = match self.mapping {
                Some(_) => (format!(" for {role}"), format!(" (map it with --column {role}=NAME)")),
                None => Default::default(),
            };
            self.header.fault(format_args!("no column {name}{of}, found {found}{hint}"))
        };
        self.header.find_any(names).ok_or_else(missing)
    }

    /// Index of the column of a role. If the user maps no column, the column has packwatch's name `ours` or, in the
    /// Battery Data Format, the format's name.
    ///
    /// # Errors
    /// Fails if the file does not have this column.
    pub fn required(&self, role: &str, ours: &'a str) -> Result<usize, TableError> {
        self.find(role, &self.mapped(role).map_or_else(|| self.usual(ours), |column| vec![column]))
    }

    /// Index of the column of a role. If the user maps no column, the column has packwatch's name `ours` or, in the
    /// Battery Data Format, the format's name. `None` = the file does not have this column.
    ///
    /// # Errors
    /// Fails if the file does not have the column that the user maps.
    pub fn optional(&self, role: &str, ours: &'a str) -> Result<Option<usize>, TableError> {
        match self.mapped(role) {
            Some(column) => self.find(role, &[column]).map(Some),
            None => Ok(self.header.find_any(&self.usual(ours))),
        }
    }

    /// Index of the section column. Time restarts at each new value of this column.
    ///
    /// # Errors
    /// Fails if the file does not have the column that the user maps.
    pub fn part(&self) -> Result<Option<usize>, TableError> {
        match self.mapped("section") {
            Some("") => Ok(None),
            Some(column) => self.find("section", &[column]).map(Some),
            None => Ok(self.header.find_any(&PART_COLUMNS)),
        }
    }
}

/// Returns the names that the Battery Data Format uses for packwatch's column `ours`.
fn bdf_names(ours: &str) -> Vec<&'static str> {
    BDF_COLUMNS.iter().filter(|of| of.0 == ours).flat_map(|of| [of.1, of.2]).collect()
}

/// The columns of a log, according to its options.
struct Columns<'a> {
    named: SampleColumns<'a>,
    options: &'a CsvOptions,
}

impl Columns<'_> {
    fn sections(&self) -> Result<Option<Sections>, TableError> {
        let (column, header) = (self.named.part()?, self.named.header);
        let starts = match (&self.options.start_times, column) {
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

    fn channels(&self) -> Result<Vec<(Channel, usize)>, TableError> {
        let mut channels = vec![(Channel::Current, self.named.required("current", "current_a")?)];
        self.temperatures(&mut channels)?;
        self.voltages(&mut channels)?;
        channels.sort_by_key(|&(channel, _)| channel);
        Ok(channels)
    }

    /// Finds the temperature columns, which are optional: one column for the first sensor, or a pattern for all sensors
    /// of the file.
    fn temperatures(&self, channels: &mut Vec<(Channel, usize)>) -> Result<(), TableError> {
        if let Some(pattern) = self.named.mapped("temperature{n}") {
            self.named.find("temperature{n}", &[&numbered(pattern, 0)])?;
            let found = (0..u16::MAX).map_while(|n| Some((n, self.named.header.find(&numbered(pattern, n))?)));
            channels.extend(found.map(|(n, column)| (Channel::Temperature(SensorIndex(n)), column)));
            return Ok(());
        }
        let column = self.named.optional("temperature", "temperature_c")?;
        channels.extend(column.map(|c| (Channel::Temperature(SensorIndex(0)), c)));
        Ok(())
    }

    fn voltages(&self, channels: &mut Vec<(Channel, usize)>) -> Result<(), TableError> {
        let cells = self.options.cells;
        let pattern = self.named.mapped("voltage{n}");
        if self.options.pack_total {
            channels.push((Channel::PackVoltage, self.named.required("voltage", "voltage_v")?));
        } else if cells == 1 && pattern.is_none() {
            channels.push((Channel::CellVoltage(CellIndex(0)), self.named.required("voltage", "voltage_v")?));
        } else {
            let pattern = pattern.unwrap_or("voltage{n}_v");
            for n in 0..cells {
                let column = self.named.find("voltage{n}", &[&numbered(pattern, n)])?;
                channels.push((Channel::CellVoltage(CellIndex(n)), column));
            }
        }
        Ok(())
    }
}

fn numbered(pattern: &str, index: u16) -> String {
    pattern.replace("{n}", &(u32::from(index) + 1).to_string())
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
mod tests {
    use super::*;

    #[test]
    fn battery_data_format_current_changes_sign() {
        let text = "Test Time / s,Voltage / V,Current / A\n0,3.5,-2\n";
        let options = CsvOptions { cells: 1, ..CsvOptions::default() };
        let mut log = CsvLog::open(Box::new(text.as_bytes()), "cell.csv", &options).expect("opens");
        assert!(matches!(log.next_row(), Ok(Some(Ok(_)))));
        let expected = [(Channel::Current, Some(2.0)), (Channel::CellVoltage(CellIndex(0)), Some(3.5))];
        assert!(log.values.len() == 2 && expected.iter().all(|value| log.values.contains(value)), "{:?}", log.values);
    }
}
