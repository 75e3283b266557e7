//! The row of `meta`: the end of the chain, the counts of half-cycles, which pack is connected, and the vehicle.

use rusqlite::{Connection, OptionalExtension, params};

use super::chain::{ChainHead, Hash};
use super::rows::HistoryTable;
use super::schema::{self, VERSION_WITH_THINNED};
use crate::config::VehicleIdentity;

/// The vehicle that the history is of. A text that cannot be read states none.
pub(super) fn vehicle(connection: &Connection) -> rusqlite::Result<VehicleIdentity> {
    let text: Option<String> = connection.query_row("SELECT vehicle FROM meta WHERE id = 1", [], |row| row.get(0))?;
    Ok(text.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default())
}

/// Writes the vehicle.
pub(super) fn set_vehicle(connection: &Connection, vehicle: &VehicleIdentity) -> rusqlite::Result<()> {
    let text = serde_json::to_string(vehicle).ok().filter(|_| vehicle.is_stated());
    connection.execute("UPDATE meta SET vehicle = ?1 WHERE id = 1", [text]).map(drop)
}

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
    /// Chained rows that were thinned out: counted in the table `thinned`.
    pub(super) chain_thinned: i64,
}

impl Meta {
    /// Chained rows in the tables.
    pub(super) const fn chained_rows(&self) -> i64 {
        self.head.count - self.chain_thinned
    }

    /// Reads it, with the number of the connected pack (0 = none yet).
    pub(super) fn read(connection: &Connection) -> rusqlite::Result<Self> {
        let pack = connection.query_row("SELECT coalesce(max(id), 0) FROM pack", [], |row| row.get(0))?;
        let has_thinned = schema::version(connection)? >= VERSION_WITH_THINNED;
        // A real number: damaged numbers do not overflow.
        let sql = if has_thinned { "SELECT total(last - first + 1) FROM thinned" } else { "SELECT 0.0" };
        let chain_thinned = connection.query_row(sql, [], |row| Ok(row.get::<_, f64>(0)? as i64))?;
        let sql = "SELECT chained, head, half_cycles, thinned, thinned_to FROM meta WHERE id = 1";
        connection.query_row(sql, [], |row| {
            let head = ChainHead { count: row.get(0)?, hash: row.get(1)? };
            Ok(Self {
                head,
                half_cycles: row.get(2)?,
                thinned: row.get(3)?,
                thinned_to: row.get(4)?,
                pack,
                chain_thinned,
            })
        })
    }

    /// Compares it with the tables of layout `version`; returns what contradicts it. The number of half-cycles is counted again.
    pub(super) fn fault(&mut self, connection: &Connection, version: i32) -> rusqlite::Result<Option<String>> {
        self.half_cycles = connection.query_row("SELECT count(*) FROM half_cycle", [], |row| row.get(0))?;
        let packs: i64 = connection.query_row("SELECT count(*) FROM pack", [], |row| row.get(0))?;
        if packs != self.pack {
            return Ok(Some(format!("{packs} packs, the last of number {}", self.pack)));
        }
        if !(0..=self.head.count).contains(&self.chain_thinned) {
            let Self { head, chain_thinned, .. } = self;
            return Ok(Some(format!("{chain_thinned} of {} rows thinned out", head.count)));
        }
        let mut last: (i64, Hash) = (0, [0; 32]);
        for table in HistoryTable::CHAINED.into_iter().filter(|table| table.is_in(version)) {
            let sql = format!("SELECT seq, hash FROM {} ORDER BY seq DESC LIMIT 1", table.name());
            let row = connection.query_row(&sql, [], |row| Ok((row.get(0)?, row.get(1)?))).optional()?;
            last = last.max(row.unwrap_or(last));
        }
        let ChainHead { count, hash } = self.head;
        Ok((last != (count, hash))
            .then(|| format!("the history ends with row {}, not with row {count} as noted", last.0)))
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
