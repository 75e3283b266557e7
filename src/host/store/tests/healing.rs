//! Tests what the daemon recovers at its start if the store has no valid saved state, and what it must not restore.

use super::folder::Folder;
use super::rows::tests::capacity;
use super::*;
use crate::alarm::{AlarmState, Change, Rule, Severity};
use crate::monitor::{EventKind, LearnedCell};

/// Records a replay in a store in a new folder. Returns the folder and the final state of the replay.
fn replayed_store() -> (tempfile::TempDir, Snapshot) {
    let place = tempfile::tempdir().unwrap();
    let state = place.path().join("state");
    let end = snapshot(None, Some(Recorder::create(&state, &config().store, &VehicleIdentity::default()).unwrap()));
    (place, end)
}

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
    assert_eq!(replace_pack(&state).unwrap().next, 2);
    std::fs::write(state.join(DATABASE), "nothing").unwrap();
    let (_store, found) = open(place.path());
    assert!(found.states.is_empty() && found.learned.is_empty());
}

#[test]
fn pack_replacement_reports_damaged_history() {
    let (place, _) = replayed_store();
    let state = place.path().join("state");
    std::fs::write(state.join(DATABASE), "nothing").unwrap();
    let replaced = replace_pack(&state).unwrap();
    assert!(replaced.damage.unwrap().ends_with("set aside as packwatch.db.damaged-1; a new history starts"));
    assert_eq!(replace_pack(&state).unwrap().damage, None);
}

#[test]
fn missing_and_damaged_state_give_different_errors() {
    let (place, _) = replayed_store();
    let state = place.path().join("state");
    let required = || HistoryReader::open(&state).unwrap().required_snapshot();
    assert!(required().is_ok());
    without_states(place.path());
    let damaged = required().unwrap_err();
    assert!(damaged.contains(
        "the stored state cannot be used: state-a.json.zst: damaged: no hash at the end of the file; state-b.json.zst: damaged"
    ));
    state_files::forget(&state).unwrap();
    assert!(required().unwrap_err().contains("contains no stored state (state-a.json.zst, state-b.json.zst)"));
}

fn change(change: Change, occurrences: u32, acknowledged: bool) -> EventKind {
    let state = if change == Change::Raised { AlarmState::Active } else { AlarmState::Inactive };
    EventKind::Alarm {
        rule: Rule::EstimateUntrusted,
        cell: Some(CellIndex(0)),
        change,
        state,
        active: state.is_raised(),
        severity: Severity::Warning,
        value: Some(5.0),
        probability: None,
        threshold: 4.0,
        occurrences,
        acknowledged,
    }
}

/// Copies the folder and opens the store in the copy, as after a power cut.
fn after_cut(place: &Path) -> StoredStates {
    let copy = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(place.join("state")).unwrap() {
        let entry = entry.unwrap();
        std::fs::create_dir_all(copy.path().join("state")).unwrap();
        std::fs::copy(entry.path(), copy.path().join("state").join(entry.file_name())).unwrap();
    }
    let (store, found) = open(copy.path());
    store.finish(&at(9.0), Timestamp::from_secs(9.0));
    found
}

/// The raised alarms of a restored state, each with its occurrences and the time of the last occurrence (s).
fn raised(snapshot: Snapshot) -> Vec<(u32, f64)> {
    let monitor = restored(snapshot);
    monitor.alarms().raised().map(|alarm| (alarm.occurrences, alarm.last_raised.unwrap().secs())).collect()
}

#[test]
fn announced_alarm_survives_power_cut_without_new_state() {
    let place = tempfile::tempdir().unwrap();
    let (mut store, _) = open(place.path());
    let monitor = at(1.0);
    let mut announce = |seconds: u32, kind: EventKind| {
        let time = Timestamp::from_secs(f64::from(seconds));
        let ticket = store.learned(&[Event { time, kind }], &monitor, time).unwrap();
        assert!(answer(&store, ticket).works);
    };
    for second in 1..=200 {
        let kind = if second % 2 == 1 { Change::Raised } else { Change::Cleared };
        announce(second, change(kind, second.div_ceil(2), false));
    }
    assert_eq!(stored(&place.path().join("state")).number, 1, "no other state was written");
    let mut found = after_cut(place.path());
    assert_eq!(raised(found.states.remove(0).snapshot), []);
    announce(201, change(Change::Raised, 101, false));
    assert_eq!(stored(&place.path().join("state")).number, 1);
    let mut found = after_cut(place.path());
    assert_eq!(raised(found.states.remove(0).snapshot), [(101, 1.0)], "times are not later than the state's restore");
    // If there is no valid state, the history alone is enough to restore the alarms.
    without_states(place.path());
    let found = after_cut(place.path());
    assert_eq!((found.states.len(), found.alarms.len()), (0, 201));
    let mut snapshot = Monitor::new(config().monitor).snapshot();
    snapshot.repeat_alarms(&found.alarms);
    snapshot.time = Timestamp::from_secs(300.0);
    assert_eq!(raised(snapshot), [(101, 201.0)]);
}

#[test]
fn alarm_rows_of_a_new_database_continue_a_new_state() {
    let (place, _) = replayed_store();
    std::fs::write(place.path().join("state").join(DATABASE), "nothing").unwrap();
    let (mut store, found) = open(place.path());
    assert!(found.states.len() == 1 && found.alarms.is_empty() && !found.works);
    let before = stored(&place.path().join("state")).number;
    for second in 1..=3_u32 {
        let time = Timestamp::from_secs(f64::from(second));
        let kind = change(Change::Raised, second, false);
        let ticket = store.learned(&[Event { time, kind }], &at(1.0), time).unwrap();
        assert!(answer(&store, ticket).works);
    }
    let state = stored(&place.path().join("state"));
    assert_eq!(state.number, before + 1, "the first row is written with a state");
    assert!(state.history_rows <= 2, "of the new database: {}", state.history_rows);
    assert_eq!(raised(after_cut(place.path()).states.remove(0).snapshot).len(), 1);
}

#[test]
fn damaged_alarm_rows_are_not_repeated() {
    let (place, _) = replayed_store();
    let mut folder = Folder::new(place.path().join("state"));
    let mut database = folder.open(&document(1, 1, 1).stamp, 0).unwrap().0;
    let before = database.rows();
    let rows = vec![HistoryRow::Event(change(Change::Raised, 1, false))];
    database.commit(&[RowBatch { stamp: document(1, 1, 1_800_000_000).stamp, rows }]).unwrap();
    assert_eq!(database.alarm_changes(before).unwrap().len(), 1);
    database.connection().execute("UPDATE alarm SET occurrences = 7 WHERE seq > ?1", [before]).unwrap();
    assert_eq!(database.alarm_changes(before).unwrap(), []);
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
