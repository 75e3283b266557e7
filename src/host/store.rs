//! State and history that survive a restart and a power cut, in one SQLite database.
//!
//! * Learned results and changes of alarms are committed together with the state at that moment, before they are
//!   announced; an announcement waits at most 200 ms for that ([`commit_barrier`]). So a restored state contains
//!   everything that was announced.
//! * The state is also checkpointed every `[store] checkpoint_s` and on stop, and every second in the runtime folder,
//!   which is in memory.
//! * The state has two copies, written in turn (`state_slots`). Without a good one, the capacities in the history are
//!   used (`learned`). Damage of the file is healed from its pages (`carve`).
//! * On a full disk a reserve makes room for learned results and alarms (`reserve`).
//! * The loop never touches the disk: a separate thread does (`writer`).
//! * The daemon keeps running whatever is wrong with disk, folder or file, and reports it to the core (`store_failed`).

mod backlog;
mod carve;
mod chain;
mod chain_retention;
pub mod commit_barrier;
mod database;
mod delta_encoder;
mod document;
mod folder;
mod history_filter;
mod learned;
mod meta;
mod packed;
mod pages;
mod parts;
mod reader;
mod recorder;
mod replace;
mod reserve;
mod retention;
mod row_sql;
mod rows;
mod runtime;
mod salvage;
mod schema;
mod stamp;
mod state_slots;
mod verify;
mod wal;
mod writer;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;

use tokio::sync::watch;

use crate::config::{StoreConfig, VehicleIdentity};
use crate::io::background_file::{MAX_FINISH, ends_in_time};
use crate::io::place::{PlaceSetting, first_folder};
use crate::monitor::{Command, Downtime, Event, EventKind, LearnedCell, Monitor, Snapshot};
use crate::quantity::Timestamp;
use database::OpenError;
use document::StateDocument;
use folder::{Folder, OpenedDatabase, SET_ASIDE};
use history_filter::HistoryFilter;
use reader::MAX_DAEMON_COPY_BYTES;
use reserve::Reserve;
use rows::{HistoryRow, RowBatch};
use runtime::RuntimeState;
use stamp::{BootId, Stamp, WallClock};
use writer::{Retry, WriteQueue, Writer};

pub use reader::{HistoryEntry, HistoryExtent, HistoryQuery, HistoryReader};
pub use recorder::Recorder;
pub use replace::replace_pack;
pub use rows::HistoryTable;
pub use verify::{BrokenRow, ChainReport, NotedHead};
pub use writer::StoreProgress;

/// State folder of the service.
const STANDARD_FOLDER: &str = "/var/lib/packwatch";
/// Period of the state in the runtime folder, s.
const RUNTIME_PERIOD_S: f64 = 1.0;
/// Period of checkpoints while no frame comes, s: the state only grows older.
const QUIET_PERIOD_S: f64 = 3600.0;

/// The folder in which clients look: the service's, or where there is none, that of a daemon started from a shell.
pub fn standard_folder() -> PathBuf {
    let service = first_folder("STATE_DIRECTORY").unwrap_or_else(|| PathBuf::from(STANDARD_FOLDER));
    let own = daemon_folder().0;
    if !service.exists() && own.exists() { own } else { service }
}

/// Default folder of a daemon, and whether systemd created it. One that is started from a shell, as in a tutorial, keeps its state
/// apart from the service's: in `$XDG_STATE_HOME/packwatch`, by default `~/.local/state/packwatch`.
pub fn daemon_folder() -> (PathBuf, bool) {
    if let Some(folder) = first_folder("STATE_DIRECTORY") {
        return (folder, true);
    }
    let own = first_folder("XDG_STATE_HOME").or_else(|| Some(first_folder("HOME")?.join(".local/state")));
    (own.map_or_else(|| PathBuf::from(STANDARD_FOLDER), |folder| folder.join("packwatch")), false)
}

/// Source of the state that the next checkpoint overwrites.
pub const DATABASE_SOURCE: &str = "database";

/// Source of a state that begins with the capacities in the history.
pub const HISTORY_SOURCE: &str = "learned values in the history";

/// A stored state that may be restored.
#[derive(Debug)]
pub struct StateCandidate {
    /// The state.
    pub snapshot: Snapshot,
    /// Its age.
    pub downtime: Downtime,
    /// Its place, for the log.
    pub source: &'static str,
}

/// The states a store held when it was opened.
#[derive(Debug)]
pub struct StoredStates {
    /// Stored states, the newest first.
    pub states: Vec<StateCandidate>,
    /// What the history knows of the cells of the connected pack, when the database has no good state.
    pub learned: Vec<LearnedCell>,
    /// Whether the store could be read and can be written.
    pub works: bool,
}

/// The loop's side of the store.
#[derive(Debug)]
pub struct Store {
    write_queue: Arc<WriteQueue>,
    progress: watch::Receiver<StoreProgress>,
    writer: Option<JoinHandle<()>>,
    runtime: Option<RuntimeState>,
    history_filter: HistoryFilter,
    boot: BootId,
    folder: PathBuf,
    checkpoint_s: f64,
    checkpointed: Option<Timestamp>,
    runtime_written: Option<Timestamp>,
}

impl Store {
    /// Opens the store; `None` = it is off, or its database cannot be used.
    ///
    /// # Errors
    /// When another daemon uses the folder.
    pub fn open(
        setting: &PlaceSetting,
        config: &StoreConfig,
        vehicle: &VehicleIdentity,
    ) -> Result<(Option<Self>, StoredStates), String> {
        let none = |works| (None, StoredStates { states: Vec::new(), learned: Vec::new(), works });
        let Some((path, is_needed)) = setting.resolve(daemon_folder) else { return Ok(none(true)) };
        let shown = path.display().to_string();
        let mut folder = Folder::new(path.clone(), config.into());
        match folder.lock() {
            Ok(()) => {}
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {
                return Err(format!(
                    "{shown}: another packwatch keeps its state there; stop it, or name another folder with --state"
                ));
            }
            Err(error) if !is_needed => {
                tracing::info!(folder = shown, %error, "state is not kept; name a folder with --state to keep it");
                return Ok(none(true));
            }
            Err(_) => {} // logged below, and retried
        }
        let now = Stamp::now(Timestamp::ZERO, BootId::current());
        let opening = match folder.open(&now) {
            Ok(opening) => Some(opening),
            Err(error @ OpenError::Newer { .. }) => {
                tracing::error!(folder = shown, %error, "the database is not used: nothing is stored");
                return Ok(none(false));
            }
            Err(error) => {
                tracing::error!(folder = shown, %error, "the database cannot be used now; packwatch retries");
                None
            }
        };
        Self::start(folder, opening, (config, vehicle), &now).map_err(|error| format!("{shown}: {error}"))
    }

    fn start(
        folder: Folder,
        opening: Option<OpenedDatabase>,
        (config, vehicle): (&StoreConfig, &VehicleIdentity),
        now: &Stamp,
    ) -> std::io::Result<(Option<Self>, StoredStates)> {
        let path = folder.path().to_owned();
        let runtime_file = first_folder("RUNTIME_DIRECTORY").map(|folder| folder.join(runtime::FILE_NAME));
        let mut retry = Retry::default();
        let works = opening.as_ref().is_some_and(|opening| opening.is_sound);
        let mut found = StoredStates { states: Vec::new(), learned: Vec::new(), works };
        let mut reset_ns = None;
        let (database, rows, state, aside, is_unreadable) = match opening {
            Some(OpenedDatabase { database, rows, state, aside, learned, is_unreadable, .. }) => {
                found.learned = learned;
                let counts = database.counts();
                tracing::info!(
                    folder = %path.display(),
                    learned_rows = counts.chained,
                    half_cycles = counts.half_cycles,
                    pack = counts.packs,
                    "history open"
                );
                reset_ns = database.last_reset_ns(now.boot).unwrap_or_default();
                (Some(database), rows, state, aside, is_unreadable)
            }
            None => {
                retry.after_failure();
                // A disk that cannot be written may be readable.
                (None, Vec::new(), unwritable_state(&path), None, false)
            }
        };
        let running = runtime_file.as_deref().and_then(|file| running_state(file, &path));
        let running = running.filter(|running| {
            running.stamp.same_boot(now) && reset_ns.is_none_or(|reset_ns| running.stamp.boottime_ns > reset_ns)
        });
        let wall = WallClock::assess(now);
        found.states = candidates(running, state, now, wall);
        found.states.extend(aside.map(|document| candidate(document, "database, set aside earlier", now, wall)));
        let (sender, progress) =
            watch::channel(StoreProgress { works: found.works, has_room: true, ..StoreProgress::default() });
        let write_queue = Arc::new(WriteQueue::default());
        if !rows.is_empty() {
            // They are written with the first state.
            write_queue.keep(RowBatch { stamp: *now, rows });
        }
        let knows_state = database.is_some() || !found.states.is_empty();
        let writer = Writer {
            write_queue: Arc::clone(&write_queue),
            vehicle: vehicle.clone(),
            is_vehicle_noted: false,
            reserve: Reserve::new(&path),
            head_day: None,
            keep_years: config.keep_years,
            folder,
            database,
            progress: sender,
            retry,
            commits: 0,
            failures: 0,
            knows_state,
            sets_aside: is_unreadable,
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
            checkpoint_s: config.checkpoint_s,
            checkpointed: None,
            runtime_written: None,
        };
        Ok((Some(store), found))
    }

    /// Its folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Keeps a stored state that could not be restored for the first start at which it fits; `why` goes into the history.
    pub fn set_state_aside(&self, why: &str, now: Timestamp) {
        tracing::error!(error = why, "the stored state is {SET_ASIDE}");
        let row = HistoryRow::Own { reason: "state_unfit", detail: format!("{why}; {SET_ASIDE}") };
        self.write_queue.keep(RowBatch { stamp: Stamp::now(now, self.boot), rows: vec![row] });
        self.write_queue.set_aside();
    }

    /// The progress of the writer, with every change.
    pub fn progress(&self) -> watch::Receiver<StoreProgress> {
        self.progress.clone()
    }

    /// Commits what the events of one input have taught. Returns the ticket that its announcement waits for; `None` = no
    /// wait.
    pub fn learned(&mut self, events: &[Event], monitor: &Monitor, now: Timestamp) -> Option<u64> {
        let rows = match self.history_filter.take(events) {
            Some(rows) => rows,
            // Its sender gets an answer when it is stored.
            None if events.iter().any(|event| is_command_with_effect(&event.kind)) => self.history_filter.deferred(),
            None => return None,
        };
        self.checkpointed = Some(now);
        Some(self.submit(rows, monitor, now, false))
    }

    /// Writes the state of the second, and the checkpoint when it is due. `is_fresh`: frames have come since the last
    /// checkpoint. Returns whether it made a checkpoint.
    pub fn tick(&mut self, monitor: &Monitor, now: Timestamp, is_fresh: bool) -> bool {
        let due = |last: Option<Timestamp>, period_s: f64| last.is_none_or(|last| now.since(last) >= period_s);
        if let Some(runtime) = &self.runtime
            && due(self.runtime_written, RUNTIME_PERIOD_S)
        {
            runtime.put(self.document(monitor, now));
            self.runtime_written = Some(now);
        }
        let period_s = if is_fresh { self.checkpoint_s } else { self.checkpoint_s.max(QUIET_PERIOD_S) };
        // The first is a period after the start: the restored state is in the database already.
        let checkpointed = *self.checkpointed.get_or_insert(now);
        if now.since(checkpointed) < period_s {
            return false;
        }
        self.checkpointed = Some(now);
        let waiting = self.history_filter.for_checkpoint(now);
        self.submit(waiting, monitor, now, false);
        true
    }

    /// Writes the last state, unrounded; waits a bounded time until it is on the disk.
    pub fn finish(mut self, monitor: &Monitor, now: Timestamp) {
        // On a disk that fails it is lost; then only the runtime folder has the last second.
        if let Some(runtime) = &self.runtime {
            runtime.put(self.document(monitor, now));
        }
        let waiting = self.history_filter.deferred();
        self.submit(waiting, monitor, now, true);
        self.write_queue.stop();
        let Some(writer) = self.writer.take() else { return };
        if !ends_in_time(&writer) {
            tracing::error!(limit_s = MAX_FINISH.as_secs(), "the disk does not answer: the last state is not stored");
            return;
        }
        let lost = self.write_queue.lost_rows();
        if lost > 0 || !self.progress.borrow().works {
            tracing::error!(lost_rows = lost, "the last state is not stored");
        }
    }

    /// Queues rows and the state for the writer; returns the ticket.
    fn submit(&self, rows: Vec<HistoryRow>, monitor: &Monitor, now: Timestamp, exact: bool) -> u64 {
        let state = self.document(monitor, now);
        let batch = (!rows.is_empty()).then_some(RowBatch { stamp: state.stamp, rows });
        self.write_queue.submit(batch, state, exact)
    }

    fn document(&self, monitor: &Monitor, now: Timestamp) -> StateDocument {
        let stamp = Stamp::now(now, self.boot);
        let folder = self.folder.to_string_lossy().into_owned();
        StateDocument { folder, stamp, snapshot: Box::new(monitor.snapshot().for_restart()) }
    }
}

/// Whether an event is a command that has changed alarms.
fn is_command_with_effect(kind: &EventKind) -> bool {
    matches!(kind, EventKind::Command { command: Command::Acknowledge(_) | Command::Clear(_), changed: 1.., .. })
}

/// Reads the state of a folder that cannot be written.
fn unwritable_state(folder: &Path) -> Option<StateDocument> {
    match HistoryReader::open_within(folder, MAX_DAEMON_COPY_BYTES) {
        Ok(reader) => reader.state(),
        Err(error) => {
            tracing::warn!(error, "the stored state cannot be read");
            None
        }
    }
}

/// Reads the state of the last second of a killed daemon, if it kept its state in this folder.
fn running_state(file: &Path, folder: &Path) -> Option<StateDocument> {
    let json = match std::fs::read(file) {
        Ok(json) => json,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return None,
        Err(error) => {
            tracing::warn!(file = %file.display(), %error, "state of the last second not read");
            return None;
        }
    };
    match StateDocument::parse(&json) {
        Ok(document) if Path::new(&document.folder) == folder => Some(document),
        Ok(_) => None,
        Err(error) => {
            tracing::warn!(file = %file.display(), error, "state of the last second not used");
            None
        }
    }
}

/// Both states, the newer first.
fn candidates(
    running: Option<StateDocument>,
    stored: Option<StateDocument>,
    now: &Stamp,
    wall: WallClock,
) -> Vec<StateCandidate> {
    let is_older = |running: &StateDocument, stored: &StateDocument| {
        running.stamp.same_boot(&stored.stamp) && running.stamp.boottime_ns < stored.stamp.boottime_ns
    };
    let stored_first = matches!((&running, &stored), (Some(running), Some(stored)) if is_older(running, stored));
    let mut both = [(running, "runtime folder"), (stored, DATABASE_SOURCE)];
    if stored_first {
        both.reverse();
    }
    both.into_iter().filter_map(|(document, source)| Some(candidate(document?, source, now, wall))).collect()
}

fn candidate(document: StateDocument, source: &'static str, now: &Stamp, wall: WallClock) -> StateCandidate {
    let downtime = document.stamp.age(now, wall);
    StateCandidate { snapshot: *document.snapshot, downtime, source }
}

#[cfg(test)]
mod tests;
