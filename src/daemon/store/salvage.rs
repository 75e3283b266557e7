//! What can still be read of a damaged database.
//!
//! Rows are copied from the front up to where reading fails and from the back down to there. A chained row whose hash
//! does not fit its own contents was changed by the damage: it is not taken over, and counted. The copies get numbers
//! and hashes of the new chain.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use rusqlite::types::Value;
use rusqlite::{Connection, OpenFlags};

use super::chain::{self, Hash};
use super::database::{self, Database, Ledger};
use super::document::Document;
use super::rows::Table;
use super::stamp::{BootId, Stamp};
use crate::quantity::Timestamp;

/// What was taken over.
#[derive(Debug, Default)]
pub(super) struct Saved {
    pub(super) capacities: usize,
    pub(super) alarms: usize,
    pub(super) resets: usize,
    pub(super) half_cycles: usize,
    /// Rows that the damage has changed.
    pub(super) refused: usize,
    pub(super) state: Option<Document>,
}

impl fmt::Display for Saved {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { capacities, alarms, resets, half_cycles, refused, state } = self;
        let state = if state.is_some() { "with" } else { "without" };
        write!(
            f,
            "taken over: {capacities} capacities, {alarms} alarms, {resets} resets, {half_cycles} half-cycles, {state} its \
             state; refused: {refused}"
        )
    }
}

/// A row read from the damaged file.
struct Found {
    seq: i64,
    hash: Option<Hash>,
    moment: Vec<Value>,
    values: Vec<Value>,
}

/// Copies what is good into a database that is new.
pub(super) fn salvage(damaged: &Path, database: &mut Database) -> Saved {
    let mut saved = Saved::default();
    let Ok(old) =
        Connection::open_with_flags(damaged, OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX)
    else {
        return saved;
    };
    saved.state = state_of(&old);
    let tables: Vec<(Table, Vec<Found>)> =
        Table::ALL.into_iter().map(|table| (table, read_both_ways(&old, table))).collect();
    drop(old);
    let copied = copy(database, &tables, &mut saved);
    if let Err(error) = copied {
        tracing::error!(%error, "rows of the damaged database not taken over");
        saved = Saved { state: saved.state, ..Saved::default() };
    }
    saved
}

fn state_of(old: &Connection) -> Option<Document> {
    let shelf = database::read_shelf(old).ok()?;
    let stored = database::read_state(old, &shelf).ok()?.ok()??;
    Document::parse(&stored.json).ok()
}

/// Every row that can be read, by its number.
fn read_both_ways(old: &Connection, table: Table) -> Vec<Found> {
    let mut found = BTreeMap::new();
    for order in ["ASC", "DESC"] {
        let mut index = 0_i64;
        let result = read(old, table, order, |row| {
            // Half-cycles have no number: their order from the front, or behind all of those from the back.
            let key = if table == Table::HalfCycle {
                index += 1;
                half_cycle_key(&row)
            } else {
                (row.seq, 0)
            };
            found.entry(key).or_insert(row);
        });
        if result.is_ok() {
            break;
        }
    }
    found.into_values().collect()
}

fn half_cycle_key(row: &Found) -> (i64, i64) {
    let whole = |value: Option<&Value>| if let Some(Value::Integer(whole)) = value { *whole } else { 0 };
    (whole(row.moment.first()), whole(row.values.first()))
}

fn read(old: &Connection, table: Table, order: &str, mut take: impl FnMut(Found)) -> rusqlite::Result<()> {
    let columns: Vec<String> = table.columns().iter().map(|column| format!("r.{column}")).collect();
    let (own, by) = match table {
        Table::HalfCycle => ("0, NULL", format!("r.moment {order}, r.cell {order}")),
        _ => ("r.seq, r.hash", format!("r.seq {order}")),
    };
    let sql = format!(
        "SELECT {own}, r.moment, m.wall_ns, m.time_ns, m.boottime_ns, m.boot, m.pack, {} FROM {} r LEFT JOIN moment m ON \
         m.id = r.moment ORDER BY {by}",
        columns.join(", "),
        table.name()
    );
    let mut statement = old.prepare(&sql)?;
    let mut rows = statement.query([])?;
    while let Some(row) = rows.next()? {
        let moment = (2..8).map(|index| row.get(index)).collect::<rusqlite::Result<_>>()?;
        let values = (8..8 + columns.len()).map(|index| row.get(index)).collect::<rusqlite::Result<_>>()?;
        take(Found { seq: row.get(0)?, hash: row.get(1)?, moment, values });
    }
    Ok(())
}

/// Numbers and hashes of the old chain's rows, to judge their successors by.
fn hashes(tables: &[(Table, Vec<Found>)]) -> BTreeMap<i64, Hash> {
    let rows = tables.iter().flat_map(|(_, rows)| rows);
    rows.filter_map(|row| row.hash.map(|hash| (row.seq, hash))).collect()
}

/// Whether a chained row is as it was written. One whose predecessor is lost cannot be judged, and is believed.
fn is_good(table: Table, row: &Found, hashes: &BTreeMap<i64, Hash>) -> bool {
    let Some(hash) = row.hash else { return true };
    let before = if row.seq == 1 { Some(&[0; 32]) } else { hashes.get(&(row.seq - 1)) };
    let Some(before) = before else { return true };
    let chained: Vec<Value> = row.moment.iter().chain(&row.values).cloned().collect();
    chain::link(before, table, row.seq, &chained) == hash
}

fn copy(database: &mut Database, tables: &[(Table, Vec<Found>)], saved: &mut Saved) -> rusqlite::Result<()> {
    let hashes = hashes(tables);
    let (connection, ledger) = database.parts_mut();
    let transaction = connection.transaction()?;
    let mut copied = *ledger;
    // Chained rows in the order of the old chain, whatever their table.
    let mut chained: Vec<(Table, &Found)> =
        tables.iter().flat_map(|(table, rows)| rows.iter().map(|row| (*table, row))).collect();
    chained.sort_by_key(|(table, row)| (*table == Table::HalfCycle, row.seq));
    let mut moments: BTreeMap<i64, Vec<Value>> = BTreeMap::new();
    for (table, row) in chained {
        if !is_good(table, row, &hashes) {
            saved.refused += 1;
            continue;
        }
        if copy_row(&transaction, &mut copied, &mut moments, table, row)? {
            match table {
                Table::HalfCycle => saved.half_cycles += 1,
                Table::Capacity => saved.capacities += 1,
                Table::Alarm => saved.alarms += 1,
                Table::Reset => saved.resets += 1,
            }
        } else {
            saved.refused += 1;
        }
    }
    for pack in 2..=copied.pack {
        transaction.execute("INSERT OR IGNORE INTO pack (id, opened_ns, reason) VALUES (?1, 0, 'salvaged')", [pack])?;
    }
    database::write_ledger(&transaction, &copied)?;
    transaction.commit()?;
    *ledger = copied;
    Ok(())
}

/// Copies a row with its moment; false when the moment is lost or the row breaks a rule of the layout.
fn copy_row(
    connection: &Connection,
    ledger: &mut Ledger,
    moments: &mut BTreeMap<i64, Vec<Value>>,
    table: Table,
    row: &Found,
) -> rusqlite::Result<bool> {
    let [
        Value::Integer(id),
        Value::Integer(wall_ns),
        Value::Integer(time),
        Value::Integer(boottime_ns),
        Value::Blob(boot),
        Value::Integer(pack),
    ] = row.moment.as_slice()
    else {
        return Ok(false);
    };
    let Ok(boot) = <[u8; 16]>::try_from(boot.as_slice()) else { return Ok(false) };
    if !moments.contains_key(id) {
        let stamp = Stamp {
            wall_ns: *wall_ns,
            time: Timestamp::from_nanos(*time),
            boottime_ns: *boottime_ns,
            boot: BootId(boot),
        };
        moments.insert(*id, database::write_moment(connection, &stamp, *pack)?);
    }
    let Some(moment) = moments.get(id) else { return Ok(false) };
    let before = *ledger;
    match database::write_row(connection, ledger, table, moment, &row.values) {
        Ok(()) => {
            ledger.pack = ledger.pack.max(*pack);
            Ok(true)
        }
        Err(error) if error.sqlite_error_code() == Some(rusqlite::ErrorCode::ConstraintViolation) => {
            *ledger = before;
            Ok(false)
        }
        Err(error) => Err(error),
    }
}
