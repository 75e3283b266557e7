//! The row of `meta`: the end of the chain, the counts of half-cycles, and which pack is connected.

use rusqlite::{Connection, params};

use super::chain::ChainHead;

/// The contents of `meta`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Meta {
    /// End of the chain.
    pub(super) head: ChainHead,
    /// Rows of half-cycles.
    pub(super) half_cycles: i64,
    /// Rows of half-cycles that were thinned out.
    pub(super) thinned: i64,
    /// The moment that the present round of thinning has reached.
    pub(super) thinned_to: i64,
    /// The pack that is connected.
    pub(super) pack: i64,
}

impl Meta {
    /// Reads it, with the number of the connected pack (0 = none yet).
    pub(super) fn read(connection: &Connection) -> rusqlite::Result<Self> {
        let pack = connection.query_row("SELECT coalesce(max(id), 0) FROM pack", [], |row| row.get(0))?;
        let sql = "SELECT chained, head, half_cycles, thinned, thinned_to FROM meta WHERE id = 1";
        connection.query_row(sql, [], |row| {
            let head = ChainHead { count: row.get(0)?, hash: row.get(1)? };
            Ok(Self { head, half_cycles: row.get(2)?, thinned: row.get(3)?, thinned_to: row.get(4)?, pack })
        })
    }

    /// Writes it, without the pack.
    pub(super) fn write(&self, connection: &Connection) -> rusqlite::Result<()> {
        let Self { head, half_cycles, thinned, thinned_to, .. } = self;
        connection
            .prepare_cached(
                "UPDATE meta SET chained = ?1, head = ?2, half_cycles = ?3, thinned = ?4, thinned_to = ?5 WHERE id = 1",
            )?
            .execute(params![head.count, head.hash, half_cycles, thinned, thinned_to])
            .map(drop)
    }
}
