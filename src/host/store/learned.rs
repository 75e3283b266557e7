//! Reads the part of the history that a starting daemon restores. Alarm changes are read if they are newer than the
//! stored state. If there is no valid state, learned values and all alarms are read. Only intact segments are read.

use rusqlite::{Connection, Row};

use super::rows::{DROPPED, HistoryTable};
use super::segments;
use crate::alarm::{Alarm, AlarmChange, Change};
use crate::filter::ScalarGaussian;
use crate::monitor::LearnedCell;
use crate::quantity::catalogue::Quantity;
use crate::quantity::{CellIndex, Timestamp};

/// Maximum number of segments that are read, newest first. A segment is a day of use or less.
const MAX_SEGMENTS: usize = 16;

/// Returns the alarm changes of pack `pack` after row `after`, oldest first, with their times on the inputs' clock.
pub(super) fn alarm_changes(
    connection: &Connection,
    pack: i64,
    after: i64,
) -> rusqlite::Result<Vec<(Timestamp, AlarmChange)>> {
    let mut statement = connection.prepare(
        "SELECT m.time_ns, r.* FROM alarm r JOIN moment m ON m.id = r.moment WHERE m.pack = ?1 AND r.seq BETWEEN ?2 AND ?3 ORDER \
         BY r.seq",
    )?;
    let mut changes = Vec::new();
    for segment in segments::intact(connection, after, MAX_SEGMENTS)? {
        let first = segment.first.max(after.saturating_add(1));
        let mut rows = statement.query([pack, first, segment.last])?;
        while let Some(row) = rows.next()? {
            let time = Timestamp::from_nanos(row.get("time_ns")?);
            changes.extend(alarm_change(row)?.map(|change| (time, change)));
        }
    }
    Ok(changes)
}

/// Returns the contents of a row of `alarm`; `None` = the row was written by a version with other alarms.
fn alarm_change(row: &Row<'_>) -> rusqlite::Result<Option<AlarmChange>> {
    let change: String = row.get("change")?;
    let is_dropped = change == DROPPED;
    let change = if is_dropped { Some(Change::Forgotten) } else { serde_json::from_value(change.into()).ok() };
    let alarm = serde_json::json!({
        "rule": row.get::<_, String>("rule")?,
        "severity": row.get::<_, String>("severity")?,
        "cell": row.get::<_, Option<u16>>("cell")?,
        "state": row.get::<_, String>("state")?,
        "value": row.get::<_, Option<f64>>("value")?,
        "threshold": row.get::<_, Option<f64>>("threshold")?.unwrap_or_default(),
        "occurrences": if is_dropped { 0 } else { row.get::<_, u32>("occurrences")? },
        "is_acknowledged": row.get::<_, bool>("acknowledged")?,
    });
    let alarm: Option<Alarm> = serde_json::from_value(alarm).ok();
    Ok(change.zip(alarm).map(|(change, alarm)| AlarmChange { change, alarm }))
}

/// Returns the learned values of the cells of pack `pack`, in the order of the cells. Each value is from the newest row
/// of the cell.
pub(super) fn read(connection: &Connection, pack: i64) -> rusqlite::Result<Vec<LearnedCell>> {
    let mut statement = connection.prepare(&format!(
        "SELECT r.{} FROM capacity r JOIN moment m ON m.id = r.moment WHERE m.pack = ?1 AND r.seq BETWEEN ?2 AND ?3 ORDER BY r.seq DESC",
        HistoryTable::Capacity.columns().join(", r.")
    ))?;
    let mut cells: Vec<LearnedCell> = Vec::new();
    for segment in segments::intact(connection, 0, MAX_SEGMENTS)?.iter().rev() {
        let mut rows = statement.query([pack, segment.first, segment.last])?;
        while let Some(row) = rows.next()? {
            let learned = learned(row)?.filter(|learned| cells.iter().all(|known| known.cell != learned.cell));
            cells.extend(learned);
        }
    }
    cells.sort_by_key(|learned| learned.cell);
    Ok(cells)
}

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
