//! Tests histories of many days that are changed, truncated, or beyond their limits.

use super::super::database::{Database, RowLimits};
use super::super::folder::DATABASE;
use super::super::reader::{HistoryQuery, HistoryReader};
use super::super::rows::tests::{alarm, capacity, half_cycle};
use super::super::rows::{HistoryRow, RowBatch};
use super::*;
use crate::alarm::Change;
use crate::config::StoreConfig;
use crate::monitor::EventKind;
use crate::quantity::{DAY_S, Timestamp};

/// A folder in memory if the system has one, because a commit needs several syncs, which are slow on a disk.
fn place() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

fn open(folder: &std::path::Path) -> Database {
    Database::open(&folder.join(DATABASE), &Stamp::replayed(Timestamp::ZERO), 0).unwrap()
}

fn commit(database: &mut Database, seconds: f64, kinds: &[EventKind]) {
    let stamp = Stamp::replayed(Timestamp::from_secs(seconds));
    database.commit(&[RowBatch { stamp, rows: kinds.iter().copied().map(HistoryRow::Event).collect() }]).unwrap();
}

/// Ten rows on each of these days: a half-cycle, eight capacities and an alarm.
fn filled(folder: &std::path::Path, days: std::ops::Range<u32>) -> Database {
    let mut database = open(folder);
    for day in days {
        let mut kinds = vec![half_cycle(0)];
        kinds.extend((0..8).map(|cell| capacity(cell, Some(2.0), 1.9)));
        commit(&mut database, DAY_S * f64::from(day), &kinds);
        commit(&mut database, DAY_S * f64::from(day) + 60.0, &[alarm(Change::Raised)]);
    }
    database
}

fn limits(max_rows: u32, keep_years: Option<f64>) -> RowLimits {
    (&StoreConfig { checkpoint_s: 60.0, max_rows, keep_years }).into()
}

fn number(database: &Database, sql: &str) -> i64 {
    database.connection().query_row(sql, [], |row| row.get(0)).unwrap()
}

#[test]
fn changed_row_breaks_its_segment() {
    let place = place();
    let database = filled(place.path(), 0..20);
    let broken = |change: &str| {
        database.connection().execute_batch(&format!("BEGIN; {change}")).unwrap();
        let broken = verify(database.connection()).unwrap().broken.map(|broken| (broken.segment, broken.rows));
        database.connection().execute_batch("ROLLBACK").unwrap();
        broken
    };
    assert_eq!(broken("SELECT 1"), None);
    for (change, segment) in [
        ("UPDATE capacity SET capacity_ah = 9 WHERE seq = 53", 6),
        ("UPDATE capacity SET code = code + 1 WHERE seq = 53", 6),
        ("UPDATE half_cycle SET charge_ah = 9 WHERE seq = 51", 6),
        ("UPDATE alarm SET acknowledged = 1 WHERE seq = 20", 2),
        ("DELETE FROM capacity WHERE seq = 8", 1),
        ("DELETE FROM alarm WHERE seq = 200", 20),
        ("UPDATE capacity SET seq = 1000 WHERE seq = 199", 20),
        ("UPDATE moment SET wall_ns = wall_ns + 1 WHERE id = 3", 2),
        ("DELETE FROM moment WHERE id = 4", 2),
        ("UPDATE segment SET hash = zeroblob(32) WHERE id = 7", 7),
        ("UPDATE segment SET last = last + 1 WHERE id = 7", 7),
        ("UPDATE segment SET last = 9223372036854775807 WHERE id = 7", 7),
        ("DELETE FROM segment WHERE id = 7", 8),
        ("UPDATE segment SET deleted = 1 WHERE id = 7", 7),
    ] {
        assert_eq!(broken(change).map(|(segment, _)| segment), Some(segment), "{change}");
    }
    // These changes remove rows at the end, or add rows without extending the chain.
    let cut = "DELETE FROM segment WHERE id = 20; DELETE FROM capacity WHERE seq > 190; DELETE FROM alarm WHERE seq > 190; \
               DELETE FROM half_cycle WHERE seq > 190";
    assert_eq!(broken(cut), Some((20, [191, 191])));
    let added = "INSERT INTO half_cycle (seq, code, moment) VALUES (201, 0, 40)";
    assert_eq!(broken(added), Some((21, [201, 201])));
}

#[test]
fn history_beyond_limit_loses_oldest_days() {
    let place = place();
    let mut database = filled(place.path(), 0..1);
    let mut heads = Vec::new();
    for day in 1..100 {
        drop(database);
        database = filled(place.path(), day..day + 1);
        heads.push(database.head());
        database.apply(&limits(200, None), &Stamp::replayed(Timestamp::ZERO)).unwrap();
    }
    let report = verify(database.connection()).unwrap();
    assert_eq!((report.broken, report.rows, report.deleted_rows, report.good_rows), (None, 1000, 800, 200));
    for table in ["half_cycle", "moment"] {
        let rows = number(&database, &format!("SELECT count(*) FROM {table}"));
        assert_eq!(rows, if table == "moment" { 40 } else { 20 });
    }
    let reader = HistoryReader::open(place.path()).unwrap();
    let extent = reader.extent().unwrap();
    assert_eq!((extent.half_cycles, extent.deleted_half_cycles, extent.written_half_cycles), (20, 80, 100));
    assert_eq!(reader.entries(&HistoryQuery::default()).unwrap().len(), 200);
    // The end of the chain was noted after each day. It still matches the history, even if the rows of the day were
    // deleted.
    for (rows, hash) in heads {
        assert_eq!(reader.contradiction(&NotedHead { rows, hash }).unwrap(), None, "{rows}");
        let other = NotedHead { rows, hash: "0".repeat(64) };
        assert!(reader.contradiction(&other).unwrap().unwrap().contains("rewritten"), "{rows}");
    }
    let within = NotedHead { rows: 15, hash: "0".repeat(64) };
    assert!(reader.contradiction(&within).unwrap().unwrap().contains("has been deleted"));
}

#[test]
fn end_noted_within_a_day_matches_later() {
    let place = place();
    let mut database = filled(place.path(), 0..3);
    commit(&mut database, 3.0 * DAY_S, &[alarm(Change::Raised)]);
    let (rows, hash) = database.head();
    commit(&mut database, 3.0 * DAY_S + 60.0, &[alarm(Change::Cleared)]);
    let noted = format!("{rows}:{hash}").parse::<NotedHead>().unwrap();
    assert_eq!(contradiction(database.connection(), &noted).unwrap(), None);
    let later = NotedHead { rows: rows + 2, ..noted };
    assert!(contradiction(database.connection(), &later).unwrap().unwrap().contains("row 33 does not exist"));
    for text in ["", "3", "3:12", ":", "-1:00", &format!("x:{}", later.hash)] {
        assert!(text.parse::<NotedHead>().is_err(), "{text}");
    }
}

#[test]
fn rows_beyond_horizon_are_deleted() {
    let place = place();
    let mut database = filled(place.path(), 0..800);
    let now = Stamp::replayed(Timestamp::from_secs(800.0 * DAY_S));
    database.apply(&limits(1_000_000, None), &now).unwrap();
    assert_eq!(verify(database.connection()).unwrap().deleted_rows, 0, "without a horizon all rows are kept");
    for _ in 0..800 {
        database.apply(&limits(1_000_000, Some(1.0)), &now).unwrap();
    }
    let report = verify(database.connection()).unwrap();
    assert_eq!((report.broken, report.good_rows), (None, 3650));
}

#[test]
fn day_of_unknown_date_is_deleted_with_later_days() {
    const WALL_S: f64 = 1.8e9;
    let place = place();
    let mut database = open(place.path());
    // The clock shows 1970 until it is set.
    for wall_s in [0.0, WALL_S, WALL_S + DAY_S, WALL_S + 2.0 * DAY_S] {
        let stamp = Stamp { boot: BootId([7; 16]), ..Stamp::replayed(Timestamp::from_secs(wall_s)) };
        database.commit(&[RowBatch { stamp, rows: vec![HistoryRow::Event(half_cycle(0))] }]).unwrap();
    }
    let kept_at = |database: &Database, horizon_s: f64| {
        let newest = Segment::newest(database.connection()).unwrap();
        delete_oldest(database.connection(), &newest, i64::MAX, Some(horizon_s as i64 * 1_000_000_000)).unwrap();
        number(database, "SELECT count(*) FROM half_cycle")
    };
    assert_eq!(kept_at(&database, WALL_S), 4, "a segment of unknown age may be new and is kept");
    assert_eq!(kept_at(&database, WALL_S + 1.0), 3, "the segment precedes one that is too old");
    assert_eq!(kept_at(&database, WALL_S + 1.0), 2);
    assert_eq!(kept_at(&database, WALL_S + 1.0), 2);
}

#[test]
fn day_with_many_rows_has_several_segments() {
    let place = place();
    let mut database = open(place.path());
    let kinds: Vec<EventKind> = (0..1000).map(|cell| capacity(cell, Some(2.0), 1.9)).collect();
    (0..25).for_each(|second| commit(&mut database, f64::from(second), &kinds));
    assert_eq!(number(&database, "SELECT count(*) FROM segment"), 3);
    assert_eq!(verify(database.connection()).unwrap().broken, None);
    let intact = intact(database.connection(), 0, 2).unwrap();
    assert_eq!(
        intact.iter().map(|segment| (segment.first, segment.last)).collect::<Vec<_>>(),
        [(10_001, 20_000), (20_001, 25_000)]
    );
}
