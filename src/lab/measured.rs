//! Reads the files of a cycler: CSV (plain, gzip or zstd) with time, current, voltage, temperature and ampere-hours.
//!
//! Columns are found by name. Required are `time_s`, `current_a` (positive = discharge) and `voltage_v`. Optional are
//! `temperature_c`, `discharged_ah` (positive = taken out), `type`, and a part column (`cycle`, `segment` or `ref`).
//! The time restarts at each new value of the part column. An empty field becomes NaN, except the time. An empty time,
//! or a field that is not a number, causes an error that names the line.
//!
//! Files in the Battery Data Format are recognised by their columns ([`BDF_COLUMNS`]). The signs of their current and
//! charge are inverted.

use std::path::{Path, PathBuf};

pub use crate::ident::MeasuredPart;
pub use crate::io::csv_log::BDF_COLUMNS;
use crate::io::csv_log::SampleColumns;
use crate::io::table::{Header, Row, Table, TableError};

/// One measured file.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredFile {
    /// Path of the file.
    pub path: PathBuf,
    /// Parts in the order of the file; without a part column, the file is one part.
    pub parts: Vec<MeasuredPart>,
    /// Whether the file is in the Battery Data Format.
    pub is_bdf: bool,
}

/// Indices of the columns.
struct Columns {
    time: usize,
    current: usize,
    voltage: usize,
    temperature: Option<usize>,
    discharged: Option<usize>,
    part: Option<usize>,
    kind: Option<usize>,
    /// Factor for current and charge: 1, or -1 if a positive current in the file charges the cell.
    sign: f64,
}

impl MeasuredFile {
    /// Reads a whole file.
    ///
    /// # Errors
    /// The file cannot be read, a column is missing, a field is not a number, or the file has no rows. The error states
    /// the place and what was found.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let mut table = Table::open(path)?;
        let columns = Columns::find(table.header())?;
        let mut parts: Vec<MeasuredPart> = Vec::new();
        while let Some(row) = table.next_row()? {
            columns.add_row(&row, &mut parts)?;
        }
        if parts.is_empty() {
            return Err(table.header().file_fault("no rows after the header"));
        }
        Ok(Self { path: path.to_owned(), parts, is_bdf: columns.sign < 0.0 })
    }

    /// Number of rows of all parts.
    pub fn rows(&self) -> usize {
        self.parts.iter().map(MeasuredPart::len).sum()
    }
}

impl Columns {
    fn find(header: &Header) -> Result<Self, TableError> {
        let columns = SampleColumns::new(header, None);
        Ok(Self {
            time: columns.required("time", "time_s")?,
            current: columns.required("current", "current_a")?,
            voltage: columns.required("voltage", "voltage_v")?,
            temperature: columns.optional("temperature", "temperature_c")?,
            discharged: columns.optional("charge", "discharged_ah")?,
            part: columns.part()?,
            kind: header.find("type"),
            sign: if columns.is_bdf { -1.0 } else { 1.0 },
        })
    }

    /// Converts the sign; the result is never -0.
    fn signed(&self, value: f64) -> f64 {
        self.sign * value + 0.0
    }

    /// Adds a row to the last part, or to a new part if the key of the row differs.
    fn add_row(&self, row: &Row<'_>, parts: &mut Vec<MeasuredPart>) -> Result<(), TableError> {
        let text = |column: Option<usize>| column.map_or_else(Default::default, |column| row.text(column));
        let number = |column: usize| Ok(row.number(column)?.unwrap_or(f64::NAN));
        let optional = |column: Option<usize>| column.map_or(Ok(f64::NAN), number);
        let time_s = row.number(self.time)?.ok_or_else(|| row.fault(self.time, "seconds"))?;
        let (current_a, voltage_v) = (self.signed(number(self.current)?), number(self.voltage)?);
        let (temperature_c, discharged_ah) = (optional(self.temperature)?, self.signed(optional(self.discharged)?));
        let key = text(self.part);
        if parts.last().is_none_or(|part| part.key != key) {
            let kind = text(self.kind).into_owned();
            parts.push(MeasuredPart { key: key.into_owned(), kind, ..MeasuredPart::default() });
        }
        let Some(part) = parts.last_mut() else { return Ok(()) };
        part.push(time_s, current_a, voltage_v, temperature_c, discharged_ah);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<MeasuredFile, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cell.csv");
        std::fs::write(&path, text).expect("written");
        MeasuredFile::read(&path).map_err(|e| e.to_string().replace(&format!("{}/", folder.path().display()), ""))
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
            Err("cell.csv:1: no column Current / A or current_ampere, found Test Time / s,Voltage / V".into())
        );
    }

    #[test]
    fn fault_names_line_and_value() {
        let found = read("time_s,current_a,voltage_v\n0,1,3.5\n1,x,3.5\n");
        assert_eq!(
            found,
            Err("cell.csv:3: column current_a: found \"x\", must be a finite number or an empty field".into())
        );
        let found = read("time_s,voltage_v\n0,3.5\n");
        assert_eq!(found, Err("cell.csv:1: no column current_a, found time_s,voltage_v".into()));
        assert_eq!(read("time_s,current_a,voltage_v\n"), Err("cell.csv: no rows after the header".into()));
    }
}
