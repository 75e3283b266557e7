//! Reads a store without changing it. This works next to a running daemon, after a crash, and on a read-only disk.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use rusqlite::types::Value;
use rusqlite::{Connection, OpenFlags};

use super::database;
use super::folder::DATABASE;
use super::rows::{HistoryRow, HistoryTable};
use super::segments::{self, ChainReport, NotedHead, StoredRow, hex};
use super::state_files::{FILES, FoundStates, StateDocument, StateFiles};
use crate::config::VehicleIdentity;
use crate::io::place::with_suffix;
use crate::monitor::Snapshot;

/// Maximum size (bytes) of a database and its log that are copied for reading. A temporary folder has room for this
/// size.
const MAX_COPY_BYTES: u64 = 256 << 20;

/// A store, open for reading.
#[derive(Debug)]
pub struct HistoryReader {
    connection: Connection,
    path: PathBuf,
    /// Numbers of the damaged rows that were read. Such rows are left out.
    damaged: RefCell<BTreeSet<i64>>,
    /// Folder of the copy, if the original cannot be read in place.
    _copy: Option<TemporaryCopy>,
}

/// A selection of rows.
#[derive(Debug, Clone, Default)]
pub struct HistoryQuery {
    /// Selected tables; empty = all.
    pub kinds: Vec<HistoryTable>,
    /// Cell, from 0; `None` = all.
    pub cell: Option<u16>,
    /// Earliest wall clock (ns since 1970).
    pub since_ns: Option<i64>,
    /// Latest wall clock (ns since 1970).
    pub until_ns: Option<i64>,
    /// Maximum number of rows; older rows are left out. `None` = all rows.
    pub limit: Option<u32>,
}

impl HistoryQuery {
    /// The selected tables, in display order.
    pub fn wanted_kinds(&self) -> impl Iterator<Item = HistoryTable> {
        HistoryTable::ALL.into_iter().filter(|kind| self.kinds.is_empty() || self.kinds.contains(kind))
    }
}

/// One row of the history.
#[derive(Debug, Clone, PartialEq)]
pub struct HistoryEntry {
    /// Table of the row.
    pub kind: HistoryTable,
    /// Number of the row, counted across the tables.
    pub seq: i64,
    /// Wall clock when the row was written (ns since 1970).
    pub wall_ns: i64,
    /// Clock of the inputs when the row was written (ns).
    pub time_ns: i64,
    /// Identity of the boot, 32 hexadecimal digits.
    pub boot: String,
    /// Number of the pack, from 1.
    pub pack: i64,
    /// Values of [`HistoryTable::columns`].
    pub values: Vec<serde_json::Value>,
}

/// Numbers of half-cycles (charges and discharges) that a store contains, has deleted and has written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HistoryExtent {
    /// Number of the connected pack, from 1; 0 = no pack has been connected.
    pub pack: i64,
    /// Half-cycles of all packs in the store.
    pub half_cycles: i64,
    /// Half-cycles that the store has deleted, for all packs. The store deletes rows because it limits their number and
    /// age.
    pub deleted_half_cycles: i64,
    /// Half-cycles that the store has ever written, for all packs.
    pub written_half_cycles: i64,
}

impl HistoryReader {
    /// Opens the store in a folder.
    ///
    /// # Errors
    /// Fails if the store does not exist or cannot be read. The error names the file.
    pub fn open(folder: &Path) -> Result<Self, String> {
        let path = folder.join(DATABASE);
        let named = |error: String| format!("{}: {error}", path.display());
        if !path.exists() {
            return Err(named("no history found; give the daemon's state folder with --state".to_owned()));
        }
        let (connection, copy) = open_read_only(&path, MAX_COPY_BYTES).map_err(named)?;
        match database::format(&connection) {
            Ok(database::FORMAT) => Ok(Self { connection, path, damaged: RefCell::default(), _copy: copy }),
            Ok(format) => Err(named(format!("format {format}, must be {}", database::FORMAT))),
            Err(error) => Err(named(error.to_string())),
        }
    }

    fn named(&self, error: &rusqlite::Error) -> String {
        format!("{}: {error}", self.path.display())
    }

    /// The vehicle of the history, as last configured.
    pub fn vehicle(&self) -> Result<VehicleIdentity, String> {
        database::vehicle(&self.connection).map_err(|error| self.named(&error))
    }

    /// How many half-cycles the store contains.
    pub fn extent(&self) -> Result<HistoryExtent, String> {
        // A single statement reads all counts, so that a daemon cannot write in between.
        let sql = "SELECT (SELECT coalesce(max(id), 0) FROM pack), (SELECT count(*) FROM half_cycle), coalesce(sum(half_cycles * \
                   deleted), 0), coalesce(sum(half_cycles), 0) FROM segment";
        let extent = self.connection.query_row(sql, [], |row| {
            Ok(HistoryExtent {
                pack: row.get(0)?,
                half_cycles: row.get(1)?,
                deleted_half_cycles: row.get(2)?,
                written_half_cycles: row.get(3)?,
            })
        });
        extent.map_err(|error| self.named(&error))
    }

    /// Checks the hash chain.
    ///
    /// # Errors
    /// Fails if the file cannot be read to the end.
    pub fn verify(&self) -> Result<ChainReport, String> {
        self.at_once(segments::verify)
    }

    /// Compares the history with `noted`, the end of the hash chain as it was once noted outside the store. Returns the
    /// contradiction; `None` = the history agrees.
    pub fn contradiction(&self, noted: &NotedHead) -> Result<Option<String>, String> {
        self.at_once(|connection| segments::contradiction(connection, noted))
    }

    /// Describes the damaged rows among the rows that were read, as a sentence without its full stop; `None` = all rows
    /// were intact.
    pub fn damage(&self) -> Option<String> {
        let damaged = self.damaged.borrow();
        let first = damaged.first()?;
        Some(format!("damaged rows left out of the history: {}, the first is row {first}", damaged.len()))
    }

    /// Runs all queries of `read` on one snapshot of the file, even while a daemon writes.
    fn at_once<T>(&self, read: impl FnOnce(&Connection) -> rusqlite::Result<T>) -> Result<T, String> {
        let snapshot = self.connection.unchecked_transaction();
        snapshot.and_then(|snapshot| read(&snapshot)).map_err(|error| self.named(&error))
    }

    /// The stored snapshot; `None` = missing or damaged.
    pub fn snapshot(&self) -> Option<Snapshot> {
        self.state().map(|document| *document.snapshot)
    }

    /// The stored snapshot, for a command that cannot work without it.
    ///
    /// # Errors
    /// Fails if the folder contains no state, or only states that cannot be used. The error names the files.
    pub fn required_snapshot(&self) -> Result<Snapshot, String> {
        let folder = self.path.parent().unwrap_or(Path::new(""));
        let FoundStates { newest, faults, .. } = StateFiles::open(folder).1;
        newest.map(|document| *document.snapshot).ok_or_else(|| {
            let faults: Vec<&str> = faults.iter().filter_map(HistoryRow::detail).collect();
            let why = match faults.is_empty() {
                true => format!(
                    "contains no stored state ({}); give the state folder of a daemon that has run",
                    FILES.join(", ")
                ),
                false => format!(
                    "the stored state cannot be used: {}; start the daemon to store a new one",
                    faults.join("; ")
                ),
            };
            format!("{}: {why}", folder.display())
        })
    }

    /// The stored snapshot, and the wall clock when it was taken (ns since 1970); `None` = missing or damaged.
    pub fn dated_snapshot(&self) -> Option<(i64, Snapshot)> {
        self.state().map(|document| (document.stamp.wall_ns, *document.snapshot))
    }

    /// The newest valid state next to the database.
    pub(super) fn state(&self) -> Option<StateDocument> {
        StateFiles::open(self.path.parent()?).1.newest
    }

    /// The selected rows, in the order of writing.
    pub fn entries(&self, filter: &HistoryQuery) -> Result<Vec<HistoryEntry>, String> {
        let mut entries = Vec::new();
        for kind in filter.wanted_kinds() {
            self.read(kind, filter, "DESC", &mut |entry| entries.push(entry)).map_err(|error| self.named(&error))?;
        }
        entries.sort_by_key(|entry| entry.seq);
        if let Some(limit) = filter.limit {
            let surplus = entries.len().saturating_sub(usize::try_from(limit).unwrap_or(usize::MAX));
            entries.drain(..surplus);
        }
        Ok(entries)
    }

    /// Calls `take` with each selected row of one table, oldest first.
    pub fn for_each(
        &self,
        kind: HistoryTable,
        filter: &HistoryQuery,
        take: &mut dyn FnMut(HistoryEntry),
    ) -> Result<(), String> {
        self.read(kind, filter, "ASC", take).map_err(|error| self.named(&error))
    }

    fn read(
        &self,
        kind: HistoryTable,
        filter: &HistoryQuery,
        order: &str,
        take: &mut dyn FnMut(HistoryEntry),
    ) -> rusqlite::Result<()> {
        // Rows without a readable time are damaged. Select them too, so that they are counted.
        let sql = format!(
            "{} WHERE (?1 IS NULL OR r.cell = ?1) AND coalesce(m.wall_ns >= ?2, TRUE) AND coalesce(m.wall_ns <= ?3, TRUE) ORDER \
             BY r.seq {order} LIMIT ?4",
            StoredRow::select(kind)
        );
        let limit = filter.limit.map_or(-1, i64::from);
        let mut statement = self.connection.prepare(&sql)?;
        let mut rows = statement.query((filter.cell, filter.since_ns, filter.until_ns, limit))?;
        while let Some(row) = rows.next()? {
            let stored = StoredRow::read(kind, row)?;
            if !stored.is_intact() {
                self.damaged.borrow_mut().insert(stored.seq);
                continue;
            }
            let boot: Vec<u8> = row.get(5)?;
            take(HistoryEntry {
                kind,
                seq: stored.seq,
                wall_ns: row.get(3)?,
                time_ns: row.get(4)?,
                boot: hex(&boot),
                pack: row.get(6)?,
                values: (StoredRow::COLUMNS..StoredRow::COLUMNS + kind.columns().len())
                    .map(|index| row.get(index).map(json))
                    .collect::<rusqlite::Result<_>>()?,
            });
        }
        Ok(())
    }
}

fn json(value: Value) -> serde_json::Value {
    match value {
        Value::Null => serde_json::Value::Null,
        Value::Integer(whole) => whole.into(),
        Value::Real(real) => real.into(),
        Value::Text(text) => text.into(),
        Value::Blob(blob) => hex(&blob).into(),
    }
}

/// Opens the database for reading while a daemon may write to it. On a read-only disk, SQLite cannot create its index
/// of the write-ahead log, so a copy is opened.
fn open_read_only(path: &Path, max_copy_bytes: u64) -> Result<(Connection, Option<TemporaryCopy>), String> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let open = |path: &Path, flags: OpenFlags| -> rusqlite::Result<Connection> {
        let connection = Connection::open_with_flags(path, flags)?;
        connection.busy_timeout(std::time::Duration::from_secs(1))?;
        connection.query_row("SELECT count(*) FROM sqlite_schema", [], |_| Ok(()))?;
        Ok(connection)
    };
    let error = match open(path, flags) {
        Ok(connection) => return Ok((connection, None)),
        Err(error) => error,
    };
    let code = error.sqlite_error_code();
    if !matches!(code, Some(rusqlite::ErrorCode::CannotOpen | rusqlite::ErrorCode::ReadOnly)) {
        return Err(error.to_string());
    }
    let folder = copy_to_temporary(path, max_copy_bytes)
        .map_err(|copying| format!("{error}; and it cannot be copied: {copying}"))?;
    // The copy is writable, so SQLite can create its index there.
    let opened = open(&folder.0.join(DATABASE), OpenFlags::default());
    opened.map(|connection| (connection, Some(folder))).map_err(|error| error.to_string())
}

/// A copy of the database, removed on drop.
#[derive(Debug)]
struct TemporaryCopy(PathBuf);

impl Drop for TemporaryCopy {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn copy_to_temporary(path: &Path, max_bytes: u64) -> std::io::Result<TemporaryCopy> {
    let log_bytes = fs::metadata(with_suffix(path, "-wal")).map_or(0, |file| file.len());
    let bytes = fs::metadata(path)?.len() + log_bytes;
    if bytes > max_bytes {
        return Err(std::io::Error::other(format!("{bytes} bytes, must be at most {max_bytes}")));
    }
    let folder = std::env::temp_dir().join(format!("packwatch-history-{}", std::process::id()));
    fs::create_dir(&folder)?;
    let folder = TemporaryCopy(folder);
    let copy = folder.0.join(DATABASE);
    fs::copy(path, &copy)?;
    match fs::copy(with_suffix(path, "-wal"), with_suffix(&copy, "-wal")) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
        _ => Ok(folder),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copied_size_includes_log_and_is_limited() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(DATABASE);
        fs::write(&path, [0; 600]).unwrap();
        fs::write(with_suffix(&path, "-wal"), [0; 500]).unwrap();
        let refused = copy_to_temporary(&path, 1000).unwrap_err().to_string();
        assert_eq!(refused, "1100 bytes, must be at most 1000");
        let copy = copy_to_temporary(&path, 1100).unwrap();
        assert!(with_suffix(&copy.0.join(DATABASE), "-wal").exists());
    }
}
