//! Collects the rows of a damaged database by this program's own layout, page by page.
//!
//! The schema in the file, the pages above the rows and the file's header are not used: a row is known by its columns. In: the
//! damaged file. Out: a database of the present layout with the rows found (not checked; numbers, moments and hashes as they
//! were), and the newest valid state.
//!
//! Rows of `loss_modes` and `remaining_life` have the same columns; their hash shows the table. One whose predecessor in the
//! chain is lost is in neither.

use std::path::Path;

use rusqlite::types::Value;
use rusqlite::{Connection, OptionalExtension, Statement, params_from_iter};

use super::chain::{self, Hash};
use super::delta_encoder::DeltaEncoder;
use super::document::StateDocument;
use super::packed;
use super::pages::{PageFile, PageKind, PageRecord};
use super::row_sql::MOMENT_COLUMNS;
use super::rows::HistoryTable;
use super::schema::MIGRATIONS;

/// Tables whose rows are collected.
const TABLES: [&str; 9] = ["pack", "moment", "half_cycle", "capacity", "model", "alarm", "reset", "thinned", UNSURE];
/// Rows of one of the two tables of equal columns, until their hash has shown which.
const UNSURE: &str = "unsure";
/// Those tables.
const ALIKE: [HistoryTable; 2] = [HistoryTable::LossModes, HistoryTable::RemainingLife];
/// Full records and deltas of the state that are tried: two of each are stored, and as many may be set aside.
const MAX_STATE_RECORDS: usize = 16;

/// What was collected.
#[derive(Debug)]
pub(super) struct Carved {
    /// The rows.
    pub(super) connection: Connection,
    /// Records that are no row, and rows without a table.
    pub(super) lost: usize,
    /// The newest valid state.
    pub(super) state: Option<StateDocument>,
}

/// Collects the rows of `damaged` into a new database at `path`, which is not used after a power cut.
///
/// # Errors
/// When that database cannot be written.
pub(super) fn carve(damaged: &Path, path: &Path) -> rusqlite::Result<Carved> {
    let connection = Connection::open(path)?;
    connection.query_row("PRAGMA journal_mode = OFF", [], |_| Ok(()))?;
    connection.pragma_update(None, "synchronous", "OFF")?;
    MIGRATIONS.iter().try_for_each(|migration| connection.execute_batch(migration))?;
    let columns = "seq INTEGER PRIMARY KEY, moment INTEGER NOT NULL, cell INTEGER, a REAL, b REAL, c REAL, d REAL, e REAL, f REAL, \
                   hash BLOB NOT NULL";
    connection.execute_batch(&format!("CREATE TABLE {UNSURE} ({columns}) STRICT; BEGIN"))?;
    let mut lost = 0;
    let mut states = StateRecords::default();
    if let Ok(file) = PageFile::open(damaged) {
        let mut tables =
            TABLES.map(|table| TableTarget::new(&connection, table)).into_iter().collect::<Result<Vec<_>, _>>()?;
        for page in 1..=file.pages() {
            let Some((kind, records, unreadable)) = file.records(page) else { continue };
            lost += unreadable;
            for record in records {
                states.note(&record);
                for table in &mut tables {
                    if table.insert(kind, &record)? {
                        break;
                    }
                }
            }
        }
    }
    lost += resolve_unsure(&connection)?;
    connection.execute_batch("COMMIT")?;
    Ok(Carved { state: states.newest(), connection, lost })
}

/// A table that rows are inserted into.
struct TableTarget<'a> {
    kind: PageKind,
    columns: Vec<Column>,
    insert: Statement<'a>,
}

/// A column of the layout.
struct Column {
    type_name: String,
    is_required: bool,
    /// It is the row's number, which the record does not repeat.
    is_number: bool,
}

impl Column {
    fn accepts(&self, value: &Value) -> bool {
        match (value, self.type_name.as_str()) {
            (Value::Null, _) => self.is_number || !self.is_required,
            _ if self.is_number => false,
            (Value::Integer(_), "INTEGER" | "REAL")
            | (Value::Real(_), "REAL")
            | (Value::Text(_), "TEXT")
            | (Value::Blob(_), "BLOB") => true,
            _ => false,
        }
    }
}

impl<'a> TableTarget<'a> {
    fn new(connection: &'a Connection, table: &str) -> rusqlite::Result<Self> {
        let kind = if table == HistoryTable::HalfCycle.name() { PageKind::Keys } else { PageKind::Rows };
        let mut statement = connection.prepare(&format!("PRAGMA table_info({table})"))?;
        let columns = statement.query_map([], |row| {
            let is_key: bool = row.get(5)?;
            Ok(Column { type_name: row.get(2)?, is_required: row.get(3)?, is_number: is_key && kind == PageKind::Rows })
        })?;
        let columns: Vec<Column> = columns.collect::<rusqlite::Result<_>>()?;
        let places = vec!["?"; columns.len()].join(", ");
        let insert = connection.prepare(&format!("INSERT OR IGNORE INTO {table} VALUES ({places})"))?;
        Ok(Self { kind, columns, insert })
    }

    /// Inserts a record that is a row of this table; `false` = it is none.
    fn insert(&mut self, kind: PageKind, record: &PageRecord) -> rusqlite::Result<bool> {
        let is_row = kind == self.kind
            && record.values.len() == self.columns.len()
            && self.columns.iter().zip(&record.values).all(|(column, value)| column.accepts(value));
        if is_row {
            let number = Value::Integer(record.rowid);
            let values = self.columns.iter().zip(&record.values);
            let values = values.map(|(column, value)| if column.is_number { &number } else { value });
            self.insert.execute(params_from_iter(values))?;
        }
        Ok(is_row)
    }
}

/// Moves the rows of [`UNSURE`] to the table that their hash shows; returns the number of those that no hash shows.
fn resolve_unsure(connection: &Connection) -> rusqlite::Result<usize> {
    let links = ["capacity", "model", "alarm", "reset", UNSURE];
    let links = links.map(|table| format!("SELECT hash FROM {table} WHERE seq = ?1"));
    let thinned = "SELECT hash FROM thinned WHERE last = ?1".to_owned();
    let links: Vec<String> = links.into_iter().chain([thinned]).collect();
    let mut before = connection.prepare(&links.join(" UNION ALL "))?;
    let mut rows = connection.prepare(&format!(
        "SELECT r.hash, r.moment, m.wall_ns, m.time_ns, m.boottime_ns, m.boot, m.pack, r.cell, a, b, c, d, e, f, r.seq \
         FROM {UNSURE} r JOIN moment m ON m.id = r.moment ORDER BY r.seq"
    ))?;
    let values = MOMENT_COLUMNS + 7;
    let mut rows = rows.query([])?;
    let mut found = 0;
    while let Some(row) = rows.next()? {
        let seq: i64 = row.get(1 + values)?;
        let Ok(hash) = row.get::<_, Hash>(0) else { continue };
        let known = before.query_row([seq - 1], |row| row.get::<_, Hash>(0)).optional();
        let Some(known) = known.ok().flatten().or((seq == 1).then_some([0; 32])) else { continue };
        let values: Vec<Value> = (1..=values).map(|at| row.get(at)).collect::<rusqlite::Result<_>>()?;
        let table = ALIKE.into_iter().find(|&table| chain::link(&known, table, seq, &values) == hash);
        if let Some(table) = table {
            let name = table.name();
            found += connection.execute(&format!("INSERT INTO {name} SELECT * FROM {UNSURE} WHERE seq = ?1"), [seq])?;
        }
    }
    let all: i64 = connection.query_row(&format!("SELECT count(*) FROM {UNSURE}"), [], |row| row.get(0))?;
    Ok(usize::try_from(all).unwrap_or(0) - found)
}

/// Records of the state, with their numbers.
#[derive(Debug, Default)]
struct StateRecords {
    full: Vec<(i64, Vec<u8>)>,
    delta: Vec<(i64, Vec<u8>)>,
}

impl StateRecords {
    /// Keeps a record that is a row of the state: number in the chain of states, length, bytes.
    fn note(&mut self, record: &PageRecord) {
        let [Value::Null, Value::Integer(number), Value::Integer(length), Value::Blob(bytes)] =
            record.values.as_slice()
        else {
            return;
        };
        let Some(bytes) = usize::try_from(*length).ok().and_then(|length| bytes.get(..length)) else { return };
        let records = match record.rowid {
            0 => &mut self.full,
            1 => &mut self.delta,
            _ => return,
        };
        if records.len() < MAX_STATE_RECORDS {
            records.push((*number, bytes.to_vec()));
        }
    }

    /// The newest state of a full record, or of a delta to one, whose hash is good.
    fn newest(&self) -> Option<StateDocument> {
        let mut newest = None;
        for (serial, record) in &self.full {
            let Ok(encoder) = DeltaEncoder::with_base(*serial, record, 0) else { continue };
            let Some((_, base)) = encoder.base() else { continue };
            let deltas = self.delta.iter().filter_map(|(number, record)| {
                Some((*number, packed::read_delta(record, base, *serial, *number).ok()?))
            });
            let state = deltas.max_by_key(|(number, _)| *number).unwrap_or_else(|| (*serial, base.clone()));
            newest = newest.filter(|(number, _): &(i64, _)| *number > state.0).or(Some(state));
        }
        StateDocument::parse(&newest?.1.join()).ok()
    }
}
