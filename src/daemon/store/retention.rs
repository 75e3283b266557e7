//! Bounded growth: beyond the configured number of half-cycles the older half is thinned, every second transition of it.
//!
//! A little at each checkpoint, so that no commit is long. Capacities, alarms and resets are never thinned.

use rusqlite::{Connection, params};

use super::database::Ledger;

/// Transitions taken out at one checkpoint: far more than one minute brings.
const MAX_STEPS: usize = 4;

/// Takes out what is too much, up to [`MAX_STEPS`] transitions of it.
pub(super) fn thin(connection: &Connection, ledger: &mut Ledger, max_half_cycles: i64) -> rusqlite::Result<()> {
    for _ in 0..MAX_STEPS {
        if ledger.half_cycles <= max_half_cycles {
            return Ok(());
        }
        let (first, last): (i64, i64) =
            connection.query_row("SELECT min(moment), max(moment) FROM half_cycle", [], |row| {
                Ok((row.get::<_, Option<i64>>(0)?.unwrap_or(0), row.get::<_, Option<i64>>(1)?.unwrap_or(0)))
            })?;
        let middle = first + (last - first) / 2;
        let kept = next_transition(connection, ledger.thinned_to)?;
        let dropped = match kept {
            Some(kept) => next_transition(connection, kept)?,
            None => None,
        };
        match dropped.filter(|&dropped| dropped <= middle) {
            Some(dropped) => {
                let rows = connection.execute("DELETE FROM half_cycle WHERE moment = ?1", params![dropped])?;
                let rows = i64::try_from(rows).unwrap_or(i64::MAX);
                ledger.half_cycles -= rows;
                ledger.thinned += rows;
                ledger.thinned_to = dropped;
            }
            // The next round begins at the oldest.
            None => ledger.thinned_to = 0,
        }
    }
    Ok(())
}

fn next_transition(connection: &Connection, after: i64) -> rusqlite::Result<Option<i64>> {
    connection.query_row("SELECT min(moment) FROM half_cycle WHERE moment > ?1", [after], |row| row.get(0))
}
