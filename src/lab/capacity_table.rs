//! Reads tables of capacities over the life of a cell: CSV files (plain, gzip or zstd) whose columns are found by name.
//!
//! | column | value |
//! | --- | --- |
//! | `time_s`, `start`, `date` or `time` | time in seconds, or as text such as 2008-04-02T13:08:17 |
//! | `capacity_ah` or `capacity_ah_source` | capacity (Ah), above 0; empty = not measured |
//! | `soc` | SOC, fraction; empty = not measured |
//! | `cell` | number of the cell, from 0 |
//! | `cycle` | number of the part of a measured file that the row describes |
//! | `type` | `discharge`, or another word for any other kind of cycle |
//! | `duration_s` | time (s) in use after the time of the row |

use std::borrow::Cow;
use std::path::Path;

use crate::io::table::{Header, Row, Table, TableError};
use crate::quantity::{CellIndex, Timestamp};

const CAPACITY: [&str; 2] = ["capacity_ah", "capacity_ah_source"];

pub(crate) struct CapacityTable {
    table: Table,
    time: usize,
    capacity: Option<usize>,
    soc: Option<usize>,
    cell: Option<usize>,
    cycle: Option<usize>,
    kind: Option<usize>,
    duration: Option<usize>,
    /// Time of the last row; `None` = the rows may have any order.
    last: Option<Timestamp>,
}

/// A row of the table. A field is `None` if the table does not state it.
pub(crate) struct CapacityRow<'t> {
    pub(crate) line: u64,
    pub(crate) time: Timestamp,
    pub(crate) capacity_ah: Option<f64>,
    pub(crate) soc: Option<f64>,
    pub(crate) cell: Option<CellIndex>,
    pub(crate) cycle: Cow<'t, str>,
    /// Whether the row belongs to a discharge; true for every row if the table has no column `type`.
    pub(crate) is_discharge: bool,
    pub(crate) duration_s: Option<f64>,
}

impl CapacityTable {
    /// Opens a table of capacities whose rows may have any order.
    ///
    /// # Errors
    /// The file cannot be read, or the column of times or of capacities is missing.
    pub(crate) fn open(path: &Path) -> Result<Self, TableError> {
        Self::open_with(path, &CAPACITY)
    }

    /// Opens a table of capacities, SOC or both, whose rows may have any order.
    ///
    /// # Errors
    /// The file cannot be read, the column of times is missing, or the file has neither capacities nor SOC.
    pub(crate) fn open_reference(path: &Path) -> Result<Self, TableError> {
        Self::open_with(path, &[CAPACITY[0], CAPACITY[1], "soc"])
    }

    fn open_with(path: &Path, values: &[&str]) -> Result<Self, TableError> {
        let table = Table::open(path)?;
        let header = table.header();
        header.required(values)?;
        Ok(Self {
            time: header.required(&["time_s", "start", "date", "time"])?,
            capacity: header.find_any(&CAPACITY),
            soc: header.find("soc"),
            cell: header.find("cell"),
            cycle: header.find("cycle"),
            kind: header.find("type"),
            duration: header.find("duration_s"),
            last: None,
            table,
        })
    }

    /// Opens a table of capacities whose rows must be in order of time.
    pub(crate) fn open_in_order(path: &Path) -> Result<Self, TableError> {
        Ok(Self { last: Some(Timestamp::from_nanos(i64::MIN)), ..Self::open(path)? })
    }

    pub(crate) fn header(&self) -> &Header {
        self.table.header()
    }

    /// Returns the next row, or `None` at the end of the file.
    ///
    /// # Errors
    /// The file cannot be read, or a field is wrong.
    pub(crate) fn next_row(&mut self) -> Result<Option<CapacityRow<'_>>, TableError> {
        let Some(row) = self.table.next_row()? else { return Ok(None) };
        let time = row.stamp(self.time)?;
        if let Some(last) = &mut self.last {
            if time < *last {
                return Err(row.fault(self.time, "no earlier than the row before"));
            }
            *last = time;
        }
        let number = |column: Option<usize>, low: f64, high: f64, allowed: &str| {
            column.map_or(Ok(None), |column| row.number_in(column, low..=high, allowed))
        };
        Ok(Some(CapacityRow {
            line: row.line,
            time,
            capacity_ah: number(self.capacity, f64::MIN_POSITIVE, f64::MAX, "Ah above 0 or nothing")?,
            // Measured SOC may be slightly outside 0 to 1. The limit of 1.5 detects a column in percent.
            soc: number(self.soc, -0.5, 1.5, "a fraction, 0 to 1")?,
            cell: self.cell.map(|column| cell(&row, column)).transpose()?,
            cycle: self.cycle.map_or_else(Cow::default, |column| row.text(column)),
            is_discharge: self.kind.is_none_or(|column| row.text(column) == "discharge"),
            duration_s: number(self.duration, 0.0, f64::MAX, "seconds of 0 or more, or nothing")?,
        }))
    }
}

fn cell(row: &Row<'_>, column: usize) -> Result<CellIndex, TableError> {
    row.text(column).parse().map(CellIndex).map_err(|_| row.fault(column, "a cell from 0"))
}
