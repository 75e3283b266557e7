//! Reloads the configuration on SIGHUP, outside the service loop. If the new configuration is rejected, the old
//! configuration stays in use.
//!
//! Only one read of the files runs at a time. Signals that arrive during a read cause one further read, which starts at
//! least [`MIN_PERIOD`] after the start of the last one. Many signals in a short time therefore neither fill the log
//! nor block the loop. The last read starts after the last signal, so the newest file always applies in the end.
//!
//! A new configuration with other interfaces or another store is rejected, because these changes require a restart. The
//! core decides whether all other changes can be applied
//! ([`Monitor::reconfigure`](crate::monitor::Monitor::reconfigure)).

use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};

use crate::config::{self, Config, InterfaceConfig, KeySource, StoreConfig, VehicleIdentity};
use crate::monitor::{MonitorConfig, Reconfigured};
use crate::status::document::ConfigFile;

const MIN_PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of faults that are logged one by one. A file that is not a configuration may have thousands of
/// faults.
const MAX_FAULTS_LOGGED: usize = 50;

#[derive(Debug)]
pub(super) enum ReloadStep {
    /// A signal arrived; [`ReloadStep::Read`] follows.
    Requested,
    /// The file was read. Contains the new configuration, or every fault.
    Read(Result<Box<LoadedConfig>, Vec<String>>),
}

#[derive(Debug)]
pub(super) struct LoadedConfig {
    pub(super) monitor: MonitorConfig,
    pub(super) file: Option<ConfigFile>,
}

type LoadTask = JoinHandle<Result<Box<LoadedConfig>, Vec<String>>>;

/// Catches SIGHUP and reads the configuration.
#[derive(Debug)]
pub(super) struct Reload {
    hangup: Signal,
    path: PathBuf,
    fixed: Arc<FixedSettings>,
    reading: Option<LoadTask>,
    /// Whether a signal has arrived after the start of the last read.
    is_requested: bool,
    not_before: Instant,
}

impl Reload {
    /// Starts catching SIGHUP, so that the signal does not end the program. Must be called inside the runtime.
    ///
    /// # Errors
    /// Fails if the signal cannot be caught.
    pub(super) fn new(running: &Config) -> io::Result<Self> {
        Ok(Self {
            hangup: signal(SignalKind::hangup())?,
            path: running.path.clone(),
            fixed: Arc::new(FixedSettings::of(running)),
            reading: None,
            is_requested: false,
            not_before: Instant::now(),
        })
    }

    /// Waits for the next step. The wait may be cancelled.
    pub(super) async fn next(&mut self) -> ReloadStep {
        loop {
            tokio::select! {
                read = finished(&mut self.reading) => {
                    self.reading = None;
                    return ReloadStep::Read(read);
                }
                Some(()) = self.hangup.recv() => {
                    if !std::mem::replace(&mut self.is_requested, true) && self.reading.is_none() {
                        return ReloadStep::Requested;
                    }
                }
                () = sleep_until(self.not_before), if self.is_requested && self.reading.is_none() => self.read(),
            }
        }
    }

    pub(super) fn is_busy(&self) -> bool {
        self.is_requested || self.reading.is_some()
    }

    fn read(&mut self) {
        self.is_requested = false;
        self.not_before = Instant::now() + MIN_PERIOD;
        let (path, fixed) = (self.path.clone(), Arc::clone(&self.fixed));
        // Reading a large DBC takes longer than one tick (10 ms) of the service loop.
        self.reading = Some(tokio::task::spawn_blocking(move || {
            let new = config::load(&path).map_err(|faults| faults.0)?;
            fixed.check(&new).map_err(|why| vec![why])?;
            Ok(Box::new(LoadedConfig { monitor: new.monitor, file: ConfigFile::of(&path) }))
        }));
    }
}

async fn finished(reading: &mut Option<LoadTask>) -> Result<Box<LoadedConfig>, Vec<String>> {
    match reading {
        None => std::future::pending().await,
        Some(reading) => reading.await.unwrap_or_else(|error| Err(vec![format!("cannot be read: {error}")])),
    }
}

/// Settings outside the core that cannot change while the service runs, such as the interfaces and the store.
#[derive(Debug)]
struct FixedSettings {
    interfaces: Vec<InterfaceConfig>,
    store: StoreConfig,
    vehicle: VehicleIdentity,
    key: Option<KeySource>,
}

impl FixedSettings {
    fn of(config: &Config) -> Self {
        Self {
            interfaces: config.interfaces.clone(),
            store: config.store,
            vehicle: config.vehicle.clone(),
            key: config.key.clone(),
        }
    }

    /// Checks whether `new` can be applied.
    ///
    /// # Errors
    /// Returns a text that names the setting that needs a restart.
    fn check(&self, new: &Config) -> Result<(), String> {
        let new = Self::of(new);
        if self.interfaces != new.interfaces {
            return Err(format!("interfaces = {new}, running with {self}: needs a restart"));
        }
        if self.vehicle != new.vehicle {
            let (found, running) = (new.vehicle.to_string(), self.vehicle.to_string());
            return Err(format!("[vehicle] = {found:?}, running with {running:?}: needs a restart"));
        }
        if self.store != new.store {
            return Err("[store]: the settings have changed: needs a restart".to_owned());
        }
        if self.key != new.key {
            return Err("[authentication]: the key's location has changed: needs a restart".to_owned());
        }
        Ok(())
    }
}

impl fmt::Display for FixedSettings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, interface) in self.interfaces.iter().enumerate() {
            let (comma, fd) = (if index > 0 { ", " } else { "" }, if interface.fd { " (FD)" } else { "" });
            write!(f, "{comma}{}{fd}", interface.name)?;
        }
        Ok(())
    }
}

/// Logs the result of a reload, each fault separately up to a limit.
pub(super) fn log_outcome(taken: &Result<Reconfigured, Vec<String>>) {
    match taken {
        Ok(Reconfigured { changed, alarms_ended }) => {
            tracing::info!(changed = changed.join(", "), alarms_ended, "configuration applied");
        }
        Err(faults) => {
            for fault in faults.iter().take(MAX_FAULTS_LOGGED) {
                tracing::error!(fault, "configuration rejected, the old one stays");
            }
            let more = faults.len().saturating_sub(MAX_FAULTS_LOGGED);
            if more > 0 {
                tracing::error!(more, "configuration rejected: further faults");
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
    fn changed_threshold_is_applied() {
        let (old, mut new) = (example(), example());
        new.monitor.rules[0].threshold *= 0.5;
        assert_eq!(FixedSettings::of(&old).check(&new), Ok(()));
    }

    #[test]
    fn changed_checkpoint_period_needs_restart() {
        let (old, mut new) = (example(), example());
        new.store.checkpoint_s *= 2.0;
        assert!(
            FixedSettings::of(&old)
                .check(&new)
                .is_err_and(|why| why.contains("[store]") && why.contains("needs a restart"))
        );
    }

    #[test]
    fn changed_vehicle_needs_restart() {
        let (old, mut new) = (example(), example());
        new.vehicle.id = Some("WDB1".to_owned());
        let why = FixedSettings::of(&old).check(&new).expect_err("another vehicle");
        assert_eq!(why, "[vehicle] = \"WDB1\", running with \"\": needs a restart");
    }

    #[test]
    fn changed_interface_needs_restart() {
        let (old, mut new) = (example(), example());
        new.interfaces[0].name = "can7".to_owned();
        let why = FixedSettings::of(&old).check(&new).expect_err("another interface");
        assert_eq!(why, format!("interfaces = can7, running with {}: needs a restart", old.interfaces[0].name));
    }
}
