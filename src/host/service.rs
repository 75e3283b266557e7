//! The live loop: interfaces in, the core stepped, frames out, a tick every [`TICK_PERIOD_MS`].
//!
//! One task owns the [`Monitor`]; every input is journalled before it is handed over, in that very order, so that
//! the journal replayed gives the same frames. Nothing a bus, a disk or a service manager does ends the loop;
//! SIGTERM and SIGINT do, cleanly.

mod engine;
mod j1939_carrier;
mod live;
pub mod readiness;
mod reload;
mod status_publisher;
mod stop;

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use engine::Engine;
use live::Loop;
use reload::Reload;
use sd_notify::NotifyState;
use status_publisher::StatusPublisher;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::Instant;

use super::control::{ControlServer, ControlSetting, MAX_CONNECTIONS};
use super::status::StatusServer;
use super::status::collect::Identity;
use super::status::document::ConfigFile;
use super::store::StateSetting;

use crate::config::Config;
use crate::io::clock::{MappedClock, Reading};
use crate::io::socket::{Link, LinkConfig, LinkMessage, LinkOutput};
use crate::io::unix_socket::SocketSetting;
use crate::monitor::{Downtime, Input, RestoreError, Snapshot};
use crate::quantity::BusIndex;

pub(super) use stop::Stop;

/// Things received and not yet handed to the core: half a second of a full 1 Mbit/s bus.
const INBOX: usize = 4096;

/// Threads for what would hold up the loop: reading a configuration, long answers. More would only wait for the disk.
const BLOCKING_THREADS: usize = 4;

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
    /// Age of that state.
    pub away: Downtime,
    /// Where the state goes when the daemon stops.
    pub snapshot: Option<PathBuf>,
    /// Stop after this long; `None` = when told to.
    pub duration: Option<Duration>,
    /// How long the first usable reading is waited for before the service calls itself ready.
    pub ready_timeout: Duration,
    /// Receive buffer asked for per interface, bytes.
    pub receive_buffer_bytes: usize,
    /// The control socket.
    pub control: ControlSetting,
    /// Where state and history are kept.
    pub state: StateSetting,
    /// The status sockets.
    pub status: SocketSetting,
    /// Where the configuration came from, for those who look.
    pub config_file: Option<ConfigFile>,
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
    /// The state folder is another daemon's.
    #[error("{0}")]
    Store(String),
    /// The control or status socket is another daemon's, or cannot be made.
    #[error("{0}")]
    Socket(String),
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
        let mut builder = tokio::runtime::Builder::new_current_thread();
        let runtime = builder.enable_all().max_blocking_threads(BLOCKING_THREADS).build()?;
        // A task like those of the interfaces: waking the one future that is no task goes through the kernel, for every frame.
        let served = runtime.block_on(async { tokio::spawn(self.serve()).await });
        served.unwrap_or_else(|stopped| std::panic::resume_unwind(stopped.into_panic()))
    }

    async fn serve(mut self) -> Result<(), ServiceError> {
        let stop = Stop::new(self.duration)?;
        let reload = Reload::new(&self.config)?;
        let clock = MappedClock::new(Reading::now());
        let (sender, inbox) = mpsc::channel(INBOX);
        let snapshot = self.snapshot.take();
        // Before any file is opened: a second daemon must not take those of the first.
        let (asked, requests) = mpsc::channel(MAX_CONNECTIONS);
        let control = ControlServer::start(&self.control, asked).await.map_err(ServiceError::Socket)?;
        let status = StatusServer::start(&self.status).map_err(ServiceError::Socket)?;
        let mut engine = Engine::new(&mut self, clock)?;
        let (links, outputs) = self.start_links(clock, &sender);
        drop(sender);
        // The first input is the time of the start; what it sends waits for the interfaces.
        engine.handle(&Input::Tick { time: clock.now() }, &outputs);
        engine.tell_works(clock.now(), &outputs);
        let status_publisher = StatusPublisher::new(status, self.identity(clock));
        let mut service = Loop {
            engine,
            inbox,
            requests,
            reload,
            clock,
            outputs,
            batch: Vec::new(),
            left_out_told: Instant::now(),
            status_publisher,
        };
        tracing::info!(interfaces = self.config.interfaces.len(), "started");
        if self.config.monitor.j1939.is_some() {
            j1939_carrier::tell();
        }
        service.run(stop).await;
        notify(&[NotifyState::Stopping]);
        drop(control);
        service.finish(links, snapshot.as_deref()).await
    }

    fn identity(&self, clock: MappedClock) -> Identity {
        let interfaces = self.config.interface_names();
        Identity { started: clock.now(), config: self.config_file.clone(), interfaces }
    }

    fn start_links(&self, clock: MappedClock, inbox: &mpsc::Sender<LinkMessage>) -> (JoinSet<()>, Vec<LinkOutput>) {
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

/// Tells the service manager; without one nothing happens.
fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::warn!(%error, "service manager not told");
    }
}
