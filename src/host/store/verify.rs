//! Whether the chain of the history is whole: every row looked at, the first that is not as it was written named.

use rusqlite::types::Value;
use rusqlite::{Connection, Rows, Statement};
use serde::Serialize;

use super::chain::{Hash, hex, link};
use super::database;
use super::rows::Table;
use super::schema;

/// What came of it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Verdict {
    /// Chained rows found good before the first that is not.
    pub good_rows: i64,
    /// Rows there should be.
    pub rows: i64,
    /// Hash of the last row, to be noted elsewhere.
    pub head: String,
    /// The first that is not as it was written; `None` = all are.
    pub broken: Option<Broken>,
}

/// A row that is not as it was written.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Broken {
    /// Its table; empty where a row is missing.
    pub table: String,
    /// Its number in the chain.
    pub row: i64,
    /// What should be there.
    pub expected: String,
    /// What is there.
    pub found: String,
}

/// A row of the chain as it is stored.
struct Link {
    seq: i64,
    hash: Vec<u8>,
    values: Vec<Value>,
}

/// Goes through the chain in the order of its numbers.
pub(super) fn verify(connection: &Connection) -> rusqlite::Result<Verdict> {
    let meta = database::read_meta(connection)?;
    let version = schema::version(connection)?;
    let mut statements: Vec<(Table, Statement<'_>)> = Table::CHAINED
        .into_iter()
        .filter(|table| table.is_in(version))
        .map(|table| {
            connection.prepare(&database::rows_sql(table, "ORDER BY r.seq")).map(|statement| (table, statement))
        })
        .collect::<rusqlite::Result<_>>()?;
    let mut cursors = statements
        .iter_mut()
        .map(|(table, statement)| Cursor::new(*table, statement))
        .collect::<rusqlite::Result<Vec<_>>>()?;
    let mut before: Hash = [0; 32];
    let mut seq = 0;
    let broken = loop {
        seq += 1;
        let next = cursors.iter_mut().filter(|c| c.next.is_some()).min_by_key(|c| c.next.as_ref().map(|row| row.seq));
        let Some(cursor) = next else { break judge_end(&meta, seq - 1, &before) };
        let table = cursor.table;
        let Some(row) = cursor.advance()? else { break None };
        match judge(table, seq, &row, &before) {
            Ok(hash) => before = hash,
            Err(broken) => break Some(broken),
        }
    };
    let good_rows = if broken.is_some() { (seq - 1).min(meta.head.count) } else { seq - 1 };
    Ok(Verdict { good_rows, rows: meta.head.count, head: hex(&meta.head.hash), broken })
}

/// One table's rows in order.
struct Cursor<'a> {
    table: Table,
    rows: Rows<'a>,
    next: Option<Link>,
}

impl<'a> Cursor<'a> {
    fn new(table: Table, statement: &'a mut Statement<'_>) -> rusqlite::Result<Self> {
        let mut cursor = Self { table, rows: statement.query([])?, next: None };
        cursor.advance()?;
        Ok(cursor)
    }

    /// Takes the next row and reads the one after it.
    fn advance(&mut self) -> rusqlite::Result<Option<Link>> {
        let columns = database::MOMENT_COLUMNS + self.table.columns().len();
        let after = match self.rows.next()? {
            None => None,
            Some(row) => {
                let values = (2..2 + columns).map(|index| row.get(index)).collect::<rusqlite::Result<_>>()?;
                Some(Link { seq: row.get(0)?, hash: row.get(1)?, values })
            }
        };
        Ok(std::mem::replace(&mut self.next, after))
    }
}

/// The row's hash when it is row `seq` of the chain, as it was written.
fn judge(table: Table, seq: i64, row: &Link, before: &Hash) -> Result<Hash, Broken> {
    if row.seq != seq {
        let found = format!("row {} of {}", row.seq, table.name());
        return Err(Broken { table: String::new(), row: seq, expected: format!("row {seq}"), found });
    }
    let expected = link(before, table, seq, &row.values);
    if row.hash == expected {
        return Ok(expected);
    }
    Err(Broken { table: table.name().to_owned(), row: seq, expected: hex(&expected), found: hex(&row.hash) })
}

/// After the last row: the head kept apart must be that row's.
fn judge_end(meta: &database::Meta, rows: i64, last: &Hash) -> Option<Broken> {
    let head = &meta.head;
    if rows == head.count && *last == head.hash {
        return None;
    }
    let of = |rows: i64, hash: &Hash| format!("{rows} rows, the last of hash {}", hex(hash));
    let row = rows.min(head.count) + 1;
    Some(Broken { table: String::new(), row, expected: of(head.count, &head.hash), found: of(rows, last) })
}
