//! The live loop: interfaces in, the core stepped, frames out, a tick every [`TICK_PERIOD_MS`].
//!
//! One task owns the [`Monitor`]; every input is journalled before it is handed over, in that very order, so that
//! the journal replayed gives the same frames. Nothing a bus, a disk or a service manager does ends the loop;
//! SIGTERM and SIGINT do, cleanly.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use sd_notify::NotifyState;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until, timeout};

use super::background_file::BackgroundFile;
use super::control::protocol::{Answer, Request};
use super::control::{Asked, ControlServer, ControlSetting, MAX_CONNECTIONS, answer};
use super::event_log::{self, EventLog};
use super::{j1939_carrier, snapshot_file};
use crate::config::Config;
use crate::io::candump::{self, StampDigits};
use crate::io::clock::{MappedClock, Reading};
use crate::io::journal::JournalWriter;
use crate::io::socket::{Link, LinkConfig, LinkOutput, Received, What};
use crate::monitor::{Command, Input, Monitor, Outputs, RestoreError, Snapshot, TICK_PERIOD_MS};
use crate::quantity::BusIndex;

/// Things received and not yet handed to the core: half a second of a full 1 Mbit/s bus.
const INBOX: usize = 4096;
/// Of these, handed over between two looks at the timer: under one tick's time of a full bus.
const BATCH: usize = 256;
/// Time the interfaces have to send what is queued when the daemon stops.
const DRAIN_LIMIT: Duration = Duration::from_millis(500);
/// How often files are handed to the operating system: what a crash of the daemon can lose.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);

/// What to run.
#[derive(Debug)]
pub struct Service {
    /// Checked configuration.
    pub config: Config,
    /// Journal of every input.
    pub record: Option<PathBuf>,
    /// Log of the frames sent, with the time of the input that caused each.
    pub frames: Option<PathBuf>,
    /// Events as JSON, a line each.
    pub events: Option<PathBuf>,
    /// State to start from.
    pub restore: Option<Snapshot>,
    /// Age of that state, s; `None` = as its stamp says.
    pub away_s: Option<f64>,
    /// Where the state goes when the daemon stops.
    pub snapshot: Option<PathBuf>,
    /// Stop after this long; `None` = when told to.
    pub duration: Option<Duration>,
    /// Receive buffer asked for per interface, bytes.
    pub receive_buffer_bytes: usize,
    /// The control socket.
    pub control: ControlSetting,
}

/// Why the service could not start, or not end as it should.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// A file could not be written.
    #[error("{}: {error}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// The snapshot does not fit.
    #[error("{0}")]
    Restore(#[from] RestoreError),
    /// The control socket is another daemon's, or cannot be made.
    #[error("{0}")]
    Control(String),
    /// The runtime or a signal handler could not be set up.
    #[error("cannot start: {0}")]
    Start(#[from] io::Error),
}

impl Service {
    /// Runs until told to stop.
    ///
    /// # Errors
    /// When it cannot start, or its final snapshot cannot be written.
    pub fn run(self) -> Result<(), ServiceError> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        runtime.block_on(self.serve())
    }

    async fn serve(mut self) -> Result<(), ServiceError> {
        let stop = Stop::new(self.duration)?;
        let clock = MappedClock::new(Reading::now());
        let (sender, inbox) = mpsc::channel(INBOX);
        let snapshot = self.snapshot.take();
        // Before any file is opened: a second daemon must not take those of the first.
        let (asked, requests) = mpsc::channel(MAX_CONNECTIONS);
        let control = ControlServer::start(&self.control, asked).await.map_err(ServiceError::Control)?;
        let mut engine = self.engine(clock)?;
        let (links, outputs) = self.start_links(clock, &sender);
        drop(sender);
        // The first input is the time of the start; what it sends waits for the interfaces.
        engine.handle(&Input::Tick { time: clock.now() }, &outputs);
        let works = !std::mem::take(&mut engine.lost_file);
        engine.handle(&Input::Store { time: clock.now(), works }, &outputs);
        let mut service = Loop { engine, inbox, requests, clock, outputs, batch: Vec::with_capacity(BATCH) };
        notify(&[NotifyState::Ready, NotifyState::Status("running")]);
        tracing::info!(interfaces = self.config.interfaces.len(), "started");
        if self.config.monitor.j1939.is_some() {
            j1939_carrier::tell();
        }
        service.run(stop).await;
        notify(&[NotifyState::Stopping]);
        drop(control);
        service.finish(links, snapshot.as_deref()).await
    }

    /// The core and the files round it.
    fn engine(&mut self, clock: MappedClock) -> Result<Engine, ServiceError> {
        let names: Vec<String> = self.config.interfaces.iter().map(|i| i.name.clone()).collect();
        let mut monitor = Monitor::new(self.config.monitor.clone());
        let restored = self.restore.take();
        let now = clock.now();
        let is_restored = restored.is_some();
        if let Some(snapshot) = restored {
            let away_s = self.away_s.unwrap_or_else(|| now.since(snapshot.time).max(0.0));
            // Before any file is opened: a start that fails leaves what an earlier run has recorded.
            monitor.restore(snapshot, self.away_s)?;
            tracing::info!(away_s, "state taken up");
        }
        let mut record = open_journal(self.record.as_deref(), &names)?;
        let mut lost_file = false;
        let marked = record.as_mut().filter(|_| is_restored).map(|journal| journal.restored(now, self.away_s));
        if let Some(Err(error)) = marked {
            tracing::error!(%error, "recording stopped");
            (record, lost_file) = (None, true);
        }
        let frames = self.frames.as_deref().map(create).transpose()?;
        let events = self.events.as_deref().map(create).transpose()?;
        let log = EventLog::new(names.clone());
        Ok(Engine { monitor, outputs: Outputs::default(), record, frames, events, names, log, lost_file })
    }

    fn start_links(&self, clock: MappedClock, inbox: &mpsc::Sender<Received>) -> (JoinSet<()>, Vec<LinkOutput>) {
        let mut links = JoinSet::new();
        let mut outputs = Vec::new();
        for (bus, interface) in (0_u8..).map(BusIndex).zip(&self.config.interfaces) {
            let config = LinkConfig {
                bus,
                interface: interface.name.clone(),
                fd: interface.fd,
                ids: self.config.monitor.wanted_ids(bus),
                patterns: self.config.monitor.wanted_patterns(bus),
                receive_buffer_bytes: self.receive_buffer_bytes,
            };
            let (link, output) = Link::new(config, clock, inbox.clone());
            links.spawn(link.run());
            outputs.push(output);
        }
        (links, outputs)
    }
}

/// The core, its journal and its log.
#[derive(Debug)]
struct Engine {
    monitor: Monitor,
    outputs: Outputs,
    record: Option<JournalWriter<BackgroundFile>>,
    frames: Option<BackgroundFile>,
    events: Option<BackgroundFile>,
    names: Vec<String>,
    log: EventLog,
    /// A file was given up, and the core has not been told yet.
    lost_file: bool,
}

impl Engine {
    /// Journals one input, hands it to the core, and hands on what comes of it.
    fn handle(&mut self, input: &Input<'_>, links: &[LinkOutput]) {
        if let Some(Err(error)) = self.record.as_mut().map(|journal| journal.append(input)) {
            self.stop_recording(&error);
        }
        self.outputs.clear();
        self.monitor.handle(*input, &mut self.outputs);
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
            self.lost_file |= write_or_stop(&mut self.events, "events", |file| event_log::write_line(file, event));
        }
    }

    fn stop_recording(&mut self, error: &io::Error) {
        tracing::error!(%error, "recording stopped");
        (self.record, self.lost_file) = (None, true);
    }

    fn flush(&mut self) {
        if let Some(Err(error)) = self.record.as_mut().map(JournalWriter::flush) {
            self.stop_recording(&error);
        }
        self.lost_file |= write_or_stop(&mut self.frames, "frames", Write::flush);
        self.lost_file |= write_or_stop(&mut self.events, "events", Write::flush);
    }

    fn close_files(&mut self) {
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

/// The running loop.
#[derive(Debug)]
struct Loop {
    engine: Engine,
    inbox: mpsc::Receiver<Received>,
    requests: mpsc::Receiver<Asked>,
    clock: MappedClock,
    outputs: Vec<LinkOutput>,
    batch: Vec<Received>,
}

impl Loop {
    async fn run(&mut self, mut stop: Stop) {
        let mut ticks = interval(Duration::from_millis(u64::from(TICK_PERIOD_MS)));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let watchdog = sd_notify::watchdog_enabled().map(|period| period / 2);
        let (mut fed, mut flushed) = (Instant::now(), Instant::now());
        loop {
            // In this order: a bus that never falls silent must hold up neither the stop nor the ticks.
            tokio::select! {
                biased;
                () = stop.wait() => return,
                now = ticks.tick() => {
                    self.tick().await;
                    if watchdog.is_some_and(|period| now.duration_since(fed) >= period) {
                        notify(&[NotifyState::Watchdog]);
                        fed = now;
                    }
                    if now.duration_since(flushed) >= FLUSH_PERIOD {
                        self.engine.flush();
                        flushed = now;
                    }
                }
                // Each is taken between two ticks, and there are never more than connections.
                Some(asked) = self.requests.recv() => self.answer(asked).await,
                received = self.inbox.recv_many(&mut self.batch, BATCH) => {
                    if received > 0 { self.handle_batch() }
                }
            }
        }
    }

    /// What came before the tick is handed over before it.
    async fn tick(&mut self) {
        self.drain().await;
        if std::mem::take(&mut self.engine.lost_file) {
            // The journal may be the one that is lost: the core is told all the same.
            self.engine.handle(&Input::Store { time: self.clock.now(), works: false }, &self.outputs);
        }
        self.engine.handle(&Input::Tick { time: self.clock.now() }, &self.outputs);
    }

    /// Somebody on this computer asks.
    async fn answer(&mut self, asked: Asked) {
        let alarms = self.engine.monitor.alarms();
        let answer = match asked.request {
            Request::Alarms { all } => answer::list(alarms, self.clock.now(), all),
            Request::Command(command) => match answer::meaningless(alarms, &command) {
                Some(error) => error,
                None => self.obey(command).await,
            },
        };
        // A client that has gone wants no answer.
        let _ = asked.answer.send(answer);
    }

    /// Hands a command to the core like any other input, after what came before it.
    async fn obey(&mut self, command: Command) -> Answer {
        self.drain().await;
        let time = self.clock.now();
        self.engine.handle(&Input::Command { time, command }, &self.outputs);
        let Engine { monitor, outputs, .. } = &self.engine;
        answer::outcome(monitor.alarms(), &command, &outputs.events, time)
    }

    /// Hands over what the interfaces have received so far.
    async fn drain(&mut self) {
        for _ in 0..INBOX / BATCH {
            // Lets the interfaces' tasks take what is in their sockets, and send.
            tokio::task::yield_now().await;
            while self.batch.len() < BATCH
                && let Ok(received) = self.inbox.try_recv()
            {
                self.batch.push(received);
            }
            if self.batch.is_empty() {
                break;
            }
            self.handle_batch();
        }
    }

    /// Interfaces merge by time; what one interface delivered keeps its order.
    fn handle_batch(&mut self) {
        self.batch.sort_by_key(|received| received.time);
        for received in &self.batch {
            let Received { time, bus, what } = *received;
            let input = match &what {
                What::Frame(frame) => Input::Frame { time, bus, frame },
                What::Event(event) => Input::Bus { time, bus, event: *event },
            };
            self.engine.handle(&input, &self.outputs);
        }
        self.batch.clear();
    }

    /// Sends what is queued, closes the files, stores the state.
    async fn finish(mut self, mut links: JoinSet<()>, snapshot: Option<&Path>) -> Result<(), ServiceError> {
        self.outputs.clear();
        self.inbox.close();
        let drained = async { while links.join_next().await.is_some() {} };
        if timeout(DRAIN_LIMIT, drained).await.is_err() {
            tracing::warn!("not every queued frame was sent before the stop");
        }
        // The state first: the files may hang on a disk that does not answer.
        let stored = snapshot.map_or(Ok(()), |path| {
            snapshot_file::write(path, &self.engine.monitor.snapshot())
                .map_err(|error| ServiceError::File { path: path.to_owned(), error })
        });
        self.engine.close_files();
        tracing::info!("stopped");
        stored
    }
}

/// What ends the loop.
#[derive(Debug)]
struct Stop {
    terminate: Signal,
    interrupt: Signal,
    at: Option<Instant>,
}

impl Stop {
    fn new(duration: Option<Duration>) -> io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            at: duration.map(|duration| Instant::now() + duration),
        })
    }

    async fn wait(&mut self) {
        let at = self.at;
        let timer = async move {
            match at {
                Some(at) => sleep_until(at).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = self.terminate.recv() => {}
            _ = self.interrupt.recv() => {}
            () = timer => {}
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

/// Tells the service manager; without one nothing happens.
fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::warn!(%error, "service manager not told");
    }
}

fn create(path: &Path) -> Result<BackgroundFile, ServiceError> {
    BackgroundFile::create(path).map_err(|error| ServiceError::File { path: path.to_owned(), error })
}

fn open_journal(path: Option<&Path>, names: &[String]) -> Result<Option<JournalWriter<BackgroundFile>>, ServiceError> {
    let Some(path) = path else { return Ok(None) };
    let journal = JournalWriter::new(create(path)?, names.to_vec());
    journal.map(Some).map_err(|error| ServiceError::File { path: path.to_owned(), error })
}
