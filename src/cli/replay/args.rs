//! Arguments of `replay`.

use std::path::{Path, PathBuf};

use crate::cli::common::logs::InputArgs;
use crate::cli::common::numbers::{away, integer, positive};
use crate::io::stamp;
use crate::monitor::Downtime;
use crate::replay::LogTime;
use packwatch_host::failure::Failure;

/// Arguments of `replay`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(short, long, value_name = "FILE")]
    pub(crate) config: PathBuf,
    /// Journals, candump logs or CSV files, also .gz or .zst, read in this order as one record; - reads standard input
    #[arg(required = true, value_name = "LOG")]
    pub(crate) logs: Vec<PathBuf>,
    #[command(flatten)]
    pub(crate) input: InputArgs,
    /// Replay every log separately, several at a time. Summaries appear in the order of the logs, as JSON one per line. If a log
    /// fails, report it and continue
    #[arg(long, conflicts_with_all = ["to", "speed", "snapshot", "snapshot_at", "restore", "away", "state"])]
    pub(crate) each: bool,
    /// Logs to replay at a time [default: one per core]
    #[arg(short, long, value_name = "N", requires = "each", value_parser = integer::<u16>(1, 1024))]
    pub(crate) jobs: Option<u16>,
    /// Replay this many times faster than real time [default: as fast as possible; with --to, 1]
    #[arg(long, value_name = "FACTOR", value_parser = positive)]
    pub(crate) speed: Option<f64>,
    /// Send the frames on this CAN interface instead of computing estimates and alarms from them
    #[arg(long, value_name = "IFACE", conflicts_with_all = ["estimates", "events", "frames", "snapshot", "restore", "state"])]
    pub(crate) to: Option<String>,
    /// Write every estimate as CSV. With --each, give a folder for a NAME.csv per log
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) estimates: Option<PathBuf>,
    /// Write every event as a JSON line. With --each, give a folder for a NAME.jsonl per log
    #[arg(long, value_name = "FILE.jsonl")]
    pub(crate) events: Option<PathBuf>,
    /// Write the frames that would be sent as candump lines. With --each, give a folder for a NAME.log per log
    #[arg(long, value_name = "FILE.log")]
    pub(crate) frames: Option<PathBuf>,
    /// Print the summary as JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Write what has been learned, and the state of the alarms, to this file, for --restore
    #[arg(long, value_name = "FILE")]
    pub(crate) snapshot: Option<PathBuf>,
    /// Time at which to write the state: time of the log in seconds, +SECONDS after its start, or a time such as
    /// 2008-04-02T13:08:17 (UTC) [default: end of the log]
    #[arg(long, value_name = "WHEN", requires = "snapshot", value_parser = when, allow_hyphen_values = true)]
    pub(crate) snapshot_at: Option<LogTime>,
    /// Keep state and history in this new folder as `packwatch run` does, with the clock of the log
    #[arg(long, value_name = "DIR")]
    pub(crate) state: Option<PathBuf>,
    /// Start from the state in this file, which --snapshot has written
    #[arg(long, value_name = "FILE")]
    pub(crate) restore: Option<PathBuf>,
    /// Time since the restored state was written [default: from the journal, else from the time stamp of the state]
    #[arg(long, value_name = "SECONDS|unknown", requires = "restore", value_parser = away)]
    pub(crate) away: Option<Downtime>,
    /// Skip everything before this time; formats as for --snapshot-at
    #[arg(long, value_name = "WHEN", value_parser = when, allow_hyphen_values = true)]
    pub(crate) from: Option<LogTime>,
    /// Skip everything after this time; formats as for --snapshot-at
    #[arg(long, value_name = "WHEN", value_parser = when, allow_hyphen_values = true)]
    pub(crate) until: Option<LogTime>,
}

impl Args {
    fn results(&self) -> impl Iterator<Item = &Path> {
        [&self.estimates, &self.events, &self.frames, &self.snapshot].into_iter().filter_map(|path| path.as_deref())
    }

    /// Whether a result goes to standard output. If so, the summary is printed on standard error.
    pub(crate) fn results_on_stdout(&self) -> bool {
        self.results().any(|path| path == Path::new("-"))
    }

    pub(crate) fn check(&self) -> Result<(), Failure> {
        if self.each {
            // With `--each`, results are folders, which `each` checks.
            return Ok(());
        }
        let on_stdout = self.results().filter(|&path| path == Path::new("-")).count() + usize::from(self.json);
        if on_stdout > 1 {
            return Err(Failure::new(
                "only one result can go to standard output (a result file given as -, or --json)",
            ));
        }
        let files: Vec<_> = self.results().filter(|&path| path != Path::new("-")).collect();
        for (index, file) in files.iter().enumerate() {
            if files[..index].contains(file) {
                return Err(Failure::new(format!(
                    "{}: given for two results; each needs its own file",
                    file.display()
                )));
            }
            if self.logs.iter().any(|log| log == file) {
                return Err(Failure::new(format!(
                    "{}: is an input log, so it cannot be a result; give another file",
                    file.display()
                )));
            }
        }
        Ok(())
    }
}

fn when(text: &str) -> Result<LogTime, String> {
    let after = text.strip_prefix('+').map(|s| stamp::parse_seconds(s.as_bytes()).map(|t| LogTime::After(t.nanos())));
    after
        .unwrap_or_else(|| stamp::parse_stamp(text).map(LogTime::At))
        .ok_or_else(|| "must be seconds, +seconds, or a time such as 2008-04-02T13:08:17.921".to_owned())
}
