//! What can still be read of a damaged database.
//!
//! Rows are copied from the front up to where reading fails and from the back down to there, a few at a time: a history
//! of any length needs the same memory. A chained row whose hash does not fit its own contents was changed by the damage:
//! it is not taken over, and counted. The copies get numbers and hashes of the new chain.
//!
//! How many packs there were is known from rows whose hash is good and from the number of rows in `pack`; a row without
//! proof that names another pack is refused.

use std::collections::VecDeque;
use std::fmt;
use std::path::Path;

use rusqlite::types::Value;
use rusqlite::{Connection, OpenFlags, Row, params};

use super::chain::{self, Hash};
use super::database::{self, Database, Meta};
use super::document::Document;
use super::rows::Table;
use super::stamp::{BootId, Stamp};
use crate::quantity::Timestamp;

/// Rows of a table in memory at once.
const PAGE_ROWS: usize = 64;
/// Rows copied in one transaction: the new file's log stays short.
const STEP_ROWS: usize = 2_000;

/// What was taken over.
#[derive(Debug, Default)]
pub(super) struct Saved {
    pub(super) capacities: usize,
    pub(super) lives: usize,
    pub(super) alarms: usize,
    pub(super) resets: usize,
    pub(super) half_cycles: usize,
    /// Rows that the damage has changed.
    pub(super) refused: usize,
    pub(super) state: Option<Document>,
}

impl fmt::Display for Saved {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { capacities, lives, alarms, resets, half_cycles, refused, state } = self;
        let state = if state.is_some() { "with" } else { "without" };
        write!(
            f,
            "taken over: {capacities} capacities, {lives} remaining lives, {alarms} alarms, {resets} resets, {half_cycles} \
             half-cycles, {state} its state; refused: {refused}"
        )
    }
}

impl Saved {
    fn count(&mut self, table: Table) {
        *match table {
            Table::HalfCycle => &mut self.half_cycles,
            Table::Capacity => &mut self.capacities,
            Table::RemainingLife => &mut self.lives,
            Table::Alarm => &mut self.alarms,
            Table::Reset => &mut self.resets,
        } += 1;
    }
}

/// Copies what is good into a database that is new and that nobody uses before this has returned.
///
/// # Errors
/// When the new one cannot be written.
pub(super) fn salvage(damaged: &Path, database: &mut Database) -> rusqlite::Result<Saved> {
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let Ok(old) = Connection::open_with_flags(damaged, flags) else { return Ok(Saved::default()) };
    let packs = read_packs(&old);
    let (connection, ledger) = database.parts_mut();
    let saved = Saved { state: database::read_document(&old, database::STATE), ..Saved::default() };
    let count = i64::try_from(packs.len()).unwrap_or(1).max(1);
    let mut copier = Copier { connection, ledger, moment: None, before: Some((0, [0; 32])), packs: count, saved };
    let mut sources = Table::ALL.map(|table| Source::new(&old, table));
    connection.execute_batch("BEGIN IMMEDIATE")?;
    let mut rows = 0_usize;
    while let Some((table, row)) = next(&old, &mut sources) {
        copier.take(table, &row)?;
        rows += 1;
        if rows.is_multiple_of(STEP_ROWS) {
            connection.execute_batch("COMMIT; BEGIN IMMEDIATE")?;
        }
    }
    copier.copy_packs(&packs)?;
    let Copier { packs, saved, .. } = copier;
    ledger.pack = packs;
    database::write_meta(connection, ledger)?;
    connection.execute_batch("COMMIT")?;
    Ok(saved)
}

/// A row of the table `pack`.
struct Pack {
    id: i64,
    opened_ns: i64,
    closed_ns: Option<i64>,
    reason: Option<String>,
    identity: Option<String>,
}

/// Those that can be read.
fn read_packs(old: &Connection) -> Vec<Pack> {
    let Ok(mut statement) = old.prepare("SELECT id, opened_ns, closed_ns, reason, identity FROM pack ORDER BY id")
    else {
        return Vec::new();
    };
    let of = |row: &Row<'_>| {
        let (id, opened_ns, closed_ns) = (row.get(0)?, row.get(1)?, row.get(2)?);
        Ok(Pack { id, opened_ns, closed_ns, reason: row.get(3)?, identity: row.get(4)? })
    };
    statement.query_map([], of).map(|packs| packs.filter_map(Result::ok).collect()).unwrap_or_default()
}

/// Where a row stands in its table: its number; of a half-cycle its moment and its cell.
type Key = (i64, i64);

/// A row read from the damaged file.
struct Found {
    key: Key,
    hash: Option<Hash>,
    /// Both empty when something in them has no meaning.
    moment: Vec<Value>,
    values: Vec<Value>,
}

/// One table's rows in order.
struct Source {
    table: Table,
    page: VecDeque<Found>,
    /// Where reading goes on. A search for the key before it could end in a damaged page.
    from: Key,
    /// The key of the table's last row: none is beyond it.
    end: Key,
    phase: Phase,
}

/// How far the reading of a table is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// From the front.
    Front,
    /// Behind the damage.
    Back,
    Done,
}

impl Source {
    fn new(old: &Connection, table: Table) -> Self {
        let mut source = Self {
            table,
            page: VecDeque::new(),
            from: (i64::MIN, i64::MIN),
            end: (i64::MAX, i64::MAX),
            phase: Phase::Front,
        };
        source.end = source.back_keys(old, Some(1)).unwrap_or(source.end);
        source
    }

    /// Reads on when nothing is left.
    fn fill(&mut self, old: &Connection) {
        while self.page.is_empty() && self.phase != Phase::Done {
            match (self.read_page(old), self.phase) {
                (Ok(PAGE_ROWS), _) => {}
                (Err(_), Phase::Front) => {
                    self.phase = Phase::Back;
                    self.from = self.back_keys(old, None).unwrap_or((i64::MAX, i64::MAX));
                }
                _ => self.phase = Phase::Done,
            }
        }
    }

    /// The next rows; how many. What was read before an error is in the page.
    fn read_page(&mut self, old: &Connection) -> rusqlite::Result<usize> {
        let (which, bound): (&str, &[i64]) = match self.table {
            Table::HalfCycle => {
                ("WHERE (r.moment, r.cell) >= (?1, ?2) ORDER BY r.moment, r.cell", &[self.from.0, self.from.1])
            }
            _ => ("WHERE r.seq >= ?1 ORDER BY r.seq", &[self.from.0]),
        };
        let sql = database::rows_sql(self.table, &format!("{which} LIMIT {PAGE_ROWS}"));
        let mut statement = old.prepare_cached(&sql)?;
        let mut rows = statement.query(rusqlite::params_from_iter(bound))?;
        let mut count = 0;
        while let Some(row) = rows.next()? {
            let key = key_of(self.table, row)?;
            if key < self.from || key > self.end {
                // Out of order: reading on from there would go round, or past all that follows.
                return Err(rusqlite::Error::QueryReturnedMoreThanOneRow);
            }
            self.from = match self.table {
                Table::HalfCycle => (key.0, key.1.saturating_add(1)),
                _ => (key.0.saturating_add(1), key.1),
            };
            self.page.push_back(found(self.table, key, row));
            count += 1;
        }
        Ok(count)
    }

    /// The lowest key that can be reached from the back in so many rows; `None` = not even the last.
    fn back_keys(&self, old: &Connection, rows: Option<usize>) -> Option<Key> {
        let order = match self.table {
            Table::HalfCycle => "ORDER BY r.moment DESC, r.cell DESC",
            _ => "ORDER BY r.seq DESC",
        };
        let mut statement = old.prepare(&database::rows_sql(self.table, order)).ok()?;
        let mut found = statement.query([]).ok()?;
        let mut lowest = None;
        for _ in 0..rows.unwrap_or(usize::MAX) {
            let Ok(Some(row)) = found.next() else { break };
            match key_of(self.table, row) {
                Ok(key) if lowest.is_none_or(|lowest| key < lowest) && key >= self.from => lowest = Some(key),
                _ => break,
            }
        }
        lowest
    }
}

fn key_of(table: Table, row: &Row<'_>) -> rusqlite::Result<Key> {
    Ok((row.get(0)?, if table == Table::HalfCycle { row.get(1)? } else { 0 }))
}

fn found(table: Table, key: Key, row: &Row<'_>) -> Found {
    let values = |from: usize, count: usize| -> Vec<Value> {
        (from..from + count).map(|index| row.get(index)).collect::<rusqlite::Result<_>>().unwrap_or_default()
    };
    let columns = table.columns().len();
    let (moment, values) = (values(2, database::MOMENT_COLUMNS), values(2 + database::MOMENT_COLUMNS, columns));
    let hash = if table == Table::HalfCycle { None } else { row.get(1).ok() };
    Found { key, hash, moment, values }
}

/// The next row: of the chain by its number, of the half-cycles with the rows of its moment.
fn next(old: &Connection, sources: &mut [Source]) -> Option<(Table, Found)> {
    sources.iter_mut().for_each(|source| source.fill(old));
    let heads = || sources.iter().enumerate().filter_map(|(at, source)| Some((source.page.front()?, source.table, at)));
    let chained = heads().filter(|(_, table, _)| *table != Table::HalfCycle).min_by_key(|(row, ..)| row.key);
    let half_cycle = heads().find(|(_, table, _)| *table == Table::HalfCycle);
    let at = match (half_cycle, chained) {
        (Some((row, _, at)), Some((other, _, later))) => {
            let moment = if let Some(Value::Integer(moment)) = other.moment.first() { *moment } else { i64::MIN };
            if row.key.0 <= moment { at } else { later }
        }
        (Some((.., at)), None) | (None, Some((.., at))) => at,
        (None, None) => return None,
    };
    let source = sources.get_mut(at)?;
    source.page.pop_front().map(|row| (source.table, row))
}

/// What speaks for a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Proof {
    /// Its hash.
    Proven,
    /// Nothing, and nothing against it: it has no hash, or the row before it is lost.
    Believed,
    /// The damage has changed it.
    Refused,
}

/// The side of the new file.
struct Copier<'a> {
    connection: &'a Connection,
    ledger: &'a mut Meta,
    /// The last moment: its number in the old file, its values in the new one.
    moment: Option<(i64, Vec<Value>)>,
    /// Number and hash of the old chain's last row.
    before: Option<(i64, Hash)>,
    /// Packs there were.
    packs: i64,
    saved: Saved,
}

impl Copier<'_> {
    fn take(&mut self, table: Table, row: &Found) -> rusqlite::Result<()> {
        let proof = self.prove(table, row);
        if proof != Proof::Refused && self.copy(table, row, proof)? {
            self.saved.count(table);
        } else {
            self.saved.refused += 1;
        }
        Ok(())
    }

    fn prove(&mut self, table: Table, row: &Found) -> Proof {
        if table == Table::HalfCycle {
            return Proof::Believed;
        }
        let (seq, Some(hash)) = (row.key.0, row.hash) else { return Proof::Refused };
        let proof = match self.before {
            Some((before, _)) if seq <= before => return Proof::Refused,
            Some((before, before_hash)) if seq - 1 == before => {
                let chained: Vec<Value> = row.moment.iter().chain(&row.values).cloned().collect();
                if chain::link(&before_hash, table, seq, &chained) == hash { Proof::Proven } else { Proof::Refused }
            }
            _ => Proof::Believed,
        };
        self.before = Some((seq, hash));
        proof
    }

    /// Copies a row with its moment; false when the moment is lost or the row breaks a rule of the layout.
    fn copy(&mut self, table: Table, row: &Found, proof: Proof) -> rusqlite::Result<bool> {
        let Some((id, stamp, pack)) = moment_of(&row.moment) else { return Ok(false) };
        if proof == Proof::Proven {
            let replaces = table == Table::Reset && row.values.iter().any(is_replacement);
            self.packs = self.packs.max(pack + i64::from(replaces));
        } else if !(1..=self.packs).contains(&pack) {
            return Ok(false);
        }
        let moment = match self.moment.take().filter(|(last, _)| *last == id) {
            Some((_, moment)) => moment,
            None => database::write_moment(self.connection, &stamp, pack)?,
        };
        let before = *self.ledger;
        let written = database::write_row(self.connection, self.ledger, table, &moment, &row.values);
        self.moment = Some((id, moment));
        match written {
            Ok(()) => Ok(true),
            Err(error) if error.sqlite_error_code() == Some(rusqlite::ErrorCode::ConstraintViolation) => {
                *self.ledger = before;
                Ok(false)
            }
            Err(error) => Err(error),
        }
    }

    /// Every pack gets its row, as it was where that can be read.
    fn copy_packs(&self, packs: &[Pack]) -> rusqlite::Result<()> {
        for Pack { id, opened_ns, closed_ns, reason, identity } in packs.iter().filter(|pack| self.is_pack(pack.id)) {
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

/// Number, stamp and pack of a moment, if all are there.
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
