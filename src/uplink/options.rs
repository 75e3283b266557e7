//! Defines the options of the commands that run until stopped.

use std::path::PathBuf;

use packwatch_host::logging;

use crate::Failure;
use crate::settings::Settings;

/// Options of `mqtt`, `kuksa` and `sovd`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Settings file of the uplink
    #[arg(short, long, value_name = "FILE", default_value = "/etc/packwatch/uplink.toml")]
    pub(crate) config: PathBuf,
    /// Log level or filter: error, warn, info, debug, trace [default: $PACKWATCH_LOG, else info]
    #[arg(long, value_name = "LEVEL")]
    log: Option<String>,
}

impl Options {
    /// Starts logging and reads the settings.
    ///
    /// # Errors
    /// Fails if the log filter or the settings are invalid.
    pub(crate) fn start(&self) -> Result<Settings, Failure> {
        logging::start(self.log.as_deref()).map_err(Failure::new)?;
        Settings::read(&self.config).map_err(Failure::config)
    }
}
