//! SQL of the history's rows: reading with their moment, writing with number and hash.

use rusqlite::types::Value;
use rusqlite::{Connection, OptionalExtension, Transaction, params};

use super::chain::Hash;
use super::meta::Meta;
use super::rows::{HistoryTable, RowBatch};
use super::schema;
use super::stamp::Stamp;
use super::state_slots;

/// Columns of a moment in a chained row.
pub(super) const MOMENT_COLUMNS: usize = 6;

/// Selects rows of a table: number and hash (moment and cell of a half-cycle), the moment's values, the row's own values.
/// `tail` has the condition and the order.
pub(super) fn rows_sql(table: HistoryTable, tail: &str) -> String {
    let columns: Vec<String> = table.columns().iter().map(|column| format!("r.{column}")).collect();
    let own = if table == HistoryTable::HalfCycle { "r.moment, r.cell" } else { "r.seq, r.hash" };
    format!(
        "SELECT {own}, r.moment, m.wall_ns, m.time_ns, m.boottime_ns, m.boot, m.pack, {} FROM {} r LEFT JOIN moment m ON \
         m.id = r.moment {tail}",
        columns.join(", "),
        table.name()
    )
}

/// Values of a moment as they are hashed with a chained row: its number, the clocks, the pack.
fn moment_values(id: i64, stamp: &Stamp, pack: i64) -> Vec<Value> {
    vec![
        Value::Integer(id),
        Value::Integer(stamp.wall_ns),
        Value::Integer(stamp.time.nanos()),
        Value::Integer(stamp.boottime_ns),
        Value::Blob(stamp.boot.0.to_vec()),
        Value::Integer(pack),
    ]
}

/// Writes the rows of one moment, and what they change in `pack`.
pub(super) fn write_batch(transaction: &Transaction<'_>, meta: &mut Meta, batch: &RowBatch) -> rusqlite::Result<()> {
    let moment = write_moment(transaction, &batch.stamp, meta.pack)?;
    for row in &batch.rows {
        let Some((table, values)) = row.values() else { continue };
        write_row(transaction, meta, table, &moment, &values)?;
        if row.replaces_pack() {
            replace_pack(transaction, meta, &batch.stamp)?;
        }
        if let Some(identity) = row.pack_identity() {
            let values = params![meta.pack, identity.to_string()];
            transaction.execute("UPDATE pack SET identity = ?2 WHERE id = ?1", values)?;
        }
    }
    Ok(())
}

/// Writes a moment; returns its values.
pub(super) fn write_moment(connection: &Connection, stamp: &Stamp, pack: i64) -> rusqlite::Result<Vec<Value>> {
    connection
        .prepare_cached("INSERT INTO moment (wall_ns, time_ns, boottime_ns, boot, pack) VALUES (?1, ?2, ?3, ?4, ?5)")?
        .execute(params![stamp.wall_ns, stamp.time.nanos(), stamp.boottime_ns, stamp.boot.0, pack])?;
    Ok(moment_values(connection.last_insert_rowid(), stamp, pack))
}

/// Writes one row of a moment; a chained one gets its number and its hash.
pub(super) fn write_row(
    connection: &Connection,
    meta: &mut Meta,
    table: HistoryTable,
    moment: &[Value],
    values: &[Value],
) -> rusqlite::Result<()> {
    let columns = table.columns().join(", ");
    let placeholders =
        |first: usize| (first..first + values.len()).map(|number| format!("?{number}")).collect::<Vec<_>>().join(", ");
    if table == HistoryTable::HalfCycle {
        let sql = format!("INSERT OR REPLACE INTO half_cycle (moment, {columns}) VALUES (?1, {})", placeholders(2));
        let bound = moment.iter().take(1).chain(values);
        connection.prepare_cached(&sql)?.execute(rusqlite::params_from_iter(bound))?;
        meta.half_cycles += 1;
        return Ok(());
    }
    let chained: Vec<Value> = moment.iter().chain(values).cloned().collect();
    meta.head.append(table, &chained);
    let own = [Value::Integer(meta.head.count), Value::Blob(meta.head.hash.to_vec())];
    let sql =
        format!("INSERT INTO {} (seq, hash, moment, {columns}) VALUES (?1, ?2, ?3, {})", table.name(), placeholders(4));
    let bound = own.iter().chain(moment.iter().take(1)).chain(values);
    connection.prepare_cached(&sql)?.execute(rusqlite::params_from_iter(bound)).map(drop)
}

/// Closes the history of the pack and opens that of the next one.
fn replace_pack(connection: &Connection, meta: &mut Meta, stamp: &Stamp) -> rusqlite::Result<()> {
    connection.execute(
        "UPDATE pack SET closed_ns = ?2, reason = 'pack_replaced' WHERE id = ?1",
        params![meta.pack, stamp.wall_ns],
    )?;
    meta.pack += 1;
    // A state of the old pack must not come back.
    state_slots::forget_aside(connection)?;
    connection.execute("INSERT INTO pack (id, opened_ns) VALUES (?1, ?2)", params![meta.pack, stamp.wall_ns]).map(drop)
}

/// The hash of row `seq` of the chain in a database of layout `version`; zeros before the first. `None` = the row is missing, or
/// was thinned out together with the next one.
pub(super) fn hash_of(connection: &Connection, seq: i64, version: i32) -> rusqlite::Result<Option<Hash>> {
    if seq == 0 {
        return Ok(Some([0; 32]));
    }
    for table in HistoryTable::CHAINED.into_iter().filter(|table| table.is_in(version)) {
        let sql = format!("SELECT hash FROM {} WHERE seq = ?1", table.name());
        let hash = connection.prepare_cached(&sql)?.query_row([seq], |row| row.get(0)).optional()?;
        if hash.is_some() {
            return Ok(hash);
        }
    }
    if version < schema::VERSION_WITH_THINNED {
        return Ok(None);
    }
    let mut thinned = connection.prepare_cached("SELECT hash FROM thinned WHERE last = ?1")?;
    thinned.query_row([seq], |row| row.get(0)).optional()
}
