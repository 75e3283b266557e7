//! Reads the true capacities of a log from a CSV file in the same folder.
//!
//! There are two formats. A table with a column `cell` was written by `simulate --truth`. It contains the capacity of
//! every cell from the full to the empty open-circuit voltage. A table with the columns `cycle` and `type` has the
//! format of `score --cycles`. It contains, for each discharge of one cell, the published capacity at the load of this
//! discharge.
//!
//! For a log `NAME.log`, `NAME.csv` etc., the files `NAME.truth.csv`, `NAME_truth.csv` and `NAME_cycles.csv` are
//! searched for. `truth.csv` is also used if no other given log is in the folder. Each name may end in `.gz` or `.zst`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::capacity_table::CapacityTable;
use crate::io::table::TableError;
use crate::quantity::{CellIndex, Timestamp};
use crate::score::CycleTable;

const ENDINGS: [&str; 3] = [".truth.csv", "_truth.csv", CYCLES];
const CYCLES: &str = "_cycles.csv";
const COMPRESSED: [&str; 3] = ["", ".gz", ".zst"];

/// Source of the capacity that determines the end of life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub enum EndOfLifeSource {
    /// The true capacity.
    #[serde(rename = "true_capacity")]
    Truth,
    /// Published capacities.
    #[serde(rename = "published_capacity")]
    Published,
    /// The learned usable capacity.
    #[serde(rename = "learned_usable_capacity")]
    LearnedUsable,
    /// The learned capacity.
    #[serde(rename = "learned_capacity")]
    Learned,
}

impl EndOfLifeSource {
    /// Returns the name for tables.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Truth => "the true capacity",
            Self::Published => "published capacities",
            Self::LearnedUsable => "the learned usable capacity",
            Self::Learned => "the learned capacity",
        }
    }
}

/// The true capacities of a log.
#[derive(Debug, Clone)]
pub struct Truth {
    /// Source of the capacities.
    pub kind: EndOfLifeSource,
    cells: BTreeMap<CellIndex, Vec<(Timestamp, f64)>>,
    span: (Timestamp, Timestamp),
}

impl Truth {
    /// Reads a table of true capacities in either format.
    /// # Errors
    /// The file cannot be read, has neither format, or a field is wrong.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let table = CapacityTable::open_in_order(path)?;
        if table.header().find("cell").is_some() { read_simulated(table) } else { Self::of_table(path) }
    }

    fn of_table(path: &Path) -> Result<Self, TableError> {
        let table = CycleTable::read(path)?;
        let points: Vec<_> = table.discharges.iter().filter_map(|d| Some((d.start, d.capacity_ah?))).collect();
        let span = points.first().zip(points.last()).map(|(first, last)| (first.0, last.0));
        let span = span.ok_or_else(|| TableError::Data(format!("{}: no discharge has a capacity", path.display())))?;
        Ok(Self { kind: EndOfLifeSource::Published, cells: BTreeMap::from([(CellIndex(0), points)]), span })
    }

    /// Returns the first time at which the capacity of any cell is below `end_ah`, and this cell.
    pub fn falls_below(&self, end_ah: f64) -> Option<(Timestamp, CellIndex)> {
        let of_cell = |(&cell, points): (&CellIndex, &Vec<(Timestamp, f64)>)| {
            points.iter().find(|(_, ah)| *ah < end_ah).map(|(time, _)| (*time, cell))
        };
        self.cells.iter().filter_map(of_cell).min()
    }

    /// Returns the capacity of a cell in the last row up to `time`; `None` = there is no such row.
    pub fn capacity_ah(&self, cell: CellIndex, time: Timestamp) -> Option<f64> {
        let points = self.cells.get(&cell)?;
        let after = points.partition_point(|(at, _)| *at <= time);
        points.get(after.checked_sub(1)?).map(|(_, ah)| *ah)
    }

    /// Returns the first and last time.
    pub fn span(&self) -> (Timestamp, Timestamp) {
        self.span
    }
}

/// Reads a table that `simulate --truth` wrote. Keeps a row only if the capacity of its cell has changed by more than
/// 0.02 % since the last kept row.
fn read_simulated(mut table: CapacityTable) -> Result<Truth, TableError> {
    let (mut cells, mut span): (BTreeMap<CellIndex, Vec<(Timestamp, f64)>>, _) = (BTreeMap::new(), None);
    while let Some(row) = table.next_row()? {
        let (first, _) = span.unwrap_or((row.time, row.time));
        span = Some((first, row.time));
        let (Some(cell), Some(ah)) = (row.cell, row.capacity_ah) else { continue };
        let points = cells.entry(cell).or_default();
        if points.last().is_none_or(|(_, kept)| (ah - kept).abs() > 2e-4 * kept) {
            points.push((row.time, ah));
        }
    }
    let span = span.filter(|_| !cells.is_empty());
    let span =
        span.ok_or_else(|| table.header().file_fault("no row with a capacity, must have one per time and cell"))?;
    Ok(Truth { kind: EndOfLifeSource::Truth, cells, span })
}

/// Finds the file with the true capacities of each log; `None` = there is no file.
pub fn find_next_to(logs: &[PathBuf]) -> Vec<Option<PathBuf>> {
    let alone = |log: &PathBuf| logs.iter().filter(|other| other.parent() == log.parent()).count() == 1;
    logs.iter().map(|log| find(log, alone(log))).collect()
}

/// Finds the table that states the start time of each cycle of a CSV log.
pub fn cycles_next_to(log: &Path) -> Option<PathBuf> {
    let (stem, ending) = stem_of(log)?;
    (ending == "csv").then(|| existing(log, [format!("{stem}{CYCLES}")])).flatten()
}

fn find(log: &Path, alone: bool) -> Option<PathBuf> {
    if log == Path::new("-") {
        return None;
    }
    let (stem, _) = stem_of(log)?;
    let names = ENDINGS.iter().map(|ending| format!("{stem}{ending}"));
    existing(log, names.chain(alone.then(|| "truth.csv".to_owned())))
}

/// Returns the name of a log without its endings, and its format: `("a", "csv")` for `a.csv.gz`.
fn stem_of(log: &Path) -> Option<(&str, &str)> {
    let name = log.file_name()?.to_str()?;
    let name = crate::without_compression(name);
    Some(name.rsplit_once('.').unwrap_or((name, "")))
}

/// Returns the first name that is a file in the folder of the log, compressed or not.
fn existing(log: &Path, names: impl IntoIterator<Item = String>) -> Option<PathBuf> {
    let paths =
        names.into_iter().flat_map(|name| COMPRESSED.map(|ending| log.with_file_name(format!("{name}{ending}"))));
    paths.into_iter().find(|path| path != log && path.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Truth, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("t.csv");
        std::fs::write(&path, text).expect("written");
        Truth::read(&path).map_err(|error| error.to_string().replace(&path.display().to_string(), "t.csv"))
    }

    #[test]
    fn first_cell_below_ends_the_life() {
        let truth = read(
            "time_s,cell,soc,capacity_ah\n1,0,0.5,2.0\n1,1,0.5,2.1\n2,0,0.5,1.9\n2,1,0.5,1.7\n3,0,0.5,1.6\n3,1,0.5,1.5\n",
        );
        let truth = truth.expect("reads");
        assert_eq!(truth.falls_below(1.8), Some((Timestamp::from_secs(2.0), CellIndex(1))));
        assert_eq!(truth.falls_below(1.4), None);
        assert_eq!(truth.capacity_ah(CellIndex(0), Timestamp::from_secs(2.5)), Some(1.9));
        assert_eq!(truth.capacity_ah(CellIndex(0), Timestamp::from_secs(0.5)), None, "not known yet");
        assert_eq!(truth.kind, EndOfLifeSource::Truth);
    }

    #[test]
    fn columns_identify_published_capacities() {
        let truth =
            read("cycle,type,start,capacity_ah_source\n1,discharge,100,1.5\n2,charge,150,\n3,discharge,200,1.3\n");
        let truth = truth.expect("reads");
        assert_eq!(truth.falls_below(1.4), Some((Timestamp::from_secs(200.0), CellIndex(0))));
        assert_eq!(truth.kind, EndOfLifeSource::Published);
    }

    #[test]
    fn fault_names_its_line() {
        assert_eq!(
            read("time_s,cell,capacity_ah\n1,0,x\n").expect_err("bad"),
            "t.csv:2: column capacity_ah: found \"x\", must be Ah above 0 or nothing"
        );
        assert_eq!(
            read("time_s,cell,capacity_ah\n5,0,2\n4,0,2\n").expect_err("bad"),
            "t.csv:3: column time_s: found \"4\", must be no earlier than the row before"
        );
        assert!(
            read("a,b\n1,2\n")
                .expect_err("bad")
                .starts_with("t.csv:1: no column capacity_ah or capacity_ah_source, found a,b")
        );
        assert!(read("time_s,cell,capacity_ah\n").expect_err("bad").contains("no row"));
    }

    #[test]
    fn truth_is_found_in_the_folder_of_its_log() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        for name in ["a.truth.csv", "b_cycles.csv.gz", "truth.csv"] {
            std::fs::write(path(name), "").expect("written");
        }
        let logs = ["a.log.gz", "b.csv.gz", "c.log"].map(path);
        assert_eq!(find_next_to(&logs), [Some(path("a.truth.csv")), Some(path("b_cycles.csv.gz")), None]);
        assert_eq!(find_next_to(&[path("c.log")]), [Some(path("truth.csv"))]);
        let logs = ["b.csv.gz", "b.log", "a.csv"].map(path);
        assert_eq!(logs.map(|log| cycles_next_to(&log)), [Some(path("b_cycles.csv.gz")), None, None]);
    }
}
