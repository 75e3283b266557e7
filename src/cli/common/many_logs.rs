//! Arguments of the commands that read many logs: the logs, reading options, progress.

use std::path::{Path, PathBuf};

use indicatif::ProgressBar;
use packwatch_host::failure::Failure;

use super::logs::{InputArgs, log_options};
use super::numbers::integer;
use super::output::check_distinct;
use super::progress::progress_bar;
use crate::config::Config;
use crate::io::log::LogSource;
use crate::lab::fleet::{OpenedLog, truth};

/// Logs and reading options.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Logs")]
pub(crate) struct LogArgs {
    /// Journals, candump logs or CSV files, also .gz or .zst; each is a separate life or trip
    #[arg(required = true, value_name = "LOG")]
    pub(crate) logs: Vec<PathBuf>,
    #[command(flatten)]
    input: InputArgs,
    /// Number of threads [default: one per core]
    #[arg(short, long, value_name = "N", value_parser = integer::<u16>(1, 1024))]
    jobs: Option<u16>,
}

impl LogArgs {
    pub(crate) fn check(&self) -> Result<(), Failure> {
        check_distinct(&self.logs)?;
        if self.input.start_times.is_some() && self.logs.len() > 1 {
            let found = self.logs.len();
            return Err(Failure::new(format!(
                "--start-times dates one log, but {found} are given; place NAME_cycles.csv next to each log instead"
            )));
        }
        if self.logs.len() > 1 && self.is_stdin() {
            return Err(Failure::new("-: standard input must be the only log"));
        }
        Ok(())
    }

    /// Opens logs as one continuous recording. The configuration determines how they are read.
    pub(crate) fn open(&self, config: &Config, logs: &[PathBuf]) -> OpenedLog {
        open(&self.input, config, logs)
    }

    /// Gap that counts as sleep of the recorder (s); `None` = the configuration decides.
    pub(crate) fn sleep_gap_s(&self) -> Option<f64> {
        self.input.sleep_gap
    }

    /// Whether the log is standard input, which can be read only once.
    pub(crate) fn is_stdin(&self) -> bool {
        self.logs.iter().any(|log| log == Path::new("-"))
    }

    /// Number of threads; `None` means one per core.
    pub(crate) fn threads(&self) -> Option<usize> {
        self.jobs.map(usize::from)
    }

    /// Creates a progress bar in bytes, for logs that are read `times` times.
    pub(crate) fn bar(&self, times: usize) -> ProgressBar {
        let size = |path: &PathBuf| std::fs::metadata(path).map_or(0, |meta| meta.len());
        let total = self.logs.iter().map(size).sum::<u64>() * times as u64;
        progress_bar(total, "{bar:32} {bytes}/{total_bytes} eta {eta}")
    }
}

/// Opens logs as one continuous recording. The configuration determines how they are read.
pub(crate) fn open(input: &InputArgs, config: &Config, logs: &[PathBuf]) -> OpenedLog {
    let mut options = log_options(input, config);
    // A table of cycles (start time of each cycle) next to a log applies only to this log, so it is not used with
    // several logs.
    let found = logs.first().filter(|_| options.csv.start_times.is_none() && logs.len() == 1);
    let found = found.and_then(|log| truth::cycles_next_to(log));
    let note = found.as_ref().map(|table| format!("dated by {}", table.display()));
    options.csv.start_times = options.csv.start_times.or(found);
    (LogSource::new(logs.to_owned(), options), note)
}
