//! Tests of the store with real states.

mod flips;
mod healing;
mod rounding;

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use super::folder::DATABASE;
use super::*;

use crate::can::encode::{InputEncoder, InputProtector};
use crate::config::{self, Config};
use crate::io::csv_log::CsvOptions;
use crate::io::log::{LogOptions, LogSource};
use crate::monitor::{Outputs, Record};
use crate::quantity::CellIndex;
use crate::replay::{self, LogTime, ReplaySettings, Sinks};

fn config() -> Config {
    config::load(&PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../config/measured.toml")).unwrap()
}

/// Returns the log of a cell that is alternately discharged and charged, for a quarter of an hour each.
fn log(config: &Config, folder: &Path) -> LogSource {
    let mut text = String::from("time_s,current_a,voltage_v,temperature_c\n");
    let mut soc: f64 = 0.9;
    for second in 0..7_200_u32 {
        let current_a = if second / 900 % 2 == 0 { 2.0 } else { -2.0 };
        soc -= current_a / 3600.0 / 2.6;
        let _ = writeln!(text, "{second},{current_a},{:.4},24.5", 3.3 + 0.8 * soc - 0.05 * current_a);
    }
    let path = folder.join("cell.csv");
    std::fs::write(&path, text).unwrap();
    let encoder = InputEncoder::new(&config.monitor.input);
    let mut protector = InputProtector::new(&config.monitor.guards);
    let options = LogOptions {
        interfaces: config.interface_names(),
        channels: Vec::new(),
        strict: true,
        csv: CsvOptions { cells: 1, ..CsvOptions::default() },
        encode_row: Box::new(move |values, frames| {
            let uncarried = encoder.encode(values, frames);
            protector.protect(frames);
            uncarried
        }),
    };
    LogSource::new(vec![path], options)
}

/// Returns the state after `seconds` of the log, or at the end of the log if `seconds` is `None`.
fn snapshot(seconds: Option<i64>, store: Option<Recorder>) -> Snapshot {
    let folder = tempfile::tempdir().unwrap();
    let config = config();
    let mut source = log(&config, folder.path());
    let settings = ReplaySettings {
        snapshot: true,
        snapshot_at: seconds.map(|seconds| LogTime::After(seconds * 1_000_000_000)),
        away: Some(Downtime::AsStamped),
        store,
        ..ReplaySettings::plain(30.0, config.interface_names())
    };
    let monitor = Monitor::new(config.monitor);
    replay::run(&mut source, monitor, Sinks::default(), settings, &mut |_| {}).unwrap().1.unwrap()
}

fn restored(snapshot: Snapshot) -> Monitor {
    let mut monitor = Monitor::new(config().monitor);
    let time = snapshot.time;
    monitor.restore(snapshot, Downtime::AsStamped).unwrap();
    monitor.handle(&Record::tick(time), &mut Outputs::default());
    monitor
}

fn stored(folder: &Path) -> StateDocument {
    StateFiles::open(folder).1.newest.unwrap()
}

#[test]
fn replay_stores_its_final_state() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let end = snapshot(None, Some(Recorder::create(&state, &config().store, &VehicleIdentity::default()).unwrap()));
    let now = Stamp::replayed(end.time.plus_secs(60.0));
    let rows = Database::open(&state.join(DATABASE), &now, 0).unwrap().rows();
    let stored = stored(&state);
    assert!(rows >= 8 && stored.history_rows == rows && stored.pack == 1, "{rows}, {}", stored.history_rows);
    assert_eq!(stored.stamp.age(&now, WallClock::Reliable), Downtime::Seconds(60.0));
    let (near, exact) = (restored(*stored.snapshot), restored(end.for_restart()));
    let (near, exact) = (near.capacity(CellIndex(0)), exact.capacity(CellIndex(0)));
    assert!((near.mean - exact.mean).abs() < 1e-8 && (near.std() - exact.std()).abs() < 1e-8, "{near:?} {exact:?}");
}

/// Builds a state document that was taken `boottime_s` seconds after the boot `boot`.
pub(super) fn document(boot: u8, boottime_s: i64, wall_s: i64) -> StateDocument {
    let boot = BootId([boot; 16]);
    let time = Timestamp::from_secs(1.0);
    let stamp = Stamp { wall_ns: wall_s * 1_000_000_000, time, boottime_ns: boottime_s * 1_000_000_000, boot };
    let monitor = Monitor::new(config().monitor);
    StateDocument {
        format: FORMAT,
        number: 0,
        folder: String::new(),
        pack: 1,
        history_rows: 0,
        stamp,
        snapshot: Box::new(monitor.snapshot()),
    }
}

#[test]
fn newer_state_comes_first() {
    let of = |running: Option<StateDocument>, stored: Option<StateDocument>| -> Vec<(&str, i64)> {
        let found = candidates([running, stored, None]);
        found.into_iter().map(|(state, source)| (source, state.stamp.boottime_ns / 1_000_000_000)).collect()
    };
    let at = |boottime_s| Some(document(1, boottime_s, 0));
    assert_eq!(of(at(98), at(50)), [("runtime folder", 98), (STATE_SOURCE, 50)]);
    assert_eq!(of(at(50), at(98)), [(STATE_SOURCE, 98), ("runtime folder", 50)]);
    assert_eq!(of(None, at(50)), [(STATE_SOURCE, 50)]);
    assert_eq!(of(None, None), []);
}

#[test]
fn state_of_replaced_pack_is_not_restored() {
    let place = tempfile::tempdir().unwrap();
    let now = document(1, 100, 1_800_000_000);
    let open = |running: Option<i64>| {
        let running = running.map(|pack| StateDocument { pack, ..now.clone() });
        let opened = OpenedFolder::open(&mut Folder::new(place.path().to_owned()), running, &now.stamp);
        (opened.found.states.iter().map(|state| state.source).collect::<Vec<_>>(), opened)
    };
    let (none, mut opened) = open(None);
    assert_eq!(none.len(), 0);
    opened.state_files.write(now.clone()).unwrap();
    drop(opened);
    assert_eq!(open(None).0, [STATE_SOURCE]);
    // A power cut happens after the row of the pack change was written and before the state was written.
    open(None).1.database.unwrap().replace_pack(&now.stamp).unwrap();
    assert_eq!(open(None).0.len(), 0);
    assert_eq!(open(Some(1)).0.len(), 0, "the runtime state of the old pack is not restored either");
    assert_eq!(open(Some(2)).0, ["runtime folder"]);
    // If the history is lost, the old state is not restored either.
    std::fs::remove_file(place.path().join(DATABASE)).unwrap();
    assert_eq!(open(Some(2)).0, ["runtime folder"]);
    assert_eq!(open(Some(0)).0, ["runtime folder", STATE_SOURCE], "the pack is unknown");
}

#[test]
fn rows_missing_in_history_are_reported() {
    let place = tempfile::tempdir().unwrap();
    let state = document(1, 100, 1_800_000_000);
    let open = || OpenedFolder::open(&mut Folder::new(place.path().to_owned()), None, &state.stamp);
    let mut opened = open();
    let rows = vec![HistoryRow::Event(rows::tests::capacity(0, Some(2.0), 1.9))];
    opened.database.unwrap().commit(&[RowBatch { stamp: state.stamp, rows }]).unwrap();
    opened.state_files.write(StateDocument { history_rows: 3, ..state.clone() }).unwrap();
    let opened = open();
    assert!(matches!(&opened.rows[..], [HistoryRow::Own { reason: "history_cut", .. }]), "{:?}", opened.rows);
    assert!(!opened.found.works && opened.found.states.len() == 1);
}

fn writer(folder: &Path) -> Writer {
    Writer {
        write_queue: Arc::default(),
        vehicle: VehicleIdentity::default(),
        limits: (&StoreConfig { checkpoint_s: 60.0, max_rows: 10_000, keep_years: None }).into(),
        reserve: Reserve::new(folder),
        head_day: None,
        folder: Folder::new(folder.to_owned()),
        state_files: StateFiles::open(folder).0,
        database: None,
        progress: watch::channel(StoreProgress::default()).0,
        retry: Retry::default(),
        knows_state: true,
        needs_state: true,
        was_replaced: false,
    }
}

/// Waits for the writer's progress to reach a ticket.
fn answer(store: &Store, ticket: u64) -> StoreProgress {
    let progress = store.progress();
    let begun = Instant::now();
    while progress.borrow().ticket < ticket {
        assert!(begun.elapsed() < Duration::from_secs(30), "the writer did not answer");
        std::thread::sleep(Duration::from_millis(1));
    }
    *progress.borrow()
}

#[test]
fn failing_disk_gets_everything_when_it_works() {
    let place = tempfile::tempdir().unwrap();
    let state = place.path().join("folder");
    // A file in place of the folder prevents the store from creating anything there.
    std::fs::write(&state, "").unwrap();
    let (store, found) =
        Store::open(&PlaceSetting::At(state.clone()), &config().store, &VehicleIdentity::default()).unwrap();
    let mut store = store.unwrap();
    assert!(!found.works && found.states.is_empty());
    let monitor = Monitor::new(config().monitor);
    let kind = rows::tests::capacity(0, Some(2.0), 1.9);
    let mut learn = |seconds: f64| {
        let time = Timestamp::from_secs(seconds);
        store.learned(&[Event { time, kind }], &monitor, time).unwrap()
    };
    let tickets = [learn(1.0), learn(2.0), learn(3.0)];
    let last = tickets[2];
    assert!(!answer(&store, last).works);
    std::fs::remove_file(&state).unwrap();
    let begun = Instant::now();
    while !store.progress().borrow().works {
        assert!(begun.elapsed() < Duration::from_secs(30), "the writer did not retry");
        std::thread::sleep(Duration::from_millis(10));
    }
    assert!(store.progress().borrow().file_bytes.is_some_and(|bytes| bytes > 0));
    store.finish(&monitor, Timestamp::from_secs(4.0));
    let entries = HistoryReader::open(&state).unwrap().entries(&HistoryQuery::default()).unwrap();
    assert_eq!(entries.iter().filter(|entry| entry.kind == HistoryTable::Capacity).count(), 3);
}

#[test]
fn failing_disk_is_retried_after_pauses() {
    let place = tempfile::tempdir().unwrap();
    let state = place.path().join("folder");
    std::fs::write(&state, "").unwrap();
    let (store, _) =
        Store::open(&PlaceSetting::At(state.clone()), &config().store, &VehicleIdentity::default()).unwrap();
    let store = store.unwrap();
    let mut progress = store.progress();
    let (begun, mut changes) = (Instant::now(), 0);
    while begun.elapsed() < Duration::from_millis(2500) {
        changes += u32::from(progress.has_changed().unwrap());
        progress.borrow_and_update();
        std::thread::sleep(Duration::from_micros(200));
    }
    // The first retry comes after 1 s; the next pause is 2 s.
    assert_eq!((changes, progress.borrow().failures), (1, 1));
    // Work that is queued during the pause is reported as failed, without an attempt to write it.
    let write_queue = Arc::clone(&store.write_queue);
    for _ in 0..3 {
        let ticket = write_queue.submit(None, document(1, 1, 1), true);
        assert_eq!(answer(&store, ticket).failures, 1);
    }
    std::fs::remove_file(&state).unwrap();
    let monitor = Monitor::new(config().monitor);
    store.finish(&monitor, Timestamp::from_secs(4.0));
    assert!(HistoryReader::open(&state).unwrap().state().is_some());
}

#[test]
fn database_damaged_while_running_is_set_aside() {
    let place = tempfile::tempdir().unwrap();
    let (store, _) =
        Store::open(&PlaceSetting::At(place.path().to_owned()), &config().store, &VehicleIdentity::default()).unwrap();
    let mut store = store.unwrap();
    let monitor = Monitor::new(config().monitor);
    let learn = |store: &mut Store, seconds: f64| {
        let time = Timestamp::from_secs(seconds);
        let kind = rows::tests::capacity(0, Some(2.0), 1.9);
        store.learned(&[Event { time, kind }], &monitor, time).unwrap()
    };
    let ticket = learn(&mut store, 1.0);
    assert!(answer(&store, ticket).works);
    // Simulates disk corruption: other bytes in the database and its log.
    for name in ["packwatch.db", "packwatch.db-wal"] {
        let path = place.path().join(name);
        let length = std::fs::metadata(&path).map_or(0, |file| file.len());
        std::fs::write(&path, vec![0x5A; usize::try_from(length).unwrap()]).unwrap();
    }
    for second in 2..6 {
        let ticket = learn(&mut store, f64::from(second));
        answer(&store, ticket);
        std::thread::sleep(Duration::from_millis(700));
    }
    store.finish(&monitor, Timestamp::from_secs(9.0));
    let (store, found) =
        Store::open(&PlaceSetting::At(place.path().to_owned()), &config().store, &VehicleIdentity::default()).unwrap();
    let mut store = store.unwrap();
    // If SQLite had the pages in its cache when the file was damaged, only the next start finds the damage.
    assert!(!found.works || place.path().join("packwatch.db.damaged-1").exists());
    assert_eq!(found.states.len(), 1, "the state does not depend on the database");
    let ticket = learn(&mut store, 10.0);
    assert!(answer(&store, ticket).works);
    store.finish(&monitor, Timestamp::from_secs(11.0));
    let reader = HistoryReader::open(place.path()).unwrap();
    assert_eq!(reader.verify().unwrap().broken, None);
    assert!(reader.state().is_some());
    assert!(place.path().join("packwatch.db.damaged-1").exists());
}

#[test]
fn deleted_or_replaced_store_is_reported_and_written_again() {
    let changes: [fn(&Path); 5] = [
        |state| std::fs::remove_file(state.join(DATABASE)).unwrap(),
        |state| std::fs::remove_file(state.join("packwatch.db-wal")).unwrap(),
        |state| std::fs::remove_dir_all(state).unwrap(),
        |state| std::fs::rename(state, state.with_extension("moved")).unwrap(),
        |state| {
            let copy = state.join("copy");
            std::fs::copy(state.join(DATABASE), &copy).unwrap();
            std::fs::rename(copy, state.join(DATABASE)).unwrap();
        },
    ];
    for (number, change) in changes.into_iter().enumerate() {
        let place = tempfile::tempdir().unwrap();
        let state = place.path().join("state");
        let open = || Store::open(&PlaceSetting::At(state.clone()), &config().store, &VehicleIdentity::default());
        let mut store = open().unwrap().0.unwrap();
        let learn = |store: &mut Store, seconds: f64| {
            let (time, kind) = (Timestamp::from_secs(seconds), rows::tests::capacity(0, Some(2.0), 1.9));
            let ticket = store.learned(&[Event { time, kind }], &at(seconds), time).unwrap();
            answer(store, ticket)
        };
        assert!(learn(&mut store, 1.0).works, "{number}");
        change(&state);
        let progress = learn(&mut store, 2.0);
        assert!(progress.works && progress.was_replaced, "{number}: {progress:?}");
        assert!(open().is_err(), "{number}: the folder is locked again");
        store.finish(&at(3.0), Timestamp::from_secs(3.0));
        let reader = HistoryReader::open(&state).unwrap();
        assert_eq!(reader.state().unwrap().snapshot.time, Timestamp::from_secs(3.0), "{number}");
        let entries = reader.entries(&HistoryQuery::default()).unwrap();
        assert!(entries.iter().any(|entry| entry.kind == HistoryTable::Capacity), "{number}: {entries:?}");
        let told = entries.iter().filter(|entry| entry.values.contains(&"replaced".into()));
        assert_eq!(told.count(), 1, "{number}: {entries:?}");
    }
}

#[test]
fn deleted_states_are_written_with_next_rows() {
    let place = tempfile::tempdir().unwrap();
    let mut writer = writer(place.path());
    let commit = |writer: &mut Writer| {
        let state = document(1, 100, 1_800_000_000);
        let rows = vec![HistoryRow::Event(rows::tests::capacity(0, Some(2.0), 1.9))];
        writer.commit(&mut vec![RowBatch { stamp: state.stamp, rows }], &state).unwrap()
    };
    assert!(commit(&mut writer).is_some() && commit(&mut writer).is_none());
    state_files::forget(place.path()).unwrap();
    assert!(commit(&mut writer).is_some() && StateFiles::open(place.path()).1.newest.is_some());
}

fn at(seconds: f64) -> Monitor {
    let mut monitor = Monitor::new(config().monitor);
    monitor.handle(&Record::tick(Timestamp::from_secs(seconds)), &mut Outputs::default());
    monitor
}

fn states(found: &StoredStates) -> Vec<(&'static str, f64)> {
    found.states.iter().map(|state| (state.source, state.snapshot.time.secs())).collect()
}

#[test]
fn failing_disk_leaves_last_state_in_runtime_folder() {
    let place = tempfile::tempdir().unwrap();
    let state = place.path().join("folder");
    std::fs::write(&state, "").unwrap();
    let (store, _) =
        Store::open(&PlaceSetting::At(state.clone()), &config().store, &VehicleIdentity::default()).unwrap();
    let file = place.path().join(runtime::FILE_NAME);
    let mut store = store.unwrap();
    store.runtime = Some(RuntimeState::start(file.clone()).unwrap());
    store.tick(&at(3.0), Timestamp::from_secs(3.0), true);
    store.finish(&at(3.9), Timestamp::from_secs(3.9));
    assert_eq!(running_state(&file, &state).unwrap().snapshot.time, Timestamp::from_secs(3.9));
}

fn reasons(folder: &Path) -> Vec<String> {
    let filter = HistoryQuery { kinds: vec![HistoryTable::Reset], ..HistoryQuery::default() };
    let entries = HistoryReader::open(folder).unwrap().entries(&filter).unwrap();
    entries.iter().map(|entry| entry.values[1].as_str().unwrap().to_owned()).collect()
}

#[test]
fn unfit_state_waits_for_matching_start() {
    const ASIDE: &str = "state set aside earlier";
    let place = tempfile::tempdir().unwrap();
    let open = || {
        let (store, found) =
            Store::open(&PlaceSetting::At(place.path().to_owned()), &config().store, &VehicleIdentity::default())
                .unwrap();
        (store.unwrap(), found)
    };
    let finish = |store: Store, seconds: f64| store.finish(&at(seconds), Timestamp::from_secs(seconds));
    finish(open().0, 1.0);
    let (store, found) = open();
    assert_eq!(states(&found), [(STATE_SOURCE, 1.0)]);
    store.set_state_aside("snapshot is of 4 cells", Timestamp::from_secs(2.0));
    finish(store, 2.0);
    assert_eq!(reasons(place.path()), ["state_unfit"]);
    let (store, found) = open();
    assert_eq!(states(&found), [(STATE_SOURCE, 2.0), (ASIDE, 1.0)]);
    // Writing later states does not replace the state that was set aside.
    finish(store, 3.0);
    let (store, found) = open();
    assert_eq!(states(&found), [(STATE_SOURCE, 3.0), (ASIDE, 1.0)]);
    // In this start, the pack fits the state that was set aside. That state becomes current, and the newest state is
    // set aside in its place.
    store.set_state_aside("snapshot is of 5 cells", Timestamp::from_secs(4.0));
    finish(store, 4.0);
    let (store, found) = open();
    assert_eq!(states(&found), [(STATE_SOURCE, 4.0), (ASIDE, 3.0)]);
    drop(found);
    finish(store, 5.0);
    // The state that was set aside belongs to the old pack, so a pack change deletes it.
    replace_pack(place.path()).unwrap();
    assert_eq!(states(&open().1), []);
}
