//! Measured capacities from a CSV, to be drawn beside the estimates.

use std::path::Path;

use crate::io::stamp;

/// Names a column of capacities may have, Ah.
const CAPACITY: [&str; 2] = ["capacity_ah", "capacity_ah_source"];
/// Names a column of moments may have.
const TIME: [&str; 4] = ["time_s", "start", "date", "time"];

/// A capacity that was measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reference {
    /// When, s on the data's clock.
    pub time_s: f64,
    /// Ah.
    pub capacity_ah: f64,
}

/// Reads a table with a capacity (`capacity_ah` or `capacity_ah_source`, Ah) and a moment (`time_s`, s; `start`, `date`
/// or `time`, s or like 2008-04-02T13:08:17). A row without a capacity is passed over.
///
/// # Errors
/// The file cannot be read, a column is missing, or a value is no number; names file and line.
pub fn read(path: &Path) -> Result<Vec<Reference>, String> {
    let at = |line: usize, what: String| format!("{}:{line}: {what}", path.display());
    let mut table = csv::Reader::from_path(path).map_err(|error| format!("{}: {error}", path.display()))?;
    let header = table.headers().map_err(|error| at(1, error.to_string()))?.clone();
    let column = |names: &[&str]| {
        names.iter().find_map(|name| header.iter().position(|column| column.trim() == *name)).ok_or_else(|| {
            at(1, format!("no column {}, has {}", names.join(" or "), header.iter().collect::<Vec<_>>().join(", ")))
        })
    };
    let (capacity, time) = (column(&CAPACITY)?, column(&TIME)?);
    let mut references = Vec::new();
    for (index, row) in table.records().enumerate() {
        let line = index + 2;
        let row = row.map_err(|error| at(line, error.to_string()))?;
        let text = row.get(capacity).unwrap_or_default().trim();
        if text.is_empty() {
            continue;
        }
        let value = text.parse().ok().filter(|value: &f64| value.is_finite() && *value >= 0.0);
        let capacity_ah = value.ok_or_else(|| at(line, format!("capacity {text:?}, must be a number, 0 or more")))?;
        let text = row.get(time).unwrap_or_default();
        let moment = stamp::parse_stamp(text);
        let time_s = moment.ok_or_else(|| at(line, format!("time {text:?}, must be seconds or a date")))?.secs();
        references.push(Reference { time_s, capacity_ah });
    }
    references.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    Ok(references)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(text: &str) -> Result<Vec<Reference>, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("r.csv");
        std::fs::write(&path, text).expect("written");
        read(&path)
    }

    #[test]
    fn dates_and_seconds_are_read_and_rows_without_a_capacity_passed_over() {
        let rows = of("cycle,start,capacity_ah_source\n0,2008-04-02T13:08:17,\n1,2008-04-02T15:25:41,1.856\n").unwrap();
        assert_eq!(rows, [Reference { time_s: 1_207_149_941.0, capacity_ah: 1.856 }]);
        assert_eq!(of("time_s,capacity_ah\n20,2\n10,1\n").unwrap()[0].capacity_ah, 1.0);
    }

    #[test]
    fn what_is_wrong_is_told_with_its_line() {
        assert!(of("a,b\n1,2\n").unwrap_err().contains("r.csv:1: no column capacity_ah or capacity_ah_source"));
        assert!(of("time_s,capacity_ah\n1,2\n2,NaN\n").unwrap_err().contains("r.csv:3: capacity \"NaN\""));
        assert!(of("time_s,capacity_ah\nsoon,2\n").unwrap_err().contains("r.csv:2: time \"soon\""));
    }
}
