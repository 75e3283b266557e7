//! Rows without evidence, and a history larger than the memory.

use super::super::folder::DATABASE;
use super::super::retention::RowLimits;
use super::super::rows::tests::{capacity, half_cycle, loss_modes, model, remaining_life};
use super::super::rows::{HistoryRow, RowBatch};
use super::*;
use crate::monitor::EventKind;

fn open(path: &Path) -> Database {
    Database::open(path, &Stamp::replayed(Timestamp::ZERO), RowLimits::SMALL).unwrap()
}

fn commit(database: &mut Database, seconds: f64, kinds: &[EventKind]) {
    let stamp = Stamp::replayed(Timestamp::from_secs(seconds));
    let rows = kinds.iter().copied().map(HistoryRow::Event).collect();
    database.commit(&[RowBatch { stamp, rows }], None).unwrap();
}

#[test]
fn the_number_of_a_pack_is_accepted_from_rows_with_a_good_hash() {
    for odd in [3, 66, i64::MAX, 0, -1] {
        let place = tempfile::tempdir().unwrap();
        let (path, new) = (place.path().join(DATABASE), place.path().join("new.db"));
        let mut database = open(&path);
        commit(&mut database, 1.0, &[EventKind::PackIdentity { identity: 4711.0 }, capacity(0, Some(2.0), 1.9)]);
        commit(&mut database, 2.0, &[half_cycle(0)]);
        commit(&mut database, 3.0, &[EventKind::PackReplaced { capacity_ah: None, capacity_std_ah: None }]);
        commit(&mut database, 4.0, &[half_cycle(0), half_cycle(1), capacity(0, Some(2.0), 1.8)]);
        let damages = ["UPDATE moment SET pack = ?1 WHERE id = 2", "UPDATE moment SET pack = ?1 WHERE id = 4"];
        for damage in damages {
            assert_eq!(database.connection().execute(damage, [odd]).unwrap(), 1);
        }
        database.close().unwrap();
        let mut database = open(&new);
        let saved = salvage(&path, &place.path().join("pages.db"), &mut database).unwrap();
        assert_eq!((saved.half_cycles, saved.capacities, saved.resets, saved.refused), (0, 1, 2, 4), "{odd}");
        assert_eq!(database.counts().packs, 2, "{odd}");
        let packs: Vec<Option<String>> = database
            .connection()
            .prepare("SELECT identity FROM pack ORDER BY id")
            .unwrap()
            .query_map([], |row| row.get(0))
            .unwrap()
            .map(Result::unwrap)
            .collect();
        assert_eq!(packs, [Some("4711".to_owned()), None], "{odd}");
    }
}

#[test]
fn all_rows_of_a_sound_file_are_copied_in_their_order() {
    let place = tempfile::tempdir().unwrap();
    let (path, new) = (place.path().join(DATABASE), place.path().join("new.db"));
    let mut database = open(&path);
    for second in 0..100 {
        let learned: Vec<EventKind> =
            (0..3).flat_map(|cell| [half_cycle(cell), capacity(cell, Some(2.0), 1.9)]).collect();
        commit(&mut database, f64::from(second), &learned);
    }
    let counts = database.counts();
    database.close().unwrap();
    let mut database = open(&new);
    let saved = salvage(&path, &place.path().join("pages.db"), &mut database).unwrap();
    assert_eq!((database.counts(), saved.refused), (counts, 0));
    let moments: i64 = database.connection().query_row("SELECT count(*) FROM moment", [], |row| row.get(0)).unwrap();
    assert_eq!(moments, 100, "a moment is copied once");
}

#[test]
fn models_and_rows_with_as_many_columns_are_not_mixed_up() {
    let place = tempfile::tempdir().unwrap();
    let (path, new) = (place.path().join(DATABASE), place.path().join("new.db"));
    let mut database = open(&path);
    // A row whose table its hash shows comes after a model, and before one.
    let kinds = [model(None), loss_modes(0, 0.1), model(Some(2.0)), remaining_life(90.0), capacity(0, None, 1.9)];
    commit(&mut database, 1.0, &kinds);
    let rows = |path: &Path| -> Vec<(i64, String, Option<f64>, i64)> {
        let sql = "SELECT seq, state, residual_v, taken_back FROM model ORDER BY seq";
        let connection = Connection::open(path).unwrap();
        let mut statement = connection.prepare(sql).unwrap();
        let rows = statement.query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?, row.get(3)?)));
        rows.unwrap().collect::<rusqlite::Result<_>>().unwrap()
    };
    database.close().unwrap();
    let written = rows(&path);
    assert_eq!(written, [(1, "prior".to_owned(), None, 1), (3, "learning".to_owned(), Some(0.003), 0)]);
    let mut database = open(&new);
    let saved = salvage(&path, &place.path().join("pages.db"), &mut database).unwrap();
    assert_eq!((saved.models, saved.losses, saved.lives, saved.capacities, saved.refused), (2, 1, 1, 1, 0));
    database.close().unwrap();
    assert_eq!(rows(&new), written);
}

/// Peak memory of this process since the last call, kB.
fn peak_kb() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    std::fs::write("/proc/self/clear_refs", "5").unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

#[test]
fn a_long_history_needs_no_more_memory_than_a_short_one() {
    const ROWS: i64 = 60_000;
    let place = tempfile::tempdir().unwrap();
    let (path, new) = (place.path().join(DATABASE), place.path().join("new.db"));
    let database = open(&path);
    let fill = format!(
        "WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < {ROWS} - 1)
         INSERT INTO half_cycle SELECT i + 1, 0, 'charge', 1.0, 0.5, 0.1, 60.0, 1.0, 25.0 FROM n;
         INSERT INTO moment SELECT moment, moment, moment, moment, zeroblob(16), 1 FROM half_cycle;"
    );
    database.connection().execute_batch(&fill).unwrap();
    database.close().unwrap();
    let mut database = open(&new);
    peak_kb();
    let before = peak_kb();
    let saved = salvage(&path, &place.path().join("pages.db"), &mut database).unwrap();
    let after = peak_kb();
    assert_eq!(i64::try_from(saved.half_cycles).unwrap(), ROWS);
    // All in memory were 40 MB. Other tests of this process may take some.
    assert!(after < before + 12_000, "{before} kB, then {after} kB");
}
