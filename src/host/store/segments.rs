//! Divides the history into segments, chains the rows by hash, and verifies the chain. A segment contains the rows of a
//! day, but at most about 10,000 rows.
//!
//! Every row has a number, counted across the tables, and a check code: the first eight bytes of its SHA-256 hash.
//! The code reveals a changed row when it is read. The hash of a segment is a chain over its rows, which starts from
//! the hash of the previous segment. The chain reveals rows that were changed, removed, inserted or moved. The number
//! of segments is stored separately, to reveal missing segments at the end. The oldest segments are deleted as a
//! whole but keep their hashes, so the remaining segments can still be verified.
//!
//! A person who can write the file can recompute the whole chain. A copy of the chain's end that is kept elsewhere
//! reveals a recomputed chain ([`contradiction`]).

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use rusqlite::types::{Value, ValueRef};
use rusqlite::{Connection, OptionalExtension, Row, params};
use serde::Serialize;
use sha2::{Digest, Sha256};

use super::backlog;
use super::database::is_damage;
use super::rows::HistoryTable;
use super::stamp::{BootId, SANE_WALL_NS, Stamp};

pub(super) type Hash = [u8; 32];

pub(super) const NS_PER_DAY: i64 = 86_400_000_000_000;
/// Number of rows after which a segment ends. The batch that reaches this number is still added to the segment.
/// Deleting this many rows takes about 0.1 s.
const MAX_ROWS: i64 = 10_000;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Segment {
    /// Number of the segment, from 1; 0 = the start before the first segment.
    pub id: i64,
    /// Day on the wall clock, counted from 1970-01-01.
    pub day: i64,
    pub first: i64,
    pub last: i64,
    /// Number of the moment (row of the table `moment`) at which the last row was written.
    pub last_moment: i64,
    pub half_cycles: i64,
    /// Whether the rows were deleted because of the limits on rows and age.
    pub is_deleted: bool,
    pub hash: Hash,
}

/// Columns of a segment, in the order of [`Segment::of_row`].
const COLUMNS: &str = "id, day, first, last, last_moment, half_cycles, deleted, hash";

impl Segment {
    /// The predecessor of the first segment.
    const START: Self =
        Self { id: 0, day: 0, first: 1, last: 0, last_moment: 0, half_cycles: 0, is_deleted: false, hash: [0; 32] };

    fn of_row(row: &Row<'_>) -> rusqlite::Result<Self> {
        Ok(Self {
            id: row.get(0)?,
            day: row.get(1)?,
            first: row.get(2)?,
            last: row.get(3)?,
            last_moment: row.get(4)?,
            half_cycles: row.get(5)?,
            is_deleted: row.get(6)?,
            hash: row.get(7)?,
        })
    }

    pub(super) fn newest(connection: &Connection) -> rusqlite::Result<Self> {
        let sql = format!("SELECT {COLUMNS} FROM segment ORDER BY id DESC LIMIT 1");
        Ok(connection.query_row(&sql, [], Self::of_row).optional()?.unwrap_or(Self::START))
    }

    /// Returns the segment for rows of the moment `stamp`: this segment, or a new one after it.
    pub(super) fn at(self, connection: &Connection, stamp: &Stamp) -> rusqlite::Result<Self> {
        let day = stamp.wall_ns.div_euclid(NS_PER_DAY);
        if self.id > 0 && self.day == day && self.last.saturating_sub(self.first) < MAX_ROWS - 1 {
            return Ok(self);
        }
        let next = Self {
            id: self.id.saturating_add(1),
            day,
            first: self.last.saturating_add(1),
            half_cycles: 0,
            is_deleted: false,
            ..self
        };
        connection.execute("UPDATE meta SET segments = ?1", [next.id])?;
        Ok(next)
    }

    pub(super) fn write_row(
        &mut self,
        connection: &Connection,
        table: HistoryTable,
        moment: &[Value],
        values: &[Value],
    ) -> rusqlite::Result<()> {
        self.last = self.last.saturating_add(1);
        let hash = row_hash(table, self.last, moment.iter().chain(values).map(ValueRef::from));
        let code = check_code(&hash);
        self.hash = link(&self.hash, &hash, code);
        self.half_cycles = self.half_cycles.saturating_add((table == HistoryTable::HalfCycle).into());
        let places: String = (0..values.len()).map(|_| ", ?").collect();
        let sql = format!(
            "INSERT INTO {} (seq, code, moment, {}) VALUES (?, ?, ?{places})",
            table.name(),
            table.columns().join(", ")
        );
        let own = [Value::Integer(self.last), Value::Integer(code)];
        let bound = own.iter().chain(moment.first()).chain(values);
        connection.prepare_cached(&sql)?.execute(rusqlite::params_from_iter(bound)).map(drop)
    }

    pub(super) fn write(&self, connection: &Connection) -> rusqlite::Result<()> {
        let Self { id, day, first, last, last_moment, half_cycles, is_deleted, hash } = self;
        connection
            .prepare_cached(&format!("INSERT OR REPLACE INTO segment ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)"))?
            .execute(params![id, day, first, last, last_moment, half_cycles, is_deleted, hash])
            .map(drop)
    }

    /// Computes the hash of the chain at row `last` from the stored rows. `before`: hash of the chain before the
    /// segment.
    fn hash_to(&self, connection: &Connection, before: &Hash, last: i64) -> rusqlite::Result<Hash> {
        let mut rows: BTreeMap<(i64, HistoryTable), (Hash, i64)> = BTreeMap::new();
        // Limit `last`, so that a damaged value cannot fill the memory with rows.
        let last = last.min(self.first.saturating_add(MAX_ROWS + backlog::MAX_ROWS as i64));
        for table in HistoryTable::ALL {
            let sql = format!("{} WHERE r.seq BETWEEN ?1 AND ?2", StoredRow::select(table));
            let mut statement = connection.prepare_cached(&sql)?;
            let mut found = statement.query([self.first, last])?;
            while let Some(row) = found.next()? {
                let StoredRow { seq, hash, code } = StoredRow::read(table, row)?;
                rows.insert((seq, table), (hash, code));
            }
        }
        Ok(rows.values().fold(*before, |chain, (hash, code)| link(&chain, hash, *code)))
    }
}

/// Number, hash and check code of a stored row.
pub(super) struct StoredRow {
    pub seq: i64,
    hash: Hash,
    code: i64,
}

impl StoredRow {
    /// Number of columns of [`StoredRow::select`] before the table's own columns.
    pub(super) const COLUMNS: usize = 7;

    /// Selects number, check code, moment (number, wall clock, clock of the inputs, boot, pack) and the table's columns.
    pub(super) fn select(table: HistoryTable) -> String {
        format!(
            "SELECT r.seq, r.code, m.id, m.wall_ns, m.time_ns, m.boot, m.pack, r.{} FROM {} r LEFT JOIN moment m ON m.id = r.moment",
            table.columns().join(", r."),
            table.name()
        )
    }

    /// Computes the hash of a selected row. A value of a wrong type changes the hash, but is not an error.
    pub(super) fn read(table: HistoryTable, row: &Row<'_>) -> rusqlite::Result<Self> {
        let seq = row.get(0)?;
        let values = (2..Self::COLUMNS + table.columns().len()).map(|index| row.get_ref(index));
        let hash = row_hash(table, seq, values.collect::<rusqlite::Result<Vec<_>>>()?);
        Ok(Self { seq, hash, code: row.get_ref(1)?.as_i64().unwrap_or(0) })
    }

    /// Whether the row is as it was written.
    pub(super) fn is_intact(&self) -> bool {
        self.code == check_code(&self.hash)
    }
}

/// Computes the hash of a row from the table, the number, and every value with its type and length.
fn row_hash<'v>(table: HistoryTable, seq: i64, values: impl IntoIterator<Item = ValueRef<'v>>) -> Hash {
    let mut hasher = Sha256::new();
    hasher.update(table.name().as_bytes());
    hasher.update([0]);
    hasher.update(seq.to_le_bytes());
    for value in values {
        match value {
            ValueRef::Null => hasher.update([0]),
            ValueRef::Integer(whole) => {
                hasher.update([1]);
                hasher.update(whole.to_le_bytes());
            }
            ValueRef::Real(real) => {
                hasher.update([2]);
                hasher.update(real.to_bits().to_le_bytes());
            }
            ValueRef::Text(text) => update_bytes(&mut hasher, 3, text),
            ValueRef::Blob(blob) => update_bytes(&mut hasher, 4, blob),
        }
    }
    hasher.finalize().into()
}

fn check_code(hash: &Hash) -> i64 {
    let [a, b, c, d, e, f, g, h, ..] = *hash;
    i64::from_le_bytes([a, b, c, d, e, f, g, h])
}

/// Appends a row to the chain. The stored code is part of the chain, so a changed code breaks it.
fn link(before: &Hash, row: &Hash, code: i64) -> Hash {
    Sha256::new().chain_update(before).chain_update(row).chain_update(code.to_le_bytes()).finalize().into()
}

fn update_bytes(hasher: &mut Sha256, tag: u8, bytes: &[u8]) {
    hasher.update([tag]);
    hasher.update((bytes.len() as u64).to_le_bytes());
    hasher.update(bytes);
}

pub(super) fn hex(hash: &[u8]) -> String {
    hash.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns all segments, oldest first, each together with the segment before it.
fn pairs(connection: &Connection) -> rusqlite::Result<Vec<(Segment, Segment)>> {
    let (mut before, mut pairs) = (Segment::START, Vec::new());
    let mut statement = connection.prepare(&format!("SELECT {COLUMNS} FROM segment ORDER BY id"))?;
    for segment in statement.query_map([], Segment::of_row)? {
        // If a value has a wrong type, use a segment that breaks the chain.
        let next = before.last.saturating_add(1);
        let damaged = Segment { id: before.id.saturating_add(1), first: next, last: next, ..Segment::START };
        let segment = segment.or_else(|error| if is_damage(&error) { Ok(damaged) } else { Err(error) })?;
        pairs.push((before, segment));
        before = segment;
    }
    Ok(pairs)
}

/// If the history has more than `max_rows` rows, or if any segment except the newest ended before `horizon_ns`, deletes
/// the rows of the oldest segment that still has rows. A segment that was written with an unset wall clock is not
/// compared with `horizon_ns`. It is deleted when a later segment ended before `horizon_ns`.
pub(super) fn delete_oldest(
    connection: &Connection,
    newest: &Segment,
    max_rows: i64,
    horizon_ns: Option<i64>,
) -> rusqlite::Result<()> {
    let sql = format!("SELECT {COLUMNS} FROM segment WHERE NOT deleted AND id < ?1 ORDER BY id LIMIT 1");
    let Some(oldest) = connection.prepare_cached(&sql)?.query_row([newest.id], Segment::of_row).optional()? else {
        return Ok(());
    };
    let is_old = |horizon_ns: i64| {
        connection
            .prepare_cached(
                "SELECT 1 FROM segment s JOIN moment m ON m.id = s.last_moment WHERE NOT s.deleted AND s.id < ?1 AND m.wall_ns < ?2 \
                 AND (m.wall_ns >= ?3 OR m.boot = ?4)",
            )?
            .exists(params![newest.id, horizon_ns, SANE_WALL_NS, BootId::REPLAY.0])
    };
    if newest.last.saturating_sub(oldest.first) < max_rows && !horizon_ns.map_or(Ok(false), is_old)? {
        return Ok(());
    }
    for table in HistoryTable::ALL {
        connection.execute(&format!("DELETE FROM {} WHERE seq <= ?1", table.name()), [oldest.last])?;
    }
    connection.execute("DELETE FROM moment WHERE id <= ?1", [oldest.last_moment])?;
    Segment { is_deleted: true, ..oldest }.write(connection)
}

/// The result of a verification.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ChainReport {
    /// Valid rows before the first broken segment.
    pub good_rows: i64,
    /// Rows ever written.
    pub rows: i64,
    /// Rows that the store has deleted.
    pub deleted_rows: i64,
    /// Hash of the last row. Users can keep this hash elsewhere and compare it later.
    pub head: String,
    /// The first broken segment; `None` = the chain is intact.
    pub broken: Option<BrokenSegment>,
}

/// A segment with changed, missing or inserted rows, or with a wrong number.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BrokenSegment {
    /// Number of the segment.
    pub segment: i64,
    /// Numbers of the first and last row of the segment.
    pub rows: [i64; 2],
    /// What the verification expects: a hash, or numbers of segments and rows.
    pub expected: String,
    /// What the store contains instead.
    pub found: String,
}

impl fmt::Display for BrokenSegment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { segment, rows: [first, last], .. } = self;
        write!(f, "rows {first} to {last} (segment {segment}) were changed")
    }
}

pub(super) fn verify(connection: &Connection) -> rusqlite::Result<ChainReport> {
    let noted =
        connection.query_row("SELECT segments FROM meta", [], |row| Ok(row.get_ref(0)?.as_i64().unwrap_or(-1)))?;
    let mut report = ChainReport { good_rows: 0, rows: 0, deleted_rows: 0, head: String::new(), broken: None };
    let mut newest = Segment::START;
    for (before, segment) in pairs(connection)? {
        if report.broken.is_none() {
            report.broken = judge(connection, &before, &segment)?;
        }
        let rows = segment.last.saturating_sub(before.last);
        if segment.is_deleted {
            report.deleted_rows = report.deleted_rows.saturating_add(rows);
        } else if report.broken.is_none() {
            report.good_rows = report.good_rows.saturating_add(rows);
        }
        newest = segment;
    }
    (report.rows, report.head) = (newest.last, hex(&newest.hash));
    if report.broken.is_none() {
        report.broken = judge_number(connection, &newest, noted, report.good_rows)?;
    }
    Ok(report)
}

/// Returns the fault of the segment after `before`; `None` = the segment is valid.
fn judge(connection: &Connection, before: &Segment, segment: &Segment) -> rusqlite::Result<Option<BrokenSegment>> {
    let Segment { id, first, last, is_deleted, hash, .. } = *segment;
    let broken = |expected, found| Some(BrokenSegment { segment: id, rows: [first, last], expected, found });
    // Segments are deleted starting with the oldest.
    let [next, row] = [before.id, before.last].map(|number| number.saturating_add(1));
    if (id, first) != (next, row) || last < first || (is_deleted && !before.is_deleted && before.id > 0) {
        let expected = format!("segment {next} from row {row} on");
        let state = if is_deleted { ", deleted" } else { "" };
        return Ok(broken(expected, format!("segment {id} from row {first} to {last}{state}")));
    }
    if is_deleted {
        return Ok(None);
    }
    let expected = segment.hash_to(connection, &before.hash, last)?;
    Ok(if expected == hash { None } else { broken(hex(&expected), hex(&hash)) })
}

/// Compares the numbers of segments and rows that the chain should have with the numbers that the store contains.
fn judge_number(
    connection: &Connection,
    newest: &Segment,
    noted: i64,
    rows: i64,
) -> rusqlite::Result<Option<BrokenSegment>> {
    let counts: Vec<String> =
        HistoryTable::ALL.iter().map(|table| format!("(SELECT count(*) FROM {})", table.name())).collect();
    let stored: i64 = connection.query_row(&format!("SELECT {}", counts.join(" + ")), [], |row| row.get(0))?;
    let of = |segments: i64, rows: i64| format!("{segments} segments, {rows} rows");
    Ok((noted != newest.id || stored != rows).then(|| BrokenSegment {
        segment: newest.id.saturating_add(1),
        rows: [newest.last.saturating_add(1); 2],
        expected: of(noted, rows),
        found: of(newest.id, stored),
    }))
}

/// Returns the newest segments that have rows after row `after`: at most `limit` segments, oldest first. Damaged
/// segments are logged and left out.
pub(super) fn intact(connection: &Connection, after: i64, limit: usize) -> rusqlite::Result<Vec<Segment>> {
    let mut pairs = pairs(connection)?;
    pairs.retain(|(_, segment)| !segment.is_deleted && segment.last > after);
    let mut intact = Vec::new();
    for (before, segment) in &pairs[pairs.len().saturating_sub(limit)..] {
        match judge(connection, before, segment)? {
            None => intact.push(*segment),
            Some(broken) => tracing::error!("the history is damaged: {broken}; the start does not use them"),
        }
    }
    Ok(intact)
}

/// A chain's end that was noted elsewhere, written `ROWS:HASH`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NotedHead {
    /// Number of rows when the end was noted.
    pub rows: i64,
    /// Hash of the last row, 64 hexadecimal digits.
    pub hash: String,
}

impl FromStr for NotedHead {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once(':').and_then(|(rows, hash)| Some((rows.parse().ok()?, hash.to_ascii_lowercase())));
        let is_hash = |hash: &str| hash.len() == 64 && hash.bytes().all(|byte| byte.is_ascii_hexdigit());
        match parts {
            Some((rows, hash)) if rows >= 0 && is_hash(&hash) => Ok(Self { rows, hash }),
            _ => Err("must be ROWS:HASH, a number and 64 hexadecimal digits".to_owned()),
        }
    }
}

/// Returns why the history contradicts a noted chain end; `None` = no contradiction.
pub(super) fn contradiction(connection: &Connection, noted: &NotedHead) -> rusqlite::Result<Option<String>> {
    let NotedHead { rows, hash } = noted;
    let pairs = pairs(connection)?;
    let Some((before, segment)) = pairs.iter().find(|(_, segment)| (segment.first..=segment.last).contains(rows))
    else {
        return Ok((*rows != 0)
            .then(|| format!("the noted row {rows} does not exist: the history was rewritten or truncated")));
    };
    if segment.is_deleted && segment.last != *rows {
        return Ok(Some(format!("the noted row {rows} has been deleted and cannot be compared; note a newer end")));
    }
    let found = if segment.is_deleted { segment.hash } else { segment.hash_to(connection, &before.hash, *rows)? };
    let found = hex(&found);
    Ok((found != *hash)
        .then(|| format!("row {rows} has the hash {found}, noted was {hash}: the history was rewritten")))
}

#[cfg(test)]
mod tests;
