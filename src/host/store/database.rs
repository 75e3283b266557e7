//! The database: checked when it is opened, written in transactions that hold rows together with their state.
//!
//! * One file in write-ahead mode with `synchronous=FULL`: a commit that returned survives a power cut, a commit that did
//!   not return leaves no trace.
//! * A damaged file, a file of a newer program and a file that cannot be reached are three different errors.

use std::fs::File;
use std::path::Path;
use std::time::{Duration, Instant};

use rusqlite::{Connection, ErrorCode, MAIN_DB, OpenFlags, OptionalExtension, TransactionBehavior};

use super::chain::hex;
use super::chain_retention::ChainSweep;
use super::document::StateDocument;
use super::learned;
use super::meta::{self, Meta};
use super::retention::{self, RowLimits};
use super::row_sql::write_batch;
use super::rows::{HistoryRow, RowBatch};
use super::schema::{self, MIGRATIONS};
use super::stamp::{BootId, Stamp};
use super::state_slots::{self, StateCopies, StateRecord, StoredState, read_aside, read_state};
use crate::config::VehicleIdentity;
use crate::monitor::{EventKind, LearnedCell};

/// Bytes of a page: a checkpoint changes few bytes, and whole pages are written.
pub(super) const PAGE_BYTES: u32 = 1024;
/// Pages in the write-ahead log after which SQLite copies them into the main file: half a megabyte, some seventy
/// checkpoints of a pack of 96 cells, which change a dozen pages of the main file.
const AUTOCHECKPOINT_PAGES: u32 = 512;
/// SQLite truncates a larger log to this, bytes.
const MAX_LOG_BYTES: u32 = 1 << 20;
/// Memory for pages, KiB.
const CACHE_KIB: u32 = 256;
/// Longest wait of a commit for a reader that locks the database.
const BUSY_TIMEOUT: Duration = Duration::from_millis(100);
/// Longest check of the file at the start; damage beyond it is found when that part is read.
const MAX_CHECK: Duration = Duration::from_secs(2);
/// Virtual machine steps between two readings of the clock during that check.
const CHECK_STEPS: i32 = 10_000;

/// Why the database cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum OpenError {
    /// A newer program wrote it.
    #[error("layout version {found}, this program reads up to {known}; the file is left as it is")]
    Newer {
        /// In the file.
        found: i32,
        /// Readable here.
        known: i32,
    },
    /// The file is no longer a database.
    #[error("damaged: {0}")]
    Damaged(String),
    /// The disk, the folder or the permissions prevent it.
    #[error("{0}")]
    Unavailable(String),
}

impl From<rusqlite::Error> for OpenError {
    fn from(error: rusqlite::Error) -> Self {
        if is_damage(&error) { Self::Damaged(error.to_string()) } else { Self::Unavailable(error.to_string()) }
    }
}

/// Whether an error means that the file's contents are wrong: every error that neither the disk nor another process
/// causes. One that is missed would end in a store that is never written again.
pub(super) fn is_damage(error: &rusqlite::Error) -> bool {
    match error {
        rusqlite::Error::SqliteFailure(failure, _) => !matches!(
            failure.code,
            ErrorCode::SystemIoFailure
                | ErrorCode::DiskFull
                | ErrorCode::CannotOpen
                | ErrorCode::PermissionDenied
                | ErrorCode::ReadOnly // of a writable file: `Database::open`
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

/// The database, open for writing.
#[derive(Debug)]
pub(super) struct Database {
    connection: Connection,
    meta: Meta,
    copies: StateCopies,
    limits: RowLimits,
    sweep: ChainSweep,
    /// Half-cycles before this wall clock are deleted, ns since 1970; `None` = none.
    horizon_ns: Option<i64>,
}

/// Rows in the history.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Counts {
    /// Capacities, loss modes, remaining lives, cell models, alarms and resets that were written.
    pub chained: i64,
    /// Half-cycles.
    pub half_cycles: i64,
    /// Packs.
    pub packs: i64,
}

impl Database {
    /// Opens the file; creates it or brings its layout up to date where needed.
    pub(super) fn open(path: &Path, now: &Stamp, limits: RowLimits) -> Result<Self, OpenError> {
        Self::open_with(path, now, limits, MIGRATIONS)
    }

    pub(super) fn open_with(
        path: &Path,
        now: &Stamp,
        limits: RowLimits,
        migrations: &[&str],
    ) -> Result<Self, OpenError> {
        let is_new = std::fs::metadata(path).map_or(true, |file| file.len() == 0);
        let mut connection = Connection::open_with_flags(
            path,
            OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE | OpenFlags::SQLITE_OPEN_NO_MUTEX,
        )?;
        connection.busy_timeout(BUSY_TIMEOUT)?;
        let version = schema::version(&connection)?;
        let known = schema::known(migrations);
        if !schema::is_confirmed(&connection, version) {
            return Err(OpenError::Damaged(format!("layout version {version}, not the one noted in the table meta")));
        }
        if version > known {
            return Err(OpenError::Newer { found: version, known });
        }
        if connection.is_readonly(MAIN_DB)? && File::options().write(true).open(path).is_ok() {
            return Err(OpenError::Damaged("the file is marked as read-only".to_owned()));
        }
        if version == 0 && !is_new && has_tables(&connection)? {
            return Err(OpenError::Damaged("a database, but not one of packwatch".to_owned()));
        }
        prepare(&connection)?;
        if !is_new {
            check(&mut connection)?;
        }
        schema::migrate(&mut connection, version, migrations)?;
        let mut meta = open_pack(&connection, now)?;
        if let Some(fault) = meta.fault(&connection, known)? {
            return Err(OpenError::Damaged(fault));
        }
        // A damaged record is reported by [`Self::state`].
        let copies = StateCopies::read(&connection, known)?;
        let sweep = ChainSweep::begin(meta.head.count);
        Ok(Self { connection, meta, copies, limits, sweep, horizon_ns: None })
    }

    /// Rows so far.
    pub(super) fn counts(&self) -> Counts {
        let Meta { head, half_cycles, pack, .. } = self.meta;
        Counts { chained: head.count, half_cycles, packs: pack }
    }

    /// The chain's end: number of rows, hash of the last.
    pub(super) fn head(&self) -> (i64, String) {
        (self.meta.head.count, hex(&self.meta.head.hash))
    }

    /// Sets the wall clock before which checkpoints delete half-cycles, ns since 1970; `None` = they delete none.
    pub(super) fn set_horizon_ns(&mut self, horizon_ns: Option<i64>) {
        self.horizon_ns = horizon_ns;
    }

    /// Notes which vehicle the history is of, if it is not noted yet.
    pub(super) fn set_vehicle(&self, vehicle: &VehicleIdentity) -> rusqlite::Result<()> {
        if meta::vehicle(&self.connection)? == *vehicle {
            return Ok(());
        }
        meta::set_vehicle(&self.connection, vehicle)
    }

    /// Writes rows and state, all or nothing; durable when it returns.
    pub(super) fn commit(&mut self, batches: &[RowBatch], state: Option<StateRecord>) -> rusqlite::Result<()> {
        let transaction = self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let mut meta = self.meta;
        for batch in batches {
            write_batch(&transaction, &mut meta, batch)?;
        }
        let mut sweep = self.sweep;
        if batches.is_empty() {
            sweep.thin(&transaction, &mut meta, self.limits.chained_rows)?;
            retention::thin(&transaction, &mut meta, self.limits.half_cycles)?;
            if let Some(horizon_ns) = self.horizon_ns {
                retention::expire(&transaction, &mut meta, horizon_ns)?;
            }
        }
        let written = match state {
            None => None,
            Some(StateRecord { parts, exact, sets_aside }) => {
                if sets_aside {
                    self.copies.set_aside(&transaction)?;
                }
                Some(self.copies.write(&transaction, parts, exact)?)
            }
        };
        if meta != self.meta {
            meta.write(&transaction)?;
        }
        transaction.commit()?;
        (self.meta, self.sweep) = (meta, sweep);
        written.into_iter().for_each(|written| self.copies.note_stored(written));
        Ok(())
    }

    /// The latest state, as [`read_state`] reads it.
    pub(super) fn state(&self) -> rusqlite::Result<Result<Option<StoredState>, String>> {
        read_state(&self.connection)
    }

    /// The state that was set aside; `None` = there is no good one.
    pub(super) fn state_aside(&self) -> Option<StateDocument> {
        read_aside(&self.connection)
    }

    /// What the history knows of the cells of the connected pack.
    pub(super) fn learned(&self) -> rusqlite::Result<Vec<LearnedCell>> {
        learned::read(&self.connection, self.meta.pack)
    }

    /// Boot time at which another pack was connected last in this boot, ns.
    pub(super) fn last_reset_ns(&self, boot: BootId) -> rusqlite::Result<Option<i64>> {
        self.connection.query_row(
            "SELECT max(m.boottime_ns) FROM reset r JOIN moment m ON m.id = r.moment WHERE r.reason = 'pack_replaced' AND \
             m.boot = ?1",
            [boot.0],
            |row| row.get(0),
        )
    }

    /// Closes the history of the pack with the last capacity of its weakest cell, opens that of the next pack and forgets
    /// the state. Returns the number of the new pack.
    pub(super) fn replace_pack(&mut self, now: &Stamp) -> rusqlite::Result<i64> {
        let transaction = self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let mut meta = self.meta;
        let learned = transaction
            .query_row(
                "SELECT capacity_ah, capacity_std_ah FROM capacity WHERE seq IN (SELECT max(r.seq) FROM capacity r JOIN \
                 moment m ON m.id = r.moment WHERE m.pack = ?1 GROUP BY r.cell) ORDER BY capacity_ah LIMIT 1",
                [meta.pack],
                |row| Ok((row.get(0)?, row.get(1)?)),
            )
            .optional()?;
        let (capacity_ah, capacity_std_ah) = learned.unwrap_or_default();
        let row = HistoryRow::Event(EventKind::PackReplaced { capacity_ah, capacity_std_ah });
        write_batch(&transaction, &mut meta, &RowBatch { stamp: *now, rows: vec![row] })?;
        state_slots::forget_all(&transaction)?;
        meta.write(&transaction)?;
        transaction.commit()?;
        self.meta = meta;
        self.copies = StateCopies::default();
        Ok(meta.pack)
    }

    /// Connection and meta, for rows copied from a damaged database.
    pub(super) fn parts_mut(&mut self) -> (&mut Connection, &mut Meta) {
        (&mut self.connection, &mut self.meta)
    }

    /// Closes it with all contents in the main file.
    pub(super) fn close(self) -> rusqlite::Result<()> {
        let is_busy: bool = self.connection.query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |row| row.get(0))?;
        if is_busy {
            return Err(rusqlite::Error::SqliteFailure(rusqlite::ffi::Error::new(rusqlite::ffi::SQLITE_BUSY), None));
        }
        self.connection.close().map_err(|(_, error)| error)
    }

    /// The connection, for tests.
    #[cfg(test)]
    pub(super) fn connection(&self) -> &Connection {
        &self.connection
    }
}

fn has_tables(connection: &Connection) -> rusqlite::Result<bool> {
    connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| Ok(row.get::<_, i64>(0)? > 0))
}

/// Settings of the connection, and of the file while it is new.
fn prepare(connection: &Connection) -> rusqlite::Result<()> {
    connection.pragma_update(None, "page_size", PAGE_BYTES)?;
    let mode: String = connection.query_row("PRAGMA journal_mode = WAL", [], |row| row.get(0))?;
    if mode != "wal" {
        // A file system without shared memory. As safe, but every commit is written and synced twice.
        tracing::warn!(mode, "the file system does not support a write-ahead log: the database writes more");
    }
    connection.pragma_update(None, "synchronous", "FULL")?;
    connection.pragma_update(None, "cache_size", -i64::from(CACHE_KIB))?;
    connection.pragma_update(None, "temp_store", "MEMORY")?;
    connection.pragma_update(None, "cell_size_check", true)?;
    // What is deleted is overwritten: a salvage must not find it.
    connection.query_row("PRAGMA secure_delete = ON", [], |_| Ok(()))?;
    connection.query_row(&format!("PRAGMA journal_size_limit = {MAX_LOG_BYTES}"), [], |_| Ok(()))?;
    connection.query_row(&format!("PRAGMA wal_autocheckpoint = {AUTOCHECKPOINT_PAGES}"), [], |_| Ok(()))
}

/// Checks the file, for a bounded time.
fn check(connection: &mut Connection) -> Result<(), OpenError> {
    let started = Instant::now();
    connection.progress_handler(CHECK_STEPS, Some(move || started.elapsed() > MAX_CHECK))?;
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

/// Reads `meta`; opens the history of the first pack in a new file.
fn open_pack(connection: &Connection, now: &Stamp) -> rusqlite::Result<Meta> {
    let mut meta = Meta::read(connection)?;
    if meta.pack == 0 {
        meta.pack = 1;
        connection.execute("INSERT INTO pack (id, opened_ns) VALUES (1, ?1)", [now.wall_ns])?;
    }
    Ok(meta)
}

#[cfg(test)]
mod tests;
