//! Stores state and history so that they survive restarts and power cuts: in two state files and a history database, in
//! one folder.
//!
//! * Learned results and alarm changes are written to disk before they are announced (sent in frames). An announcement
//!   waits at most 200 ms for the disk ([`commit_barrier`]). Learned results are stored with the whole state. An alarm
//!   change is stored as a small row of the history. A start restores the newest state, then reapplies newer alarm
//!   changes (`learned`).
//! * Rows are committed before the state that contains them (`writer`). If the power is cut between these two writes,
//!   the results in these rows were not announced. The next start reapplies the alarm changes in the rows. Learned
//!   results are learned again and get a second row. A pack change is not undone: the history shows that the pack of
//!   the state has been replaced, so the state is not restored.
//! * The state is also written at checkpoints (`checkpoint`), on stop, and every second to the runtime folder, which is
//!   in memory.
//! * The state is written to two files in turn (`state_files`) and does not depend on the database. If there is no
//!   valid state, the capacities and alarms in the history are used (`learned`).
//! * A damaged database is set aside and a new one is created (`folder`). The next start then uses the state alone.
//! * On a full disk, a reserve provides space for learned results and alarms (`reserve`).
//! * The loop never accesses the disk; a separate thread does (`writer`).
//! * After any fault of disk, folder or file, the daemon keeps running and reports the fault to the core
//!   (`store_failed`).

mod backlog;
mod checkpoint;
pub mod commit_barrier;
mod database;
mod folder;
mod history_filter;
mod learned;
mod reader;
mod recorder;
mod replace;
mod reserve;
mod rows;
mod runtime;
mod segments;
mod stamp;
mod state_files;
mod writer;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::sync::watch;

use crate::alarm::AlarmChange;
use crate::config::{StoreConfig, VehicleIdentity};
use crate::io::background_file::{MAX_FINISH, ends_in_time};
use crate::io::place::{PlaceSetting, first_folder};
use crate::monitor::{Downtime, Event, LearnedCell, Monitor, RESTART_FRESHNESS, Snapshot};
use crate::quantity::Timestamp;
use checkpoint::CheckpointSchedule;
use database::Database;
use folder::Folder;
use history_filter::{HistoryCommit, HistoryFilter};
use reserve::Reserve;
use rows::{HistoryRow, RowBatch};
use runtime::RuntimeState;
use stamp::{BootId, Stamp, WallClock};
use state_files::{FORMAT, FoundStates, SET_ASIDE, StateDocument, StateFiles};
use writer::{Retry, WriteQueue, Writer};

pub use reader::{HistoryEntry, HistoryExtent, HistoryQuery, HistoryReader};
pub use recorder::Recorder;
pub use replace::{ReplacedPack, replace_pack};
pub use rows::HistoryTable;
pub use segments::{BrokenSegment, ChainReport, NotedHead};
pub use writer::StoreProgress;

/// State folder of the service.
const STANDARD_FOLDER: &str = "/var/lib/packwatch";
/// Time between states in the runtime folder (s).
const RUNTIME_PERIOD_S: f64 = 1.0;
/// Time between checkpoints while no frame arrives (s). During this time the state does not change; it only becomes
/// older.
const QUIET_PERIOD_S: f64 = 3600.0;

/// The default folder for clients: the folder of the service or, if it does not exist, the folder of a daemon started
/// from a shell.
pub fn standard_folder() -> PathBuf {
    let service = first_folder("STATE_DIRECTORY").unwrap_or_else(|| PathBuf::from(STANDARD_FOLDER));
    let own = daemon_folder().0;
    if !service.exists() && own.exists() { own } else { service }
}

/// Default folder of a daemon, and whether systemd created it. A daemon started from a shell keeps its state separate
/// from the service's: in `$XDG_STATE_HOME/packwatch`, by default `~/.local/state/packwatch`.
pub fn daemon_folder() -> (PathBuf, bool) {
    if let Some(folder) = first_folder("STATE_DIRECTORY") {
        return (folder, true);
    }
    let own = first_folder("XDG_STATE_HOME").or_else(|| Some(first_folder("HOME")?.join(".local/state")));
    (own.map_or_else(|| PathBuf::from(STANDARD_FOLDER), |folder| folder.join("packwatch")), false)
}

/// Source of the newest stored state.
pub const STATE_SOURCE: &str = "state file";

/// Source of a state that was built from the capacities and alarms in the history.
pub const HISTORY_SOURCE: &str = "history";

/// A stored state that may be restored.
#[derive(Debug)]
pub struct StateCandidate {
    /// The state.
    pub snapshot: Snapshot,
    /// Age of the state.
    pub downtime: Downtime,
    /// Origin of the state, for the log.
    pub source: &'static str,
}

/// The states found in a store when it was opened.
#[derive(Debug)]
pub struct StoredStates {
    /// Stored states, newest first.
    pub states: Vec<StateCandidate>,
    /// Learned values of the connected pack's cells in the history, if there is no valid state.
    pub learned: Vec<LearnedCell>,
    /// Alarm changes of the connected pack in the history; empty if there is a valid state.
    pub alarms: Vec<(Timestamp, AlarmChange)>,
    /// Whether the store was readable and undamaged, and is writable.
    pub works: bool,
}

/// The store, as the service loop uses it.
#[derive(Debug)]
pub struct Store {
    write_queue: Arc<WriteQueue>,
    progress: watch::Receiver<StoreProgress>,
    writer: Option<JoinHandle<()>>,
    runtime: Option<RuntimeState>,
    history_filter: HistoryFilter,
    boot: BootId,
    folder: PathBuf,
    schedule: CheckpointSchedule,
    runtime_written: Option<Timestamp>,
    /// [`Monitor::sent_freshness`] of the last queued state.
    stored_freshness: u64,
}

impl Store {
    /// Opens the store. Returns no store if the store is disabled. Also returns no store if a default folder cannot be
    /// used, unless systemd created this folder.
    ///
    /// # Errors
    /// Fails if another daemon uses the folder.
    pub fn open(
        setting: &PlaceSetting,
        config: &StoreConfig,
        vehicle: &VehicleIdentity,
    ) -> Result<(Option<Self>, StoredStates), String> {
        let none = |works| (None, StoredStates { states: Vec::new(), learned: Vec::new(), alarms: Vec::new(), works });
        let Some((path, is_needed)) = setting.resolve(daemon_folder) else { return Ok(none(true)) };
        let shown = path.display().to_string();
        let mut folder = Folder::new(path.clone());
        match folder.lock() {
            Ok(()) => {}
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {
                return Err(format!(
                    "{shown}: already in use by another packwatch; stop it, or choose another folder with --state"
                ));
            }
            Err(error) if !is_needed => {
                tracing::info!(folder = shown, %error, "state not kept; give a folder with --state to keep it");
                return Ok(none(true));
            }
            Err(_) => {} // this error is logged below, and the writer tries again
        }
        Self::start(folder, config, vehicle).map_err(|error| format!("{shown}: {error}"))
    }

    fn start(
        mut folder: Folder,
        config: &StoreConfig,
        vehicle: &VehicleIdentity,
    ) -> std::io::Result<(Option<Self>, StoredStates)> {
        let now = Stamp::now(Timestamp::ZERO, BootId::current());
        let path = folder.path().to_owned();
        let runtime_file = first_folder("RUNTIME_DIRECTORY").map(|folder| folder.join(runtime::FILE_NAME));
        let running = runtime_file.as_deref().and_then(|file| running_state(file, &path));
        let OpenedFolder { state_files, database, rows, pack, known_rows, found } =
            OpenedFolder::open(&mut folder, running, &now);
        let mut retry = Retry::default();
        if database.is_none() {
            retry.after_failure();
        }
        let progress =
            StoreProgress { works: found.works, has_room: true, pack, rows: known_rows, ..StoreProgress::default() };
        let (sender, progress) = watch::channel(progress);
        let write_queue = Arc::new(WriteQueue::default());
        if !rows.is_empty() {
            // These rows are written with the first state.
            write_queue.keep(RowBatch { stamp: now, rows });
        }
        let writer = Writer {
            write_queue: Arc::clone(&write_queue),
            vehicle: vehicle.clone(),
            limits: config.into(),
            reserve: Reserve::new(&path),
            head_day: None,
            folder,
            state_files,
            knows_state: database.is_some() || !found.states.is_empty(),
            needs_state: true,
            was_replaced: false,
            database,
            progress: sender,
            retry,
        };
        let writer = std::thread::Builder::new().name("store".to_owned()).spawn(move || writer.run())?;
        let store = Self {
            write_queue,
            progress,
            writer: Some(writer),
            runtime: runtime_file.map(RuntimeState::start).transpose()?,
            history_filter: HistoryFilter::default(),
            boot: now.boot,
            folder: path,
            schedule: CheckpointSchedule::new(config.checkpoint_s),
            runtime_written: None,
            stored_freshness: 0,
        };
        Ok((Some(store), found))
    }

    /// The folder of the store.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Sets aside a stored state that could not be restored, and keeps it until a later start can restore it. `why` is
    /// recorded in the history.
    pub fn set_state_aside(&self, why: &str, now: Timestamp) {
        tracing::error!(error = why, "stored state {SET_ASIDE}");
        let row = HistoryRow::Own { reason: "state_unfit", detail: format!("{why}; {SET_ASIDE}") };
        self.write_queue.keep(RowBatch { stamp: Stamp::now(now, self.boot), rows: vec![row] });
        self.write_queue.set_aside();
    }

    /// The progress of the writer, updated with every change.
    pub fn progress(&self) -> watch::Receiver<StoreProgress> {
        self.progress.clone()
    }

    /// Commits the results learned from the events of one input. Returns the ticket (number of the commit) for which
    /// the announcement must wait; `None` = no wait.
    pub fn learned(&mut self, events: &[Event], monitor: &Monitor, now: Timestamp) -> Option<u64> {
        let commit = self.history_filter.take(events)?;
        Some(self.submit(commit, monitor, now))
    }

    /// Writes the runtime state every second, and a checkpoint when it is due. `is_fresh` states whether frames have
    /// arrived since the last checkpoint. Returns whether a checkpoint was queued.
    pub fn tick(&mut self, monitor: &Monitor, now: Timestamp, is_fresh: bool) -> bool {
        let last = self.runtime_written;
        if let Some(runtime) = &self.runtime
            && last.is_none_or(|last| now.since(last) >= RUNTIME_PERIOD_S)
        {
            runtime.put(self.document(monitor, now));
            self.runtime_written = Some(now);
        }
        let has_used_freshness =
            monitor.sent_freshness().saturating_sub(self.stored_freshness) >= RESTART_FRESHNESS / 2;
        if !has_used_freshness && !self.schedule.is_due(now, if is_fresh { 0.0 } else { QUIET_PERIOD_S }) {
            return false;
        }
        self.write_checkpoint(monitor, now);
        true
    }

    /// Queues a checkpoint. Returns its ticket.
    fn write_checkpoint(&mut self, monitor: &Monitor, now: Timestamp) -> u64 {
        let commit = self.history_filter.checkpoint(now);
        self.submit(commit, monitor, now)
    }

    /// Writes the state of a start to both state files and waits until it is on disk, for a limited time. A power cut
    /// right after the start, or a damaged file, then cannot make the next start use the same freshness (counter of
    /// authenticated frames) again.
    pub fn write_start(&mut self, monitor: &Monitor, now: Timestamp) {
        let limit = Instant::now() + MAX_FINISH;
        let mut is_stored = true;
        for _ in state_files::FILES {
            let ticket = self.write_checkpoint(monitor, now);
            while self.progress.borrow().ticket < ticket && Instant::now() < limit {
                std::thread::sleep(Duration::from_millis(1));
            }
            let progress = *self.progress.borrow();
            is_stored &= progress.ticket >= ticket && progress.works;
        }
        if !is_stored {
            tracing::error!(
                "state not stored before the first authenticated frame: a power cut may repeat its freshness"
            );
        }
    }

    /// Writes the last state, and waits a limited time until it is on disk.
    pub fn finish(mut self, monitor: &Monitor, now: Timestamp) {
        // If the disk fails, only the runtime folder contains the changes of the last second.
        if let Some(runtime) = &self.runtime {
            runtime.put(self.document(monitor, now));
        }
        let commit = self.history_filter.finish();
        self.submit(commit, monitor, now);
        self.write_queue.stop();
        let Some(writer) = self.writer.take() else { return };
        if !ends_in_time(&writer) {
            tracing::error!(limit_s = MAX_FINISH.as_secs(), "disk does not respond: last state not stored");
            return;
        }
        let lost = self.write_queue.lost_rows();
        if lost > 0 || !self.progress.borrow().works {
            tracing::error!(lost_rows = lost, "last state not stored");
        }
    }

    /// Waits until the writer has handled everything that was queued.
    #[cfg(test)]
    pub(crate) fn settle(&self) -> StoreProgress {
        while self.progress.borrow().ticket < self.write_queue.submitted() {
            std::thread::sleep(Duration::from_micros(50));
        }
        *self.progress.borrow()
    }

    /// Queues rows and the state for the writer. Returns the ticket.
    fn submit(&mut self, HistoryCommit { rows, with_state }: HistoryCommit, monitor: &Monitor, now: Timestamp) -> u64 {
        let state = self.document(monitor, now);
        if with_state {
            self.stored_freshness = monitor.sent_freshness();
        }
        self.schedule.note_written(now, rows.len(), with_state.then_some(self.progress.borrow().state_bytes));
        let batch = (!rows.is_empty()).then_some(RowBatch { stamp: state.stamp, rows });
        self.write_queue.submit(batch, state, with_state)
    }

    fn document(&self, monitor: &Monitor, now: Timestamp) -> StateDocument {
        let StoreProgress { pack, rows, .. } = *self.progress.borrow();
        StateDocument {
            format: FORMAT,
            // The writer assigns the number.
            number: 0,
            folder: self.folder.to_string_lossy().into_owned(),
            pack,
            history_rows: rows,
            stamp: Stamp::now(now, self.boot),
            snapshot: Box::new(monitor.snapshot().for_restart()),
        }
    }
}

/// The contents of a folder at the start.
#[derive(Debug)]
struct OpenedFolder {
    state_files: StateFiles,
    /// The open database; `None` = the database cannot be used at present.
    database: Option<Database>,
    /// Rows to add to the history. They report what was found while the folder was opened.
    rows: Vec<HistoryRow>,
    /// Number of the connected pack; 0 = unknown.
    pack: i64,
    /// Number of rows of the history that the newest state contains or that the start reapplies.
    known_rows: i64,
    found: StoredStates,
}

impl OpenedFolder {
    /// Reads the states and opens the database. `running` is the state in the runtime folder.
    fn open(folder: &mut Folder, running: Option<StateDocument>, now: &Stamp) -> Self {
        let (state_files, FoundStates { mut newest, aside, faults: mut rows }) = StateFiles::open(folder.path());
        let mut running = running.filter(|running| running.stamp.same_boot(now));
        let database = match folder.open(now, newest.as_ref().map_or(0, |state| state.pack)) {
            Ok((database, about)) => {
                rows.extend(about.into_iter().chain(newest.as_ref().and_then(|state| lost_rows(state, &database))));
                tracing::info!(%folder, rows = database.rows(), pack = database.pack(), "history open");
                Some(database)
            }
            Err(error) => {
                tracing::error!(%folder, %error, "database not usable, retrying");
                None
            }
        };
        let known_rows = running.iter().chain(&newest).map(|state| state.history_rows).max().unwrap_or(0);
        for state in running.iter_mut().chain(&mut newest) {
            let changes = read(database.as_ref(), |database| database.alarm_changes(state.history_rows));
            state.snapshot.repeat_alarms(&changes);
        }
        let mut states = candidates([running, newest, aside]);
        let newest_pack = states.iter().map(|(state, _)| state.pack).max().unwrap_or(0);
        // The state of a replaced pack must not be restored.
        states.retain(|(state, _)| {
            let is_closed = |database: &Database| database.is_closed(state.pack).unwrap_or(false);
            state.pack == 0 || (state.pack == newest_pack && !database.as_ref().is_some_and(is_closed))
        });
        let wall = WallClock::assess(now);
        let candidate = |(state, source): (StateDocument, _)| StateCandidate {
            downtime: state.stamp.age(now, wall),
            snapshot: *state.snapshot,
            source,
        };
        let stateless = database.as_ref().filter(|_| states.is_empty());
        let found = StoredStates {
            learned: read(stateless, Database::learned),
            alarms: read(stateless, |database| database.alarm_changes(0)),
            works: database.is_some() && rows.is_empty(),
            states: states.into_iter().map(candidate).collect(),
        };
        let (pack, known_rows) =
            database.as_ref().map_or((newest_pack, known_rows), |database| (database.pack(), database.rows()));
        Self { state_files, database, rows, pack, known_rows, found }
    }
}

/// Reads from the history. If reading fails, logs the error and returns an empty list.
fn read<T>(database: Option<&Database>, read: impl Fn(&Database) -> rusqlite::Result<Vec<T>>) -> Vec<T> {
    let found = database.map(read).transpose();
    found.inspect_err(|error| tracing::error!(%error, "the history cannot be read")).ok().flatten().unwrap_or_default()
}

/// Returns a row for the history if the database has fewer rows than when the state was stored. Damage to SQLite's log
/// has no other symptom.
fn lost_rows(state: &StateDocument, database: &Database) -> Option<HistoryRow> {
    let (known, found) = (state.history_rows, database.rows());
    let detail = format!("the history ends with row {found}, the stored state knew {known}");
    (0 < found && found < known).then_some(HistoryRow::Own { reason: "history_cut", detail })
}

/// Reads the runtime state of a killed daemon, if that daemon kept its state in this folder.
fn running_state(file: &Path, folder: &Path) -> Option<StateDocument> {
    let json = match std::fs::read(file) {
        Ok(json) => json,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return None,
        Err(error) => {
            tracing::warn!(file = %file.display(), %error, "runtime state not read");
            return None;
        }
    };
    match StateDocument::parse(&json) {
        Ok(document) if Path::new(&document.folder) == folder => Some(document),
        Ok(_) => None,
        Err(fault) => {
            tracing::warn!(file = %file.display(), ?fault, "runtime state not used");
            None
        }
    }
}

/// Lists the existing states with their sources. The newer of the runtime state and the stored state comes first; the
/// state that was set aside comes last.
fn candidates([running, stored, aside]: [Option<StateDocument>; 3]) -> Vec<(StateDocument, &'static str)> {
    let is_older = |running: &StateDocument, stored: &StateDocument| {
        running.stamp.same_boot(&stored.stamp) && running.stamp.boottime_ns < stored.stamp.boottime_ns
    };
    let stored_first = matches!((&running, &stored), (Some(running), Some(stored)) if is_older(running, stored));
    let mut all = [(running, "runtime folder"), (stored, STATE_SOURCE), (aside, "state set aside earlier")];
    if stored_first {
        all.swap(0, 1);
    }
    all.into_iter().filter_map(|(document, source)| Some((document?, source))).collect()
}

#[cfg(test)]
mod tests;
