//! Capacity histories: CSV (plain, gzip or zstd), columns by name.
//!
//! * `date` or `start`: when the reading began, ISO 8601 or seconds, in order of time.
//! * `capacity_ah` or `capacity_ah_source`: Ah above 0; empty = not measured.
//! * `type`, where it exists: only `discharge` rows are readings, and each of them counts as a full cycle. Without it the
//!   file holds no use, and days count.
//! * `duration_s`, where it exists in addition to `type`: time of use between two readings; the remaining time was rest.

use std::path::Path;

use crate::health::{Axis, Usage};
use crate::io::table::{Header, Row, Table, TableError};
use crate::quantity::Timestamp;

/// Seconds in a day.
const DAY_S: f64 = 86_400.0;

/// A reading.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MeasuredCapacity {
    /// Line of the file.
    pub line: u64,
    /// Units of the history's axis since the first reading.
    pub used: f64,
    /// Full cycles since the first reading; 0 where they are not counted.
    pub cycles: f64,
    /// Days since the first reading.
    pub days: f64,
    /// Days of these without current.
    pub rest_days: f64,
    /// Ah.
    pub capacity_ah: f64,
}

/// A cell's capacities over its life.
#[derive(Debug, Clone, PartialEq)]
pub struct History {
    /// What counts as use.
    pub axis: Axis,
    /// In order of time, at least one.
    pub rows: Vec<MeasuredCapacity>,
}

struct Columns {
    time: usize,
    capacity: usize,
    kind: Option<usize>,
    duration: Option<usize>,
}

/// Use counted over the lines read so far.
#[derive(Default)]
struct UseCounter {
    first: Option<Timestamp>,
    last: Option<Timestamp>,
    discharges: f64,
    /// Discharges before the first reading.
    before: f64,
    used_days: f64,
    rest_days: f64,
}

impl MeasuredCapacity {
    /// Returns the use since another reading.
    pub fn since(&self, before: &Self) -> Usage {
        Usage {
            cycles: self.cycles - before.cycles,
            days: self.days - before.days,
            rest_days: self.rest_days - before.rest_days,
        }
    }
}

impl History {
    /// Reads a file.
    ///
    /// # Errors
    /// It cannot be read or a field is wrong, with file, line, column, what was found and what is allowed.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let mut table = Table::open(path)?;
        let columns = Columns::find(table.header())?;
        let (mut counter, mut rows) = (UseCounter::default(), Vec::new());
        while let Some(row) = table.next_row()? {
            rows.extend(counter.add_row(&columns, &row)?);
        }
        if rows.is_empty() {
            let column = &table.header().names()[columns.capacity];
            return Err(table.header().file_fault(format_args!("no row with a {column}, needs at least one")));
        }
        let axis = if columns.kind.is_some() { Axis::Cycles } else { Axis::Days };
        Ok(Self { axis, rows })
    }

    /// Ah.
    pub fn first_capacity_ah(&self) -> f64 {
        self.rows.first().map_or(f64::NAN, |row| row.capacity_ah)
    }
}

impl Columns {
    fn find(header: &Header) -> Result<Self, TableError> {
        Ok(Self {
            time: header.required(&["date", "start"])?,
            capacity: header.required(&["capacity_ah", "capacity_ah_source"])?,
            kind: header.find("type"),
            duration: header.find("duration_s"),
        })
    }
}

impl UseCounter {
    /// Counts a line; returns its reading, if it has one.
    fn add_row(&mut self, columns: &Columns, row: &Row<'_>) -> Result<Option<MeasuredCapacity>, TableError> {
        let time = row.stamp(columns.time)?;
        if self.last.is_some_and(|last| time < last) {
            return Err(row.fault(columns.time, "no earlier than the line before"));
        }
        let capacity = row.number_in(columns.capacity, f64::MIN_POSITIVE..=f64::MAX, "Ah above 0 or nothing")?;
        let duration = |column| row.number_in(column, 0.0..=f64::MAX, "seconds of 0 or more, or nothing");
        let duration_s = columns.duration.map_or(Ok(None), duration)?;
        self.pass(time);
        let is_discharge = columns.kind.is_none_or(|kind| row.text(kind) == "discharge");
        let counts_cycles = columns.kind.is_some();
        let reading = capacity.filter(|_| is_discharge);
        let reading = reading.map(|ah| MeasuredCapacity { line: row.line, ..self.reading(counts_cycles, time, ah) });
        if is_discharge {
            self.discharges += 1.0;
        }
        self.used_days = duration_s.unwrap_or(0.0) / DAY_S;
        Ok(reading)
    }

    /// Counts the time since the line before: time that the line before did not use was rest.
    fn pass(&mut self, time: Timestamp) {
        if let Some(last) = self.last {
            self.rest_days += (time.since(last) / DAY_S - self.used_days).max(0.0);
        }
        self.last = Some(time);
    }

    fn reading(&mut self, counts_cycles: bool, time: Timestamp, capacity_ah: f64) -> MeasuredCapacity {
        if self.first.is_none() {
            (self.first, self.before, self.rest_days) = (Some(time), self.discharges, 0.0);
        }
        let days = self.first.map_or(0.0, |first| time.since(first) / DAY_S);
        let cycles = if counts_cycles { self.discharges - self.before } else { 0.0 };
        let used = if counts_cycles { cycles } else { days };
        MeasuredCapacity { line: 0, used, cycles, days, rest_days: self.rest_days, capacity_ah }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<History, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        std::fs::write(&path, text).expect("written");
        History::read(&path).map_err(|e| e.to_string().replace(&format!("{}/", folder.path().display()), ""))
    }

    #[test]
    fn discharges_are_cycles_and_unused_time_is_rest() {
        let history = read(
            "cycle,type,start,capacity_ah_source,duration_s\n0,charge,0,,\n1,discharge,86400,2.0,43200\n\
             2,charge,129600,,43200\n3,discharge,259200,,43200\n4,discharge,345600,1.9,100\n",
        );
        let history = history.expect("reads");
        assert_eq!((history.axis, history.rows.len(), history.first_capacity_ah()), (Axis::Cycles, 2, 2.0));
        let row = history.rows[1];
        assert_eq!((row.line, row.cycles, row.used), (6, 2.0, 2.0));
        assert!((row.days - 3.0).abs() < 1e-9 && (row.rest_days - 1.5).abs() < 1e-9, "{row:?}");
    }

    #[test]
    fn without_a_type_days_count() {
        let history = read("ref,date,capacity_ah\n1,2014-01-06T12:00:00,2.1\n2,2014-01-11T00:00:00,2.0\n");
        let history = history.expect("reads");
        assert_eq!((history.axis, history.rows[1].used, history.rows[1].cycles), (Axis::Days, 4.5, 0.0));
    }

    #[test]
    fn a_fault_names_line_column_what_was_found_and_what_is_allowed() {
        let head = "date,capacity_ah\n";
        for (rows, fault) in [
            ("0,2.1\n1,x\n", "cell.csv:3: column capacity_ah: found \"x\", must be Ah above 0 or nothing"),
            ("0,-1\n", "cell.csv:2: column capacity_ah: found \"-1\", must be Ah above 0 or nothing"),
            ("0,nan\n", "cell.csv:2: column capacity_ah: found \"nan\", must be Ah above 0 or nothing"),
            ("soon,1\n", "cell.csv:2: column date: found \"soon\", must be like 2008-04-02T13:08:17.921 or seconds"),
            ("5,2\n4,2\n", "cell.csv:3: column date: found \"4\", must be no earlier than the line before"),
            ("0,\n", "cell.csv: no row with a capacity_ah, needs at least one"),
        ] {
            assert_eq!(read(&format!("{head}{rows}")), Err(fault.to_owned()));
        }
        assert_eq!(
            read("date,ah\n"),
            Err("cell.csv:1: no column capacity_ah or capacity_ah_source, found date,ah".into())
        );
    }
}
