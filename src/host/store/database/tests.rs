//! Commits, restores, the chain and its faults, thinning, migration and damaged files, on real databases.

use super::super::folder::{DATABASE, Folder};
use super::super::packed;
use super::super::parts::JsonParts;
use super::super::reader::{HistoryQuery, HistoryReader};
use super::super::rows::HistoryTable;
use super::super::rows::tests::{alarm, capacity, half_cycle, loss_modes, model, remaining_life};
use super::super::verify;
use super::*;
use crate::alarm::Change;
use crate::quantity::Timestamp;

fn stamp(seconds: f64) -> Stamp {
    Stamp::replayed(Timestamp::from_secs(seconds))
}

fn batch(seconds: f64, kinds: &[EventKind]) -> RowBatch {
    RowBatch { stamp: stamp(seconds), rows: kinds.iter().map(|kind| HistoryRow::Event(*kind)).collect() }
}

fn state(numbers: &[f64]) -> StateRecord {
    StateRecord {
        parts: JsonParts::of(&serde_json::to_vec(numbers).unwrap()).unwrap(),
        exact: false,
        sets_aside: false,
    }
}

fn open(folder: &Path) -> Database {
    Database::open(&folder.join(DATABASE), &stamp(0.0), RowLimits::SMALL).unwrap()
}

/// A history of every kind of row, with a state.
fn filled(folder: &Path) -> Database {
    let mut database = open(folder);
    for day in 0..40_u32 {
        let seconds = f64::from(day) * 86_400.0;
        let learned: Vec<EventKind> =
            (0..4).flat_map(|cell| [half_cycle(cell), capacity(cell, Some(2.0 + seconds * 1e-9), 1.9)]).collect();
        let numbers: Vec<f64> = (0..300).map(|n| f64::from(n) + seconds).collect();
        database
            .commit(&[batch(seconds, &learned), batch(seconds, &[alarm(Change::Raised)])], Some(state(&numbers)))
            .unwrap();
    }
    database
}

fn broken_row(folder: &Path) -> (String, i64) {
    let verdict = HistoryReader::open(folder).unwrap().verify().unwrap();
    verdict.broken.map(|broken| (broken.table, broken.row)).unwrap_or_default()
}

#[test]
fn a_commit_is_there_after_reopening() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = filled(folder.path());
    database.commit(&[], Some(state(&[1.5; 300]))).unwrap();
    let counts = database.counts();
    assert_eq!(counts, Counts { chained: 200, half_cycles: 160, packs: 1 });
    drop(database);
    let database = open(folder.path());
    assert_eq!(database.counts(), counts);
    let stored = database.state().unwrap().unwrap().unwrap();
    assert_eq!((stored.json, stored.fault), (serde_json::to_vec(&vec![1.5; 300]).unwrap(), None));
    assert_eq!(broken_row(folder.path()), (String::new(), 0));
}

#[test]
fn every_change_of_a_chained_row_is_found_and_named() {
    let changes = [
        ("UPDATE capacity SET capacity_ah = 9 WHERE seq = 5 * 10 + 2", ("capacity", 52)),
        ("UPDATE alarm SET acknowledged = 1 WHERE seq = 15", ("alarm", 15)),
        ("UPDATE capacity SET hash = zeroblob(32) WHERE seq = 7", ("capacity", 7)),
        ("DELETE FROM capacity WHERE seq = 8", ("", 8)),
        ("DELETE FROM alarm WHERE seq = 200", ("", 200)),
        ("UPDATE moment SET wall_ns = wall_ns + 1 WHERE id = 3", ("capacity", 6)),
        ("DELETE FROM moment WHERE id = 4", ("alarm", 10)),
        ("UPDATE meta SET chained = 199", ("", 200)),
        (
            "INSERT INTO alarm SELECT 201, moment, cell, rule, severity, change, state, active, value, probability, threshold, \
          occurrences, acknowledged, hash FROM alarm WHERE seq = 200",
            ("alarm", 201),
        ),
    ];
    for (sql, (table, row)) in changes {
        let folder = tempfile::tempdir().unwrap();
        drop(filled(folder.path()));
        let connection = Connection::open(folder.path().join(DATABASE)).unwrap();
        assert_eq!(connection.execute(sql, []).unwrap(), 1, "{sql}");
        drop(connection);
        assert_eq!(broken_row(folder.path()), (table.to_owned(), row), "{sql}");
    }
}

#[test]
fn the_identity_of_a_pack_is_in_its_row_and_in_the_chain() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = open(folder.path());
    let another = EventKind::PackReplaced { capacity_ah: Some(1.9), capacity_std_ah: Some(0.1) };
    let identified = |identity| EventKind::PackIdentity { identity };
    database.commit(&[batch(1.0, &[identified(4711.0)]), batch(2.0, &[another, identified(4712.0)])], None).unwrap();
    let connection = database.connection();
    let of = |id: i64| -> String {
        connection.query_row("SELECT identity FROM pack WHERE id = ?1", [id], |row| row.get(0)).unwrap()
    };
    assert_eq!((of(1), of(2)), ("4711".to_owned(), "4712".to_owned()));
    assert_eq!(database.counts(), Counts { chained: 3, half_cycles: 0, packs: 2 });
    assert_eq!(broken_row(folder.path()), (String::new(), 0));
}

#[test]
fn half_cycles_are_thinned_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = open(folder.path());
    for day in 0..400_u32 {
        let learned: Vec<EventKind> =
            (0..4).flat_map(|cell| [half_cycle(cell), capacity(cell, Some(2.0), 1.9)]).collect();
        database.commit(&[batch(f64::from(day), &learned)], None).unwrap();
        database.commit(&[], None).unwrap();
    }
    let counts = database.counts();
    assert_eq!(counts.chained, 1600);
    assert_eq!(counts.half_cycles, 1000);
    let rows: i64 = database.connection().query_row("SELECT count(*) FROM half_cycle", [], |row| row.get(0)).unwrap();
    assert_eq!(rows, 1000);
    let latest: i64 = database
        .connection()
        .query_row("SELECT count(*) FROM half_cycle WHERE moment > 300", [], |row| row.get(0))
        .unwrap();
    assert_eq!(latest, 400, "of the latest hundred transitions all are there");
    assert_eq!(verify::verify(database.connection()).unwrap().broken, None);
}

#[test]
fn half_cycles_beyond_the_horizon_are_deleted_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = open(folder.path());
    for day in 0..40_u32 {
        let learned = [half_cycle(0), half_cycle(1), capacity(0, Some(2.0), 1.9)];
        database.commit(&[batch(86_400.0 * f64::from(day), &learned)], None).unwrap();
    }
    database.commit(&[], None).unwrap();
    assert_eq!(database.counts().half_cycles, 80, "without a horizon all are kept");
    database.set_horizon_ns(Some(10 * 86_400_000_000_000));
    database.commit(&[], None).unwrap();
    assert_eq!(database.counts().half_cycles, 72, "a few at each checkpoint");
    (0..10).for_each(|_| database.commit(&[], None).unwrap());
    let counts = database.counts();
    assert_eq!((counts.half_cycles, counts.chained), (60, 40));
    let sql = "SELECT min(m.wall_ns) FROM half_cycle h JOIN moment m ON m.id = h.moment";
    let oldest: i64 = database.connection().query_row(sql, [], |row| row.get(0)).unwrap();
    assert_eq!(oldest, 10 * 86_400_000_000_000);
    assert_eq!(verify::verify(database.connection()).unwrap().broken, None);
}

#[test]
fn a_half_cycle_of_unknown_age_is_deleted_with_those_after_it() {
    const WALL_S: f64 = 1.8e9;
    let folder = tempfile::tempdir().unwrap();
    let mut database = open(folder.path());
    let write = |database: &mut Database, wall_s: f64| {
        let stamp = Stamp { boot: BootId([7; 16]), ..stamp(wall_s) };
        database.commit(&[RowBatch { stamp, rows: vec![HistoryRow::Event(half_cycle(0))] }], None).unwrap();
    };
    // The clock shows 1970 until it is set.
    [0.0, 60.0, WALL_S].into_iter().for_each(|wall_s| write(&mut database, wall_s));
    database.set_horizon_ns(Some(WALL_S as i64 * 1_000_000_000));
    database.commit(&[], None).unwrap();
    assert_eq!(database.counts().half_cycles, 3, "of unknown age, perhaps new");
    database.set_horizon_ns(Some((WALL_S as i64 + 1) * 1_000_000_000));
    database.commit(&[], None).unwrap();
    assert_eq!(database.counts().half_cycles, 0, "older than one that is too old");
}

#[test]
fn another_pack_closes_one_history_and_opens_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = filled(folder.path());
    let replaced = EventKind::PackReplaced { capacity_ah: Some(2.1), capacity_std_ah: Some(0.1) };
    database.commit(&[batch(9e6, &[replaced])], None).unwrap();
    database.commit(&[batch(9.1e6, &[capacity(0, Some(2.5), 2.4)])], None).unwrap();
    let packs: Vec<(i64, Option<i64>)> = database
        .connection()
        .prepare("SELECT id, closed_ns FROM pack")
        .unwrap()
        .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))
        .unwrap()
        .map(Result::unwrap)
        .collect();
    assert_eq!(packs, [(1, Some(9_000_000_000_000_000)), (2, None)]);
    drop(database);
    let entries = HistoryReader::open(folder.path())
        .unwrap()
        .entries(&HistoryQuery { limit: Some(2), ..HistoryQuery::default() })
        .unwrap();
    assert_eq!(
        entries.iter().map(|entry| (entry.kind, entry.pack)).collect::<Vec<_>>(),
        [(HistoryTable::Reset, 1), (HistoryTable::Capacity, 2)]
    );
}

#[test]
fn an_older_layout_is_migrated_with_its_rows() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(DATABASE);
    drop(filled(folder.path()));
    let added = "CREATE TABLE added (id INTEGER PRIMARY KEY) STRICT; INSERT INTO added SELECT count(*) FROM alarm;";
    let migrations: Vec<&str> = MIGRATIONS.iter().copied().chain([added]).collect();
    let database = Database::open_with(&path, &stamp(1.0), RowLimits::SMALL, &migrations).unwrap();
    assert_eq!(database.counts().chained, 200);
    assert_eq!(database.connection().query_row("SELECT id FROM added", [], |row| row.get::<_, i64>(0)).unwrap(), 40);
    drop(database);
    // Now it is a newer layout, which the present program must not touch.
    let before = std::fs::read(&path).unwrap();
    let newer = Database::open(&path, &stamp(2.0), RowLimits::SMALL).unwrap_err();
    let known = schema::known(MIGRATIONS);
    assert_eq!(newer, OpenError::Newer { found: known + 1, known });
    assert_eq!(std::fs::read(&path).unwrap(), before);
}

#[test]
fn a_history_of_an_older_layout_is_read_and_continued() {
    (1..MIGRATIONS.len()).for_each(continues_from_version);
}

fn continues_from_version(version: usize) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(DATABASE);
    let mut old = Database::open_with(&path, &stamp(1.0), RowLimits::SMALL, &MIGRATIONS[..version]).unwrap();
    let rows = |kinds: Vec<EventKind>| kinds.into_iter().map(HistoryRow::Event).collect();
    old.commit(&[RowBatch { stamp: stamp(2.0), rows: rows(vec![capacity(0, Some(2.0), 1.9)]) }], None).unwrap();
    drop(old);
    let kinds = || -> Vec<HistoryTable> {
        let reader = HistoryReader::open(folder.path()).unwrap();
        assert_eq!(reader.verify().unwrap().broken, None);
        reader.entries(&HistoryQuery::default()).unwrap().iter().map(|entry| entry.kind).collect()
    };
    assert_eq!(kinds(), [HistoryTable::Capacity]);
    let mut database = open(folder.path());
    let learned = vec![capacity(0, Some(2.0), 1.8), loss_modes(0, 0.08), remaining_life(90.0), model(Some(2.0))];
    database.commit(&[RowBatch { stamp: stamp(3.0), rows: rows(learned) }], None).unwrap();
    drop(database);
    let [capacity, losses, life] = [HistoryTable::Capacity, HistoryTable::LossModes, HistoryTable::RemainingLife];
    assert_eq!(kinds(), [capacity, capacity, losses, life, HistoryTable::Model]);
}

#[test]
fn a_history_without_models_keeps_every_row_when_it_gets_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(DATABASE);
    let mut old = Database::open_with(&path, &stamp(1.0), RowLimits::SMALL, &MIGRATIONS[..6]).unwrap();
    let first = [half_cycle(0), capacity(0, Some(2.0), 1.9), loss_modes(0, 0.08), remaining_life(90.0)];
    let reset = EventKind::FilterReset { cell: crate::quantity::CellIndex(0) };
    old.commit(&[batch(2.0, &first), batch(3.0, &[alarm(Change::Raised), reset])], Some(state(&[1.0]))).unwrap();
    drop(old);
    let rows = || {
        let reader = HistoryReader::open(folder.path()).unwrap();
        (reader.verify().unwrap(), reader.entries(&HistoryQuery::default()).unwrap())
    };
    let before = rows();
    assert_eq!((before.0.broken.as_ref(), before.0.rows, before.1.len()), (None, 5, 6));
    let mut database = open(folder.path());
    assert_eq!(schema::version(database.connection()).unwrap(), 7);
    assert_eq!(rows(), before);
    assert_eq!(database.state().unwrap().unwrap().unwrap().fault, None);
    database.commit(&[batch(4.0, &[model(None)])], None).unwrap();
    drop(database);
    let (verdict, entries) = rows();
    assert_eq!((verdict.broken, verdict.rows, &entries[..6]), (None, 6, &before.1[..]));
    let [added] = &entries[6..] else { panic!() };
    assert_eq!((added.kind, &added.values[1], added.values[2].is_null()), (HistoryTable::Model, &"prior".into(), true));
    let older = Database::open_with(&path, &stamp(5.0), RowLimits::SMALL, &MIGRATIONS[..6]).unwrap_err();
    assert_eq!(older, OpenError::Newer { found: 7, known: 6 });
}

#[test]
fn a_failed_migration_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(DATABASE);
    drop(filled(folder.path()));
    let migrations: Vec<&str> =
        MIGRATIONS.iter().copied().chain(["CREATE TABLE added (id); INSERT INTO nowhere VALUES (1);"]).collect();
    Database::open_with(&path, &stamp(1.0), RowLimits::SMALL, &migrations).unwrap_err();
    let database = open(folder.path());
    let version = schema::version(database.connection()).unwrap();
    assert_eq!((version, database.counts().chained), (schema::known(MIGRATIONS), 200));
}

#[test]
fn a_commit_that_fails_leaves_no_trace() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = filled(folder.path());
    let counts = database.counts();
    database.connection().execute_batch("ALTER TABLE state RENAME TO elsewhere").unwrap();
    database.commit(&[batch(9e6, &[capacity(0, Some(2.5), 2.4)])], Some(state(&[1.0]))).unwrap_err();
    database.connection().execute_batch("ALTER TABLE elsewhere RENAME TO state").unwrap();
    assert_eq!(database.counts(), counts);
    database.commit(&[batch(9e6, &[capacity(0, Some(2.5), 2.4)])], Some(state(&[1.0]))).unwrap();
    assert_eq!(verify::verify(database.connection()).unwrap().broken, None);
}

/// Overwrites pages in the middle of the file.
fn damage(path: &Path, from: f64, bytes: usize) {
    use std::os::unix::fs::FileExt as _;
    let file = std::fs::File::options().write(true).open(path).unwrap();
    let at = (file.metadata().unwrap().len() as f64 * from) as u64;
    file.write_all_at(&vec![0xA5; bytes], at).unwrap();
}

#[test]
fn a_damaged_database_is_set_aside_and_its_rows_are_copied() {
    for from in [0.3, 0.5, 0.7, 0.9] {
        let place = tempfile::tempdir().unwrap();
        drop(filled(place.path()));
        damage(&place.path().join(DATABASE), from, 3000);
        let mut folder = Folder::new(place.path().to_owned(), RowLimits::SMALL);
        let opening = folder.open(&stamp(1.0)).unwrap();
        assert!(!opening.is_sound, "{from}");
        assert!(place.path().join("packwatch.db.damaged-1").exists(), "{from}");
        let saved = opening.database.counts();
        assert!(saved.chained > 100 && saved.chained < 200, "{from}: {saved:?}");
        let reports: i64 = opening
            .database
            .connection()
            .query_row("SELECT count(*) FROM reset WHERE reason = 'damaged'", [], |row| row.get(0))
            .unwrap();
        assert_eq!(reports, 1, "{from}");
        assert_eq!(verify::verify(opening.database.connection()).unwrap().broken, None, "{from}");
        // No changed row was copied.
        let odd: i64 = opening
            .database
            .connection()
            .query_row("SELECT count(*) FROM capacity WHERE capacity_ah <> 2.5", [], |row| row.get(0))
            .unwrap();
        assert_eq!(odd, 0, "{from}");
    }
}

#[test]
fn a_file_that_is_no_database_is_set_aside() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join(DATABASE);
    let makers: [&dyn Fn(); 3] = [
        &|| std::fs::write(&path, "this is no database\n".repeat(500)).unwrap(),
        &|| std::fs::create_dir(&path).unwrap(),
        &|| Connection::open(&path).unwrap().execute_batch("CREATE TABLE other (x)").unwrap(),
    ];
    for (number, make) in (1..).zip(makers) {
        make();
        let mut opening = Folder::new(place.path().to_owned(), RowLimits::SMALL).open(&stamp(1.0)).unwrap();
        assert!(!opening.is_sound);
        assert!(place.path().join(format!("packwatch.db.damaged-{number}")).exists());
        opening.database.commit(&[], Some(state(&[1.0]))).unwrap();
        drop(opening);
        std::fs::remove_file(&path).unwrap();
    }
}

#[test]
fn a_folder_belongs_to_one_process() {
    let place = tempfile::tempdir().unwrap();
    let mut first = Folder::new(place.path().join("made/on the way"), RowLimits::SMALL);
    first.lock().unwrap();
    let mut second = Folder::new(place.path().join("made/on the way"), RowLimits::SMALL);
    assert_eq!(second.lock().unwrap_err().kind(), std::io::ErrorKind::WouldBlock);
    drop(first);
    second.lock().unwrap();
}

#[test]
fn a_checkpoint_overwrites_its_pages_in_place() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = filled(folder.path());
    let pages = |database: &Database| -> i64 {
        database.connection().query_row("PRAGMA page_count", [], |row| row.get(0)).unwrap()
    };
    database.commit(&[], Some(state(&[1.0; 300]))).unwrap();
    let before = pages(&database);
    for minute in 0..200 {
        let numbers: Vec<f64> = (0..300).map(|n| 1.0 + f64::from(n % 60) * f64::from(minute) * 1e-6).collect();
        database.commit(&[], Some(state(&numbers))).unwrap();
    }
    assert!(pages(&database) <= before + 4, "{} pages, then {}", before, pages(&database));
}

#[test]
fn a_history_can_be_read_while_it_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = filled(folder.path());
    let reader = HistoryReader::open(folder.path()).unwrap();
    let all = reader.entries(&HistoryQuery::default()).unwrap();
    assert_eq!(all.len(), 360);
    database.commit(&[batch(9e6, &[alarm(Change::Cleared)])], None).unwrap();
    let filter = HistoryQuery { kinds: vec![HistoryTable::Alarm], limit: Some(1), ..HistoryQuery::default() };
    let last = &reader.entries(&filter).unwrap()[0];
    assert_eq!((last.seq, last.wall_ns), (Some(201), 9_000_000_000_000_000));
    assert_eq!(last.values[3], "cleared");
    let of_cell = HistoryQuery {
        cell: Some(2),
        since_ns: Some(86_400_000_000_000),
        until_ns: Some(2 * 86_400_000_000_000),
        ..HistoryQuery::default()
    };
    assert_eq!(reader.entries(&of_cell).unwrap().len(), 4);
}

/// Numbers of the records of each copy.
fn numbers(database: &Database) -> [Vec<i64>; 2] {
    state_slots::COPIES.map(|table| {
        let mut statement =
            database.connection().prepare(&format!("SELECT serial FROM {table} ORDER BY slot")).unwrap();
        statement.query_map([], |row| row.get(0)).unwrap().map(Result::unwrap).collect()
    })
}

fn stored(database: &Database) -> (Vec<f64>, Option<String>) {
    let stored = database.state().unwrap().unwrap().unwrap();
    (serde_json::from_slice(&stored.json).unwrap(), stored.fault)
}

#[test]
fn each_state_overwrites_the_older_copy_and_the_newest_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = open(folder.path());
    for number in 1..=7_i32 {
        let mut values = vec![0.5; 300];
        values[7] = f64::from(number);
        database.commit(&[], Some(state(&values))).unwrap();
        assert_eq!(stored(&database), (values.clone(), None));
        drop(database);
        database = open(folder.path());
        assert_eq!(stored(&database), (values, None), "after a start");
    }
    assert_eq!(numbers(&database), [vec![1, 7], vec![2, 6]]);
}

#[test]
fn a_damaged_copy_leaves_the_other_and_is_written_next() {
    for (damage, newer_is_lost) in [
        ("UPDATE state SET bytes = zeroblob(length) WHERE slot = 1", true),
        ("UPDATE state SET bytes = zeroblob(length) WHERE slot = 0", true),
        ("UPDATE state SET serial = serial + 1 WHERE slot = 1", true),
        ("UPDATE state SET length = length - 1 WHERE slot = 0", true),
        ("DELETE FROM state WHERE slot = 0", true),
        ("UPDATE state_b SET bytes = zeroblob(length) WHERE slot = 1", false),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let mut database = open(folder.path());
        // Short in binary: a delta rounds.
        let values = |number: i32| -> Vec<f64> {
            (0..300).map(|n| if n == 7 { f64::from(number) } else { 0.5 + f64::from(n) }).collect()
        };
        (1..=5).for_each(|number| database.commit(&[], Some(state(&values(number)))).unwrap());
        assert_eq!(database.connection().execute(damage, []).unwrap(), 1);
        drop(database);
        let mut database = open(folder.path());
        let (found, fault) = stored(&database);
        let fault = fault.unwrap();
        assert_eq!(found, values(if newer_is_lost { 4 } else { 5 }), "{damage}");
        let outcome = if newer_is_lost { "an earlier state is used" } else { "a newer state is good and used" };
        assert!(fault.ends_with(outcome), "{damage}: {fault}");
        database.commit(&[], Some(state(&values(6)))).unwrap();
        drop(database);
        assert_eq!(stored(&open(folder.path())), (values(6), None), "{damage}");
    }
}

#[test]
fn a_state_of_layout_4_is_restored_and_becomes_the_first_copy() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(DATABASE);
    let old = Database::open_with(&path, &stamp(1.0), RowLimits::SMALL, &MIGRATIONS[..4]).unwrap();
    let parts = |number: f64| state(&[number; 300]).parts;
    // As that layout wrote them: sealed without their own number, which is that of the full record.
    for (slot, record) in [(0, packed::full(&parts(1.5), 0)), (1, packed::old_delta(&parts(2.5), &parts(1.5), 3))] {
        let values = rusqlite::params![slot, i64::try_from(record.len()).unwrap(), record];
        old.connection().execute("INSERT INTO state VALUES (?1, 3, ?2, ?3)", values).unwrap();
    }
    drop(old);
    assert!(HistoryReader::open(folder.path()).unwrap().verify().is_ok());
    let mut database = open(folder.path());
    assert_eq!(stored(&database), (vec![2.5; 300], None));
    database.commit(&[], Some(state(&[3.5; 300]))).unwrap();
    assert_eq!(numbers(&database), [vec![3, 3], vec![4]]);
    drop(database);
    assert_eq!(stored(&open(folder.path())), (vec![3.5; 300], None));
}

#[test]
fn a_flipped_bit_of_the_version_is_damage_and_a_newer_program_is_not() {
    for bit in 0..32 {
        let place = tempfile::tempdir().unwrap();
        let database = filled(place.path());
        let version = schema::known(MIGRATIONS) ^ (1 << bit);
        database.connection().pragma_update(None, "user_version", version).unwrap();
        database.close().unwrap();
        let error = Database::open(&place.path().join(DATABASE), &stamp(1.0), RowLimits::SMALL).unwrap_err();
        assert!(matches!(error, OpenError::Damaged(_)), "{version}: {error}");
        let opening = Folder::new(place.path().to_owned(), RowLimits::SMALL).open(&stamp(1.0)).unwrap();
        assert_eq!(opening.database.counts(), Counts { chained: 201, half_cycles: 160, packs: 1 }, "{version}");
    }
}

#[test]
fn what_meta_says_of_the_history_is_compared_with_it() {
    for (change, is_damage) in [
        ("UPDATE meta SET chained = chained + 64", true),
        ("UPDATE meta SET head = zeroblob(32)", true),
        ("UPDATE pack SET id = 3", true),
        ("UPDATE meta SET half_cycles = 1000000", false),
        ("UPDATE meta SET half_cycles = -1", false),
    ] {
        let place = tempfile::tempdir().unwrap();
        let database = filled(place.path());
        assert_eq!(database.connection().execute(change, []).unwrap(), 1);
        drop(database);
        let opened = Database::open(&place.path().join(DATABASE), &stamp(1.0), RowLimits::SMALL);
        assert_eq!(matches!(opened, Err(OpenError::Damaged(_))), is_damage, "{change}");
        drop(opened);
        let opening = Folder::new(place.path().to_owned(), RowLimits::SMALL).open(&stamp(1.0)).unwrap();
        let rows = if is_damage { 201 } else { 200 };
        assert_eq!(opening.database.counts(), Counts { chained: rows, half_cycles: 160, packs: 1 }, "{change}");
    }
}

#[test]
fn a_moment_is_deleted_with_its_last_row() {
    let folder = tempfile::tempdir().unwrap();
    let mut database = open(folder.path());
    for day in 0..1200_u32 {
        // Every fifth transition has a capacity, some have an alarm.
        let mut learned = vec![half_cycle(0)];
        learned.extend((day % 5 == 0).then(|| capacity(0, Some(2.0), 1.9)));
        learned.extend((day % 7 == 0).then(|| alarm(Change::Raised)));
        database.commit(&[batch(f64::from(day), &learned)], None).unwrap();
        database.commit(&[], None).unwrap();
    }
    let count = |sql: &str| -> i64 { database.connection().query_row(sql, [], |row| row.get(0)).unwrap() };
    let rows = "SELECT moment FROM half_cycle UNION SELECT moment FROM capacity UNION SELECT moment FROM alarm";
    assert_eq!(count("SELECT count(*) FROM half_cycle"), 1000);
    assert_eq!(count(&format!("SELECT count(*) FROM ({rows}) WHERE moment NOT IN (SELECT id FROM moment)")), 0);
    assert_eq!(count(&format!("SELECT count(*) FROM moment WHERE id NOT IN ({rows})")), 0);
    assert!(count("SELECT count(*) FROM moment") < 1100);
    assert_eq!(verify::verify(database.connection()).unwrap().broken, None);
}
