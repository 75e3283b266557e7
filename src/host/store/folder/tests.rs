//! Tests state folders with damaged, foreign or locked contents.

use std::os::unix::fs::FileExt as _;

use super::super::reader::{HistoryQuery, HistoryReader};
use super::super::rows::RowBatch;
use super::super::rows::tests::capacity;
use super::super::tests::document;
use super::*;

fn open(place: &Path, pack: i64) -> (Database, Vec<HistoryRow>) {
    Folder::new(place.to_owned()).open(&document(1, 200, 1_800_000_100).stamp, pack).unwrap()
}

#[test]
fn damaged_database_is_set_aside() {
    let place = tempfile::tempdir().unwrap();
    let (mut database, about) = open(place.path(), 0);
    assert!(about.is_empty());
    for hundredth in 0..200_u32 {
        let rows = (0..4).map(|cell| HistoryRow::Event(capacity(cell, Some(2.0), f64::from(hundredth) / 100.0)));
        database.commit(&[RowBatch { stamp: document(1, 100, 1_800_000_000).stamp, rows: rows.collect() }]).unwrap();
    }
    drop(database);
    let file = File::options().write(true).open(place.path().join(DATABASE)).unwrap();
    file.write_all_at(&[0xA5; 3000], file.metadata().unwrap().len() * 2 / 5).unwrap();
    let (mut database, about) = open(place.path(), 3);
    let [HistoryRow::Own { reason: "damaged", detail }] = &about[..] else { panic!("{about:?}") };
    assert!(detail.contains("packwatch.db.damaged-1"), "{detail}");
    assert!(place.path().join("packwatch.db.damaged-1").exists());
    assert_eq!(
        (database.rows(), database.pack()),
        (0, 3),
        "the new history continues with the pack that the state knows"
    );
    database.commit(&[RowBatch { stamp: document(1, 200, 1_800_000_100).stamp, rows: about }]).unwrap();
    drop(database);
    assert!(open(place.path(), 3).1.is_empty(), "the next start finds nothing wrong");
    let reader = HistoryReader::open(place.path()).unwrap();
    assert_eq!((reader.verify().unwrap().broken, reader.entries(&HistoryQuery::default()).unwrap().len()), (None, 1));
}

#[test]
fn at_most_eight_foreign_files_are_set_aside() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join(DATABASE);
    let makers: [&dyn Fn(); 4] = [
        &|| fs::write(&path, "this is no database\n".repeat(500)).unwrap(),
        &|| fs::create_dir_all(path.join("within")).unwrap(),
        &|| rusqlite::Connection::open(&path).unwrap().execute_batch("CREATE TABLE other (x)").unwrap(),
        &|| {
            drop(open(place.path(), 0));
            rusqlite::Connection::open(&path).unwrap().pragma_update(None, "user_version", 99).unwrap();
        },
    ];
    for (number, make) in (1..=9).zip(makers.iter().cycle()) {
        let _ = fs::remove_file(&path);
        make();
        assert_eq!(open(place.path(), 0).1.len(), 1, "{number}");
        let damaged = |number: u32| place.path().join(format!("packwatch.db.damaged-{number}")).exists();
        assert!(damaged(number.min(8)) && !damaged(number.min(8) + 1), "{number}");
    }
}

#[test]
fn log_of_damaged_database_is_moved_too() {
    let place = tempfile::tempdir().unwrap();
    let [old, new] = ["packwatch.db-wal", "packwatch.db.damaged-1-wal"].map(|name| place.path().join(name));
    fs::write(&old, "of the damaged one").unwrap();
    fs::write(&new, "of an earlier one").unwrap();
    let mut folder = Folder::new(place.path().to_owned());
    folder.mark_damaged("for the test");
    let _ = folder.open(&document(1, 200, 1_800_000_100).stamp, 0).unwrap();
    assert_eq!(fs::read_to_string(new).unwrap(), "of the damaged one");
}

#[test]
fn empty_file_after_power_cut_is_filled() {
    let place = tempfile::tempdir().unwrap();
    fs::write(place.path().join(DATABASE), "").unwrap();
    assert!(open(place.path(), 0).1.is_empty());
}

#[test]
fn folder_is_locked_by_one_process() {
    let place = tempfile::tempdir().unwrap();
    let mut first = Folder::new(place.path().join("made/on the way"));
    first.lock().unwrap();
    let mut second = Folder::new(place.path().join("made/on the way"));
    assert_eq!(second.lock().unwrap_err().kind(), std::io::ErrorKind::WouldBlock);
    drop(first);
    second.lock().unwrap();
}
