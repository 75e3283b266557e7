//! Tests what a start recovers from a store without states, and what it must not restore.

use super::folder::Folder;
use super::rows::tests::{alarm, capacity};
use super::*;
use crate::alarm::{Change, Selector};
use crate::monitor::{LearnedCell, Source};

/// A store in a new folder, and the final state of its replay.
fn replayed_store() -> (tempfile::TempDir, Snapshot) {
    let place = tempfile::tempdir().unwrap();
    let state = place.path().join("state");
    let end = snapshot(None, Some(Recorder::create(&state, &config().store, &VehicleIdentity::default()).unwrap()));
    (place, end)
}

/// Damages both states.
fn without_states(place: &Path) {
    for name in state_files::FILES {
        std::fs::write(place.join("state").join(name), "nothing").unwrap();
    }
}

fn open(place: &Path) -> (Store, StoredStates) {
    let at = PlaceSetting::At(place.join("state"));
    let (store, found) = Store::open(&at, &config().store, &VehicleIdentity::default()).unwrap();
    (store.unwrap(), found)
}

#[test]
fn start_without_state_uses_capacities_in_history() {
    let (place, end) = replayed_store();
    without_states(place.path());
    let (_store, found) = open(place.path());
    assert!(found.states.is_empty() && !found.works);
    assert_eq!(found.learned.len(), 1);
    let mut monitor = Monitor::new(config().monitor);
    assert!(monitor.relearn(&found.learned));
    let (before, after) = (restored(end).capacity(CellIndex(0)), restored(monitor.snapshot()).capacity(CellIndex(0)));
    let learned = found.learned[0].capacity;
    assert!((after.mean - learned.mean).abs() < 1e-9 && (after.std() - learned.std()).abs() < 1e-9, "{after:?}");
    assert!((after.mean - before.mean).abs() < 0.1 * before.std(), "{before:?}, then {after:?}");
    let fresh = Monitor::new(config().monitor).capacity(CellIndex(0));
    assert!(fresh.std() > 1.5 * after.std(), "the capacity of a new cell is less certain: {fresh:?}, {after:?}");
}

#[test]
fn damaged_day_of_history_is_not_used() {
    let (place, _) = replayed_store();
    without_states(place.path());
    let mut folder = Folder::new(place.path().join("state"));
    let mut database = folder.open(&document(1, 1, 1).stamp, 0).unwrap().0;
    let good = database.learned().unwrap();
    assert_eq!(good.len(), 1);
    let rows = vec![HistoryRow::Event(capacity(0, Some(9.0), 9.0))];
    database.commit(&[RowBatch { stamp: document(1, 1, 1_800_000_000).stamp, rows }]).unwrap();
    assert_ne!(database.learned().unwrap(), good);
    let change = "UPDATE capacity SET capacity_ah = 9.9 WHERE seq = (SELECT max(seq) FROM capacity)";
    database.connection().execute(change, []).unwrap();
    assert_eq!(database.learned().unwrap(), good);
}

#[test]
fn capacities_of_other_cells_are_not_used() {
    let mut monitor = Monitor::new(config().monitor);
    let before = serde_json::to_string(&monitor.snapshot()).unwrap();
    let of = |cell: u16, mean: f64, std: f64| {
        let capacity = crate::filter::ScalarGaussian::from_std(mean, std);
        LearnedCell { cell: CellIndex(cell), capacity, usable: None, resistance: None }
    };
    for learned in [of(1, 2.0, 0.1), of(0, f64::NAN, 0.1), of(0, -2.0, 0.1), of(0, 2.0, 0.0), of(0, 2.0, f64::INFINITY)]
    {
        assert!(!monitor.relearn(&[of(0, 2.0, 0.1), learned]), "{learned:?}");
    }
    assert_eq!(serde_json::to_string(&monitor.snapshot()).unwrap(), before);
    assert!(monitor.relearn(&[of(0, 2.0, 0.1)]));
}

#[test]
fn lost_history_does_not_restore_old_pack() {
    let (place, _) = replayed_store();
    let state = place.path().join("state");
    assert_eq!(replace_pack(&state).unwrap(), 2);
    std::fs::write(state.join(DATABASE), "nothing").unwrap();
    let (_store, found) = open(place.path());
    assert!(found.states.is_empty() && found.learned.is_empty());
}

#[test]
fn command_is_committed_while_alarm_flickers() {
    let place = tempfile::tempdir().unwrap();
    let (store, _) =
        Store::open(&PlaceSetting::At(place.path().to_owned()), &config().store, &VehicleIdentity::default()).unwrap();
    let mut store = store.unwrap();
    let monitor = Monitor::new(config().monitor);
    let time = Timestamp::from_secs(1.0);
    let event = |kind| Event { time, kind };
    let flickers = |store: &mut Store| store.learned(&[event(alarm(Change::Raised))], &monitor, time);
    while flickers(&mut store).is_some() {}
    let command = |changed| {
        let command = Command::Clear(Selector::default());
        event(EventKind::Command { source: Source::Local, command, changed, refused: 0 })
    };
    let cleared = event(alarm(Change::Cleared));
    assert_eq!(store.learned(&[command(0)], &monitor, time), None, "nothing has changed");
    let ticket = store.learned(&[cleared, command(1)], &monitor, time).unwrap();
    assert!(answer(&store, ticket).works);
    assert!(flickers(&mut store).is_none(), "no further commit of the flickering alarm");
    let entries = HistoryReader::open(place.path()).unwrap().entries(&HistoryQuery::default()).unwrap();
    assert_eq!(entries.last().unwrap().values[3], "cleared");
}

#[test]
fn chain_end_is_logged_daily() {
    // 2027-01-15T00:00:00Z.
    const MIDNIGHT_S: i64 = 1_799_971_200;
    let place = tempfile::tempdir().unwrap();
    let mut writer = writer(place.path());
    let log = place.path().join("log");
    let file = Arc::new(std::fs::File::create(&log).unwrap());
    let subscriber = tracing_subscriber::fmt().with_writer(file).with_ansi(false).finish();
    let mut seen = 0;
    let mut logged = |from_midnight_s: i64| {
        let state = document(1, 100_000 + from_midnight_s, MIDNIGHT_S + from_midnight_s);
        let batch = RowBatch { stamp: state.stamp, rows: vec![HistoryRow::Event(capacity(0, Some(2.0), 1.9))] };
        let mut batches = vec![batch];
        writer.commit(&mut batches, &state).unwrap();
        assert!(batches.is_empty());
        let text = std::fs::read_to_string(&log).unwrap();
        text[std::mem::replace(&mut seen, text.len())..].to_owned()
    };
    tracing::subscriber::with_default(subscriber, || {
        assert!(
            logged(-7200).contains("end of the history's chain"),
            "the first commit of the process logs the chain end"
        );
        assert_eq!(logged(-1), "", "the same day");
        let head = logged(0);
        let word =
            |key: &str| head.split_whitespace().find_map(|word| word.strip_prefix(key)).unwrap().trim_matches('"');
        assert_eq!(logged(86_399), "");
        let noted = format!("{}:{}", word("rows="), word("hash=")).parse().unwrap();
        assert_eq!(word("rows="), "3");
        let reader = reader::HistoryReader::open(place.path()).unwrap();
        assert_eq!(reader.contradiction(&noted), Ok(None), "verify --noted accepts the logged chain end");
        assert!(logged(86_400).contains("rows=5 "), "the next day");
    });
}
