//! Reads from the history what was learned of the connected pack, for a start whose stored states are all lost.
//!
//! In: the rows of `capacity`. Out: for each cell its newest row whose hash is good. A row without its predecessor in the chain
//! cannot be checked and is not used.

use rusqlite::types::Value;
use rusqlite::{Connection, Row};

use super::chain::{self, Hash};
use super::row_sql::{MOMENT_COLUMNS, hash_of, rows_sql};
use super::rows::HistoryTable;
use super::schema;
use crate::filter::ScalarGaussian;
use crate::monitor::LearnedCell;
use crate::quantity::{CellIndex, MAX_CELLS};

/// Rows read, from the last on: some for each cell of the largest pack.
const MAX_ROWS: usize = 16 * MAX_CELLS;

/// What was learned of the cells of pack `pack`, in their order.
pub(super) fn read(connection: &Connection, pack: i64) -> rusqlite::Result<Vec<LearnedCell>> {
    let mut statement = connection.prepare(&rows_sql(
        HistoryTable::Capacity,
        &format!("WHERE m.pack = ?1 ORDER BY r.seq DESC LIMIT {MAX_ROWS}"),
    ))?;
    let mut rows = statement.query([pack])?;
    let mut cells: Vec<LearnedCell> = Vec::new();
    while let Some(row) = rows.next()? {
        if let Some(learned) = learned(connection, row)?
            && cells.iter().all(|known| known.cell != learned.cell)
        {
            cells.push(learned);
        }
    }
    cells.sort_by_key(|learned| learned.cell);
    Ok(cells)
}

/// The contents of a row of `capacity`; `None` = it is damaged.
fn learned(connection: &Connection, row: &Row<'_>) -> rusqlite::Result<Option<LearnedCell>> {
    let columns = HistoryTable::Capacity.columns();
    let first = 2 + MOMENT_COLUMNS;
    let (seq, hash): (i64, Hash) = (row.get(0)?, row.get(1)?);
    let values: Vec<Value> = (2..first + columns.len()).map(|at| row.get(at)).collect::<rusqlite::Result<_>>()?;
    let before = hash_of(connection, seq - 1, schema::known(schema::MIGRATIONS))?;
    if before.is_none_or(|before| chain::link(&before, HistoryTable::Capacity, seq, &values) != hash) {
        return Ok(None);
    }
    let number = |name: &str| -> rusqlite::Result<Option<f64>> {
        columns.iter().position(|column| *column == name).map_or(Ok(None), |at| row.get(first + at))
    };
    let belief = |mean: &str, std: &str| -> rusqlite::Result<Option<ScalarGaussian>> {
        Ok(number(mean)?.zip(number(std)?).map(|(mean, std)| ScalarGaussian::from_std(mean, std)))
    };
    let Some(capacity) = belief("capacity_ah", "capacity_std_ah")? else { return Ok(None) };
    Ok(Some(LearnedCell {
        cell: CellIndex(row.get(first)?),
        capacity,
        usable: belief("usable_capacity_ah", "usable_capacity_std_ah")?,
        resistance: belief("resistance_ratio", "resistance_ratio_std")?,
    }))
}
