//! What survives a restart and a power cut: the state of the core and the history, in one SQLite database.
//!
//! * What is learned, and what becomes of alarms, is committed together with the state at that moment before it is
//!   announced; an announcement waits 200 ms for that and no longer ([`hold`]). So a state that was restored contains
//!   all that was announced.
//! * The state is checkpointed every `[store] checkpoint_s` besides and on stop, and every second in the runtime folder,
//!   which is in memory.
//! * The loop never touches the disk: a thread of its own does ([`writer`]).
//! * Whatever is wrong with disk, folder or file, the daemon runs on; the core is told (`store_failed`).

mod backlog;
mod chain;
pub mod commit_barrier;
mod database;
mod delta_encoder;
mod document;
mod folder;
mod history_filter;
mod packed;
mod parts;
mod reader;
mod recorder;
mod replace;
mod retention;
mod rows;
mod runtime;
mod salvage;
mod schema;
mod stamp;
mod token_bucket;
mod verify;
mod wal;
mod writer;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;

use tokio::sync::watch;

use crate::config::StoreConfig;
use crate::io::background_file::{MAX_FINISH, ends_in_time};
use crate::monitor::{Downtime, Event, Monitor, Snapshot};
use crate::quantity::Timestamp;
use database::OpenError;
use document::Document;
use folder::{Folder, Opening, SET_ASIDE};
use history_filter::{CommitDecision, HistoryFilter};
use reader::MAX_DAEMON_COPY_BYTES;
use rows::{Batch, Row};
use runtime::RuntimeState;
use stamp::{Age, BootId, Stamp, WallClock};
use writer::{Retry, WriteQueue, Writer};

pub use folder::with_suffix;
pub use reader::{Entry, Filter, Kind, Reader};
pub use recorder::Recorder;
pub use replace::replace_pack;
pub use verify::{Broken, Verdict};
pub use writer::Progress;

/// The state folder of a daemon that systemd did not start.
const STANDARD_FOLDER: &str = "/var/lib/packwatch";
/// How often the state goes to the runtime folder, s.
const RUNTIME_PERIOD_S: f64 = 1.0;
/// While no frame comes, the state is checkpointed this seldom, s: it only grows older.
const QUIET_PERIOD_S: f64 = 3600.0;

/// Where state and history are kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum StateSetting {
    /// `$STATE_DIRECTORY` under systemd, else `/var/lib/packwatch`; where that cannot be made, nowhere.
    Standard,
    /// Nowhere.
    Off,
    /// There.
    At(PathBuf),
}

impl StateSetting {
    /// As written on the command line: a folder, or `none`.
    pub fn from_path(path: Option<PathBuf>) -> Self {
        match path {
            None => Self::Standard,
            Some(path) if path.as_os_str() == "none" => Self::Off,
            Some(path) => Self::At(path),
        }
    }
}

/// The state folder when nobody says which, and whether systemd made it.
pub fn standard_folder() -> (PathBuf, bool) {
    first_folder("STATE_DIRECTORY").map_or_else(|| (PathBuf::from(STANDARD_FOLDER), false), |folder| (folder, true))
}

/// systemd puts a colon between several folders; the first is the unit's own.
fn first_folder(variable: &str) -> Option<PathBuf> {
    let folders = std::env::var_os(variable).filter(|folders| !folders.is_empty())?;
    std::env::split_paths(&folders).next()
}

/// Where the state is that the next checkpoint overwrites.
pub const DATABASE_SOURCE: &str = "database";

/// A stored state that may be taken up.
#[derive(Debug)]
pub struct Candidate {
    /// The state.
    pub snapshot: Snapshot,
    /// How old it is.
    pub away: Downtime,
    /// Where it was, for the log.
    pub source: &'static str,
}

/// What a store came up with.
#[derive(Debug)]
pub struct Found {
    /// Stored states, the newest first.
    pub states: Vec<Candidate>,
    /// Whether what was stored could be read and more can be written.
    pub works: bool,
}

/// The loop's side of the store.
#[derive(Debug)]
pub struct Store {
    desk: Arc<WriteQueue>,
    progress: watch::Receiver<Progress>,
    writer: Option<JoinHandle<()>>,
    runtime: Option<RuntimeState>,
    history_filter: HistoryFilter,
    boot: BootId,
    folder: PathBuf,
    checkpoint_s: f64,
    checkpointed: Option<Timestamp>,
    put: Option<Timestamp>,
}

impl Store {
    /// Opens the store; `None` = there is to be none, or nothing can be done with the one there is.
    ///
    /// # Errors
    /// When another daemon works in the folder.
    pub fn open(setting: &StateSetting, config: &StoreConfig) -> Result<(Option<Self>, Found), String> {
        let none = |works| (None, Found { states: Vec::new(), works });
        let (path, is_needed) = match setting {
            StateSetting::Off => return Ok(none(true)),
            StateSetting::Standard => standard_folder(),
            StateSetting::At(path) => (path.clone(), true),
        };
        let shown = path.display().to_string();
        let mut folder = Folder::new(path.clone(), config.max_half_cycles);
        match folder.take() {
            Ok(()) => {}
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {
                return Err(format!(
                    "{shown}: another packwatch keeps its state there; stop it, or say --state and another"
                ));
            }
            Err(error) if !is_needed => {
                tracing::info!(folder = shown, %error, "state is not kept; --state says where to keep it");
                return Ok(none(true));
            }
            Err(_) => {} // told below, and tried again
        }
        let now = Stamp::now(Timestamp::ZERO, BootId::current());
        let opening = match folder.open(&now) {
            Ok(opening) => Some(opening),
            Err(error @ OpenError::Newer { .. }) => {
                tracing::error!(folder = shown, %error, "the database is not used: nothing is stored");
                return Ok(none(false));
            }
            Err(error) => {
                tracing::error!(folder = shown, %error, "the database cannot be used now; it is tried again");
                None
            }
        };
        Self::start(folder, opening, config, &now).map_err(|error| format!("{shown}: {error}"))
    }

    fn start(
        folder: Folder,
        opening: Option<Opening>,
        config: &StoreConfig,
        now: &Stamp,
    ) -> std::io::Result<(Option<Self>, Found)> {
        let path = folder.path().to_owned();
        let runtime_file = first_folder("RUNTIME_DIRECTORY").map(|folder| folder.join(runtime::FILE_NAME));
        let mut retry = Retry::default();
        let mut found = Found { states: Vec::new(), works: opening.as_ref().is_some_and(|opening| opening.is_sound) };
        let mut reset_ns = None;
        let (database, rows, state, aside, is_strange) = match opening {
            Some(Opening { database, rows, state, aside, is_strange, .. }) => {
                let counts = database.counts();
                tracing::info!(
                    folder = %path.display(),
                    learned_rows = counts.chained,
                    half_cycles = counts.half_cycles,
                    pack = counts.packs,
                    "history open"
                );
                reset_ns = database.last_reset_ns(now.boot).unwrap_or_default();
                (Some(database), rows, state, aside, is_strange)
            }
            None => {
                retry.after_failure();
                // A disk that cannot be written can perhaps be read.
                (None, Vec::new(), unwritable_state(&path), None, false)
            }
        };
        let running = runtime_file.as_deref().and_then(|file| running_state(file, &path));
        let running = running.filter(|running| {
            running.stamp.same_boot(now) && reset_ns.is_none_or(|reset_ns| running.stamp.boottime_ns > reset_ns)
        });
        let wall = WallClock::look(now);
        found.states = candidates(running, state, now, wall);
        found.states.extend(aside.map(|document| candidate(document, "database, set aside earlier", now, wall)));
        let (told, progress) = watch::channel(Progress { works: found.works, ..Progress::default() });
        let desk = Arc::new(WriteQueue::default());
        if !rows.is_empty() {
            // They wait for the first state.
            desk.keep(Batch { stamp: *now, rows });
        }
        let knows_state = database.is_some() || !found.states.is_empty();
        let writer = Writer {
            desk: Arc::clone(&desk),
            folder,
            database,
            progress: told,
            retry,
            commits: 0,
            failures: 0,
            knows_state,
            sets_aside: is_strange,
        };
        let writer = std::thread::Builder::new().name("store".to_owned()).spawn(move || writer.run())?;
        let store = Self {
            desk,
            progress,
            writer: Some(writer),
            runtime: runtime_file.map(RuntimeState::start).transpose()?,
            history_filter: HistoryFilter::default(),
            boot: now.boot,
            folder: path,
            checkpoint_s: config.checkpoint_s,
            checkpointed: None,
            put: None,
        };
        Ok((Some(store), found))
    }

    /// Where it is.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The stored state could not be taken up, and why: it is not overwritten, and used at the first start at which it fits.
    pub fn set_state_aside(&self, why: &str, now: Timestamp) {
        tracing::error!(error = why, "the stored state is {SET_ASIDE}");
        let row = Row::Own { reason: "state_unfit", detail: format!("{why}; {SET_ASIDE}") };
        self.desk.keep(Batch { stamp: Stamp::now(now, self.boot), rows: vec![row] });
        self.desk.set_aside();
    }

    /// Tells how far the writer is, whenever that changes.
    pub fn progress(&self) -> watch::Receiver<Progress> {
        self.progress.clone()
    }

    /// After an input: makes what its events have taught durable. The ticket its announcement should wait for; `None` =
    /// it need not wait.
    pub fn learned(&mut self, events: &[Event], monitor: &Monitor, now: Timestamp) -> Option<u64> {
        let rows = match self.history_filter.take(events) {
            CommitDecision::Commit(rows) => rows,
            CommitDecision::Nothing | CommitDecision::Deferred => return None,
        };
        self.checkpointed = Some(now);
        Some(self.leave(rows, monitor, now, false))
    }

    /// With every tick: the state of the second, and the checkpoint when it is due. `is_fresh`: frames have come since
    /// the last checkpoint. Returns whether it made one.
    pub fn tick(&mut self, monitor: &Monitor, now: Timestamp, is_fresh: bool) -> bool {
        let due = |last: Option<Timestamp>, period_s: f64| last.is_none_or(|last| now.since(last) >= period_s);
        if self.runtime.is_some() && due(self.put, RUNTIME_PERIOD_S) {
            self.put = Some(now);
            if let Some(runtime) = &self.runtime {
                runtime.put(self.document(monitor, now));
            }
        }
        let period_s = if is_fresh { self.checkpoint_s } else { self.checkpoint_s.max(QUIET_PERIOD_S) };
        // The first is a period after the start: what was restored is in the database already.
        let checkpointed = *self.checkpointed.get_or_insert(now);
        if now.since(checkpointed) < period_s {
            return false;
        }
        self.checkpointed = Some(now);
        let waiting = self.history_filter.for_checkpoint(now);
        self.leave(waiting, monitor, now, false);
        true
    }

    /// The last state, to the last bit; waits until it is on the disk, for a while.
    pub fn finish(mut self, monitor: &Monitor, now: Timestamp) {
        // On a disk that fails it is lost: then what the last second has taught is in the runtime folder alone.
        if let Some(runtime) = &self.runtime {
            runtime.put(self.document(monitor, now));
        }
        let waiting = self.history_filter.deferred();
        self.leave(waiting, monitor, now, true);
        self.desk.stop();
        let Some(writer) = self.writer.take() else { return };
        if !ends_in_time(&writer) {
            tracing::error!(limit_s = MAX_FINISH.as_secs(), "the disk does not answer: the last state is not stored");
            return;
        }
        let lost = self.desk.lost_rows();
        if lost > 0 || !self.progress.borrow().works {
            tracing::error!(lost_rows = lost, "the last state is not stored");
        }
    }

    /// Leaves rows and the state for the writer; the ticket.
    fn leave(&self, rows: Vec<Row>, monitor: &Monitor, now: Timestamp, exact: bool) -> u64 {
        let state = self.document(monitor, now);
        let batch = (!rows.is_empty()).then_some(Batch { stamp: state.stamp, rows });
        self.desk.leave(batch, state, exact)
    }

    fn document(&self, monitor: &Monitor, now: Timestamp) -> Document {
        let stamp = Stamp::now(now, self.boot);
        let folder = self.folder.to_string_lossy().into_owned();
        Document { folder, stamp, snapshot: Box::new(monitor.snapshot()) }
    }
}

/// The state in a folder that cannot be written.
fn unwritable_state(folder: &Path) -> Option<Document> {
    match Reader::open_within(folder, MAX_DAEMON_COPY_BYTES) {
        Ok(reader) => reader.state(),
        Err(error) => {
            tracing::warn!(error, "no stored state is read");
            None
        }
    }
}

/// The state of the last second of a daemon that was killed, if it kept its state in this folder.
fn running_state(file: &Path, folder: &Path) -> Option<Document> {
    let json = match std::fs::read(file) {
        Ok(json) => json,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return None,
        Err(error) => {
            tracing::warn!(file = %file.display(), %error, "state of the last second not read");
            return None;
        }
    };
    match Document::parse(&json) {
        Ok(document) if Path::new(&document.folder) == folder => Some(document),
        Ok(_) => None,
        Err(error) => {
            tracing::warn!(file = %file.display(), error, "state of the last second not used");
            None
        }
    }
}

/// Both states, the newer first.
fn candidates(running: Option<Document>, stored: Option<Document>, now: &Stamp, wall: WallClock) -> Vec<Candidate> {
    let is_older = |running: &Document, stored: &Document| {
        running.stamp.same_boot(&stored.stamp) && running.stamp.boottime_ns < stored.stamp.boottime_ns
    };
    let stored_first = matches!((&running, &stored), (Some(running), Some(stored)) if is_older(running, stored));
    let mut both = [(running, "runtime folder"), (stored, DATABASE_SOURCE)];
    if stored_first {
        both.reverse();
    }
    both.into_iter().filter_map(|(document, source)| Some(candidate(document?, source, now, wall))).collect()
}

fn candidate(document: Document, source: &'static str, now: &Stamp, wall: WallClock) -> Candidate {
    let away = match document.stamp.age(now, wall) {
        Age::Seconds(seconds) => Downtime::Seconds(seconds),
        Age::Unknown => Downtime::Unknown,
    };
    Candidate { snapshot: *document.snapshot, away, source }
}

#[cfg(test)]
mod tests;
