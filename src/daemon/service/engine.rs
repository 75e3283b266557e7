//! The core with its journal, its log and the files round it: one input in, what comes of it handed on.

use std::io::{self, Write};
use std::path::Path;

use tokio::time::Instant;

use super::readiness::{Readiness, restored_words};
use super::{Service, ServiceError};
use crate::daemon::background_file::BackgroundFile;
use crate::daemon::event_log::{self, EventLog};
use crate::io::candump::{self, StampDigits};
use crate::io::clock::MappedClock;
use crate::io::journal::JournalWriter;
use crate::io::socket::LinkOutput;
use crate::monitor::{Away, Input, Monitor, MonitorConfig, Outputs, Reconfigured};
use crate::quantity::Timestamp;

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
    pub(super) readiness: Readiness,
    /// A file was given up, and the core has not been told yet.
    pub(super) lost_file: bool,
}

impl Engine {
    /// The core and the files round it.
    pub(super) fn new(service: &mut Service, clock: MappedClock) -> Result<Self, ServiceError> {
        let names: Vec<String> = service.config.interfaces.iter().map(|i| i.name.clone()).collect();
        let mut monitor = Monitor::new(service.config.monitor.clone());
        let restored = service.restore.take();
        let now = clock.now();
        let is_restored = restored.is_some();
        let mut told = None;
        if let Some(snapshot) = restored {
            let stamped_s = now.since(snapshot.time);
            // Before any file is opened: a start that fails leaves what an earlier run has recorded.
            monitor.restore(snapshot, service.away)?;
            told = Some(restored_words(match service.away {
                Away::Seconds(age_s) => Some(age_s),
                Away::AsStamped => Some(stamped_s).filter(|age_s| *age_s >= 0.0),
                Away::Unknown => None,
            }));
            tracing::info!(away = %service.away, stamped_s, "state taken up");
        }
        let mut record = open_journal(service.record.as_deref(), &names)?;
        let mut lost_file = false;
        let marked = record.as_mut().filter(|_| is_restored).map(|journal| journal.restored(now, service.away));
        if let Some(Err(error)) = marked {
            tracing::error!(%error, "recording stopped");
            (record, lost_file) = (None, true);
        }
        let frames = service.frames.as_deref().map(create).transpose()?;
        let events = service.events.as_deref().map(create).transpose()?;
        let log = EventLog::new(names.clone());
        let readiness = Readiness::new(&names, service.ready_timeout, told, Instant::now());
        Ok(Self { monitor, outputs: Outputs::default(), record, frames, events, names, log, readiness, lost_file })
    }

    /// Journals one input, hands it to the core, and hands on what comes of it.
    pub(super) fn handle(&mut self, input: &Input<'_>, links: &[LinkOutput]) {
        if let Some(Err(error)) = self.record.as_mut().map(|journal| journal.append(input)) {
            self.stop_recording(&error);
        }
        self.outputs.clear();
        self.monitor.handle(*input, &mut self.outputs);
        self.hand_on(links);
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
        self.hand_on(links);
        Ok(changed)
    }

    /// What came out of the core: frames to the interfaces, events to the log, both to their files.
    fn hand_on(&mut self, links: &[LinkOutput]) {
        for transmit in &self.outputs.frames {
            if let Some(link) = links.get(transmit.bus.index()) {
                link.send(transmit.frame);
            }
            let Some(name) = self.names.get(transmit.bus.index()) else { continue };
            let write =
                |file: &mut _| candump::write_line(file, transmit.time, StampDigits::Nanos, name, &transmit.frame);
            self.lost_file |= write_or_stop(&mut self.frames, "frames", write);
        }
        for event in &self.outputs.events {
            self.log.log(event);
            self.readiness.note(event);
            self.lost_file |= write_or_stop(&mut self.events, "events", |file| event_log::write_line(file, event));
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
