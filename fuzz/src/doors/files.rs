//! Fuzz entry points for files that are read in blocks: logs, journals (recorded inputs of the daemon) and tables. The
//! test files are written to a folder in memory if the system has one (`/dev/shm`).

use std::path::Path;

use packwatch::io::csv_log::CsvOptions;
use packwatch::io::log::{Batch, LogOptions, LogSource};
use packwatch::monitor::Record;

use super::source::Source;

const MAX_RECORDS: usize = 20_000;

/// Calls `read` with a file of this name and content.
pub(super) fn with_file<T>(name: &str, content: &[u8], read: impl FnOnce(&Path) -> T) -> T {
    let folder = folder();
    let path = folder.path().join(name);
    std::fs::write(&path, content).expect("written");
    read(&path)
}

/// Creates a folder that is deleted on drop.
pub(super) fn folder() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    let made = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
    made.expect("a folder")
}

/// Reads a candump log or CSV, plain or compressed. The first byte selects the file name.
pub fn log(data: &[u8]) {
    let mut source = Source::new(data);
    let name = source.one_of(&["a.log", "a.csv", "a.log.gz", "a.log.zst", "a.csv.zst"]);
    with_file(name, source.rest(), compare);
}

/// Reads a journal.
pub fn journal(data: &[u8]) {
    let content = [b"PACKWATCH-JOURNAL 1\n", data].concat();
    with_file("a.journal", &content, compare);
}

fn options(strict: bool) -> LogOptions {
    let columns = [("time", "time_s"), ("current", "current_a"), ("voltage", "voltage_v")];
    let columns = columns.map(|(role, column)| (role.to_owned(), column.to_owned())).to_vec();
    LogOptions {
        interfaces: vec!["can0".to_owned(), "can1".to_owned()],
        channels: Vec::new(),
        strict,
        csv: CsvOptions { columns, cells: 2, ..CsvOptions::default() },
        encode_row: Box::new(|values, _| values.len()),
    }
}

/// Checks that reading records one by one and in batches gives the same records. A strict reader stops at the first
/// fault of the file. Up to this fault, it must give the same records.
fn compare(path: &Path) {
    let one_by_one = |strict: bool| -> (Vec<Record>, bool) {
        let mut log = LogSource::new([path.to_owned()], options(strict));
        log.adopt_foreign();
        let mut records = Vec::new();
        while records.len() < MAX_RECORDS {
            match log.next_record() {
                Ok(Some(record)) => records.push(record),
                Ok(None) => return (records, true),
                Err(_) => return (records, false),
            }
        }
        (records, true)
    };
    let (records, _) = one_by_one(false);
    let mut log = LogSource::new([path.to_owned()], options(false));
    log.adopt_foreign();
    let (mut batch, mut batched) = (Batch::new(64), Vec::new());
    while batched.len() < records.len() && log.next_batch(&mut batch).unwrap_or(false) {
        batched.extend_from_slice(batch.records());
    }
    // Text is compared because NaN does not equal NaN.
    let text = |records: &[Record]| format!("{records:?}");
    let count = records.len().min(batched.len());
    assert_eq!(records.len(), count, "batches end before the records");
    assert!(text(&records) == text(&batched[..count]), "batches differ: {records:?}\n{batched:?}");
    let (strict, _) = one_by_one(true);
    assert!(text(&strict) == text(&records[..strict.len().min(count)]), "a strict reader gives other records");
}

/// Reads a table of measured values as the offline commands do.
#[cfg(feature = "lab")]
pub fn table(data: &[u8]) {
    use packwatch::lab::gpr::{ColumnSelection, ColumnTable, MissingPolicy, PartColumn};
    use packwatch::lab::measured::MeasuredFile;
    use packwatch::lab::rul::History;
    let mut source = Source::new(data);
    let head: &[u8] = source.one_of(&[
        b"".as_slice(),
        b"time_s,current_a,voltage_v,temperature_c\n",
        b"cycle,capacity_ah\n",
        b"time_s,current_a,voltage_v,segment,x,y\n",
    ]);
    let content = [head, source.rest()].concat();
    with_file("a.csv", &content, |path| {
        let _ = MeasuredFile::read(path, &CsvOptions::default());
        let _ = History::read(path);
        let names = ["x".to_owned(), "y".to_owned()];
        let wanted = ColumnSelection { columns: &names[..1], optional: &names[1..], missing: MissingPolicy::Skipped };
        let files = [path.to_owned()];
        if let Ok(table) = ColumnTable::read(&files, &wanted, &PartColumn::Default) {
            assert_eq!(table.values.len(), table.len() * table.width(), "a row has a different number of values");
        }
    });
}
