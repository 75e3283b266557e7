//! A damaged database replaced, with the power cut after each step.

use super::super::database::Counts;
use super::super::reader::{HistoryQuery, HistoryReader};
use super::super::retention::RowLimits;
use super::super::rows::tests::capacity;
use super::super::tests::document;
use super::*;
use crate::monitor::EventKind;

const WHY: &str = "for the test";

/// A folder with a history of two hundred capacities and a state, damaged in the middle.
fn damaged() -> tempfile::TempDir {
    use std::os::unix::fs::FileExt as _;
    let place = tempfile::tempdir().unwrap();
    let state = document(1, 100, 1_800_000_000);
    let mut database = Database::open(&place.path().join(DATABASE), &state.stamp, RowLimits::SMALL).unwrap();
    for hundredth in 0..200_u32 {
        let learned: Vec<EventKind> =
            (0..4).map(|cell| capacity(cell, Some(2.0), f64::from(hundredth) / 100.0)).collect();
        let rows = learned.into_iter().map(HistoryRow::Event).collect();
        database.commit(&[RowBatch { stamp: state.stamp, rows }], None).unwrap();
    }
    database.commit(&[], Some(StateRecord::new(&state, true, false).unwrap())).unwrap();
    database.close().unwrap();
    let file = File::options().write(true).open(place.path().join(DATABASE)).unwrap();
    let at = file.metadata().unwrap().len() * 2 / 5;
    file.write_all_at(&[0xA5; 3000], at).unwrap();
    place
}

/// Starts and returns the chained rows and the number of reports of the damage.
fn start(place: &Path) -> (Counts, usize) {
    let now = document(1, 200, 1_800_000_100).stamp;
    let opening = Folder::new(place.to_owned(), RowLimits::SMALL).open(&now).unwrap();
    assert!(!opening.is_sound && opening.state.is_some());
    let counts = opening.database.counts();
    drop(opening);
    assert!(
        Folder::new(place.to_owned(), RowLimits::SMALL).open(&now).unwrap().is_sound,
        "the next start finds nothing wrong"
    );
    let names: Vec<String> = fs::read_dir(place)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.contains(".new") || name.contains(".part"))
        .collect();
    assert!(names.is_empty(), "{names:?}");
    assert!(place.join("packwatch.db.damaged-1").exists() && !place.join("packwatch.db.damaged-2").exists());
    let reader = HistoryReader::open(place).unwrap();
    assert_eq!(reader.verify().unwrap().broken, None);
    let rows = reader.entries(&HistoryQuery::default()).unwrap();
    (counts, rows.iter().filter(|entry| entry.values.contains(&"damaged".into())).count())
}

/// The time of the power cut, and the files in the folder then.
type Cut<'a> = (&'a str, &'a dyn Fn(&Path));

#[test]
fn an_interrupted_replacement_is_repeated_or_finished() {
    let uncut = start(damaged().path());
    assert!(uncut.0.chained > 400 && uncut.0.chained < 800 && uncut.1 == 1, "{uncut:?}");
    let stamp = document(1, 150, 1_800_000_050).stamp;
    let filled = |place: &Path| Folder::new(place.to_owned(), RowLimits::SMALL).fill_replacement(WHY, &stamp).unwrap();
    let cuts: [Cut<'_>; 4] = [
        ("while it was filled", &|place| {
            let _ = Database::open(&place.join(PART), &stamp, RowLimits::SMALL).unwrap();
            fs::write(place.join("packwatch.db.part-wal"), "of another file").unwrap();
        }),
        ("when it was complete", &filled),
        ("after the log was moved", &|place| {
            filled(place);
            fs::write(place.join("packwatch.db.damaged-1-wal"), "of the damaged one").unwrap();
        }),
        ("after the damaged one was moved", &|place| {
            filled(place);
            fs::rename(place.join(DATABASE), place.join("packwatch.db.damaged-1")).unwrap();
        }),
    ];
    for (when, cut) in cuts {
        let place = damaged();
        cut(place.path());
        assert_eq!(start(place.path()), uncut, "{when}");
    }
}

#[test]
fn a_history_is_no_place_for_a_replay_while_its_replacement_waits() {
    let place = damaged();
    let stamp = document(1, 150, 1_800_000_050).stamp;
    Folder::new(place.path().to_owned(), RowLimits::SMALL).fill_replacement(WHY, &stamp).unwrap();
    fs::remove_file(place.path().join(DATABASE)).unwrap();
    assert!(has_history(place.path()));
}

#[test]
fn a_replacement_that_cannot_be_made_leaves_the_damaged_database_where_it_is() {
    let place = damaged();
    // No file can be created under that name.
    fs::create_dir_all(place.path().join("packwatch.db.new/x")).unwrap();
    let mut folder = Folder::new(place.path().to_owned(), RowLimits::SMALL);
    let now = document(1, 150, 1_800_000_050).stamp;
    folder.lock().unwrap();
    assert!(matches!(folder.fill_replacement(WHY, &now), Err(OpenError::Unavailable(_))));
    assert!(place.path().join(DATABASE).exists());
    // Not at every attempt.
    let error = folder.fill_replacement(WHY, &now).unwrap_err().to_string();
    assert!(error.contains("less than 600 s ago"), "{error}");
    fs::remove_dir_all(place.path().join("packwatch.db.new")).unwrap();
    drop(folder);
    start(place.path());
}
