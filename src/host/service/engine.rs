//! The core with its journal, its log and the files round it: one input in, what comes of it handed on.

use std::io::{self, Write};
use std::path::Path;

use tokio::sync::watch;
use tokio::time::Instant;

use super::readiness::{Readiness, restored_words};
use super::{Service, ServiceError};
use crate::io::background_file::BackgroundFile;
use crate::io::candump::{self, StampDigits};
use crate::io::clock::MappedClock;
use crate::io::event_log::{self, EventLog};
use crate::io::journal::JournalWriter;
use crate::io::snapshot_file;
use crate::io::socket::LinkOutput;
use crate::monitor::{Downtime, Input, Monitor, MonitorConfig, Outputs, Reconfigured, Transmit};
use crate::quantity::Timestamp;
use crate::status::collect::RecentEvents;
use crate::status::document::Store as StoreStatus;
use crate::store::commit_barrier::CommitBarrier;
use crate::store::{Candidate, DATABASE_SOURCE, Progress, Store, with_suffix};

/// The core, its journal and its log.
#[derive(Debug)]
pub(super) struct Engine {
    pub(super) monitor: Monitor,
    pub(super) outputs: Outputs,
    record: Option<JournalWriter<BackgroundFile>>,
    frames: Option<BackgroundFile>,
    events: Option<BackgroundFile>,
    names: Vec<String>,
    log: EventLog,
    /// A file was given up.
    lost_file: bool,
    /// State and history.
    store: Option<Store>,
    /// Whether they can be written.
    store_works: bool,
    /// What the core was told last of all this.
    told_works: Option<bool>,
    hold: CommitBarrier,
    /// Frames have come since the last checkpoint.
    is_fresh: bool,
    pub(super) readiness: Readiness,
    /// For those who look.
    pub(super) recent: RecentEvents,
    /// What the store has told; `None` = nothing so far.
    progress: Option<Progress>,
    /// Announcements that did not wait for it any longer.
    late: u64,
}

impl Engine {
    /// The core and the files round it.
    pub(super) fn new(service: &mut Service, clock: MappedClock) -> Result<Self, ServiceError> {
        let (store, found) = Store::open(&service.state, &service.config.store).map_err(ServiceError::Store)?;
        let names = service.config.interface_names();
        let mut monitor = Monitor::new(service.config.monitor.clone());
        let now = clock.now();
        let mut stamped_s = 0.0;
        // Before any file is opened: a start that fails leaves what an earlier run has recorded.
        let (away, unfit) = if let Some(snapshot) = service.restore.take() {
            stamped_s = now.since(snapshot.time);
            monitor.restore(snapshot, service.away)?;
            tracing::info!(away = %service.away, stamped_s, "state taken up");
            (Some(service.away), None)
        } else {
            restore_first_valid(&mut monitor, found.states, service.record.as_deref())
        };
        if let Some((store, why)) = store.as_ref().zip(unfit.as_ref()) {
            store.set_state_aside(why, now);
        }
        let mut record = open_journal(service.record.as_deref(), &names)?;
        let mut lost_file = false;
        let marked = record.as_mut().zip(away).map(|(journal, away)| journal.restored(now, away));
        if let Some(Err(error)) = marked {
            tracing::error!(%error, "recording stopped");
            (record, lost_file) = (None, true);
        }
        let frames = service.frames.as_deref().map(create).transpose()?;
        let events = service.events.as_deref().map(create).transpose()?;
        let log = EventLog::new(names.clone());
        let restored = away.map(|away| match away {
            Downtime::Seconds(age_s) => restored_words(Some(age_s)),
            Downtime::AsStamped => restored_words(Some(stamped_s).filter(|age_s| *age_s >= 0.0)),
            Downtime::Unknown => restored_words(None),
        });
        let readiness = Readiness::new(&names, service.ready_timeout, restored, Instant::now());
        Ok(Self {
            monitor,
            outputs: Outputs::default(),
            record,
            frames,
            events,
            names,
            log,
            readiness,
            lost_file,
            store,
            store_works: found.works && unfit.is_none(),
            told_works: None,
            hold: CommitBarrier::default(),
            is_fresh: false,
            recent: RecentEvents::default(),
            progress: None,
            late: 0,
        })
    }

    /// Journals one input, hands it to the core, and hands on what comes of it.
    pub(super) fn handle(&mut self, input: &Input<'_>, links: &[LinkOutput]) {
        if let Some(Err(error)) = self.record.as_mut().map(|journal| journal.append(input)) {
            self.stop_recording(&error);
        }
        self.outputs.clear();
        self.monitor.handle(*input, &mut self.outputs);
        self.is_fresh |= matches!(input, Input::Frame { .. });
        self.dispatch_outputs(input.time(), links);
    }

    /// Gives the core another configuration; the journal says that it did.
    ///
    /// # Errors
    /// Why the core does not take it; then nothing has changed.
    pub(super) fn reconfigure(
        &mut self,
        config: MonitorConfig,
        time: Timestamp,
        links: &[LinkOutput],
    ) -> Result<Reconfigured, Vec<String>> {
        self.outputs.clear();
        let changed =
            self.monitor.reconfigure(config, time, &mut self.outputs).map_err(|error| vec![error.to_string()])?;
        if let Some(Err(error)) = self.record.as_mut().map(|journal| journal.reloaded(time)) {
            self.stop_recording(&error);
        }
        self.dispatch_outputs(time, links);
        Ok(changed)
    }

    /// What came out of the core: frames to the interfaces, events to the log, both to their files.
    fn dispatch_outputs(&mut self, time: Timestamp, links: &[LinkOutput]) {
        self.keep(time);
        for transmit in &self.outputs.frames {
            if !self.hold.take(transmit) {
                send(links, transmit);
            }
            let Some(name) = self.names.get(transmit.bus.index()) else { continue };
            let write =
                |file: &mut _| candump::write_line(file, transmit.time, StampDigits::Nanos, name, &transmit.frame);
            self.lost_file |= write_or_stop(&mut self.frames, "frames", write);
        }
        for event in &self.outputs.events {
            self.log.log(event);
            self.readiness.note(event);
            self.recent.note(event);
            self.lost_file |= write_or_stop(&mut self.events, "events", |file| event_log::write_line(file, event));
        }
    }

    /// Makes what was learned durable; its announcement waits for that. A store that fails is not waited for.
    fn keep(&mut self, now: Timestamp) {
        let Some(store) = &mut self.store else { return };
        let ticket = store.learned(&self.outputs.events, &self.monitor, now);
        if let Some(ticket) = ticket.filter(|_| self.store_works) {
            self.hold.begin(ticket, Instant::now());
        }
    }

    /// How far the store is, told whenever that changes; `None` = there is none.
    pub(super) fn store_progress(&self) -> Option<watch::Receiver<Progress>> {
        self.store.as_ref().map(Store::progress)
    }

    /// The store has come further, or has failed.
    pub(super) fn settle(&mut self, progress: Progress, time: Timestamp, links: &[LinkOutput]) {
        self.hold.release(progress.ticket, |transmit| send(links, transmit));
        self.store_works = progress.works;
        self.progress = Some(progress);
        self.tell_works(time, links);
    }

    /// The store, for those who look.
    pub(super) fn store_status(&self) -> Option<StoreStatus> {
        let path = match &self.store {
            Some(store) => store.folder().display().to_string(),
            // One that cannot be opened is told as such, not as "none".
            None if !self.store_works => String::new(),
            None => return None,
        };
        let progress = self.progress.unwrap_or_default();
        let is_tried = self.progress.is_some() || self.late > 0 || self.store.is_none();
        Some(StoreStatus {
            path,
            works: is_tried.then_some(self.store_works),
            commits: progress.commits,
            failures: progress.failures,
            late: self.late,
            file_bytes: progress.file_bytes,
        })
    }

    /// Nothing waits any longer: the daemon stops.
    pub(super) fn let_go(&mut self, links: &[LinkOutput]) {
        self.hold.release(u64::MAX, |transmit| send(links, transmit));
    }

    /// With every tick: what has waited too long goes, and the store gets its checkpoints.
    pub(super) fn look_after_store(&mut self, time: Timestamp, links: &[LinkOutput]) {
        if let Some(ticket) = self.hold.overdue(Instant::now()) {
            self.hold.release(ticket, |transmit| send(links, transmit));
            tracing::warn!("the disk is slow: announced before it was stored");
            self.late += 1;
            self.store_works = false;
        }
        if let Some(store) = &mut self.store
            && store.tick(&self.monitor, time, self.is_fresh)
        {
            self.is_fresh = false;
        }
        self.tell_works(time, links);
    }

    /// Tells the core when it has changed whether files can be written.
    pub(super) fn tell_works(&mut self, time: Timestamp, links: &[LinkOutput]) {
        // The journal may be the file that is lost: the core is told all the same.
        let works = self.store_works && !self.lost_file;
        if self.told_works != Some(works) {
            self.told_works = Some(works);
            self.handle(&Input::Store { time, works }, links);
        }
    }

    /// The last state, on the disk.
    pub(super) fn close_store(&mut self, time: Timestamp) {
        if let Some(store) = self.store.take() {
            store.finish(&self.monitor, time);
        }
    }

    fn stop_recording(&mut self, error: &io::Error) {
        tracing::error!(%error, "recording stopped");
        (self.record, self.lost_file) = (None, true);
    }

    pub(super) fn flush(&mut self) {
        if let Some(Err(error)) = self.record.as_mut().map(JournalWriter::flush) {
            self.stop_recording(&error);
        }
        self.lost_file |= write_or_stop(&mut self.frames, "frames", Write::flush);
        self.lost_file |= write_or_stop(&mut self.events, "events", Write::flush);
    }

    pub(super) fn close_files(&mut self) {
        let record = self.record.take().map(|journal| ("record", journal.into_inner()));
        let frames = self.frames.take().map(|file| ("frames", file));
        let events = self.events.take().map(|file| ("events", file));
        for (what, file) in record.into_iter().chain(frames).chain(events) {
            if let Err(error) = file.finish() {
                tracing::error!(what, %error, "file is not complete");
            }
        }
    }
}

fn send(links: &[LinkOutput], transmit: &Transmit) {
    if let Some(link) = links.get(transmit.bus.index()) {
        link.send(transmit.frame);
    }
}

/// Takes up the first of the stored states that fits; how old it is, and why the database's was not, if it does not fit.
/// Beside a journal goes what it began from.
fn restore_first_valid(
    monitor: &mut Monitor,
    states: Vec<Candidate>,
    journal: Option<&Path>,
) -> (Option<Downtime>, Option<String>) {
    let mut unfit = None;
    for Candidate { snapshot, away, source } in states {
        let beside = journal.map(|path| with_suffix(path, ".state.json"));
        let written = beside.as_deref().map(|path| snapshot_file::write(path, &snapshot));
        match monitor.restore(snapshot, away) {
            Ok(()) => {
                tracing::info!(source, %away, "state taken up");
                if let Some(Err(error)) = written {
                    tracing::error!(%error, "the state this record begins from is not beside it");
                }
                return (Some(away), unfit);
            }
            Err(error) => {
                tracing::error!(source, %error, "a stored state does not fit and is not used");
                unfit = unfit.or_else(|| (source == DATABASE_SOURCE).then(|| error.to_string()));
            }
        }
    }
    tracing::info!("no stored state: nothing is known of the cells yet");
    (None, unfit)
}

/// Writes to a file, if it is still wanted; one that cannot be written is given up, and the daemon goes on: then true.
fn write_or_stop(
    file: &mut Option<BackgroundFile>,
    what: &str,
    write: impl FnOnce(&mut BackgroundFile) -> io::Result<()>,
) -> bool {
    let Some(Err(error)) = file.as_mut().map(write) else { return false };
    tracing::error!(what, %error, "file given up");
    *file = None;
    true
}

fn create(path: &Path) -> Result<BackgroundFile, ServiceError> {
    BackgroundFile::create(path).map_err(|error| ServiceError::File { path: path.to_owned(), error })
}

fn open_journal(path: Option<&Path>, names: &[String]) -> Result<Option<JournalWriter<BackgroundFile>>, ServiceError> {
    let Some(path) = path else { return Ok(None) };
    let journal = JournalWriter::new(create(path)?, names.to_vec());
    journal.map(Some).map_err(|error| ServiceError::File { path: path.to_owned(), error })
}
