//! Tests commits, pack changes, and reading while another connection writes, on real databases.

use super::super::folder::DATABASE;
use super::super::reader::{HistoryQuery, HistoryReader};
use super::super::rows::tests::{alarm, capacity, half_cycle, loss_modes, model, remaining_life};
use super::*;
use crate::alarm::Change;
use crate::quantity::Timestamp;

fn batch(seconds: f64, kinds: &[EventKind]) -> RowBatch {
    let rows = kinds.iter().map(|kind| HistoryRow::Event(*kind)).collect();
    RowBatch { stamp: Stamp::replayed(Timestamp::from_secs(seconds)), rows }
}

fn open(folder: &Path) -> Database {
    Database::open(&folder.join(DATABASE), &Stamp::replayed(Timestamp::ZERO), 0).unwrap()
}

/// A history of forty days.
fn filled(folder: &Path) -> Database {
    let mut database = open(folder);
    for day in 0..40_u32 {
        let seconds = f64::from(day) * 86_400.0;
        let learned: Vec<EventKind> =
            (0..4).flat_map(|cell| [half_cycle(cell), capacity(cell, Some(2.0 + seconds * 1e-9), 1.9)]).collect();
        database.commit(&[batch(seconds, &learned), batch(seconds, &[alarm(Change::Raised)])]).unwrap();
    }
    database
}

#[test]
fn commit_survives_reopening() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = open(folder.path());
    // The commit has every kind of row, and a negative zero, which SQLite stores without its sign.
    let mut kinds =
        vec![half_cycle(0), capacity(0, Some(2.0), 1.9), loss_modes(0, -0.0), remaining_life(90.0), model(None)];
    kinds.extend([alarm(Change::Raised), EventKind::FilterReset { cell: crate::quantity::CellIndex(3) }]);
    database.commit(&[batch(1.0, &kinds)]).unwrap();
    let head = database.head();
    drop(database);
    let database = open(folder.path());
    assert_eq!((database.head(), database.rows(), database.pack()), (head, 7, 1));
    assert_eq!(segments::verify(database.connection()).unwrap().broken, None);
}

#[test]
fn failed_commit_leaves_no_trace() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = filled(folder.path());
    let head = database.head();
    database.connection().execute_batch("ALTER TABLE alarm RENAME TO elsewhere").unwrap();
    let rows = [batch(9e6, &[capacity(0, Some(2.5), 2.4), alarm(Change::Cleared)])];
    database.commit(&rows).unwrap_err();
    database.connection().execute_batch("ALTER TABLE elsewhere RENAME TO alarm").unwrap();
    assert_eq!(database.head(), head);
    database.commit(&rows).unwrap();
    assert_eq!(segments::verify(database.connection()).unwrap().broken, None);
}

#[test]
fn pack_identity_is_stored_in_pack_row() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = open(folder.path());
    let another = EventKind::PackReplaced { capacity_ah: Some(1.9), capacity_std_ah: Some(0.1) };
    let identified = |identity| EventKind::PackIdentity { identity };
    database.commit(&[batch(1.0, &[identified(4711.0)]), batch(2.0, &[another, identified(4712.0)])]).unwrap();
    let of = |id: i64| -> String {
        database.connection().query_row("SELECT identity FROM pack WHERE id = ?1", [id], |row| row.get(0)).unwrap()
    };
    assert_eq!((of(1), of(2), database.pack()), ("4711".to_owned(), "4712".to_owned(), 2));
}

#[test]
fn pack_change_closes_history_and_opens_next() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = filled(folder.path());
    assert!(!database.is_closed(1).unwrap());
    let replaced = EventKind::PackReplaced { capacity_ah: Some(2.1), capacity_std_ah: Some(0.1) };
    database.commit(&[batch(9e6, &[replaced])]).unwrap();
    database.commit(&[batch(9.1e6, &[capacity(0, Some(2.5), 2.4)])]).unwrap();
    assert_eq!([0, 1, 2, 3].map(|pack| database.is_closed(pack).unwrap()), [false, true, false, false]);
    drop(database);
    let query = HistoryQuery { limit: Some(2), ..HistoryQuery::default() };
    let entries = HistoryReader::open(folder.path()).unwrap().entries(&query).unwrap();
    assert_eq!(
        entries.iter().map(|entry| (entry.kind, entry.pack)).collect::<Vec<_>>(),
        [(HistoryTable::Reset, 1), (HistoryTable::Capacity, 2)]
    );
    // If the stored state has a later pack number (5) than the database, the database continues with this number.
    let path = folder.path().join(DATABASE);
    assert_eq!(Database::open(&path, &Stamp::replayed(Timestamp::ZERO), 5).unwrap().pack(), 5);
    assert_eq!(open(folder.path()).pack(), 5);
}

#[test]
fn history_can_be_read_while_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = filled(folder.path());
    let reader = HistoryReader::open(folder.path()).unwrap();
    assert_eq!(reader.entries(&HistoryQuery::default()).unwrap().len(), 360);
    database.commit(&[batch(9e6, &[alarm(Change::Cleared)])]).unwrap();
    let filter = HistoryQuery { kinds: vec![HistoryTable::Alarm], limit: Some(1), ..HistoryQuery::default() };
    let last = &reader.entries(&filter).unwrap()[0];
    assert_eq!((last.seq, last.wall_ns), (361, 9_000_000_000_000_000));
    assert_eq!(last.values[3], "cleared");
    let of_cell = HistoryQuery {
        cell: Some(2),
        since_ns: Some(86_400_000_000_000),
        until_ns: Some(2 * 86_400_000_000_000),
        ..HistoryQuery::default()
    };
    assert_eq!(reader.entries(&of_cell).unwrap().len(), 4);
}
