//! What was true of a log: the capacity by a CSV beside it.
//!
//! Two forms are known by their columns: `time_s`, `cell`, `capacity_ah` as `simulate --truth` writes it (the capacity
//! between the open-circuit voltages, of every cell), and `start`, `type`, `capacity_ah_source` as `score --cycles` takes
//! it (published capacities of discharges of one cell, at the load they were measured with). Looked for beside `NAME.log`,
//! `NAME.csv`, ... are `NAME.truth.csv`, `NAME_truth.csv`, `NAME_cycles.csv`, and `truth.csv` where the log is the only one
//! asked for of its folder; each also `.gz` and `.zst`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::io::{lines, stamp};
use crate::quantity::{CellIndex, Timestamp};
use crate::score::CycleTable;

/// A change of the capacity smaller than this part of it is not kept.
const KEPT_CHANGE: f64 = 2e-4;
/// Endings of the names looked for.
const ENDINGS: [&str; 3] = [".truth.csv", "_truth.csv", CYCLES];
const CYCLES: &str = "_cycles.csv";
const COMPRESSED: [&str; 3] = ["", ".gz", ".zst"];

/// Which capacity the truth is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TruthKind {
    /// Between the open-circuit voltages.
    Capacity,
    /// As published.
    Published,
}

/// The true capacities of a log.
#[derive(Debug, Clone)]
pub struct Truth {
    /// Of which kind.
    pub kind: TruthKind,
    /// Per cell, in the order of time.
    cells: BTreeMap<CellIndex, Vec<(Timestamp, f64)>>,
    span: (Timestamp, Timestamp),
}

impl Truth {
    /// Reads it.
    ///
    /// # Errors
    /// It cannot be read, is of neither form, or a field is wrong: file, line, found, allowed.
    pub fn read(path: &Path) -> Result<Self, String> {
        let name = path.display();
        let unreadable = |error: std::io::Error| format!("{name}: cannot be read: {error}");
        let file = lines::open(path, &Arc::default()).map_err(unreadable)?;
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(file);
        let headers = reader.headers().map_err(|error| format!("{name}: {error}"))?.clone();
        let column = |wanted: &str| headers.iter().position(|header| header.trim_start_matches('\u{feff}') == wanted);
        match (column("time_s"), column("cell"), column("capacity_ah"), column("capacity_ah_source")) {
            (Some(time), Some(cell), Some(capacity), _) => {
                read_simulated(&mut reader, [time, cell, capacity]).map_err(|what| format!("{name}:{what}"))
            }
            (.., Some(_)) => Self::of_table(path),
            _ => {
                let found: Vec<_> = headers.iter().collect();
                Err(format!(
                    "{name}:1: columns {}, must have time_s, cell, capacity_ah or type, start, capacity_ah_source",
                    found.join(",")
                ))
            }
        }
    }

    fn of_table(path: &Path) -> Result<Self, String> {
        let table = CycleTable::read(path).map_err(|error| error.to_string())?;
        let points: Vec<_> = table.discharges.iter().filter_map(|d| Some((d.start, d.capacity_ah?))).collect();
        let span = points.first().zip(points.last()).map(|(first, last)| (first.0, last.0));
        let span = span.ok_or_else(|| format!("{}: no discharge has a capacity", path.display()))?;
        Ok(Self { kind: TruthKind::Published, cells: BTreeMap::from([(CellIndex(0), points)]), span })
    }

    /// When the first cell fell below `end_ah`, and which.
    pub fn falls_below(&self, end_ah: f64) -> Option<(Timestamp, CellIndex)> {
        let of_cell = |(&cell, points): (&CellIndex, &Vec<(Timestamp, f64)>)| {
            points.iter().find(|(_, ah)| *ah < end_ah).map(|(time, _)| (*time, cell))
        };
        self.cells.iter().filter_map(of_cell).min()
    }

    /// The capacity of a cell at `time`, as the last row before it says; `None` = there is none.
    pub fn capacity_ah(&self, cell: CellIndex, time: Timestamp) -> Option<f64> {
        let points = self.cells.get(&cell)?;
        let after = points.partition_point(|(at, _)| *at <= time);
        points.get(after.checked_sub(1)?).map(|(_, ah)| *ah)
    }

    /// First and last moment it tells of.
    pub fn span(&self) -> (Timestamp, Timestamp) {
        self.span
    }
}

fn read_simulated(reader: &mut csv::Reader<Box<dyn std::io::Read>>, columns: [usize; 3]) -> Result<Truth, String> {
    let (mut cells, mut span): (BTreeMap<CellIndex, Vec<(Timestamp, f64)>>, _) = (BTreeMap::new(), None);
    let mut record = csv::StringRecord::new();
    while reader.read_record(&mut record).map_err(|error| format!(" {error}"))? {
        let line = record.position().map_or(0, csv::Position::line);
        let field = |index: usize| record.get(index).unwrap_or_default();
        let bad = |index: usize, what: &str| format!("{line}: {:?}, must be {what}", field(index));
        let time = stamp::parse_stamp(field(columns[0])).ok_or_else(|| bad(columns[0], "seconds"))?;
        let cell = field(columns[1]).parse().map(CellIndex).map_err(|_| bad(columns[1], "a cell from 0"))?;
        let ah = field(columns[2]).parse::<f64>().ok().filter(|ah| ah.is_finite() && *ah >= 0.0);
        let ah = ah.ok_or_else(|| bad(columns[2], "0 Ah or more"))?;
        let (first, last) = span.unwrap_or((time, time));
        if time < last {
            return Err(bad(columns[0], "no earlier than the row before"));
        }
        span = Some((first, time));
        let points = cells.entry(cell).or_default();
        if points.last().is_none_or(|(_, kept)| (ah - kept).abs() > KEPT_CHANGE * kept) {
            points.push((time, ah));
        }
    }
    let span = span.ok_or("2: no row, must have one per time and cell")?;
    Ok(Truth { kind: TruthKind::Capacity, cells, span })
}

/// The truth beside each of the logs, where there is one.
pub fn beside(logs: &[PathBuf]) -> Vec<Option<PathBuf>> {
    let alone = |log: &PathBuf| logs.iter().filter(|other| other.parent() == log.parent()).count() == 1;
    logs.iter().map(|log| find(log, alone(log))).collect()
}

/// The table of cycles beside a CSV log, which tells when each began.
pub fn cycles_beside(log: &Path) -> Option<PathBuf> {
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

/// A log's name without its endings, and what its name ends in besides compression.
fn stem_of(log: &Path) -> Option<(&str, &str)> {
    let name = log.file_name()?.to_str()?;
    let name = COMPRESSED[1..].iter().find_map(|ending| name.strip_suffix(ending)).unwrap_or(name);
    Some(name.rsplit_once('.').unwrap_or((name, "")))
}

/// The first of these names, compressed or not, that is a file beside the log.
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
        Truth::read(&path).map_err(|error| error.replace(&path.display().to_string(), "t.csv"))
    }

    #[test]
    fn the_first_cell_below_ends_the_life() {
        let truth = read(
            "time_s,cell,soc,capacity_ah\n1,0,0.5,2.0\n1,1,0.5,2.1\n2,0,0.5,1.9\n2,1,0.5,1.7\n3,0,0.5,1.6\n3,1,0.5,1.5\n",
        );
        let truth = truth.expect("reads");
        assert_eq!(truth.falls_below(1.8), Some((Timestamp::from_secs(2.0), CellIndex(1))));
        assert_eq!(truth.falls_below(1.4), None);
        assert_eq!(truth.capacity_ah(CellIndex(0), Timestamp::from_secs(2.5)), Some(1.9));
        assert_eq!(truth.capacity_ah(CellIndex(0), Timestamp::from_secs(0.5)), None, "nobody knows yet");
        assert_eq!(truth.kind, TruthKind::Capacity);
    }

    #[test]
    fn a_table_of_published_capacities_is_known_by_its_columns() {
        let truth =
            read("cycle,type,start,capacity_ah_source\n1,discharge,100,1.5\n2,charge,150,\n3,discharge,200,1.3\n");
        let truth = truth.expect("reads");
        assert_eq!(truth.falls_below(1.4), Some((Timestamp::from_secs(200.0), CellIndex(0))));
        assert_eq!(truth.kind, TruthKind::Published);
    }

    #[test]
    fn what_is_wrong_is_told_with_its_line() {
        assert_eq!(read("time_s,cell,capacity_ah\n1,0,x\n").expect_err("bad"), "t.csv:2: \"x\", must be 0 Ah or more");
        assert_eq!(
            read("time_s,cell,capacity_ah\n5,0,2\n4,0,2\n").expect_err("bad"),
            "t.csv:3: \"4\", must be no earlier than the row before"
        );
        assert!(read("a,b\n1,2\n").expect_err("bad").starts_with("t.csv:1: columns a,b, must have"));
        assert!(read("time_s,cell,capacity_ah\n").expect_err("bad").contains("no row"));
    }

    #[test]
    fn the_truth_is_found_beside_its_log() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        for name in ["a.truth.csv", "b_cycles.csv.gz", "truth.csv"] {
            std::fs::write(path(name), "").expect("written");
        }
        let logs = ["a.log.gz", "b.csv.gz", "c.log"].map(path);
        assert_eq!(beside(&logs), [Some(path("a.truth.csv")), Some(path("b_cycles.csv.gz")), None]);
        assert_eq!(beside(&[path("c.log")]), [Some(path("truth.csv"))]);
        let logs = ["b.csv.gz", "b.log", "a.csv"].map(path);
        assert_eq!(logs.map(|log| cycles_beside(&log)), [Some(path("b_cycles.csv.gz")), None, None]);
    }
}
