//! Runs the core with its journal, log, files and store. In: one input. Out: frames and events, sent to their
//! destinations.

use std::io::{self, Write};
use std::path::Path;

use tokio::sync::watch;
use tokio::time::Instant;

use super::readiness::{Readiness, describe_restored};
use super::{Service, ServiceError};
use crate::alarm::AlarmChange;
use crate::io::background_file::BackgroundFile;
use crate::io::can_key::CanKey;
use crate::io::candump::{self, StampDigits};
use crate::io::clock::MappedClock;
use crate::io::event_log::{self, EventLog};
use crate::io::journal::{self, JournalWriter};
use crate::io::place::with_suffix;
use crate::io::snapshot_file;
use crate::io::socket::LinkOutput;
use crate::monitor::{
    Downtime, LearnedCell, Monitor, MonitorConfig, Outputs, Reconfigured, Record, RecordKind, Transmit,
};
use crate::quantity::Timestamp;
use crate::status::collect::RecentEvents;
use crate::status::document::StoreStatus;
use crate::store::commit_barrier::CommitBarrier;
use crate::store::{HISTORY_SOURCE, STATE_SOURCE, StateCandidate, Store, StoreProgress};

/// The core and everything that receives its outputs.
#[derive(Debug)]
pub(super) struct Engine {
    pub(super) monitor: Monitor,
    pub(super) outputs: Outputs,
    /// Sending ends of the interfaces; empty before the start and after the stop.
    pub(super) links: Vec<LinkOutput>,
    key: Option<CanKey>,
    record: Option<JournalWriter<BackgroundFile>>,
    frames: Option<BackgroundFile>,
    events: Option<BackgroundFile>,
    names: Vec<String>,
    log: EventLog,
    /// Whether a file could not be written and was therefore closed.
    has_lost_file: bool,
    store: Option<Store>,
    store_works: bool,
    /// Whether the disk has room for more than urgent data.
    has_room: bool,
    /// Whether files can be written, as last reported to the core.
    reported_works: Option<bool>,
    barrier: CommitBarrier,
    /// Whether frames have arrived since the last checkpoint.
    is_fresh: bool,
    pub(super) readiness: Readiness,
    /// The latest events, for the status document.
    pub(super) recent: RecentEvents,
    /// Progress of the store; `None` = no progress was reported.
    progress: Option<StoreProgress>,
    /// Number of times that results were announced (sent in frames) before they were stored, because the disk was slow.
    late: u64,
}

impl Engine {
    /// Opens the store and the files, and restores the state.
    pub(super) fn new(service: &mut Service, clock: MappedClock) -> Result<Self, ServiceError> {
        let (store, found) =
            Store::open(&service.state, &service.config.store, &service.config.vehicle).map_err(ServiceError::Store)?;
        let names = service.config.interface_names();
        let mut monitor = Monitor::new(service.config.monitor.clone());
        let now = clock.now();
        let mut stamped_s = 0.0;
        // The state is restored before any file is opened, so that a failed start keeps the recording of an earlier
        // run.
        let (downtime, unfit) = if let Some(snapshot) = service.restore.take() {
            stamped_s = now.since(snapshot.time);
            monitor.restore(snapshot, service.downtime)?;
            tracing::info!(away = %service.downtime, stamped_s, "state restored");
            (Some(service.downtime), None)
        } else {
            let mut states = found.states;
            states.extend(state_of_history(&service.config.monitor, &found.learned, &found.alarms));
            restore_first_valid(&mut monitor, states, service.record.as_deref())
        };
        if let Some((store, why)) = store.as_ref().zip(unfit.as_ref()) {
            store.set_state_aside(why, now);
        }
        let mut record = open_journal(service, &names)?;
        let has_lost_file = downtime
            .is_some_and(|downtime| write_or_stop(&mut record, "record", |journal| journal.restored(now, downtime)));
        let frames = service.frames.as_deref().map(create).transpose()?;
        let mut events = service.events.as_deref().map(create).transpose()?;
        let vehicle = &service.config.vehicle;
        let has_lost_file =
            write_or_stop(&mut events, "events", |file| event_log::write_head(file, vehicle)) || has_lost_file;
        let log = EventLog::new(names.clone());
        let restored = downtime.map(|downtime| match downtime {
            Downtime::Seconds(age_s) => describe_restored(Some(age_s)),
            Downtime::AsStamped => describe_restored(Some(stamped_s).filter(|age_s| *age_s >= 0.0)),
            Downtime::Unknown => describe_restored(None),
        });
        let readiness = Readiness::new(&names, service.ready_timeout, restored, Instant::now());
        Ok(Self {
            monitor,
            outputs: Outputs::default(),
            links: Vec::new(),
            key: service.key.take(),
            record,
            frames,
            events,
            names,
            log,
            readiness,
            has_lost_file,
            store,
            store_works: found.works && unfit.is_none(),
            has_room: true,
            reported_works: None,
            barrier: CommitBarrier::default(),
            is_fresh: false,
            recent: RecentEvents::default(),
            progress: None,
            late: 0,
        })
    }

    /// Handles one record. If the record is an authenticated frame, its authenticator is checked first. Returns the
    /// ticket (number) of the commit that stores the record's changes; `None` = nothing to store, or no store.
    pub(super) fn handle(&mut self, record: &Record) -> Option<u64> {
        if let RecordKind::Frame { bus, frame } = &record.kind
            && let Some(check) = self.monitor.mac_check(*bus, frame)
        {
            let verified = self.key.as_ref().and_then(|key| check.verify(frame.data(), |bytes| key.mac(bytes)));
            return self.take(&Record::secured_frame(record.time, *bus, frame, verified));
        }
        self.take(record)
    }

    /// Journals one record, passes it to the core and dispatches its outputs.
    fn take(&mut self, record: &Record) -> Option<u64> {
        self.has_lost_file |= write_or_stop(&mut self.record, "record", |journal| journal.append(record));
        self.outputs.clear();
        self.monitor.handle(record, &mut self.outputs);
        self.is_fresh |= matches!(record.kind, RecordKind::Frame { .. } | RecordKind::SecuredFrame { .. });
        self.dispatch_outputs(record.time)
    }

    /// Applies another configuration to the core, and records the reload in the journal.
    ///
    /// # Errors
    /// Returns the reasons why the core rejects the configuration. In this case nothing has changed.
    pub(super) fn reconfigure(&mut self, config: MonitorConfig, time: Timestamp) -> Result<Reconfigured, Vec<String>> {
        self.outputs.clear();
        let changed =
            self.monitor.reconfigure(config, time, &mut self.outputs).map_err(|error| vec![error.to_string()])?;
        self.has_lost_file |= write_or_stop(&mut self.record, "record", |journal| journal.reloaded(time));
        self.dispatch_outputs(time);
        Ok(changed)
    }

    /// Sends the core's frames to the interfaces and its events to the log, and writes both to their files. Returns the
    /// ticket of the commit that stores the learned results.
    fn dispatch_outputs(&mut self, time: Timestamp) -> Option<u64> {
        let ticket = self.commit_learned(time);
        for transmit in &self.outputs.frames {
            if !self.barrier.hold(transmit) {
                send(&self.links, self.key.as_ref(), transmit);
            }
            let Some(name) = self.names.get(transmit.bus.index()) else { continue };
            let write =
                |file: &mut _| candump::write_line(file, transmit.time, StampDigits::Nanos, name, &transmit.frame);
            self.has_lost_file |= write_or_stop(&mut self.frames, "frames", write);
        }
        for event in &self.outputs.events {
            self.log.log(event);
            self.readiness.note(event);
            self.recent.note(Instant::now().into_std(), event);
            self.has_lost_file |= write_or_stop(&mut self.events, "events", |file| event_log::write_line(file, event));
        }
        ticket
    }

    /// Commits learned results. Unless the store has failed, the frames that announce the results wait for the commit.
    fn commit_learned(&mut self, now: Timestamp) -> Option<u64> {
        let ticket = self.store.as_mut()?.learned(&self.outputs.events, &self.monitor, now)?;
        if self.store_works {
            self.barrier.begin(ticket, Instant::now());
        }
        Some(ticket)
    }

    /// A receiver of the store's progress, updated with every change; `None` = no store.
    pub(super) fn store_progress(&self) -> Option<watch::Receiver<StoreProgress>> {
        self.store.as_ref().map(Store::progress)
    }

    pub(super) fn handle_store_progress(&mut self, progress: StoreProgress, time: Timestamp) {
        self.barrier.release(progress.ticket, |transmit| send(&self.links, self.key.as_ref(), transmit));
        (self.store_works, self.has_room) = (progress.works, progress.has_room);
        self.has_lost_file |= progress.was_replaced;
        self.progress = Some(progress);
        self.report_store_health(time);
    }

    pub(super) fn store_status(&self) -> Option<StoreStatus> {
        let path = match &self.store {
            Some(store) => store.folder().display().to_string(),
            // A store that cannot be opened is reported as failed, not as absent.
            None if !self.store_works => String::new(),
            None => return None,
        };
        let progress = self.progress.unwrap_or_default();
        let is_tried = self.progress.is_some() || self.late > 0 || self.store.is_none();
        Some(StoreStatus {
            path,
            works: is_tried.then_some(self.store_works && !progress.was_replaced),
            commits: progress.commits,
            failures: progress.failures,
            late: self.late,
            file_bytes: progress.file_bytes,
        })
    }

    /// Sends all frames that still wait for the disk, when the daemon stops.
    pub(super) fn release_all(&mut self) {
        self.barrier.release(u64::MAX, |transmit| send(&self.links, self.key.as_ref(), transmit));
    }

    /// Sends frames that have waited too long, and lets the store write its checkpoints. The loop calls this function
    /// with every tick.
    pub(super) fn poll_store(&mut self, time: Timestamp) {
        if let Some(ticket) = self.barrier.overdue(Instant::now()) {
            self.barrier.release(ticket, |transmit| send(&self.links, self.key.as_ref(), transmit));
            tracing::warn!("slow disk: results announced before they were stored");
            self.late += 1;
            self.store_works = false;
        }
        if let Some(store) = &mut self.store
            && store.tick(&self.monitor, time, self.is_fresh)
        {
            self.is_fresh = false;
        }
        self.report_store_health(time);
    }

    /// Reports to the core whether files can be written, if this has changed.
    pub(super) fn report_store_health(&mut self, time: Timestamp) {
        // The core receives this report even if the journal itself cannot be written.
        let works = self.store_works && self.has_room && !self.has_lost_file;
        if self.reported_works != Some(works) {
            self.reported_works = Some(works);
            self.handle(&Record::store(time, works));
        }
    }

    /// If frames are authenticated, stores the state at the start, so that a later start cannot use the same freshness
    /// counter again. The caller must not send frames before this call.
    pub(super) fn store_start(&mut self, time: Timestamp) {
        if self.key.is_some()
            && let Some(store) = &mut self.store
        {
            store.write_start(&self.monitor, time);
        }
    }

    #[cfg(test)]
    pub(super) fn write_checkpoint(&mut self, time: Timestamp) {
        if let Some(store) = &mut self.store {
            store.write_start(&self.monitor, time);
        }
    }

    #[cfg(test)]
    pub(super) fn settle_store(&mut self, time: Timestamp) -> Option<StoreProgress> {
        let progress = self.store.as_ref()?.settle();
        self.handle_store_progress(progress, time);
        Some(progress)
    }

    pub(super) fn close_store(&mut self, time: Timestamp) {
        if let Some(store) = self.store.take() {
            store.finish(&self.monitor, time);
        }
    }

    pub(super) fn flush(&mut self) {
        self.has_lost_file |= write_or_stop(&mut self.record, "record", JournalWriter::flush);
        self.has_lost_file |= write_or_stop(&mut self.frames, "frames", Write::flush);
        self.has_lost_file |= write_or_stop(&mut self.events, "events", Write::flush);
    }

    pub(super) fn close_files(&mut self) {
        let record = self.record.take().map(|journal| ("record", journal.into_inner()));
        let frames = self.frames.take().map(|file| ("frames", file));
        let events = self.events.take().map(|file| ("events", file));
        for (what, file) in record.into_iter().chain(frames).chain(events) {
            if let Err(error) = file.finish() {
                tracing::error!(what, %error, "file is incomplete");
            }
        }
    }
}

/// Sends a frame, with its authenticator if it has one.
fn send(links: &[LinkOutput], key: Option<&CanKey>, transmit: &Transmit) {
    let Some(link) = links.get(transmit.bus.index()) else { return };
    match (transmit.secured, key) {
        (None, _) => link.send(transmit.frame),
        (Some(secured), Some(key)) => link.send(secured.seal(&transmit.frame, |bytes| key.mac(bytes))),
        // This case cannot occur, because the start fails without a key. A frame without its authenticator must never
        // be sent.
        (Some(_), None) => {}
    }
}

/// Creates a state from the learned values and alarms in the history. `None` = the history is empty, or its values
/// belong to other cells.
fn state_of_history(
    config: &MonitorConfig,
    learned: &[LearnedCell],
    alarms: &[(Timestamp, AlarmChange)],
) -> Option<StateCandidate> {
    if learned.is_empty() && alarms.is_empty() {
        return None;
    }
    let mut monitor = Monitor::new(config.clone());
    if !monitor.relearn(learned) {
        tracing::warn!("learned values in the history belong to other cells, not used");
        return None;
    }
    let mut snapshot = monitor.snapshot();
    snapshot.time = alarms.last().map_or(snapshot.time, |(time, _)| *time);
    snapshot.repeat_alarms(alarms);
    Some(StateCandidate { snapshot, downtime: Downtime::Unknown, source: HISTORY_SOURCE })
}

/// Restores the first stored state that fits. Returns the age of this state and, if the state in the state file does
/// not fit, the reason. If a journal is recorded, writes the state next to the journal, because a replay of the journal
/// starts from this state.
fn restore_first_valid(
    monitor: &mut Monitor,
    states: Vec<StateCandidate>,
    journal: Option<&Path>,
) -> (Option<Downtime>, Option<String>) {
    let mut unfit = None;
    for StateCandidate { snapshot, downtime, source } in states {
        let copy = journal.map(|path| with_suffix(path, ".state.json"));
        let written = copy.as_deref().map(|path| snapshot_file::write(path, &snapshot));
        match monitor.restore(snapshot, downtime) {
            Ok(()) => {
                tracing::info!(source, away = %downtime, "state restored");
                if let Some(Err(error)) = written {
                    tracing::error!(%error, "initial state of the journal not written next to it");
                }
                return (Some(downtime), unfit);
            }
            Err(error) => {
                tracing::error!(source, %error, "stored state does not fit, not used");
                unfit = unfit.or_else(|| (source == STATE_SOURCE).then(|| error.to_string()));
            }
        }
    }
    tracing::info!("no stored state: nothing learned about the cells yet");
    (None, unfit)
}

/// Writes to a file, if it is open. If the file cannot be written, closes it and returns `true`.
fn write_or_stop<F>(file: &mut Option<F>, what: &str, write: impl FnOnce(&mut F) -> io::Result<()>) -> bool {
    let Some(Err(error)) = file.as_mut().map(write) else { return false };
    tracing::error!(what, %error, "file cannot be written, closed");
    *file = None;
    true
}

fn create(path: &Path) -> Result<BackgroundFile, ServiceError> {
    BackgroundFile::create(path).map_err(|error| ServiceError::File { path: path.to_owned(), error })
}

fn open_journal(service: &Service, names: &[String]) -> Result<Option<JournalWriter<BackgroundFile>>, ServiceError> {
    let Some(path) = service.record.as_deref() else { return Ok(None) };
    let file = match service.record_limits {
        None => BackgroundFile::create(path),
        Some(limits) => BackgroundFile::create_segments(path, journal::HEADER, limits),
    };
    let journal = file.and_then(|file| JournalWriter::new(file, names.to_vec()));
    journal.map(Some).map_err(|error| ServiceError::File { path: path.to_owned(), error })
}
