//! Reads the files of a cycler with time, current, voltage, temperature and ampere-hours.
//!
//! The column `cycle`, `segment` or `ref` divides a file into parts. A new value begins a part, and time restarts
//! there. The column `type` names the kind of a part. An empty field becomes NaN. Rows without a time, or with a field
//! that is not a number, are left out and counted. If more than 1 % of the rows are left out, reading fails with the
//! error of the first of these rows.

use std::path::{Path, PathBuf};

use crate::can::decode::Channel;
pub use crate::ident::MeasuredPart;
pub use crate::io::csv_log::BDF_COLUMNS;
use crate::io::csv_log::{CsvLog, CsvOptions, TableReading};
use crate::io::table::TableError;

/// One measured file.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredFile {
    /// Path of the file.
    pub path: PathBuf,
    /// Parts in the order of the file; without a part column, the file is one part.
    pub parts: Vec<MeasuredPart>,
    /// Whether the file is in the Battery Data Format.
    pub is_bdf: bool,
    /// Interpretation of the columns.
    pub reading: TableReading,
}

impl MeasuredFile {
    /// Reads a whole file. `options` names columns and the sign of the current; the file has one cell.
    ///
    /// # Errors
    /// The file cannot be read, a column is missing, more than 1 % of the rows are left out, values are impossible in
    /// the stated unit, or the file has no rows.
    pub fn read(path: &Path, options: &CsvOptions) -> Result<Self, TableError> {
        let mut log = CsvLog::open_path(path, &CsvOptions { cells: 1, sensors: 1, series: 1, ..options.clone() })?;
        let mut parts: Vec<MeasuredPart> = Vec::new();
        let mut first_bad = None;
        while let Some(row) = log.next_row()? {
            match row {
                // The division gives exactly the number in the file. `Timestamp::secs` may differ in the last bit.
                Ok(row) => add_row(row.time.nanos() as f64 / 1e9, &log, &mut parts),
                Err(error) => first_bad = first_bad.or(Some(error)),
            }
        }
        let bad_rows = log.reading().rows - log.reading().read;
        if let Some(error) = first_bad.filter(|_| 100 * bad_rows > log.reading().rows) {
            return Err(error);
        }
        if parts.is_empty() {
            return Err(log.header().file_fault("no rows after the header"));
        }
        Ok(Self { path: path.to_owned(), parts, is_bdf: log.is_bdf(), reading: log.reading().clone() })
    }

    /// Returns the number of rows of all parts.
    pub fn rows(&self) -> usize {
        self.parts.iter().map(MeasuredPart::len).sum()
    }
}

/// Adds the last row of `log` to the last part, or to a new part if the part column has changed.
fn add_row(time_s: f64, log: &CsvLog, parts: &mut Vec<MeasuredPart>) {
    let [mut current_a, mut voltage_v, mut temperature_c] = [f64::NAN; 3];
    for (channel, value) in &log.values {
        let place = match channel {
            Channel::Current => &mut current_a,
            Channel::CellVoltage(_) => &mut voltage_v,
            _ => &mut temperature_c,
        };
        *place = value.map_or(f64::NAN, |value| value + 0.0);
    }
    let key = String::from_utf8_lossy(log.section());
    if parts.last().is_none_or(|part| part.key != key) {
        let kind = String::from_utf8_lossy(&log.kind_text).into_owned();
        parts.push(MeasuredPart { key: key.into_owned(), kind, ..MeasuredPart::default() });
    }
    if let Some(part) = parts.last_mut() {
        part.push(time_s, current_a, voltage_v, temperature_c, log.discharged_ah);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<MeasuredFile, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        std::fs::write(&path, text).expect("written");
        MeasuredFile::read(&path, &CsvOptions::default())
            .map_err(|e| e.to_string().replace(&format!("{}/", folder.path().display()), ""))
    }

    #[test]
    fn parts_start_at_new_keys_and_empty_fields_are_nan() {
        let file =
            read("cycle,type,time_s,current_a,voltage_v\n3,charge,0,-1,3.5\n3,charge,1,-1,\n4,discharge,0,2,4\n");
        let file = file.expect("reads");
        assert_eq!((file.parts.len(), file.rows()), (2, 3));
        assert_eq!((file.parts[1].key.as_str(), file.parts[1].kind.as_str()), ("4", "discharge"));
        assert!(file.parts[0].voltage_v[1].is_nan() && file.parts[0].temperature_c[0].is_nan());
    }

    #[test]
    fn battery_data_format_inverts_signs_and_prefers_surface_temperature() {
        let head = "Test Time / s,Voltage / V,Current / A,Ambient Temperature / degC,Surface Temperature T1 / degC,Cycle Count / 1";
        let file = read(&format!("{head},Net Capacity / Ah\n0,3.5,-2,20,21,1\n1,3.4,1.5,20,,2\n")).expect("reads");
        let part = &file.parts[0];
        assert_eq!((file.parts.len(), &part.current_a), (1, &vec![2.0, -1.5]));
        assert!(part.temperature_c[0] == 21.0 && part.temperature_c[1].is_nan() && part.discharged_ah[0].is_nan());
        let file =
            read("test_time_second,voltage_volt,current_ampere,net_capacity_ah\n0,3.5,-2,-0.25\n").expect("reads");
        assert_eq!((file.parts[0].current_a[0], file.parts[0].discharged_ah[0]), (2.0, 0.25));
        let found = read("Test Time / s,Voltage / V\n0,3.5\n");
        assert_eq!(
            found,
            Err("cell.csv:1: no column for current, found Test Time / s,Voltage / V; name it with --column current=NAME, or \
                 current='NAME[UNIT]'"
                .into())
        );
    }

    #[test]
    fn fault_names_line_and_value() {
        let found = read("time_s,current_a,voltage_v\n0,1,3.5\n1,x,3.5\n");
        assert_eq!(
            found,
            Err("cell.csv:3: column current_a: found \"x\", must be a finite number, empty, - or n/a".into())
        );
        let rows: String = (0..200).map(|n| format!("{n},1,3.5\n")).collect();
        let file = read(&format!("time_s,current_a,voltage_v\n{rows}x,1,3.5\n")).expect("one bad row of 201");
        assert_eq!((file.rows(), file.reading.rows, file.reading.read), (200, 201, 200));
        let found = read("time_s,voltage_v\n0,3.5\n");
        assert!(
            found.is_err_and(|error| error.starts_with("cell.csv:1: no column for current, found time_s,voltage_v;"))
        );
        assert_eq!(read("time_s,current_a,voltage_v\n"), Err("cell.csv: no rows after the header".into()));
    }
}
