//! Reads measured or true capacities and SOC from a CSV file. The report draws these values together with the
//! estimates.

use std::path::Path;

use crate::capacity_table::CapacityTable;
use crate::io::table::TableError;

/// Measured or true values. Times are in s on the clock of the data.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reference {
    /// Time and capacity (Ah). If the rows name their cells, the capacity of the weakest cell applies.
    pub capacities: Vec<(f64, f64)>,
    /// Whether the capacities were measured under load. Otherwise, they are the charge between full and empty.
    pub is_loaded: bool,
    /// Time, and the lowest and highest SOC of all cells, fraction.
    pub socs: Vec<(f64, f64, f64)>,
}

/// Reads a [`CapacityTable`]. If it has a column `cell`, consecutive rows with the same time are joined. The reference
/// then has the capacity of the weakest cell, and the lowest and highest SOC.
///
/// # Errors
/// The file cannot be read, a column is missing, or a value is not a number or is out of range. The error names file
/// and line.
pub fn read(path: &Path) -> Result<Reference, TableError> {
    let mut table = CapacityTable::open_reference(path)?;
    let has_cells = table.header().find("cell").is_some();
    let mut reference = Reference { is_loaded: !has_cells, ..Reference::default() };
    while let Some(row) = table.next_row()? {
        let time_s = row.time.secs();
        if let Some(ah) = row.capacity_ah {
            match reference.capacities.last_mut().filter(|last| has_cells && last.0 == time_s) {
                Some(last) => last.1 = last.1.min(ah),
                None => reference.capacities.push((time_s, ah)),
            }
        }
        if let Some(soc) = row.soc {
            match reference.socs.last_mut().filter(|last| has_cells && last.0 == time_s) {
                Some(last) => (last.1, last.2) = (last.1.min(soc), last.2.max(soc)),
                None => reference.socs.push((time_s, soc, soc)),
            }
        }
    }
    reference.capacities.sort_by(|a, b| a.0.total_cmp(&b.0));
    reference.socs.sort_by(|a, b| a.0.total_cmp(&b.0));
    if has_cells {
        thin(&mut reference.capacities);
    }
    Ok(reference)
}

/// Removes each point whose capacity differs by at most 0.02 % from the capacity of the last point that was kept. The
/// first and the last point always stay.
fn thin(points: &mut Vec<(f64, f64)>) {
    let last = points.last().copied();
    let mut kept_ah = f64::INFINITY;
    points.retain(|(_, ah)| {
        let is_kept = (ah - kept_ah).abs() > 2e-4 * ah;
        kept_ah = if is_kept { *ah } else { kept_ah };
        is_kept
    });
    if last != points.last().copied() {
        points.extend(last);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(text: &str) -> Result<Reference, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("r.csv");
        std::fs::write(&path, text).expect("written");
        read(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn rows_without_capacity_are_skipped() {
        let rows = of("cycle,start,capacity_ah_source\n0,2008-04-02T13:08:17,\n1,2008-04-02T15:25:41,1.856\n").unwrap();
        assert_eq!((rows.capacities, rows.is_loaded), (vec![(1_207_149_941.0, 1.856)], true));
        assert_eq!(of("time_s,capacity_ah\n20,2\n10,1\n30,NaN\n").unwrap().capacities, [(10.0, 1.0), (20.0, 2.0)]);
    }

    #[test]
    fn truth_of_a_pack_becomes_weakest_cell_and_range() {
        let text = "time_s,cell,soc,capacity_ah\n1,0,.5,2\n1,1,.6,1.9\n2,0,.4,2\n2,1,.5,1.9\n3,0,.3,2\n3,1,.4,1.8\n4,0,.2,2\n4,1,.3,1.8\n";
        let truth = of(text).unwrap();
        assert_eq!(truth.capacities, [(1.0, 1.9), (3.0, 1.8), (4.0, 1.8)]);
        assert_eq!((truth.socs[0], truth.socs[3]), ((1.0, 0.5, 0.6), (4.0, 0.2, 0.3)));
        assert!(!truth.is_loaded);
    }

    #[test]
    fn fault_names_its_line() {
        assert!(of("a,b\n1,2\n").unwrap_err().contains("r.csv:1: no column capacity_ah or capacity_ah_source or soc"));
        assert!(
            of("time_s,capacity_ah\n1,2\n2,new\n").unwrap_err().contains("r.csv:3: column capacity_ah: found \"new\"")
        );
        assert!(of("time_s,capacity_ah\nsoon,2\n").unwrap_err().contains("r.csv:2: column time_s: found \"soon\""));
        assert!(
            of("time_s,soc\n1,57\n").unwrap_err().contains("r.csv:2: column soc: found \"57\", must be a fraction")
        );
    }
}
