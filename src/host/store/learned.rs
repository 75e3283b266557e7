//! Reads the learned values of the connected pack from the history. They are used if a start finds no valid stored
//! state.
//!
//! In: the rows of `capacity`. Out: the newest row of each cell in an intact segment.

use rusqlite::{Connection, Row};

use super::rows::HistoryTable;
use super::segments;
use crate::filter::ScalarGaussian;
use crate::monitor::LearnedCell;
use crate::quantity::CellIndex;
use crate::quantity::catalogue::Quantity;

/// Maximum number of segments that are read, newest first. A segment is a day of use or less.
const MAX_SEGMENTS: usize = 16;

/// The learned values of the cells of pack `pack`, ordered by cell.
pub(super) fn read(connection: &Connection, pack: i64) -> rusqlite::Result<Vec<LearnedCell>> {
    let mut statement = connection.prepare(&format!(
        "SELECT r.{} FROM capacity r JOIN moment m ON m.id = r.moment WHERE m.pack = ?1 AND r.seq BETWEEN ?2 AND ?3 ORDER BY r.seq DESC",
        HistoryTable::Capacity.columns().join(", r.")
    ))?;
    let mut cells: Vec<LearnedCell> = Vec::new();
    for segment in segments::intact(connection, MAX_SEGMENTS)? {
        let mut rows = statement.query([pack, segment.first, segment.last])?;
        while let Some(row) = rows.next()? {
            let learned = learned(row)?.filter(|learned| cells.iter().all(|known| known.cell != learned.cell));
            cells.extend(learned);
        }
    }
    cells.sort_by_key(|learned| learned.cell);
    Ok(cells)
}

/// The learned values in a row of `capacity`; `None` = the row has no capacity.
fn learned(row: &Row<'_>) -> rusqlite::Result<Option<LearnedCell>> {
    let belief = |quantity: Quantity| -> rusqlite::Result<Option<ScalarGaussian>> {
        let Some(std_key) = quantity.row().std_key else { return Ok(None) };
        let (mean, std): (Option<f64>, Option<f64>) = (row.get(quantity.row().key)?, row.get(std_key)?);
        Ok(mean.zip(std).map(|(mean, std)| ScalarGaussian::from_std(mean, std)))
    };
    let Some(capacity) = belief(Quantity::Capacity)? else { return Ok(None) };
    Ok(Some(LearnedCell {
        cell: CellIndex(row.get("cell")?),
        capacity,
        usable: belief(Quantity::UsableCapacity)?,
        resistance: belief(Quantity::ResistanceRatio)?,
    }))
}
