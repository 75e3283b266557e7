//! Reads capacity histories: a [`CapacityTable`] in order of time.
//!
//! If the file has a column `type`, only discharges are readings, and use is counted in full cycles, one per discharge.
//! Otherwise, use is counted in days. `duration_s` states how long the cell was in use after the time of a row. The
//! remaining time until the next row counts as rest. Without `duration_s`, up to one day per row counts as use.

use std::path::Path;

use crate::capacity_table::{CapacityRow, CapacityTable};
use crate::health::{Axis, Usage};
use crate::io::table::TableError;
use crate::quantity::Timestamp;

/// One capacity reading.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MeasuredCapacity {
    /// Line of the file.
    pub line: u64,
    /// Use since the first reading, units of the history's axis.
    pub used: f64,
    /// Full cycles since the first reading; 0 if they are not counted.
    pub cycles: f64,
    /// Days since the first reading.
    pub days: f64,
    /// Days without current since the first reading.
    pub rest_days: f64,
    /// Measured capacity (Ah).
    pub capacity_ah: f64,
}

/// A cell's capacities over its life.
#[derive(Debug, Clone, PartialEq)]
pub struct History {
    /// Unit of use.
    pub axis: Axis,
    /// Readings in order of time; there is at least one.
    pub rows: Vec<MeasuredCapacity>,
}

#[derive(Default)]
struct UseCounter {
    first: Option<Timestamp>,
    last: Option<Timestamp>,
    discharges: f64,
    /// Discharges before the first reading.
    before: f64,
    used_days: f64,
    /// Days of use that are assumed after a row without `duration_s`.
    unstated_days: f64,
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
    /// The file cannot be read, or a field is wrong.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let mut table = CapacityTable::open_in_order(path)?;
        let axis = if table.header().find("type").is_some() { Axis::Cycles } else { Axis::Days };
        // Without `duration_s`, a pause looks the same as use, so up to one day per row counts as use.
        let unstated_days = if table.header().find("duration_s").is_some() { 0.0 } else { 1.0 };
        let (mut counter, mut rows) = (UseCounter { unstated_days, ..UseCounter::default() }, Vec::new());
        while let Some(row) = table.next_row()? {
            rows.extend(counter.add_row(axis, &row));
        }
        if rows.is_empty() {
            return Err(table.header().file_fault("no row with a capacity, needs at least one"));
        }
        Ok(Self { axis, rows })
    }

    /// First capacity (Ah).
    pub fn first_capacity_ah(&self) -> f64 {
        self.rows.first().map_or(f64::NAN, |row| row.capacity_ah)
    }
}

impl UseCounter {
    fn add_row(&mut self, axis: Axis, row: &CapacityRow<'_>) -> Option<MeasuredCapacity> {
        self.pass(row.time);
        let capacity_ah = row.capacity_ah.filter(|_| row.is_discharge);
        let reading = capacity_ah.map(|ah| MeasuredCapacity { line: row.line, ..self.reading(axis, row.time, ah) });
        if row.is_discharge {
            self.discharges += 1.0;
        }
        self.used_days = row.duration_s.map_or(self.unstated_days, |duration_s| duration_s / 86_400.0);
        reading
    }

    /// Adds to the rest the time since the previous line, minus the time in which the cell was in use after that line.
    fn pass(&mut self, time: Timestamp) {
        if let Some(last) = self.last {
            self.rest_days += (time.since(last) / 86_400.0 - self.used_days).max(0.0);
        }
        self.last = Some(time);
    }

    fn reading(&mut self, axis: Axis, time: Timestamp, capacity_ah: f64) -> MeasuredCapacity {
        if self.first.is_none() {
            (self.first, self.before, self.rest_days) = (Some(time), self.discharges, 0.0);
        }
        let days = self.first.map_or(0.0, |first| time.since(first) / 86_400.0);
        let cycles = if axis == Axis::Cycles { self.discharges - self.before } else { 0.0 };
        let used = if axis == Axis::Cycles { cycles } else { days };
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
    fn day_between_rows_is_use_without_durations() {
        let history = read("type,date,capacity_ah\ndischarge,0,2.0\ndischarge,43200,1.9\ndischarge,302400,1.8\n");
        let rests: Vec<f64> = history.expect("reads").rows.into_iter().map(|row| row.rest_days).collect();
        assert_eq!(rests[..2], [0.0; 2]);
        assert!((rests[2] - 2.0).abs() < 1e-9, "{rests:?}");
    }

    #[test]
    fn days_are_counted_without_types() {
        let history = read("ref,date,capacity_ah\n1,2014-01-06T12:00:00,2.1\n2,2014-01-11T00:00:00,2.0\n");
        let history = history.expect("reads");
        assert_eq!((history.axis, history.rows[1].used, history.rows[1].cycles), (Axis::Days, 4.5, 0.0));
    }

    #[test]
    fn fault_names_line_column_found_and_allowed() {
        let head = "date,capacity_ah\n";
        for (rows, fault) in [
            ("0,2.1\n1,x\n", "cell.csv:3: column capacity_ah: found \"x\", must be Ah above 0 or nothing"),
            ("0,-1\n", "cell.csv:2: column capacity_ah: found \"-1\", must be Ah above 0 or nothing"),
            ("0,nan\n", "cell.csv: no row with a capacity, needs at least one"),
            ("soon,1\n", "cell.csv:2: column date: found \"soon\", must be like 2008-04-02T13:08:17.921 or seconds"),
            ("5,2\n4,2\n", "cell.csv:3: column date: found \"4\", must be no earlier than the row before"),
            ("0,\n", "cell.csv: no row with a capacity, needs at least one"),
        ] {
            assert_eq!(read(&format!("{head}{rows}")), Err(fault.to_owned()));
        }
        assert_eq!(
            read("date,ah\n"),
            Err("cell.csv:1: no column capacity_ah or capacity_ah_source, found date,ah".into())
        );
    }
}
