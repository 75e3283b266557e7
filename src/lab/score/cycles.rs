//! Reads tables of published capacities: a [`CapacityTable`] with the columns `cycle` and `type`, and one line per
//! cycle.

use std::collections::HashMap;
use std::path::Path;

use crate::capacity_table::CapacityTable;
use crate::io::table::TableError;
use crate::measured::MeasuredPart;
use crate::quantity::Timestamp;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Discharge {
    pub(crate) start: Timestamp,
    /// Published capacity (Ah); `None` = the table does not state it.
    pub(crate) capacity_ah: Option<f64>,
}

/// Start of each part of a measured file, and the published capacities of the discharges.
#[derive(Debug, Clone, PartialEq)]
pub struct CycleTable {
    starts: HashMap<String, Timestamp>,
    /// Discharges in order of time. Their numbers count from 1.
    pub(crate) discharges: Vec<Discharge>,
}

impl CycleTable {
    /// Reads a table.
    ///
    /// # Errors
    /// The file cannot be read, a column is missing, a field is wrong (with file and line), or no discharge has a
    /// capacity.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let mut file = CapacityTable::open(path)?;
        for name in ["cycle", "type"] {
            file.header().required(&[name])?;
        }
        let mut table = Self { starts: HashMap::new(), discharges: Vec::new() };
        while let Some(row) = file.next_row()? {
            table.starts.insert(row.cycle.into_owned(), row.time);
            if row.is_discharge {
                table.discharges.push(Discharge { start: row.time, capacity_ah: row.capacity_ah });
            }
        }
        table.discharges.sort_by_key(|discharge| discharge.start);
        if table.discharges.iter().all(|discharge| discharge.capacity_ah.is_none()) {
            return Err(file.header().file_fault("no discharge with a capacity"));
        }
        Ok(table)
    }

    /// Limits each capacity to the charge drawn until the cut-off voltage. Charge that the tester drew afterwards at
    /// constant voltage is subtracted.
    pub(super) fn at_load(&self, parts: &[MeasuredPart]) -> Self {
        let mut table = self.clone();
        for part in parts.iter().filter(|part| part.is_discharge()) {
            let Some(start) = self.start(&part.key) else { continue };
            let held_ah = part.held_ah();
            if let Some(discharge) = table.discharges.iter_mut().find(|discharge| discharge.start == start) {
                discharge.capacity_ah = discharge.capacity_ah.map(|ah| ah - held_ah).filter(|ah| *ah > 0.0);
            }
        }
        table
    }

    /// Returns the start of the part with this key; `None` = it is not in the table.
    pub(super) fn start(&self, key: &str) -> Option<Timestamp> {
        self.starts.get(key).copied()
    }

    /// Returns the number of the latest discharge that has started at `time`; 0 = none has started.
    pub(super) fn number_at(&self, time: Timestamp) -> usize {
        self.discharges.partition_point(|discharge| discharge.start <= time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<CycleTable, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cycles.csv");
        std::fs::write(&path, text).expect("written");
        CycleTable::read(&path).map_err(|e| e.to_string().replace(&format!("{}/", folder.path().display()), ""))
    }

    #[test]
    fn discharges_are_numbered_by_time() {
        let table = read(
            "cycle,type,start,capacity_ah_source\n0,charge,0,\n1,discharge,100,1.9\n2,impedance,200,\n3,discharge,300,\n",
        );
        let table = table.expect("reads");
        let at = |seconds: f64| table.number_at(Timestamp::from_secs(seconds));
        assert_eq!([at(99.0), at(100.0), at(299.0), at(1e9)], [0, 1, 1, 2]);
        assert_eq!(table.discharges[1].capacity_ah, None);
        assert_eq!((table.start("2"), table.start("9")), (Some(Timestamp::from_secs(200.0)), None));
    }

    #[test]
    fn charge_at_held_voltage_is_subtracted() {
        let table =
            read("cycle,type,start,capacity_ah_source\n1,discharge,100,1.9\n3,discharge,300,0.05\n").expect("reads");
        let part = |key: &str| {
            let mut part = MeasuredPart { key: key.into(), kind: "discharge".into(), ..MeasuredPart::default() };
            for (time_s, current_a, voltage_v) in
                [(0.0, 3.0, 3.4), (1800.0, 3.0, 2.5), (1801.0, 1.0, 2.5), (2161.0, 1.0, 2.5)]
            {
                part.push(time_s, current_a, voltage_v, 25.0, f64::NAN);
            }
            part
        };
        let at_load = table.at_load(&[part("1"), part("3"), part("9")]);
        assert!((at_load.discharges[0].capacity_ah.expect("known") - 1.8).abs() < 1e-9, "360 s at 1 A");
        assert_eq!(at_load.discharges[1].capacity_ah, None, "a negative capacity counts as not stated");
    }

    #[test]
    fn fault_names_line_and_value() {
        let fault = read("cycle,type,start,capacity_ah_source\n1,discharge,soon,1.9\n");
        assert_eq!(
            fault,
            Err("cycles.csv:2: column start: found \"soon\", must be like 2008-04-02T13:08:17.921 or seconds".into())
        );
        let fault = read("cycle,type,start,capacity_ah_source\n1,discharge,1,-1\n");
        assert_eq!(
            fault,
            Err("cycles.csv:2: column capacity_ah_source: found \"-1\", must be Ah above 0 or nothing".into())
        );
        let fault = read("cycle,type,start\n1,discharge,1\n");
        assert_eq!(
            fault,
            Err("cycles.csv:1: no column capacity_ah or capacity_ah_source, found cycle,type,start".into())
        );
        let fault = read("cycle,type,start,capacity_ah_source\n1,charge,1,\n");
        assert_eq!(fault, Err("cycles.csv: no discharge with a capacity".into()));
    }
}
