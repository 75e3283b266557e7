//! The database: opened with care, written in transactions that hold what was learned together with the state it
//! was learned in.
//!
//! * One file in write-ahead mode with `synchronous=FULL`: a commit that returned survives a power cut, one that did
//!   not leaves no trace.
//! * A damaged file, one of a newer program and one that cannot be reached are three different errors.

use std::path::Path;
use std::time::{Duration, Instant};

use rusqlite::types::Value;
use rusqlite::{Connection, ErrorCode, OpenFlags, OptionalExtension, Transaction, TransactionBehavior, params};

use super::chain::Head;
use super::delta_encoder::DeltaEncoder;
use super::document::Document;
use super::parts::Parts;
use super::rows::{Batch, Row, Table};
use super::schema::{self, MIGRATIONS};
use super::stamp::{BootId, Stamp};
use super::{packed, retention};
use crate::monitor::EventKind;

/// Bytes of a page: a checkpoint changes few bytes, and whole pages are written.
const PAGE_BYTES: u32 = 1024;
/// Pages in the write-ahead log after which they are copied into the main file: half a megabyte, some seventy
/// checkpoints of a pack of 96 cells, of which the main file then takes a dozen pages.
const AUTOCHECKPOINT_PAGES: u32 = 512;
/// The log is cut back to this when it has grown beyond, bytes.
const MAX_LOG_BYTES: u32 = 1 << 20;
/// Memory for pages, KiB.
const CACHE_KIB: u32 = 256;
/// How long a commit waits for a reader that keeps the database for itself.
const BUSY_TIMEOUT: Duration = Duration::from_millis(100);
/// Longest check of the file at the start; what it has not looked at by then is found when it is read.
const MAX_CHECK: Duration = Duration::from_secs(2);
/// Virtual machine steps between two looks at the clock during that check.
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
    /// It is no database any more.
    #[error("damaged: {0}")]
    Damaged(String),
    /// The disk, the folder, the rights.
    #[error("{0}")]
    Unavailable(String),
}

impl From<rusqlite::Error> for OpenError {
    fn from(error: rusqlite::Error) -> Self {
        if is_damage(&error) { Self::Damaged(error.to_string()) } else { Self::Unavailable(error.to_string()) }
    }
}

/// Whether an error means that the file's contents are wrong.
pub(super) fn is_damage(error: &rusqlite::Error) -> bool {
    match error {
        rusqlite::Error::SqliteFailure(failure, text) => match failure.code {
            ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase => true,
            // A table that a database of this version has.
            ErrorCode::Unknown => text.as_deref().is_some_and(|text| text.starts_with("no such")),
            _ => false,
        },
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
    delta_encoder: DeltaEncoder,
    max_half_cycles: i64,
}

/// What `meta` holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Meta {
    /// End of the chain.
    pub(super) head: Head,
    /// Rows of half-cycles.
    pub(super) half_cycles: i64,
    /// Rows of half-cycles that were thinned out.
    pub(super) thinned: i64,
    /// The moment up to which this round of thinning has come.
    pub(super) thinned_to: i64,
    /// The pack that is connected.
    pub(super) pack: i64,
}

/// A state to be stored.
#[derive(Debug)]
pub(super) struct StateRecord {
    /// The state's document.
    pub parts: Parts,
    /// To the last bit (on stop), not rounded.
    pub exact: bool,
    /// The state stored so far is kept beside it: nobody has taken it up.
    pub sets_aside: bool,
}

/// A state as it was stored.
#[derive(Debug)]
pub(super) struct StoredState {
    /// The state's document, JSON.
    pub json: Vec<u8>,
    /// What was wrong with a later one.
    pub lost_later: Option<String>,
}

/// Rows in the history.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Counts {
    /// Capacities, alarms and resets.
    pub chained: i64,
    /// Half-cycles.
    pub half_cycles: i64,
    /// Packs.
    pub packs: i64,
}

impl Database {
    /// Opens the file, making it or bringing its layout up to date where needed.
    pub(super) fn open(path: &Path, now: &Stamp, max_half_cycles: u32) -> Result<Self, OpenError> {
        Self::open_with(path, now, max_half_cycles, MIGRATIONS)
    }

    pub(super) fn open_with(
        path: &Path,
        now: &Stamp,
        max_half_cycles: u32,
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
        if version > known {
            return Err(OpenError::Newer { found: version, known });
        }
        if version == 0 && !is_new && has_tables(&connection)? {
            return Err(OpenError::Damaged("a database, but none of packwatch's".to_owned()));
        }
        prepare(&connection)?;
        if !is_new {
            check(&mut connection)?;
        }
        schema::migrate(&mut connection, version, migrations)?;
        let meta = open_pack(&connection, now)?;
        let mut database = Self {
            connection,
            meta,
            delta_encoder: DeltaEncoder::default(),
            max_half_cycles: i64::from(max_half_cycles),
        };
        database.fill_shelf()?;
        Ok(database)
    }

    /// Rows so far.
    pub(super) fn counts(&self) -> Counts {
        let Meta { head, half_cycles, pack, .. } = self.meta;
        Counts { chained: head.count, half_cycles, packs: pack }
    }

    /// Writes rows and state, all or nothing; durable when it returns.
    pub(super) fn commit(&mut self, batches: &[Batch], state: Option<StateRecord>) -> rusqlite::Result<()> {
        let transaction = self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let mut meta = self.meta;
        for batch in batches {
            write_batch(&transaction, &mut meta, batch)?;
        }
        if batches.is_empty() {
            retention::thin(&transaction, &mut meta, self.max_half_cycles)?;
        }
        let packed = match state {
            None => None,
            Some(StateRecord { parts, exact, sets_aside }) => {
                if sets_aside {
                    set_aside(&transaction)?;
                    self.delta_encoder = DeltaEncoder::default();
                }
                let packed = self.delta_encoder.pack(parts, exact);
                write_state(&transaction, &packed)?;
                Some(packed)
            }
        };
        if meta != self.meta {
            write_meta(&transaction, &meta)?;
        }
        transaction.commit()?;
        self.meta = meta;
        packed.into_iter().for_each(|packed| self.delta_encoder.stored(packed));
        Ok(())
    }

    /// The latest state; `None` = none was stored. A damaged one is an error in words: the history may still be good.
    pub(super) fn state(&self) -> rusqlite::Result<Result<Option<StoredState>, String>> {
        read_state(&self.connection, &self.delta_encoder, STATE)
    }

    /// The state that was set aside; `None` = there is none, or it is not good.
    pub(super) fn state_aside(&self) -> Option<Document> {
        read_document(&self.connection, ASIDE)
    }

    /// When in this boot another pack was connected last, boot time.
    pub(super) fn last_reset_ns(&self, boot: BootId) -> rusqlite::Result<Option<i64>> {
        self.connection.query_row(
            "SELECT max(m.boottime_ns) FROM reset r JOIN moment m ON m.id = r.moment WHERE r.reason = 'pack_replaced' AND \
             m.boot = ?1",
            [boot.0],
            |row| row.get(0),
        )
    }

    /// Closes the history of the pack, with what was learned last of its weakest cell, opens the next one's and forgets
    /// the state. The number of the pack that begins.
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
        let row = Row::Event(EventKind::PackReplaced { capacity_ah, capacity_std_ah });
        write_batch(&transaction, &mut meta, &Batch { stamp: *now, rows: vec![row] })?;
        transaction.execute("DELETE FROM state", [])?;
        write_meta(&transaction, &meta)?;
        transaction.commit()?;
        self.meta = meta;
        self.delta_encoder = DeltaEncoder::default();
        Ok(meta.pack)
    }

    /// For rows copied from a damaged database.
    pub(super) fn parts_mut(&mut self) -> (&mut Connection, &mut Meta) {
        (&mut self.connection, &mut self.meta)
    }

    /// Closes it with everything in the one file.
    pub(super) fn close(self) -> rusqlite::Result<()> {
        let is_busy: bool = self.connection.query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |row| row.get(0))?;
        if is_busy {
            return Err(rusqlite::Error::SqliteFailure(rusqlite::ffi::Error::new(rusqlite::ffi::SQLITE_BUSY), None));
        }
        self.connection.close().map_err(|(_, error)| error)
    }

    /// The connection, for looking.
    #[cfg(test)]
    pub(super) fn connection(&self) -> &Connection {
        &self.connection
    }

    fn fill_shelf(&mut self) -> rusqlite::Result<()> {
        // A damaged one is told when the state is asked for.
        self.delta_encoder = read_shelf(&self.connection, STATE)?;
        Ok(())
    }
}

/// First slot of the state.
pub(super) const STATE: i64 = 0;
/// Serial number of a delta to nothing.
const NO_SERIAL: i64 = -1;
/// First slot of a state that was set aside.
pub(super) const ASIDE: i64 = 10;

/// The shelf with the full record that is stored, if it is good.
fn read_shelf(connection: &Connection, first: i64) -> rusqlite::Result<DeltaEncoder> {
    let Some(full) = slot(connection, first)? else { return Ok(DeltaEncoder::default()) };
    let room = slot(connection, first + 1)?.map_or(0, |delta| delta.room);
    Ok(DeltaEncoder::with_base(full.serial, &full.record, room).unwrap_or_default())
}

/// As [`Database::state`].
fn read_state(
    connection: &Connection,
    delta_encoder: &DeltaEncoder,
    first: i64,
) -> rusqlite::Result<Result<Option<StoredState>, String>> {
    if slot(connection, first)?.is_none() {
        return Ok(Ok(None));
    }
    let Some((serial, base)) = delta_encoder.base() else { return Ok(Err("the stored state is damaged".to_owned())) };
    let delta = slot(connection, first + 1)?.filter(|delta| delta.serial == serial);
    let (parts, lost_later) = match delta.map(|slot| packed::read_delta(&slot.record, base, serial)) {
        None => (base.clone(), None),
        Some(Ok(parts)) => (parts, None),
        Some(Err(damaged)) => (base.clone(), Some(damaged.to_string())),
    };
    Ok(Ok(Some(StoredState { json: parts.join(), lost_later })))
}

/// The document of a state from this slot on, if it is good.
pub(super) fn read_document(connection: &Connection, first: i64) -> Option<Document> {
    let delta_encoder = read_shelf(connection, first).ok()?;
    let stored = read_state(connection, &delta_encoder, first).ok()?.ok()??;
    Document::parse(&stored.json).ok()
}

/// Keeps the stored state where no checkpoint overwrites it, in place of one that was kept before.
fn set_aside(transaction: &Transaction<'_>) -> rusqlite::Result<()> {
    transaction.execute(
        "DELETE FROM state WHERE slot >= ?1 AND EXISTS (SELECT 1 FROM state WHERE slot = ?2)",
        [ASIDE, STATE],
    )?;
    transaction.execute("UPDATE state SET slot = slot + ?1 WHERE slot < ?1", [ASIDE]).map(drop)
}

fn has_tables(connection: &Connection) -> rusqlite::Result<bool> {
    connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| Ok(row.get::<_, i64>(0)? > 0))
}

/// Settings of the connection, and of the file while it is new.
fn prepare(connection: &Connection) -> rusqlite::Result<()> {
    connection.pragma_update(None, "page_size", PAGE_BYTES)?;
    let mode: String = connection.query_row("PRAGMA journal_mode = WAL", [], |row| row.get(0))?;
    if mode != "wal" {
        // As safe, but every commit is written twice and made last twice: on a file system without shared memory.
        tracing::warn!(mode, "the file system allows the database no write-ahead log: more is written");
    }
    connection.pragma_update(None, "synchronous", "FULL")?;
    connection.pragma_update(None, "cache_size", -i64::from(CACHE_KIB))?;
    connection.pragma_update(None, "temp_store", "MEMORY")?;
    connection.pragma_update(None, "cell_size_check", true)?;
    connection.query_row(&format!("PRAGMA journal_size_limit = {MAX_LOG_BYTES}"), [], |_| Ok(()))?;
    connection.query_row(&format!("PRAGMA wal_autocheckpoint = {AUTOCHECKPOINT_PAGES}"), [], |_| Ok(()))
}

/// Looks through the file, for a bounded time.
fn check(connection: &mut Connection) -> Result<(), OpenError> {
    let started = Instant::now();
    connection.progress_handler(CHECK_STEPS, Some(move || started.elapsed() > MAX_CHECK))?;
    let found = connection.query_row("PRAGMA quick_check(1)", [], |row| row.get::<_, String>(0));
    connection.progress_handler(0, None::<fn() -> bool>)?;
    match found {
        Ok(answer) if answer == "ok" => Ok(()),
        Ok(answer) => Err(OpenError::Damaged(answer)),
        Err(error) if error.sqlite_error_code() == Some(ErrorCode::OperationInterrupted) => {
            tracing::info!(limit_s = MAX_CHECK.as_secs(), "database too large to be checked whole at the start");
            Ok(())
        }
        Err(error) => Err(error.into()),
    }
}

/// Reads the ledger; opens the first pack's history in a new file.
fn open_pack(connection: &Connection, now: &Stamp) -> rusqlite::Result<Meta> {
    let mut meta = read_meta(connection)?;
    if meta.pack == 0 {
        meta.pack = 1;
        connection.execute("INSERT INTO pack (id, opened_ns) VALUES (1, ?1)", [now.wall_ns])?;
    }
    Ok(meta)
}

/// Reads `meta` and which pack is connected (0 = none yet).
pub(super) fn read_meta(connection: &Connection) -> rusqlite::Result<Meta> {
    let pack = connection.query_row("SELECT coalesce(max(id), 0) FROM pack", [], |row| row.get(0))?;
    connection.query_row("SELECT chained, head, half_cycles, thinned, thinned_to FROM meta WHERE id = 1", [], |row| {
        let head = Head { count: row.get(0)?, hash: row.get(1)? };
        Ok(Meta { head, half_cycles: row.get(2)?, thinned: row.get(3)?, thinned_to: row.get(4)?, pack })
    })
}

pub(super) fn write_meta(connection: &Connection, meta: &Meta) -> rusqlite::Result<()> {
    let Meta { head, half_cycles, thinned, thinned_to, .. } = meta;
    connection
        .prepare_cached(
            "UPDATE meta SET chained = ?1, head = ?2, half_cycles = ?3, thinned = ?4, thinned_to = ?5 WHERE id = 1",
        )?
        .execute(params![head.count, head.hash, half_cycles, thinned, thinned_to])
        .map(drop)
}

/// Columns of a moment in a chained row.
pub(super) const MOMENT_COLUMNS: usize = 6;

/// Rows of a table: number and hash (of a half-cycle, which has none: moment and cell), the moment's values, the row's own.
/// `tail` says which and in which order.
pub(super) fn rows_sql(table: Table, tail: &str) -> String {
    let columns: Vec<String> = table.columns().iter().map(|column| format!("r.{column}")).collect();
    let own = if table == Table::HalfCycle { "r.moment, r.cell" } else { "r.seq, r.hash" };
    format!(
        "SELECT {own}, r.moment, m.wall_ns, m.time_ns, m.boottime_ns, m.boot, m.pack, {} FROM {} r LEFT JOIN moment m ON \
         m.id = r.moment {tail}",
        columns.join(", "),
        table.name()
    )
}

/// Values of a moment as a chained row has them: its number, the clocks, the pack.
fn moment_values(id: i64, stamp: &Stamp, pack: i64) -> Vec<Value> {
    vec![
        Value::Integer(id),
        Value::Integer(stamp.wall_ns),
        Value::Integer(stamp.time.nanos()),
        Value::Integer(stamp.boottime_ns),
        Value::Blob(stamp.boot.0.to_vec()),
        Value::Integer(pack),
    ]
}

fn write_batch(transaction: &Transaction<'_>, meta: &mut Meta, batch: &Batch) -> rusqlite::Result<()> {
    let moment = write_moment(transaction, &batch.stamp, meta.pack)?;
    for row in &batch.rows {
        let Some((table, values)) = row.values() else { continue };
        write_row(transaction, meta, table, &moment, &values)?;
        if row.replaces_pack() {
            replace_pack(transaction, meta, &batch.stamp)?;
        }
        if let Some(identity) = row.pack_identity() {
            let values = params![meta.pack, identity.to_string()];
            transaction.execute("UPDATE pack SET identity = ?2 WHERE id = ?1", values)?;
        }
    }
    Ok(())
}

/// Writes a moment; returns its values.
pub(super) fn write_moment(connection: &Connection, stamp: &Stamp, pack: i64) -> rusqlite::Result<Vec<Value>> {
    connection
        .prepare_cached("INSERT INTO moment (wall_ns, time_ns, boottime_ns, boot, pack) VALUES (?1, ?2, ?3, ?4, ?5)")?
        .execute(params![stamp.wall_ns, stamp.time.nanos(), stamp.boottime_ns, stamp.boot.0, pack])?;
    Ok(moment_values(connection.last_insert_rowid(), stamp, pack))
}

/// Writes one row of a moment; a chained one gets its number and its hash.
pub(super) fn write_row(
    connection: &Connection,
    meta: &mut Meta,
    table: Table,
    moment: &[Value],
    values: &[Value],
) -> rusqlite::Result<()> {
    let columns = table.columns().join(", ");
    let places =
        |first: usize| (first..first + values.len()).map(|number| format!("?{number}")).collect::<Vec<_>>().join(", ");
    if table == Table::HalfCycle {
        let sql = format!("INSERT OR REPLACE INTO half_cycle (moment, {columns}) VALUES (?1, {})", places(2));
        let bound = moment.iter().take(1).chain(values);
        connection.prepare_cached(&sql)?.execute(rusqlite::params_from_iter(bound))?;
        meta.half_cycles += 1;
        return Ok(());
    }
    let chained: Vec<Value> = moment.iter().chain(values).cloned().collect();
    meta.head.append(table, &chained);
    let own = [Value::Integer(meta.head.count), Value::Blob(meta.head.hash.to_vec())];
    let sql = format!("INSERT INTO {} (seq, hash, moment, {columns}) VALUES (?1, ?2, ?3, {})", table.name(), places(4));
    let bound = own.iter().chain(moment.iter().take(1)).chain(values);
    connection.prepare_cached(&sql)?.execute(rusqlite::params_from_iter(bound)).map(drop)
}

/// Closes the history of the pack and opens the next one's.
fn replace_pack(connection: &Connection, meta: &mut Meta, stamp: &Stamp) -> rusqlite::Result<()> {
    connection.execute(
        "UPDATE pack SET closed_ns = ?2, reason = 'pack_replaced' WHERE id = ?1",
        params![meta.pack, stamp.wall_ns],
    )?;
    meta.pack += 1;
    // A state of the pack that has gone must not come back.
    connection.execute("DELETE FROM state WHERE slot >= ?1", [ASIDE])?;
    connection.execute("INSERT INTO pack (id, opened_ns) VALUES (?1, ?2)", params![meta.pack, stamp.wall_ns]).map(drop)
}

fn write_state(transaction: &Transaction<'_>, packed: &super::delta_encoder::Packed) -> rusqlite::Result<()> {
    let slot = STATE + i64::from(!packed.is_full);
    let length = i64::try_from(packed.length).unwrap_or(i64::MAX);
    let values = params![slot, packed.serial, length, packed.bytes];
    // An update of equal length overwrites in place, page by changed page.
    let updated = transaction
        .prepare_cached("UPDATE state SET serial = ?2, length = ?3, bytes = ?4 WHERE slot = ?1")?
        .execute(values)?;
    if updated == 0 {
        transaction.execute("INSERT INTO state VALUES (?1, ?2, ?3, ?4)", values)?;
    }
    if packed.is_full {
        // Serial numbers begin anew when a full record was lost: an old delta must never fit a new one. Its room is kept.
        transaction.execute("UPDATE state SET serial = ?2 WHERE slot = ?1", [STATE + 1, NO_SERIAL])?;
    }
    Ok(())
}

/// A slot of `state`.
struct Slot {
    serial: i64,
    record: Vec<u8>,
    room: usize,
}

fn slot(connection: &Connection, slot: i64) -> rusqlite::Result<Option<Slot>> {
    connection
        .query_row("SELECT serial, length, bytes FROM state WHERE slot = ?1", [slot], |row| {
            let mut record: Vec<u8> = row.get(2)?;
            let room = record.len();
            record.truncate(usize::try_from(row.get::<_, i64>(1)?).unwrap_or(usize::MAX));
            Ok(Slot { serial: row.get(0)?, record, room })
        })
        .optional()
}

#[cfg(test)]
mod tests;
