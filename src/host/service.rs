//! The service: runs the core on live interfaces, with a tick every [`TICK_PERIOD_MS`](crate::monitor::TICK_PERIOD_MS).
//!
//! In: frames and states of the interfaces, ticks, commands. Out: frames, events, status. One task owns the core. Every
//! input is written to the journal before the core handles it, so that a replay of the journal produces the same
//! frames. No fault of a bus, a disk or the service manager ends the loop. The signals that [`Stop`] handles end the
//! loop cleanly.

mod engine;
mod j1939_carrier;
mod live;
mod pending_answers;
pub mod readiness;
mod reload;
mod status_publisher;
#[cfg(test)]
mod world;

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use sd_notify::NotifyState;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::Instant;

use super::control::{ControlServer, MAX_CONNECTIONS};

use super::status::StatusServer;
use super::status::collect::ServiceIdentity;
use super::status::document::ConfigFile;
use crate::config::{Config, VehicleIdentity};
use crate::io::can_key::CanKey;
use crate::io::clock::{MappedClock, Reading, StepDetector};
use crate::io::place::PlaceSetting;
use crate::io::runtime::check_descriptors;
use crate::io::segments::SegmentLimits;
use crate::io::socket::{Link, LinkConfig, LinkOutput};
use crate::io::stop::Stop;
use crate::monitor::{Downtime, Record, RestoreError, Snapshot};
use crate::quantity::BusIndex;

use engine::Engine;
use live::ServiceLoop;
use reload::Reload;
use status_publisher::StatusPublisher;

/// Maximum number of frames and events that wait for the core. A full 1 Mbit/s bus sends this many in half a second.
const INBOX: usize = 4096;

/// Number of threads for work that would block the loop: reading a configuration, serialising long answers, and fitting
/// a cell model. More threads would only wait for the disk.
const BLOCKING_THREADS: usize = 4;

/// The settings of a run.
#[derive(Debug)]
pub struct Service {
    /// Checked configuration.
    pub config: Config,
    /// Journal of all inputs.
    pub record: Option<PathBuf>,
    /// Size limits of a segmented journal; `None` = one file.
    pub record_limits: Option<SegmentLimits>,
    /// Log of the sent frames, with the time of the input that caused each frame.
    pub frames: Option<PathBuf>,
    /// Events as JSON lines.
    pub events: Option<PathBuf>,
    /// Initial state.
    pub restore: Option<Snapshot>,
    /// Age of the initial state.
    pub downtime: Downtime,
    /// File to which the daemon writes the state when it stops.
    pub snapshot: Option<PathBuf>,
    /// Time after which the service stops; `None` = it runs until a signal.
    pub duration: Option<Duration>,
    /// Longest wait for the first usable reading before the service reports that it is ready.
    pub ready_timeout: Duration,
    /// Receive buffer requested per interface, bytes.
    pub receive_buffer_bytes: usize,
    /// The control socket.
    pub control: PlaceSetting,
    /// Folder of state and history.
    pub state: PlaceSetting,
    /// The status sockets.
    pub status: PlaceSetting,
    /// The configuration file, for the status document.
    pub config_file: Option<ConfigFile>,
    /// Key of authenticated frames; `None` = not configured.
    pub key: Option<CanKey>,
}

/// Why the service could not start or stop.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// A file could not be written.
    #[error("{}: {error}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The error.
        error: io::Error,
    },
    /// The snapshot cannot be restored.
    #[error("{0}")]
    Restore(#[from] RestoreError),
    /// Another daemon uses the state folder.
    #[error("{0}")]
    Store(String),
    /// Another daemon uses the control or status socket, or the socket cannot be created.
    #[error("{0}")]
    Socket(String),
    /// The runtime or a signal handler could not be set up.
    #[error("cannot start: {0}")]
    Start(#[from] io::Error),
}

impl Service {
    /// Runs the service until a signal arrives or its duration ends.
    ///
    /// # Errors
    /// Fails if the service cannot start, or if its final snapshot cannot be written.
    pub fn run(self) -> Result<(), ServiceError> {
        check_descriptors()?;
        let mut builder = tokio::runtime::Builder::new_current_thread();
        let runtime = builder.enable_all().max_blocking_threads(BLOCKING_THREADS).build()?;
        // The service runs as a spawned task, because waking the future of `block_on` itself costs a system call per
        // frame.
        let served = runtime.block_on(async { tokio::spawn(self.serve()).await });
        // A running fit of the cell model is abandoned, and started again after the next start.
        runtime.shutdown_background();
        served.unwrap_or_else(|stopped| std::panic::resume_unwind(stopped.into_panic()))
    }

    async fn serve(mut self) -> Result<(), ServiceError> {
        let stop = Stop::new(self.duration)?;
        let reload = Reload::new(&self.config)?;
        let start = Reading::now();
        let clock = MappedClock::new(start);
        let (sender, inbox) = mpsc::channel(INBOX);
        let snapshot = self.snapshot.take();
        // The sockets are opened before any file, so that a second daemon does not overwrite the files of the first.
        let (sender_of_requests, requests) = mpsc::channel(MAX_CONNECTIONS);
        let control = ControlServer::start(&self.control, sender_of_requests).await.map_err(ServiceError::Socket)?;
        let status = StatusServer::start(&self.status).map_err(ServiceError::Socket)?;
        let mut engine = Engine::new(&mut self, clock)?;
        let (links, outputs) = self.start_links(clock, &sender);
        engine.links = outputs;
        drop(sender);
        // The first input is a tick at the time of the start. The frames that this tick causes wait in the send queues
        // until the tasks of the interfaces run.
        engine.handle(&Record::tick(clock.now()));
        engine.store_start(clock.now());
        engine.report_store_health(clock.now());
        let status_publisher = StatusPublisher::new(status, self.identity(clock));
        let mut service = ServiceLoop {
            engine,
            inbox,
            requests,
            pending_answers: pending_answers::PendingAnswers::default(),
            reload,
            clock,
            clock_steps: StepDetector::new(start),
            batch: Vec::new(),
            ticked: clock.now(),
            left_out_reported: Instant::now(),
            status_publisher,
            model_fit: None,
        };
        self.config.warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
        let VehicleIdentity { name: vehicle, id, pack } = &self.config.vehicle;
        tracing::info!(interfaces = self.config.interfaces.len(), vehicle, id, pack, "started");
        log_commands(&self.config);
        if self.config.monitor.j1939.is_some() {
            j1939_carrier::log_kernel_stack();
        }
        service.run(stop).await;
        notify(&[NotifyState::Stopping]);
        drop(control);
        service.finish(links, snapshot.as_deref()).await
    }

    fn identity(&self, clock: MappedClock) -> ServiceIdentity {
        let interfaces = self.config.interface_names();
        let (config, vehicle) = (self.config_file.clone(), self.config.vehicle.clone());
        ServiceIdentity { started: clock.now(), config, vehicle, interfaces }
    }

    fn start_links(&self, clock: MappedClock, inbox: &mpsc::Sender<Record>) -> (JoinSet<()>, Vec<LinkOutput>) {
        let mut links = JoinSet::new();
        let mut outputs = Vec::new();
        for (bus, interface) in (0_u8..).map(BusIndex).zip(&self.config.interfaces) {
            let config = LinkConfig {
                bus,
                interface: interface.name.clone(),
                fd: interface.fd,
                ids: self.config.monitor.wanted_ids(bus),
                patterns: self.config.monitor.wanted_patterns(bus),
                all: self.config.monitor.wants_all(bus),
                receive_buffer_bytes: self.receive_buffer_bytes,
            };
            let (link, output) = Link::new(config, clock, inbox.clone());
            links.spawn(link.run());
            outputs.push(output);
        }
        (links, outputs)
    }
}

fn log_commands(config: &Config) {
    match (&config.monitor.commands, crate::config::command_words(config)) {
        (None, _) => {}
        (Some(commands), words) if commands.plan.authentication().is_some() => tracing::info!("{words}"),
        (Some(_), words) => tracing::warn!("{words}"),
    }
}

/// Notifies the service manager, if it expects notifications.
pub(super) fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::warn!(%error, "service manager not notified");
    }
}
