//! Replays logs for the commands that describe a battery (`diagnose`, `passport`, `report`). Returns statistics, and
//! the state at the end.

use std::path::PathBuf;

use packwatch_host::failure::Failure;

use super::logs::{InputArgs, log_options, print_tables};
use super::output::failure;
use super::progress::Bar;
use crate::config::Config;
use crate::io::log::LogSource;
use crate::monitor::{Monitor, Snapshot};
use crate::replay::{self, ReplaySettings, ReplaySummary, Sinks};

/// Result of a replay.
pub(crate) struct Replayed {
    pub(crate) source: LogSource,
    pub(crate) summary: ReplaySummary,
    /// The last state; `None` if the logs have no readings.
    pub(crate) snapshot: Option<Snapshot>,
}

/// Replays logs as one continuous recording, at full speed and with a progress bar.
pub(crate) fn replay(logs: &[PathBuf], input: &InputArgs, config: &Config, sinks: Sinks) -> Result<Replayed, Failure> {
    let mut source = LogSource::new(logs.to_owned(), log_options(input, config));
    let plain = ReplaySettings::plain(input.sleep_gap_s(&config.monitor), config.interface_names());
    let settings = ReplaySettings { snapshot: true, ..plain };
    let bar = Bar::new(logs);
    let monitor = Monitor::new(config.monitor.clone());
    let result = replay::run(&mut source, monitor, sinks, settings, &mut |progress| bar.show(progress));
    bar.clear();
    print_tables(&source.counts().tables);
    let (summary, snapshot) = result.map_err(failure)?;
    if let Some(reason) = &summary.failure {
        return Err(Failure::new(reason));
    }
    Ok(Replayed { source, summary, snapshot })
}
