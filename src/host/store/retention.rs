//! Bounds the history: beyond the configured number of half-cycles, every second transition of the older half is deleted,
//! with its moment where no other row belongs to it.
//!
//! Deletes a little at each checkpoint, so that no commit is long. Capacities, alarms and resets are never thinned.

use rusqlite::{Connection, OptionalExtension, params};

use super::meta::Meta;
use super::rows::HistoryTable;

/// Transitions deleted at one checkpoint: far more than one minute adds.
const MAX_STEPS: usize = 4;

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
                let rows = connection.execute("DELETE FROM half_cycle WHERE moment = ?1", params![dropped])?;
                let rows = i64::try_from(rows).unwrap_or(i64::MAX);
                meta.half_cycles -= rows;
                meta.thinned += rows;
                meta.thinned_to = dropped;
                thin_moment(connection, dropped)?;
            }
            // The next round begins at the oldest.
            None => meta.thinned_to = 0,
        }
    }
    Ok(())
}

fn next_transition(connection: &Connection, after: i64) -> rusqlite::Result<Option<i64>> {
    connection.query_row("SELECT min(moment) FROM half_cycle WHERE moment > ?1", [after], |row| row.get(0))
}

fn thin_moment(connection: &Connection, moment: i64) -> rusqlite::Result<()> {
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
