//! Bounds the half-cycles: beyond the configured number of half-cycles, every second transition of the older half is deleted,
//! and beyond the configured age every transition, with its moment where no other row belongs to it.
//!
//! Deletes a little at each checkpoint, so that no commit is long. `chain_retention` bounds the other rows.

use rusqlite::{Connection, OptionalExtension, params};

use super::meta::Meta;
use super::rows::HistoryTable;
use super::stamp::{BootId, SANE_WALL_NS};
use crate::config::StoreConfig;

/// Transitions deleted at one checkpoint for their number, and as many for their age: far more than one minute adds.
const MAX_STEPS: usize = 4;

/// Rows that are kept; beyond, the oldest are thinned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RowLimits {
    /// Half-cycles.
    pub(super) half_cycles: i64,
    /// Rows of the chained tables.
    pub(super) chained_rows: i64,
}

impl RowLimits {
    /// All are kept.
    pub(super) const NONE: Self = Self { half_cycles: i64::MAX, chained_rows: i64::MAX };
    /// Those of tests.
    #[cfg(test)]
    pub(super) const SMALL: Self = Self { half_cycles: 1000, chained_rows: 10_000 };
}

impl From<&StoreConfig> for RowLimits {
    fn from(config: &StoreConfig) -> Self {
        Self { half_cycles: config.max_half_cycles.into(), chained_rows: config.max_chained_rows.into() }
    }
}

/// Deletes transitions beyond the limit, at most [`MAX_STEPS`].
pub(super) fn thin(connection: &Connection, meta: &mut Meta, max_half_cycles: i64) -> rusqlite::Result<()> {
    for _ in 0..MAX_STEPS {
        if meta.half_cycles <= max_half_cycles {
            return Ok(());
        }
        let (first, last): (i64, i64) =
            connection.query_row("SELECT min(moment), max(moment) FROM half_cycle", [], |row| {
                Ok((row.get::<_, Option<i64>>(0)?.unwrap_or(0), row.get::<_, Option<i64>>(1)?.unwrap_or(0)))
            })?;
        let middle = first + (last - first) / 2;
        let kept = next_transition(connection, meta.thinned_to)?;
        let dropped = match kept {
            Some(kept) => next_transition(connection, kept)?,
            None => None,
        };
        match dropped.filter(|&dropped| dropped <= middle) {
            Some(dropped) => {
                delete_transition(connection, meta, dropped)?;
                meta.thinned_to = dropped;
            }
            // The next round begins at the oldest.
            None => meta.thinned_to = 0,
        }
    }
    Ok(())
}

/// Deletes transitions before `horizon_ns` of the wall clock, at most [`MAX_STEPS`]. One that was written while the clock
/// was not set is at least as old as those after it.
pub(super) fn expire(connection: &Connection, meta: &mut Meta, horizon_ns: i64) -> rusqlite::Result<()> {
    for _ in 0..MAX_STEPS {
        let oldest_known: Option<i64> = connection
            .prepare_cached(
                "SELECT m.wall_ns FROM half_cycle h JOIN moment m ON m.id = h.moment WHERE m.wall_ns >= ?1 OR m.boot = ?2 \
                 ORDER BY h.moment LIMIT 1",
            )?
            .query_row(params![SANE_WALL_NS, BootId::REPLAY.0], |row| row.get(0))
            .optional()?;
        if oldest_known.is_none_or(|wall_ns| wall_ns >= horizon_ns) {
            return Ok(());
        }
        let Some(oldest) = next_transition(connection, 0)? else { return Ok(()) };
        delete_transition(connection, meta, oldest)?;
    }
    Ok(())
}

fn delete_transition(connection: &Connection, meta: &mut Meta, moment: i64) -> rusqlite::Result<()> {
    let rows = connection.execute("DELETE FROM half_cycle WHERE moment = ?1", params![moment])?;
    let rows = i64::try_from(rows).unwrap_or(i64::MAX);
    meta.half_cycles -= rows;
    meta.thinned += rows;
    delete_unused_moment(connection, moment)
}

fn next_transition(connection: &Connection, after: i64) -> rusqlite::Result<Option<i64>> {
    connection.query_row("SELECT min(moment) FROM half_cycle WHERE moment > ?1", [after], |row| row.get(0))
}

/// Deletes a moment to which no row belongs any more.
pub(super) fn delete_unused_moment(connection: &Connection, moment: i64) -> rusqlite::Result<()> {
    let mut statement = connection.prepare_cached("SELECT 1 FROM half_cycle WHERE moment = ?1 LIMIT 1")?;
    if statement.exists([moment])? {
        return Ok(());
    }
    for table in HistoryTable::CHAINED {
        if has_row(connection, table, moment)? {
            return Ok(());
        }
    }
    connection.execute("DELETE FROM moment WHERE id = ?1", [moment]).map(drop)
}

/// Whether a chained row belongs to this moment. Rows and moments are numbered in the same order, so a binary search
/// finds it; an index would cost a write with every row.
fn has_row(connection: &Connection, table: HistoryTable, moment: i64) -> rusqlite::Result<bool> {
    let name = table.name();
    let (mut low, mut high): (i64, i64) = connection.query_row(
        &format!("SELECT coalesce(min(seq), 0), coalesce(max(seq), 0) FROM {name}"),
        [],
        |row| Ok((row.get(0)?, row.get(1)?)),
    )?;
    let sql = format!("SELECT seq, moment FROM {name} WHERE seq >= ?1 ORDER BY seq LIMIT 1");
    let mut statement = connection.prepare_cached(&sql)?;
    let mut from = |seq: i64| -> rusqlite::Result<Option<(i64, i64)>> {
        statement.query_row([seq], |row| Ok((row.get(0)?, row.get(1)?))).optional()
    };
    while low < high {
        let middle = low + (high - low) / 2;
        match from(middle)? {
            Some((seq, of)) if of < moment => low = seq + 1,
            _ => high = middle,
        }
    }
    Ok(from(low)?.is_some_and(|(_, of)| of == moment))
}
