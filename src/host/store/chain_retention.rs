//! Thins the chained history beyond the configured number of rows N.
//!
//! | rows before the end | kept |
//! | --- | --- |
//! | up to N/2 | all |
//! | N/2 to N | one of 4 |
//! | N to 2 N | one of 16, and so on: a quarter of the part before |
//!
//! * The hash of a row decides whether it is kept: it must end in enough zero bits. Every cell loses the same part, and nothing has to be
//!   remembered.
//! * A row is deleted only between two others of its cell and pack in its table: no trend loses its ends. Of an alarm the first
//!   [`OCCURRENCES_KEPT`] occurrences are kept, as many changes of the cell model, of resets all but those of filters: so many more than
//!   N rows there may be.
//! * The chain stays verifiable: of every run of deleted rows the table `thinned` has the last row's hash, from which the next row's
//!   follows.
//!
//! It works at checkpoints, a little at a time, and only while there are more than N rows.

use rusqlite::types::Value;
use rusqlite::{Connection, OptionalExtension, params};

use super::chain::Hash;
use super::meta::Meta;
use super::retention::delete_unused_moment;
use super::rows::HistoryTable;

/// Rows looked at in one checkpoint.
const STEP_ROWS: i64 = 512;
/// Rows deleted in one checkpoint: more than a minute adds to a pack of 1,000 cells, in some 0.1 s.
const STEP_DELETED: i64 = 64;
/// Rows in one checkpoint that turn out to have no neighbour, which takes the longest search.
const STEP_ALONE: i64 = 4;
/// The factor of these three from an eighth above the limit on: where checkpoints are rare, or another limit was configured.
const HASTE: i64 = 8;
/// Rows of a table among which a neighbour is looked for: several for each cell of the largest pack.
const NEIGHBOUR_ROWS: u32 = 20_000;
/// Occurrences of an alarm, and changes of the cell model, that are kept.
const OCCURRENCES_KEPT: u32 = 100;
/// Least number of rows at the end of the chain that are never deleted: half of the least `store.max_chained_rows`.
pub(super) const LEAST_WHOLE: i64 = 5_000;

/// Goes through the tables, again and again while there are too many rows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct ChainSweep {
    /// Place of the table in [`HistoryTable::CHAINED`].
    table: usize,
    /// The last row looked at.
    seq: i64,
}

impl ChainSweep {
    /// Begins at a table and row that the number of rows decides: short runs of the daemon together reach all.
    pub(super) fn begin(rows: i64) -> Self {
        // Far apart for neighbouring numbers.
        let spread = rows.unsigned_abs().wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 1;
        let table = usize::try_from(spread % HistoryTable::CHAINED.len() as u64).unwrap_or(0);
        let seq = (spread >> 8).checked_rem(rows.unsigned_abs()).unwrap_or(0);
        Self { table, seq: i64::try_from(seq).unwrap_or(0) }
    }

    /// Deletes some rows if there are more than `max_rows`.
    pub(super) fn thin(&mut self, connection: &Connection, meta: &mut Meta, max_rows: i64) -> rusqlite::Result<()> {
        if meta.chained_rows() <= max_rows {
            return Ok(());
        }
        let haste = if meta.chained_rows() - max_rows > max_rows / 8 { HASTE } else { 1 };
        let table = HistoryTable::CHAINED[self.table % HistoryTable::CHAINED.len()];
        let newest = meta.head.count - max_rows / 2;
        let sql = format!(
            "SELECT r.seq, r.hash, r.moment, {}, m.pack, {} FROM {} r JOIN moment m ON m.id = r.moment WHERE r.seq > ?1 AND \
             r.seq <= ?2 ORDER BY r.seq LIMIT ?3",
            redundant_sql(table),
            subject(table).join(", "),
            table.name(),
        );
        let subjects = subject(table).len();
        let rows: Vec<OldRow> = connection
            .prepare_cached(&sql)?
            .query_map(params![self.seq, newest, haste * STEP_ROWS], |row| {
                let about = (4..=4 + subjects).map(|at| row.get(at)).collect::<rusqlite::Result<_>>()?;
                Ok(OldRow {
                    seq: row.get(0)?,
                    hash: row.get(1)?,
                    moment: row.get(2)?,
                    is_redundant: row.get(3)?,
                    about,
                })
            })?
            .collect::<rusqlite::Result<_>>()?;
        *self = match rows.last() {
            Some(last) => Self { seq: last.seq, ..*self },
            None => Self { table: (self.table + 1) % HistoryTable::CHAINED.len(), seq: 0 },
        };
        let (mut deleted, mut alone) = (0, 0);
        for row in &rows {
            let age = meta.head.count - row.seq;
            if !row.is_redundant || zero_bits(&row.hash) >= zero_bits_kept(age, max_rows) {
                continue;
            }
            if has_neighbours(connection, table, row)? {
                delete(connection, meta, table, row)?;
                deleted += 1;
            } else {
                alone += 1;
            }
            if deleted == haste * STEP_DELETED || alone == haste * STEP_ALONE {
                self.seq = row.seq;
                break;
            }
        }
        Ok(())
    }
}

/// A row outside the latest half.
struct OldRow {
    seq: i64,
    hash: Hash,
    moment: i64,
    is_redundant: bool,
    /// Its pack, and what it is about: the values of [`subject`].
    about: Vec<Value>,
}

/// SQL that is true for rows of which others of their kind say as much.
fn redundant_sql(table: HistoryTable) -> String {
    match table {
        HistoryTable::Alarm => format!("r.occurrences > {OCCURRENCES_KEPT}"),
        // False until there are so many.
        HistoryTable::Model => {
            format!(
                "r.seq > coalesce((SELECT seq FROM model ORDER BY seq LIMIT 1 OFFSET {OCCURRENCES_KEPT} - 1), r.seq)"
            )
        }
        HistoryTable::Reset => "r.reason = 'filter_reset'".to_owned(),
        _ => "1".to_owned(),
    }
}

/// Columns that two rows about the same thing have in common.
const fn subject(table: HistoryTable) -> &'static [&'static str] {
    match table {
        HistoryTable::Alarm => &["cell", "rule", "severity"],
        HistoryTable::Reset => &["cell", "reason"],
        _ => &["cell"],
    }
}

/// Zero bits at the end of a hash: n or more in one of 2^n.
fn zero_bits(hash: &Hash) -> u32 {
    hash.iter().rev().take_while(|byte| **byte == 0).count() as u32 * 8
        + hash.iter().rev().find(|byte| **byte != 0).map_or(0, |byte| byte.trailing_zeros())
}

/// Zero bits of the rows that are kept at `age` rows before the end: two more each time the age doubles.
fn zero_bits_kept(age: i64, max_rows: i64) -> u32 {
    2 * (age / (max_rows / 2).max(1)).max(0).checked_ilog2().map_or(0, |doublings| doublings + 1)
}

/// Whether the pack has an earlier and a later row about the same thing.
fn has_neighbours(connection: &Connection, table: HistoryTable, row: &OldRow) -> rusqlite::Result<bool> {
    let name = table.name();
    let columns = subject(table);
    let same: Vec<String> = (0..columns.len()).map(|at| format!("{} IS ?{}", columns[at], at + 3)).collect();
    for (side, order) in [("<", "DESC"), (">", "ASC")] {
        let sql = format!(
            "SELECT 1 FROM (SELECT {}, pack FROM {name} r CROSS JOIN moment m ON m.id = r.moment WHERE seq {side} ?1 ORDER BY seq \
             {order} LIMIT {NEIGHBOUR_ROWS}) WHERE pack = ?2 AND {} LIMIT 1",
            columns.join(", "),
            same.join(" AND ")
        );
        let bound = std::iter::once(Value::Integer(row.seq)).chain(row.about.iter().cloned());
        let near =
            connection.prepare_cached(&sql)?.query_row(rusqlite::params_from_iter(bound), |_| Ok(())).optional()?;
        if near.is_none() {
            return Ok(false);
        }
    }
    Ok(true)
}

fn delete(connection: &Connection, meta: &mut Meta, table: HistoryTable, row: &OldRow) -> rusqlite::Result<()> {
    connection.prepare_cached(&format!("DELETE FROM {} WHERE seq = ?1", table.name()))?.execute([row.seq])?;
    note_thinned(connection, row.seq, &row.hash)?;
    meta.chain_thinned += 1;
    delete_unused_moment(connection, row.moment)
}

/// Adds a row to the run of deleted rows that it continues, begins or joins.
fn note_thinned(connection: &Connection, seq: i64, hash: &Hash) -> rusqlite::Result<()> {
    let before: Option<i64> = connection
        .prepare_cached("DELETE FROM thinned WHERE last = ?1 RETURNING first")?
        .query_row([seq - 1], |row| row.get(0))
        .optional()?;
    let first = before.unwrap_or(seq);
    let joined = connection
        .prepare_cached(
            "UPDATE thinned SET first = ?1 WHERE last = (SELECT min(last) FROM thinned WHERE last > ?2) AND first = ?2 + 1",
        )?
        .execute([first, seq])?;
    if joined == 0 {
        connection
            .prepare_cached("INSERT INTO thinned (last, first, hash) VALUES (?1, ?2, ?3)")?
            .execute(params![seq, first, hash])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
