//! Opens, checks, reads and writes the history database. All writes are transactions.
//!
//! | table | contents of a row | kept |
//! | --- | --- | --- |
//! | `pack` | a pack that was or is connected | always |
//! | `moment` | the time of a commit: wall clock, inputs' clock, boot, pack | as long as its segment |
//! | `half_cycle` | a charge or discharge of a cell | as long as its segment |
//! | `capacity` | a learned capacity | as long as its segment |
//! | `loss_modes` | how much lithium and active material a cell has lost | as long as its segment |
//! | `remaining_life` | a forecast of the remaining life | as long as its segment |
//! | `outlook` | energy and power of the pack | as long as its segment |
//! | `model` | a change of the cell model | as long as its segment |
//! | `alarm` | a change of an alarm | as long as its segment |
//! | `reset` | a reset, a pack change, or a damaged file | as long as its segment |
//! | `segment` | a day of rows, with the end of their hash chain (`segments`) | always |
//! | `meta` | the number of segments, and the vehicle (one row) | always |
//!
//! The tables from `half_cycle` to `reset` share one numbering of rows. The oldest segments are deleted first; their
//! rows in `segment` remain. Cells count from 0, times are nanoseconds. `PRAGMA user_version` contains the version of
//! the format.
//!
//! The database is one file in write-ahead mode with `synchronous=FULL`. A commit that has returned survives a power
//! cut, and a commit that has not returned leaves no trace. A damaged file and an inaccessible file give different
//! errors. A file with another format counts as damaged.

use std::fs::{File, Metadata};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rusqlite::types::Value;
use rusqlite::{
    Connection, ErrorCode, MAIN_DB, OpenFlags, OptionalExtension, Transaction, TransactionBehavior, params,
};

use super::learned;
use super::rows::{HistoryRow, HistoryTable, RowBatch};
use super::segments::{self, Segment, hex};
use super::stamp::Stamp;
use crate::alarm::AlarmChange;
use crate::config::{StoreConfig, VehicleIdentity};
use crate::io::place::with_suffix;
use crate::monitor::{EventKind, LearnedCell};
use crate::quantity::Timestamp;

/// The format that this program reads and writes.
pub(super) const FORMAT: i32 = 3;
/// Maximum time that a commit waits for a reader that has locked the database.
const BUSY_TIMEOUT: Duration = Duration::from_millis(100);
/// Maximum duration of the check at the start. Damage in the unchecked part is found when that part is read.
const MAX_CHECK: Duration = Duration::from_secs(2);
const TABLES: &str = "
CREATE TABLE meta (id INTEGER PRIMARY KEY CHECK (id = 1), segments INTEGER NOT NULL, vehicle TEXT) STRICT;
INSERT INTO meta VALUES (1, 0, NULL);
CREATE TABLE pack (
    id INTEGER PRIMARY KEY,
    opened_ns INTEGER NOT NULL,
    closed_ns INTEGER,
    reason TEXT,
    identity TEXT
) STRICT;
CREATE TABLE moment (
    id INTEGER PRIMARY KEY,
    wall_ns INTEGER NOT NULL,
    time_ns INTEGER NOT NULL,
    boot BLOB NOT NULL,
    pack INTEGER NOT NULL
) STRICT;
CREATE TABLE segment (
    id INTEGER PRIMARY KEY,
    day INTEGER NOT NULL,
    first INTEGER NOT NULL,
    last INTEGER NOT NULL,
    last_moment INTEGER NOT NULL,
    half_cycles INTEGER NOT NULL,
    deleted INTEGER NOT NULL,
    hash BLOB NOT NULL
) STRICT;
";

/// Why the database cannot be opened.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum OpenError {
    /// The file is not a history, or is too damaged to be used as a history.
    #[error("damaged: {0}")]
    Damaged(String),
    /// The disk, the folder or the permissions prevent the opening.
    #[error("{0}")]
    Unavailable(String),
}

impl From<rusqlite::Error> for OpenError {
    fn from(error: rusqlite::Error) -> Self {
        if is_damage(&error) { Self::Damaged(error.to_string()) } else { Self::Unavailable(error.to_string()) }
    }
}

/// Whether an error means that the file's contents are wrong. An SQLite error counts as damage unless it has another
/// known cause, such as the disk, the permissions or another process. If damage were not recognised, the database would
/// not be replaced by a new one, and the store would never be written again.
pub(super) fn is_damage(error: &rusqlite::Error) -> bool {
    match error {
        rusqlite::Error::SqliteFailure(failure, _) => !matches!(
            failure.code,
            ErrorCode::SystemIoFailure
                | ErrorCode::DiskFull
                | ErrorCode::CannotOpen
                | ErrorCode::PermissionDenied
                | ErrorCode::ReadOnly // `Database::open` has reported a file that is marked as read-only
                | ErrorCode::DatabaseBusy
                | ErrorCode::DatabaseLocked
                | ErrorCode::FileLockingProtocolFailed
                | ErrorCode::OperationAborted
                | ErrorCode::OperationInterrupted
                | ErrorCode::OutOfMemory
        ),
        rusqlite::Error::QueryReturnedNoRows
        | rusqlite::Error::InvalidColumnType(..)
        | rusqlite::Error::FromSqlConversionFailure(..)
        | rusqlite::Error::IntegralValueOutOfRange(..)
        | rusqlite::Error::SqlInputError { .. } => true,
        _ => false,
    }
}

#[derive(Debug)]
pub(super) struct Database {
    connection: Connection,
    segment: Segment,
    pack: i64,
    path: PathBuf,
    /// Device and inode of the database and of its log when they were opened; `None` = no such file.
    opened: [Option<(u64, u64)>; 2],
}

/// Limits of the history. If one is exceeded, the oldest segments are deleted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct RowLimits {
    max_rows: i64,
    /// Maximum age, years; `None` = unlimited.
    keep_years: Option<f64>,
}

impl From<&StoreConfig> for RowLimits {
    fn from(config: &StoreConfig) -> Self {
        Self { max_rows: config.max_rows.into(), keep_years: config.keep_years }
    }
}

impl Database {
    /// Opens the file, or creates it if it is missing. `pack` is the number of the pack in the stored state (0 =
    /// unknown).
    pub(super) fn open(path: &Path, now: &Stamp, pack: i64) -> Result<Self, OpenError> {
        let mut connection = Connection::open_with_flags(
            path,
            OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE | OpenFlags::SQLITE_OPEN_NO_MUTEX,
        )?;
        connection.busy_timeout(BUSY_TIMEOUT)?;
        if connection.is_readonly(MAIN_DB)? && File::options().write(true).open(path).is_ok() {
            return Err(OpenError::Damaged("the file is marked as read-only".to_owned()));
        }
        // A power cut right after the creation leaves a file without tables.
        let has_tables =
            connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| Ok(row.get::<_, i64>(0)? > 0))?;
        if has_tables {
            let found = format(&connection)?;
            if found != FORMAT {
                return Err(OpenError::Damaged(format!("format {found}, not {FORMAT}")));
            }
            check(&mut connection)?;
        }
        prepare(&connection)?;
        if !has_tables {
            create(&mut connection)?;
        }
        let segment = Segment::newest(&connection)?;
        let last: i64 = connection.query_row("SELECT coalesce(max(id), 0) FROM pack", [], |row| row.get(0))?;
        let pack = pack.max(last).max(1);
        if last < pack {
            connection.execute("INSERT INTO pack (id, opened_ns) VALUES (?1, ?2)", params![pack, now.wall_ns])?;
        }
        Ok(Self { connection, segment, pack, path: path.to_owned(), opened: files_at(path) })
    }

    /// Whether the paths of the database and of its log still lead to the open files. If another program deletes or
    /// replaces these files, commits still succeed, but everything they write is lost when the database is closed.
    pub(super) fn has_its_names(&self) -> bool {
        files_at(&self.path) == self.opened
    }

    pub(super) fn rows(&self) -> i64 {
        self.segment.last
    }

    pub(super) fn pack(&self) -> i64 {
        self.pack
    }

    /// End of the hash chain: number of rows and hash of the last row.
    pub(super) fn head(&self) -> (i64, String) {
        (self.segment.last, hex(&self.segment.hash))
    }

    /// Whether another pack was connected after pack `pack`. If so, the caller discards the stored state of `pack`. Two
    /// stored values are checked, so that one flipped bit cannot discard a valid state.
    pub(super) fn is_closed(&self, pack: i64) -> rusqlite::Result<bool> {
        let sql = "SELECT 1 FROM pack WHERE id = ?1 AND closed_ns IS NOT NULL";
        Ok(pack < self.pack && self.connection.prepare(sql)?.exists([pack])?)
    }

    /// Records the vehicle of the history, if it has changed.
    pub(super) fn set_vehicle(&self, of: &VehicleIdentity) -> rusqlite::Result<()> {
        if vehicle(&self.connection)? == *of {
            return Ok(());
        }
        let text = serde_json::to_string(of).ok().filter(|_| of.is_stated());
        self.connection.execute("UPDATE meta SET vehicle = ?1 WHERE id = 1", [text]).map(drop)
    }

    /// Writes all rows or none. The rows are durable when this function returns.
    pub(super) fn commit(&mut self, batches: &[RowBatch]) -> rusqlite::Result<()> {
        let transaction = self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let (mut segment, mut pack) = (self.segment, self.pack);
        for batch in batches {
            write_batch(&transaction, &mut segment, &mut pack, batch)?;
        }
        transaction.commit()?;
        (self.segment, self.pack) = (segment, pack);
        Ok(())
    }

    /// Deletes the oldest segment if the history exceeds its limits.
    pub(super) fn apply(&mut self, limits: &RowLimits, now: &Stamp) -> rusqlite::Result<()> {
        let horizon_ns = limits.keep_years.and_then(|years| now.years_ago_ns(years));
        let transaction = self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        segments::delete_oldest(&transaction, &self.segment, limits.max_rows, horizon_ns)?;
        transaction.commit()
    }

    /// Returns the alarm changes of the connected pack after row `after`, oldest first, with their times on the inputs'
    /// clock.
    pub(super) fn alarm_changes(&self, after: i64) -> rusqlite::Result<Vec<(Timestamp, AlarmChange)>> {
        learned::alarm_changes(&self.connection, self.pack, after)
    }

    pub(super) fn learned(&self) -> rusqlite::Result<Vec<LearnedCell>> {
        learned::read(&self.connection, self.pack)
    }

    /// Closes the history of the pack and opens the history of the next pack. The row that closes the history contains
    /// the last learned capacity of the weakest cell. Returns the number of the new pack.
    pub(super) fn replace_pack(&mut self, now: &Stamp) -> rusqlite::Result<i64> {
        let learned = self
            .connection
            .query_row(
                "SELECT capacity_ah, capacity_std_ah FROM capacity WHERE seq IN (SELECT max(r.seq) FROM capacity r JOIN \
                 moment m ON m.id = r.moment WHERE m.pack = ?1 GROUP BY r.cell) ORDER BY capacity_ah LIMIT 1",
                [self.pack],
                |row| Ok((row.get(0)?, row.get(1)?)),
            )
            .optional()?;
        let (capacity_ah, capacity_std_ah) = learned.unwrap_or_default();
        let row = HistoryRow::Event(EventKind::PackReplaced { capacity_ah, capacity_std_ah });
        self.commit(&[RowBatch { stamp: *now, rows: vec![row] }])?;
        Ok(self.pack)
    }

    #[cfg(test)]
    pub(super) fn connection(&self) -> &Connection {
        &self.connection
    }
}

pub(super) fn file_id(file: &Metadata) -> (u64, u64) {
    (file.dev(), file.ino())
}

fn files_at(path: &Path) -> [Option<(u64, u64)>; 2] {
    [path.to_owned(), with_suffix(path, "-wal")].map(|path| std::fs::metadata(path).ok().as_ref().map(file_id))
}

pub(super) fn format(connection: &Connection) -> rusqlite::Result<i32> {
    connection.query_row("PRAGMA user_version", [], |row| row.get(0))
}

/// The vehicle of the history; empty if the stored text cannot be parsed.
pub(super) fn vehicle(connection: &Connection) -> rusqlite::Result<VehicleIdentity> {
    let text: Option<String> = connection.query_row("SELECT vehicle FROM meta WHERE id = 1", [], |row| row.get(0))?;
    Ok(text.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default())
}

fn create(connection: &mut Connection) -> rusqlite::Result<()> {
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    transaction.execute_batch(TABLES)?;
    for table in HistoryTable::ALL {
        let columns: String =
            table.columns().iter().map(|column| format!(", {column} {}", HistoryTable::sql_type(column))).collect();
        let sql = format!(
            "CREATE TABLE {} (seq INTEGER PRIMARY KEY, code INTEGER NOT NULL, moment INTEGER NOT NULL{columns}) STRICT",
            table.name()
        );
        transaction.execute(&sql, [])?;
    }
    // The bytes "pkwt" identify the file for file(1).
    transaction.pragma_update(None, "application_id", 0x706B_7774)?;
    transaction.pragma_update(None, "user_version", FORMAT)?;
    transaction.commit()
}

/// Sets up the connection and, if it is new, the file.
fn prepare(connection: &Connection) -> rusqlite::Result<()> {
    // The page size in bytes is small, because a commit changes few bytes but writes whole pages.
    connection.pragma_update(None, "page_size", 1024)?;
    let mode: String = connection.query_row("PRAGMA journal_mode = WAL", [], |row| row.get(0))?;
    if mode != "wal" {
        // The file system does not support shared memory. Without the log, commits are just as safe, but each commit is
        // written and synced twice.
        tracing::warn!(mode, "no write-ahead log on this file system: every commit is written twice");
    }
    connection.pragma_update(None, "synchronous", "FULL")?;
    // A negative cache size is in KiB.
    connection.pragma_update(None, "cache_size", -256)?;
    connection.pragma_update(None, "temp_store", "MEMORY")?;
    connection.pragma_update(None, "cell_size_check", true)?;
    // When the log reaches half a megabyte (about fifty commits), SQLite copies the log into the main file. SQLite
    // truncates a log that is longer than 1 MiB.
    connection.query_row("PRAGMA journal_size_limit = 1048576", [], |_| Ok(()))?;
    connection.query_row("PRAGMA wal_autocheckpoint = 512", [], |_| Ok(()))
}

fn check(connection: &mut Connection) -> Result<(), OpenError> {
    let started = Instant::now();
    // The handler runs every 10,000 steps of SQLite's virtual machine.
    connection.progress_handler(10_000, Some(move || started.elapsed() > MAX_CHECK))?;
    let found = connection.query_row("PRAGMA quick_check(1)", [], |row| row.get::<_, String>(0));
    connection.progress_handler(0, None::<fn() -> bool>)?;
    match found {
        Ok(answer) if answer == "ok" => Ok(()),
        Ok(answer) => Err(OpenError::Damaged(answer)),
        Err(error) if error.sqlite_error_code() == Some(ErrorCode::OperationInterrupted) => {
            tracing::info!(limit_s = MAX_CHECK.as_secs(), "database too large for a complete check at the start");
            Ok(())
        }
        Err(error) => Err(error.into()),
    }
}

fn write_batch(
    transaction: &Transaction<'_>,
    segment: &mut Segment,
    pack: &mut i64,
    batch: &RowBatch,
) -> rusqlite::Result<()> {
    let rows: Vec<_> = batch.rows.iter().filter_map(|row| Some((row, row.values()?))).collect();
    if rows.is_empty() {
        return Ok(());
    }
    let Stamp { wall_ns, time, boot, .. } = batch.stamp;
    *segment = segment.at(transaction, &batch.stamp)?;
    let values = params![wall_ns, time.nanos(), boot.0, *pack];
    transaction
        .prepare_cached("INSERT INTO moment (wall_ns, time_ns, boot, pack) VALUES (?1, ?2, ?3, ?4)")?
        .execute(values)?;
    segment.last_moment = transaction.last_insert_rowid();
    let moment = [
        Value::Integer(segment.last_moment),
        Value::Integer(wall_ns),
        Value::Integer(time.nanos()),
        Value::Blob(boot.0.to_vec()),
        Value::Integer(*pack),
    ];
    for (row, (table, values)) in rows {
        segment.write_row(transaction, table, &moment, &values)?;
        if row.replaces_pack() {
            transaction.execute(
                "UPDATE pack SET closed_ns = ?2, reason = 'pack_replaced' WHERE id = ?1",
                params![*pack, wall_ns],
            )?;
            *pack = pack.saturating_add(1);
            transaction.execute("INSERT INTO pack (id, opened_ns) VALUES (?1, ?2)", params![*pack, wall_ns])?;
        }
        if let Some(identity) = row.pack_identity() {
            let values = params![*pack, identity.to_string()];
            transaction.execute("UPDATE pack SET identity = ?2 WHERE id = ?1", values)?;
        }
    }
    segment.write(transaction)
}

#[cfg(test)]
mod tests;
