//! Copies the readable rows of a damaged database.
//!
//! The rows are those that `carve` finds on the pages of the file, whatever its schema and its inner pages
//! look like. They are copied in their order, a few at a time: a history of any length needs the same memory. A chained row whose hash does not match its contents was changed by the damage; it is rejected
//! and counted. The copies get numbers and hashes of the new chain.
//!
//! The number of packs comes from rows with a good hash and from the table `pack`; an unchecked row that names a further
//! pack is rejected.

use std::collections::VecDeque;
use std::fmt;
use std::path::Path;

use rusqlite::types::Value;
use rusqlite::{Connection, OptionalExtension, Row, params};

use super::carve::{Carved, carve};
use super::chain::{self, Hash};
use super::database::Database;
use super::document::StateDocument;
use super::meta::Meta;
use super::row_sql::{MOMENT_COLUMNS, rows_sql, write_moment, write_row};
use super::rows::HistoryTable;
use super::stamp::{BootId, Stamp};
use crate::quantity::Timestamp;

/// Rows of a table in memory at once.
const PAGE_ROWS: usize = 64;
/// Rows copied in one transaction: the new file's log stays short.
const STEP_ROWS: usize = 2_000;

/// Counts of the copied rows, and the state.
#[derive(Debug, Default)]
pub(super) struct SalvageReport {
    pub(super) capacities: usize,
    pub(super) losses: usize,
    pub(super) lives: usize,
    pub(super) models: usize,
    pub(super) alarms: usize,
    pub(super) resets: usize,
    pub(super) half_cycles: usize,
    /// Rows that the damage has changed or made unreadable.
    pub(super) refused: usize,
    pub(super) state: Option<StateDocument>,
}

impl fmt::Display for SalvageReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { capacities, losses, lives, models, alarms, resets, half_cycles, refused, state } = self;
        let state = if state.is_some() { "with" } else { "without" };
        write!(
            f,
            "copied: {capacities} capacities, {losses} loss modes, {lives} remaining lives, {models} models, \
             {alarms} alarms, {resets} resets, {half_cycles} half-cycles, {state} its state; rejected: {refused}"
        )
    }
}

impl SalvageReport {
    fn count(&mut self, table: HistoryTable) {
        *match table {
            HistoryTable::HalfCycle => &mut self.half_cycles,
            HistoryTable::Capacity => &mut self.capacities,
            HistoryTable::LossModes => &mut self.losses,
            HistoryTable::RemainingLife => &mut self.lives,
            HistoryTable::Model => &mut self.models,
            HistoryTable::Alarm => &mut self.alarms,
            HistoryTable::Reset => &mut self.resets,
        } += 1;
    }
}

/// Copies the good rows into a new database that is not used before this returns. `pages`: a name for a temporary database.
///
/// # Errors
/// When a new database cannot be written.
pub(super) fn salvage(damaged: &Path, pages: &Path, database: &mut Database) -> rusqlite::Result<SalvageReport> {
    let Carved { connection: old, lost, state } = carve(damaged, pages)?;
    let packs = read_packs(&old)?;
    let (connection, meta) = database.parts_mut();
    let saved = SalvageReport { state, refused: lost, ..SalvageReport::default() };
    let count = i64::try_from(packs.len()).unwrap_or(1).max(1);
    let mut copier =
        Copier { old: &old, connection, meta, moment: None, before: Some((0, [0; 32])), packs: count, saved };
    let mut sources = HistoryTable::ALL.map(TableSource::new);
    connection.execute_batch("BEGIN IMMEDIATE")?;
    let mut rows = 0_usize;
    while let Some((table, row)) = next(&old, &mut sources)? {
        copier.copy_checked(table, &row)?;
        rows += 1;
        if rows.is_multiple_of(STEP_ROWS) {
            connection.execute_batch("COMMIT; BEGIN IMMEDIATE")?;
        }
    }
    copier.copy_packs(&packs)?;
    let Copier { packs, saved, .. } = copier;
    meta.pack = packs;
    meta.write(connection)?;
    connection.execute_batch("COMMIT")?;
    Ok(saved)
}

/// A row of the table `pack`.
struct PackRow {
    id: i64,
    opened_ns: i64,
    closed_ns: Option<i64>,
    reason: Option<String>,
    identity: Option<String>,
}

/// The rows of `pack`.
fn read_packs(old: &Connection) -> rusqlite::Result<Vec<PackRow>> {
    let mut statement = old.prepare("SELECT id, opened_ns, closed_ns, reason, identity FROM pack ORDER BY id")?;
    let packs = statement.query_map([], |row: &Row<'_>| {
        let (id, opened_ns, closed_ns) = (row.get(0)?, row.get(1)?, row.get(2)?);
        Ok(PackRow { id, opened_ns, closed_ns, reason: row.get(3)?, identity: row.get(4)? })
    })?;
    packs.collect()
}

/// The key of a row in its table: its number; of a half-cycle its moment and its cell.
type RowKey = (i64, i64);

/// A row of the damaged file.
struct SalvagedRow {
    key: RowKey,
    hash: Option<Hash>,
    /// Empty when its moment is lost.
    moment: Vec<Value>,
    values: Vec<Value>,
}

/// One table's rows in order.
struct TableSource {
    table: HistoryTable,
    page: VecDeque<SalvagedRow>,
    /// The key at which reading continues.
    from: RowKey,
    is_read: bool,
}

impl TableSource {
    const fn new(table: HistoryTable) -> Self {
        Self { table, page: VecDeque::new(), from: (i64::MIN, i64::MIN), is_read: false }
    }

    /// Reads the next rows when there are none in memory.
    fn fill(&mut self, old: &Connection) -> rusqlite::Result<()> {
        if !self.page.is_empty() || self.is_read {
            return Ok(());
        }
        let (which, bound): (&str, &[i64]) = match self.table {
            HistoryTable::HalfCycle => {
                ("WHERE (r.moment, r.cell) >= (?1, ?2) ORDER BY r.moment, r.cell", &[self.from.0, self.from.1])
            }
            _ => ("WHERE r.seq >= ?1 ORDER BY r.seq", &[self.from.0]),
        };
        let sql = rows_sql(self.table, &format!("{which} LIMIT {PAGE_ROWS}"));
        let mut statement = old.prepare_cached(&sql)?;
        let mut rows = statement.query(rusqlite::params_from_iter(bound))?;
        while let Some(row) = rows.next()? {
            let key = key_of(self.table, row)?;
            self.page.push_back(found(self.table, key, row));
            let after = match self.table {
                HistoryTable::HalfCycle => key.1.checked_add(1).map(|cell| (key.0, cell)),
                _ => key.0.checked_add(1).map(|seq| (seq, key.1)),
            };
            // No row follows the greatest key.
            self.is_read = after.is_none();
            self.from = after.unwrap_or(self.from);
        }
        self.is_read |= self.page.len() < PAGE_ROWS;
        Ok(())
    }
}

fn key_of(table: HistoryTable, row: &Row<'_>) -> rusqlite::Result<RowKey> {
    Ok((row.get(0)?, if table == HistoryTable::HalfCycle { row.get(1)? } else { 0 }))
}

fn found(table: HistoryTable, key: RowKey, row: &Row<'_>) -> SalvagedRow {
    let values = |from: usize, count: usize| -> Vec<Value> {
        (from..from + count).map(|index| row.get(index)).collect::<rusqlite::Result<_>>().unwrap_or_default()
    };
    let columns = table.columns().len();
    let (moment, values) = (values(2, MOMENT_COLUMNS), values(2 + MOMENT_COLUMNS, columns));
    let hash = if table == HistoryTable::HalfCycle { None } else { row.get(1).ok() };
    SalvagedRow { key, hash, moment, values }
}

/// The next row: chained rows in the order of their numbers, half-cycles with the rows of their moment.
fn next(old: &Connection, sources: &mut [TableSource]) -> rusqlite::Result<Option<(HistoryTable, SalvagedRow)>> {
    sources.iter_mut().try_for_each(|source| source.fill(old))?;
    let heads = || sources.iter().enumerate().filter_map(|(at, source)| Some((source.page.front()?, source.table, at)));
    let chained = heads().filter(|(_, table, _)| *table != HistoryTable::HalfCycle).min_by_key(|(row, ..)| row.key);
    let half_cycle = heads().find(|(_, table, _)| *table == HistoryTable::HalfCycle);
    let at = match (half_cycle, chained) {
        (Some((row, _, at)), Some((other, _, later))) => {
            let moment = if let Some(Value::Integer(moment)) = other.moment.first() { *moment } else { i64::MIN };
            if row.key.0 <= moment { at } else { later }
        }
        (Some((.., at)), None) | (None, Some((.., at))) => at,
        (None, None) => return Ok(None),
    };
    let source = &mut sources[at];
    Ok(source.page.pop_front().map(|row| (source.table, row)))
}

/// Writes the new file.
struct Copier<'a> {
    /// The rows that were found.
    old: &'a Connection,
    connection: &'a Connection,
    meta: &'a mut Meta,
    /// The last moment: its number in the old file, its values in the new one.
    moment: Option<(i64, Vec<Value>)>,
    /// Number and hash of the old chain's last row.
    before: Option<(i64, Hash)>,
    /// Number of packs.
    packs: i64,
    saved: SalvageReport,
}

impl Copier<'_> {
    fn copy_checked(&mut self, table: HistoryTable, row: &SalvagedRow) -> rusqlite::Result<()> {
        match self.check(table, row)? {
            Some(is_verified) if self.copy(table, row, is_verified)? => self.saved.count(table),
            _ => self.saved.refused += 1,
        }
        Ok(())
    }

    /// Whether the row's hash is good, or not to be checked: it has none, or the row before it is lost. `None` = the damage has
    /// changed the row.
    fn check(&mut self, table: HistoryTable, row: &SalvagedRow) -> rusqlite::Result<Option<bool>> {
        if table == HistoryTable::HalfCycle {
            return Ok(Some(false));
        }
        let Some(hash) = row.hash else { return Ok(None) };
        let seq = row.key.0;
        let chained: Vec<Value> = row.moment.iter().chain(&row.values).cloned().collect();
        let is_linked = |before: &Hash| chain::link(before, table, seq, &chained) == hash;
        let is_verified = match self.before {
            Some((before, _)) if seq <= before => return Ok(None),
            Some((before, before_hash)) if seq - 1 == before => is_linked(&before_hash).then_some(true),
            // The hash of a row that was thinned out may be damaged itself.
            _ => Some(self.thinned_hash(seq - 1)?.is_some_and(|before_hash| is_linked(&before_hash))),
        };
        self.before = Some((seq, hash));
        Ok(is_verified)
    }

    /// The hash of the last row of a run that was thinned out.
    fn thinned_hash(&self, seq: i64) -> rusqlite::Result<Option<Hash>> {
        let mut statement =
            self.old.prepare_cached("SELECT hash FROM thinned WHERE last = ?1 AND length(hash) = 32")?;
        statement.query_row([seq], |row| row.get(0)).optional()
    }

    /// Copies a row with its moment; `false` = the moment is lost, or the row breaks a rule of the layout.
    fn copy(&mut self, table: HistoryTable, row: &SalvagedRow, is_verified: bool) -> rusqlite::Result<bool> {
        let Some((id, stamp, pack)) = moment_of(&row.moment) else { return Ok(false) };
        if is_verified {
            let replaces = table == HistoryTable::Reset && row.values.iter().any(is_replacement);
            self.packs = self.packs.max(pack + i64::from(replaces));
        } else if !(1..=self.packs).contains(&pack) {
            return Ok(false);
        }
        let moment = match self.moment.take().filter(|(last, _)| *last == id) {
            Some((_, moment)) => moment,
            None => write_moment(self.connection, &stamp, pack)?,
        };
        let before = *self.meta;
        let written = write_row(self.connection, self.meta, table, &moment, &row.values);
        self.moment = Some((id, moment));
        match written {
            Ok(()) => Ok(true),
            Err(error) if error.sqlite_error_code() == Some(rusqlite::ErrorCode::ConstraintViolation) => {
                *self.meta = before;
                Ok(false)
            }
            Err(error) => Err(error),
        }
    }

    /// Writes a row for every pack, unchanged where it can be read.
    fn copy_packs(&self, packs: &[PackRow]) -> rusqlite::Result<()> {
        for PackRow { id, opened_ns, closed_ns, reason, identity } in packs.iter().filter(|pack| self.is_pack(pack.id))
        {
            self.connection.execute(
                "INSERT OR REPLACE INTO pack (id, opened_ns, closed_ns, reason, identity) VALUES (?1, ?2, ?3, ?4, ?5)",
                params![id, opened_ns, closed_ns, reason, identity],
            )?;
        }
        for id in 1..=self.packs {
            self.connection
                .execute("INSERT OR IGNORE INTO pack (id, opened_ns, reason) VALUES (?1, 0, 'salvaged')", [id])?;
        }
        Ok(())
    }

    fn is_pack(&self, id: i64) -> bool {
        (1..=self.packs).contains(&id)
    }
}

fn is_replacement(value: &Value) -> bool {
    matches!(value, Value::Text(word) if word == "pack_replaced")
}

/// Number, stamp and pack of a moment, if all are present.
fn moment_of(values: &[Value]) -> Option<(i64, Stamp, i64)> {
    let [
        Value::Integer(id),
        Value::Integer(wall_ns),
        Value::Integer(time),
        Value::Integer(boottime_ns),
        Value::Blob(boot),
        Value::Integer(pack),
    ] = values
    else {
        return None;
    };
    let boot = BootId(<[u8; 16]>::try_from(boot.as_slice()).ok()?);
    let time = Timestamp::from_nanos(*time);
    Some((*id, Stamp { wall_ns: *wall_ns, time, boottime_ns: *boottime_ns, boot }, *pack))
}

#[cfg(test)]
mod tests;
