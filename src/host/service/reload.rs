//! SIGHUP: the configuration is read again, beside the loop; a bad one is refused and the old one stays.
//!
//! One file is read at a time, and signals that come meanwhile make one more reading when it is done, at least
//! [`MIN_PERIOD`] after the last one began: a storm of signals neither fills the log nor holds up the loop, and the file
//! as it was at the last signal is what holds in the end. What the sockets and files are made of needs a restart and is
//! refused with that word; what the core takes over is [`Monitor::reconfigure`](crate::monitor::Monitor::reconfigure)'s to say.

use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use sd_notify::NotifyState;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};

use super::live::Loop;
use super::{Engine, notify};
use crate::config::{self, Config, InterfaceConfig, StoreConfig};
use crate::monitor::{MonitorConfig, Reconfigured};
use crate::status::document::ConfigFile;

/// Readings of the file begin at least this far apart.
const MIN_PERIOD: Duration = Duration::from_secs(1);
/// Faults told one by one: a file that is something else altogether has thousands.
const MAX_FAULTS_LOGGED: usize = 50;

/// What happened.
#[derive(Debug)]
pub(super) enum Step {
    /// A reload was asked for; what follows is [`Step::Read`], sooner or later.
    Asked,
    /// The file was read: what the core is to take over, or every fault.
    Read(Result<Box<Configuration>, Vec<String>>),
}

/// What was read.
#[derive(Debug)]
pub(super) struct Configuration {
    monitor: MonitorConfig,
    /// For those who look.
    file: Option<ConfigFile>,
}

/// The task that reads.
type Reading = JoinHandle<Result<Box<Configuration>, Vec<String>>>;

/// See the module.
#[derive(Debug)]
pub(super) struct Reload {
    hangup: Signal,
    path: PathBuf,
    fixed: Arc<Fixed>,
    reading: Option<Reading>,
    /// A signal came that no reading has answered yet.
    is_asked: bool,
    /// Before this nothing is read.
    not_before: Instant,
}

impl Reload {
    /// From here on SIGHUP does not end the program. Must be called inside the runtime.
    ///
    /// # Errors
    /// When the signal cannot be caught.
    pub(super) fn new(running: &Config) -> io::Result<Self> {
        Ok(Self {
            hangup: signal(SignalKind::hangup())?,
            path: running.path.clone(),
            fixed: Arc::new(Fixed::of(running)),
            reading: None,
            is_asked: false,
            not_before: Instant::now(),
        })
    }

    /// Waits for the next step; nothing is lost when it is dropped and asked for again.
    pub(super) async fn next(&mut self) -> Step {
        loop {
            tokio::select! {
                read = finished(&mut self.reading) => {
                    self.reading = None;
                    return Step::Read(read);
                }
                Some(()) = self.hangup.recv() => {
                    if !std::mem::replace(&mut self.is_asked, true) && self.reading.is_none() {
                        return Step::Asked;
                    }
                }
                () = sleep_until(self.not_before), if self.is_asked && self.reading.is_none() => self.read(),
            }
        }
    }

    /// Whether a reload is under way or waits.
    pub(super) fn is_busy(&self) -> bool {
        self.is_asked || self.reading.is_some()
    }

    fn read(&mut self) {
        self.is_asked = false;
        self.not_before = Instant::now() + MIN_PERIOD;
        let (path, fixed) = (self.path.clone(), Arc::clone(&self.fixed));
        // A large DBC takes longer than a tick.
        self.reading = Some(tokio::task::spawn_blocking(move || {
            let new = config::load(&path).map_err(|faults| faults.0)?;
            fixed.check(&new).map_err(|why| vec![why])?;
            Ok(Box::new(Configuration { monitor: new.monitor, file: ConfigFile::of(&path) }))
        }));
    }
}

async fn finished(reading: &mut Option<Reading>) -> Result<Box<Configuration>, Vec<String>> {
    match reading {
        None => std::future::pending().await,
        Some(reading) => reading.await.unwrap_or_else(|error| Err(vec![format!("cannot be read: {error}")])),
    }
}

/// What cannot change while the service runs and the core does not know: the interfaces' names and kinds, the store.
#[derive(Debug)]
struct Fixed {
    interfaces: Vec<InterfaceConfig>,
    store: StoreConfig,
}

impl Fixed {
    fn of(config: &Config) -> Self {
        Self { interfaces: config.interfaces.clone(), store: config.store }
    }

    /// Why `new` cannot be taken over, if it cannot.
    fn check(&self, new: &Config) -> Result<(), String> {
        let new = Self::of(new);
        if self.interfaces != new.interfaces {
            return Err(format!("interfaces = {new}, running with {self}: needs a restart"));
        }
        if self.store != new.store {
            return Err("[store]: other settings than it was started with: needs a restart".to_owned());
        }
        Ok(())
    }
}

impl fmt::Display for Fixed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, interface) in self.interfaces.iter().enumerate() {
            let (comma, fd) = (if index > 0 { ", " } else { "" }, if interface.fd { " (FD)" } else { "" });
            write!(f, "{comma}{}{fd}", interface.name)?;
        }
        Ok(())
    }
}

impl Loop {
    /// Does what a step of a reload asks for, and tells the service manager.
    pub(super) async fn handle_reload(&mut self, step: Step) {
        let read = match step {
            Step::Asked => return self.tell_reloading(),
            Step::Read(read) => read,
        };
        // What came before it is judged by the old configuration.
        self.drain().await;
        let time = self.clock.now();
        let mut file = None;
        let taken = read.and_then(|config| {
            file = config.file;
            self.engine.reconfigure(config.monitor, time, &self.outputs)
        });
        log_outcome(&taken);
        self.status_publisher.note_reload(if taken.is_ok() { Ok(file) } else { Err(()) });
        let Engine { readiness, monitor, .. } = &mut self.engine;
        readiness.note_reload(taken.err().map(|faults| faults.join("; ")));
        let told = readiness.tell_now(monitor, Instant::now());
        // With a further reload waiting, that one's end is the end.
        let ready = (readiness.is_ready() && !self.reload.is_busy()).then_some(NotifyState::Ready);
        let status = told.as_deref().map(NotifyState::Status);
        notify(&ready.into_iter().chain(status).collect::<Vec<_>>());
    }

    fn tell_reloading(&self) {
        // Before the service is ready the manager must not take the end of a reload for it.
        if !self.engine.readiness.is_ready() {
            return;
        }
        let mut states = vec![NotifyState::Reloading];
        // Version 253 and later want to know when; the clock cannot fail.
        states.extend(NotifyState::monotonic_usec_now());
        notify(&states);
    }
}

/// Every fault by itself, up to a limit.
fn log_outcome(taken: &Result<Reconfigured, Vec<String>>) {
    match taken {
        Ok(Reconfigured { changed, alarms_ended }) => {
            tracing::info!(changed = changed.join(", "), alarms_ended, "configuration taken over");
        }
        Err(faults) => {
            for fault in faults.iter().take(MAX_FAULTS_LOGGED) {
                tracing::error!(fault, "configuration refused, the old one stays");
            }
            let more = faults.len().saturating_sub(MAX_FAULTS_LOGGED);
            if more > 0 {
                tracing::error!(more, "configuration refused: further faults");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn example() -> Config {
        config::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/paper.toml"))
            .expect("the example is good")
    }

    #[test]
    fn another_threshold_is_taken_over() {
        let (old, mut new) = (example(), example());
        new.monitor.rules[0].threshold *= 0.5;
        assert_eq!(Fixed::of(&old).check(&new), Ok(()));
    }

    #[test]
    fn another_checkpoint_period_needs_a_restart() {
        let (old, mut new) = (example(), example());
        new.store.checkpoint_s *= 2.0;
        assert!(
            Fixed::of(&old).check(&new).is_err_and(|why| why.contains("[store]") && why.contains("needs a restart"))
        );
    }

    #[test]
    fn another_interface_needs_a_restart_and_is_named() {
        let (old, mut new) = (example(), example());
        new.interfaces[0].name = "can7".to_owned();
        let why = Fixed::of(&old).check(&new).expect_err("another interface");
        assert_eq!(why, format!("interfaces = can7, running with {}: needs a restart", old.interfaces[0].name));
    }
}
