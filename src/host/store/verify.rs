//! Checks the hash chain of the history, row by row, up to the first row that was changed. Of rows that were thinned out the table
//! `thinned` has the hash that the next row carries on.

use std::str::FromStr;

use rusqlite::types::Value;
use rusqlite::{Connection, Statement};
use serde::Serialize;

use super::chain::{Hash, hex, link};
use super::chain_retention::LEAST_WHOLE;
use super::meta::Meta;
use super::row_sql::{MOMENT_COLUMNS, hash_of, rows_sql};
use super::rows::HistoryTable;
use super::schema::{self, VERSION_WITH_THINNED};

/// The result of a check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ChainReport {
    /// Chained rows found good before the first that is not.
    pub good_rows: i64,
    /// Rows that were written.
    pub rows: i64,
    /// Those of them that were thinned out since, up to the first row that is not good.
    pub thinned_rows: i64,
    /// Hash of the last row, to be noted elsewhere.
    pub head: String,
    /// The first row that was changed; `None` = no row was.
    pub broken: Option<BrokenRow>,
}

/// A row that was changed, is missing or was inserted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BrokenRow {
    /// Its table; empty where a row is missing.
    pub table: String,
    /// Its number in the chain.
    pub row: i64,
    /// The expected hash or row.
    pub expected: String,
    /// The hash or row in its place.
    pub found: String,
}

/// The chain's end as it was noted elsewhere, written `ROWS:HASH`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NotedHead {
    /// Rows at that time.
    pub rows: i64,
    /// Hash of the last, 64 hexadecimal digits.
    pub hash: String,
}

impl FromStr for NotedHead {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once(':').and_then(|(rows, hash)| Some((rows.parse().ok()?, hash.to_ascii_lowercase())));
        let is_hash = |hash: &str| hash.len() == 64 && hash.bytes().all(|byte| byte.is_ascii_hexdigit());
        match parts {
            Some((rows, hash)) if rows >= 0 && is_hash(&hash) => Ok(Self { rows, hash }),
            _ => Err("must be ROWS:HASH, a number and 64 hexadecimal digits".to_owned()),
        }
    }
}

/// What contradicts the chain's end as it was noted; `None` = nothing.
pub(super) fn contradiction(connection: &Connection, noted: &NotedHead) -> rusqlite::Result<Option<String>> {
    let version = schema::version(connection)?;
    let NotedHead { rows, hash } = noted;
    if let Some(found) = hash_of(connection, *rows, version)?.map(|hash| hex(&hash)) {
        return Ok((found != *hash)
            .then(|| format!("row {rows} has the hash {found}, noted was {hash}: the history was written again")));
    }
    let is_thinned = version >= VERSION_WITH_THINNED
        && connection.query_row(
            "SELECT min(first) FROM (SELECT first FROM thinned WHERE last > ?1 ORDER BY last LIMIT 1)",
            [rows],
            |row| Ok(row.get::<_, Option<i64>>(0)?.is_some_and(|first| first <= *rows)),
        )?;
    Ok(Some(if is_thinned {
        format!("row {rows}, which was noted, was thinned out since: it cannot be compared; note a newer end")
    } else {
        format!("there is no row {rows}, which was noted: the history was written again or cut off")
    }))
}

/// Rows that were thinned out: those from `first` to `last`, the last of which had this hash.
struct ThinnedRun {
    first: i64,
    last: i64,
    hash: Vec<u8>,
}

/// A row of the chain as it is stored.
struct ChainLink {
    seq: i64,
    hash: Vec<u8>,
    values: Vec<Value>,
}

/// Checks the chain in the order of its numbers.
pub(super) fn verify(connection: &Connection) -> rusqlite::Result<ChainReport> {
    verify_with(connection, LEAST_WHOLE)
}

/// The same where other than [`LEAST_WHOLE`] rows at the end are never thinned.
pub(super) fn verify_with(connection: &Connection, least_whole: i64) -> rusqlite::Result<ChainReport> {
    let meta = Meta::read(connection)?;
    let version = schema::version(connection)?;
    let mut statements: Vec<(HistoryTable, Statement<'_>)> = HistoryTable::CHAINED
        .into_iter()
        .filter(|table| table.is_in(version))
        .map(|table| connection.prepare(&rows_sql(table, "ORDER BY r.seq")).map(|statement| (table, statement)))
        .collect::<rusqlite::Result<_>>()?;
    let mut tables = Vec::new();
    for (table, statement) in &mut statements {
        let columns = MOMENT_COLUMNS + table.columns().len();
        let rows = statement.query_map([], move |row| {
            let values = (2..2 + columns).map(|index| row.get(index)).collect::<rusqlite::Result<_>>()?;
            Ok(ChainLink { seq: row.get(0)?, hash: row.get(1)?, values })
        })?;
        tables.push((*table, rows.peekable()));
    }
    let no_runs = version < VERSION_WITH_THINNED;
    let sql = if no_runs { "SELECT 0, 0, 0 WHERE 0" } else { "SELECT first, last, hash FROM thinned ORDER BY last" };
    let mut runs = connection.prepare(sql)?;
    let runs = runs.query_map([], |row| Ok(ThinnedRun { first: row.get(0)?, last: row.get(1)?, hash: row.get(2)? }))?;
    let mut runs = runs.peekable();
    let mut before: Hash = [0; 32];
    // The last row that is good or thinned out.
    let (mut seq, mut thinned_rows) = (0, 0);
    let broken = loop {
        // The latest rows are never thinned: entered as thinned they were removed.
        let continues = |run: &rusqlite::Result<ThinnedRun>| {
            run.as_ref().map_or(true, |run| {
                run.first == seq + 1 && (run.first..=meta.head.count - least_whole).contains(&run.last)
            })
        };
        if let Some(run) = runs.next_if(continues).transpose()? {
            before = run.hash.try_into().unwrap_or_default();
            thinned_rows += run.last - seq;
            seq = run.last;
            continue;
        }
        let heads = tables.iter_mut().filter_map(|(table, rows)| {
            // A row that cannot be read comes first.
            let head = rows.peek()?.as_ref().map_or(i64::MIN, |row| row.seq);
            Some((head, *table, rows))
        });
        let Some((_, table, rows)) = heads.min_by_key(|(head, ..)| *head) else {
            break judge_end(&meta, seq, &before).or(runs.next().transpose()?.map(|run| surplus(seq, &run)));
        };
        let Some(row) = rows.next().transpose()? else { break judge_end(&meta, seq, &before) };
        match judge(table, seq + 1, &row, &before) {
            Ok(hash) => (before, seq) = (hash, seq + 1),
            Err(broken) => break Some(broken),
        }
    };
    let good_rows = if broken.is_some() { seq.min(meta.head.count) - thinned_rows } else { seq - thinned_rows };
    Ok(ChainReport { good_rows, rows: meta.head.count, thinned_rows, head: hex(&meta.head.hash), broken })
}

/// A run of thinned rows whose place in the chain is taken.
fn surplus(rows: i64, run: &ThinnedRun) -> BrokenRow {
    let ThinnedRun { first, last, .. } = run;
    let found = format!("rows {first} to {last} as thinned out");
    BrokenRow { table: String::new(), row: *first, expected: format!("{rows} rows in their places"), found }
}

/// Returns the row's hash if it is row `seq` of the chain and unchanged.
fn judge(table: HistoryTable, seq: i64, row: &ChainLink, before: &Hash) -> Result<Hash, BrokenRow> {
    if row.seq != seq {
        let found = format!("row {} of {}", row.seq, table.name());
        return Err(BrokenRow { table: String::new(), row: seq, expected: format!("row {seq}"), found });
    }
    let expected = link(before, table, seq, &row.values);
    if row.hash == expected {
        return Ok(expected);
    }
    Err(BrokenRow { table: table.name().to_owned(), row: seq, expected: hex(&expected), found: hex(&row.hash) })
}

/// Compares the last row with the head in `meta`.
fn judge_end(meta: &Meta, rows: i64, last: &Hash) -> Option<BrokenRow> {
    let head = &meta.head;
    if rows == head.count && *last == head.hash {
        return None;
    }
    let of = |rows: i64, hash: &Hash| format!("{rows} rows, the last of hash {}", hex(hash));
    let row = rows.min(head.count) + 1;
    Some(BrokenRow { table: String::new(), row, expected: of(head.count, &head.hash), found: of(rows, last) })
}
