//! Capacity histories: CSV (plain, gzip or zstd), columns by name.
//!
//! * `date` or `start`: when the reading began, ISO 8601 or seconds, in order of time.
//! * `capacity_ah` or `capacity_ah_source`: Ah above 0; empty = not measured.
//! * `type`, where it exists: only `discharge` rows are readings, and each of them counts as a full cycle. Without it the
//!   file says nothing of use, and days count.
//! * `duration_s`, where it exists beside `type`: what of the time between two readings was use; the rest was rest.

use std::path::Path;
use std::sync::Arc;

use crate::health::{Axis, Usage};
use crate::io::{lines, stamp};
use crate::quantity::Timestamp;

/// Seconds in a day.
const DAY_S: f64 = 86_400.0;

/// What is wrong with a file, with its place.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct HistoryError(pub String);

/// A reading.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CapacityReading {
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
    pub rows: Vec<CapacityReading>,
}

struct Columns {
    time: usize,
    capacity: usize,
    kind: Option<usize>,
    duration: Option<usize>,
}

/// What is counted over the lines read so far.
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

impl CapacityReading {
    /// What passed since another.
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
    /// See [`super::read`].
    pub(super) fn read(path: &Path) -> Result<Self, HistoryError> {
        let name = path.display();
        let source =
            lines::open(path, &Arc::default()).map_err(|e| HistoryError(format!("{name}: cannot be read: {e}")))?;
        let mut reader = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(source);
        let fail = |e: csv::Error| HistoryError(format!("{name}: {e}"));
        let headers = reader.headers().map_err(fail)?.clone();
        let columns = Columns::find(&headers).map_err(|what| HistoryError(format!("{name}:1: {what}")))?;
        let (mut counted, mut rows) = (UseCounter::default(), Vec::new());
        for record in reader.records() {
            let record = record.map_err(fail)?;
            let line = record.position().map_or(0, csv::Position::line);
            let row = counted.take(&columns, &headers, &record);
            let row = row.map_err(|what| HistoryError(format!("{name}:{line}: {what}")))?;
            rows.extend(row.map(|row| CapacityReading { line, ..row }));
        }
        if rows.is_empty() {
            let column = &headers[columns.capacity];
            return Err(HistoryError(format!("{name}: no row with a {column}, needs at least one")));
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
    fn find(headers: &csv::StringRecord) -> Result<Self, String> {
        let find = |name: &str| headers.iter().position(|h| h.trim_start_matches('\u{feff}') == name);
        let needed = |names: [&str; 2]| {
            let found = headers.iter().collect::<Vec<_>>().join(",");
            let place = names.into_iter().find_map(find);
            place.ok_or_else(|| format!("no column {} or {}, found {found}", names[0], names[1]))
        };
        Ok(Self {
            time: needed(["date", "start"])?,
            capacity: needed(["capacity_ah", "capacity_ah_source"])?,
            kind: find("type"),
            duration: find("duration_s"),
        })
    }
}

impl UseCounter {
    /// Takes a line; a reading when it is one.
    fn take(
        &mut self,
        columns: &Columns,
        headers: &csv::StringRecord,
        record: &csv::StringRecord,
    ) -> Result<Option<CapacityReading>, String> {
        let field = |column: usize| record.get(column).unwrap_or_default();
        let fault = |column: usize, allowed: &str| {
            format!("column {}: found {:?}, must be {allowed}", &headers[column], field(column))
        };
        let number = |column: usize, allowed: &str, least: f64| match field(column) {
            "" => Ok(None),
            text => {
                let value = text.parse::<f64>().ok().filter(|value| value.is_finite() && *value >= least);
                value.map(Some).ok_or_else(|| fault(column, allowed))
            }
        };
        let time = stamp::parse_stamp(field(columns.time))
            .ok_or_else(|| fault(columns.time, "like 2008-04-02T13:08:17.921 or seconds"))?;
        if self.last.is_some_and(|last| time < last) {
            return Err(fault(columns.time, "no earlier than the line before"));
        }
        let capacity = number(columns.capacity, "Ah above 0 or nothing", f64::MIN_POSITIVE)?;
        let duration_s = columns.duration.map_or(Ok(None), |c| number(c, "seconds of 0 or more, or nothing", 0.0))?;
        self.pass(time);
        let is_discharge = columns.kind.is_none_or(|kind| field(kind) == "discharge");
        let row = capacity.filter(|_| is_discharge).map(|capacity_ah| self.row(columns, time, capacity_ah));
        if is_discharge {
            self.discharges += 1.0;
        }
        self.used_days = duration_s.unwrap_or(0.0) / DAY_S;
        Ok(row)
    }

    /// The time until the next line: what the line before did not use of it was rest.
    fn pass(&mut self, time: Timestamp) {
        if let Some(last) = self.last {
            self.rest_days += (time.since(last) / DAY_S - self.used_days).max(0.0);
        }
        self.last = Some(time);
    }

    fn row(&mut self, columns: &Columns, time: Timestamp, capacity_ah: f64) -> CapacityReading {
        if self.first.is_none() {
            (self.first, self.before, self.rest_days) = (Some(time), self.discharges, 0.0);
        }
        let days = self.first.map_or(0.0, |first| time.since(first) / DAY_S);
        let cycles = if columns.kind.is_some() { self.discharges - self.before } else { 0.0 };
        let used = if columns.kind.is_some() { cycles } else { days };
        CapacityReading { line: 0, used, cycles, days, rest_days: self.rest_days, capacity_ah }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<History, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        std::fs::write(&path, text).expect("written");
        History::read(&path).map_err(|e| e.0.replace(&format!("{}/", folder.path().display()), ""))
    }

    #[test]
    fn discharges_are_cycles_and_what_no_line_used_is_rest() {
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
