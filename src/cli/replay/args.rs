//! Arguments of `replay`.

use std::path::{Path, PathBuf};

use crate::cli::common::logs::InputArgs;
use crate::cli::common::numbers::{away, positive};
use crate::io::stamp;
use crate::monitor::Downtime;
use crate::replay::LogTime;
use packwatch_host::failure::Failure;

/// Arguments of `replay`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration
    #[arg(short, long, value_name = "FILE")]
    pub(crate) config: PathBuf,
    /// Journals, candump logs or CSV files, also .gz or .zst, read one after another as one record; - is standard input
    #[arg(required = true, value_name = "LOG")]
    pub(crate) logs: Vec<PathBuf>,
    #[command(flatten)]
    pub(crate) input: InputArgs,
    /// Replay every log by itself and from the start, several at a time; summaries come in the logs' order, as JSON one per line. A
    /// log that fails is reported, and the others continue
    #[arg(long, conflicts_with_all = ["to", "speed", "snapshot", "snapshot_at", "restore", "away", "state"])]
    pub(crate) each: bool,
    /// Logs at a time (default: one per core)
    #[arg(short, long, value_name = "N", requires = "each", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(crate) jobs: Option<u16>,
    /// Times real time (1 = real time); as fast as possible when not given, real time with --to
    #[arg(long, value_name = "X", value_parser = positive)]
    pub(crate) speed: Option<f64>,
    /// Play the frames onto this CAN interface instead of through the core
    #[arg(long, value_name = "IFACE", conflicts_with_all = ["estimates", "events", "frames", "snapshot", "restore", "state"])]
    pub(crate) to: Option<String>,
    /// Write every estimate, as CSV; with --each a folder, which gets a NAME.csv per log
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) estimates: Option<PathBuf>,
    /// Write every event, one JSON document per line; with --each a folder, which gets a NAME.jsonl per log
    #[arg(long, value_name = "FILE.jsonl")]
    pub(crate) events: Option<PathBuf>,
    /// Write the frames that would be sent, as candump lines; with --each a folder, which gets a NAME.log per log
    #[arg(long, value_name = "FILE.log")]
    pub(crate) frames: Option<PathBuf>,
    /// Print the summary as JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Write the core's state, to start from with --restore
    #[arg(long, value_name = "FILE")]
    pub(crate) snapshot: Option<PathBuf>,
    /// When the state is written: a stamp of the log in seconds, +SECONDS after its start, or like
    /// 2008-04-02T13:08:17 (UTC); the end when not given
    #[arg(long, value_name = "WHEN", requires = "snapshot", value_parser = when, allow_hyphen_values = true)]
    pub(crate) snapshot_at: Option<LogTime>,
    /// Keep state and history in this new folder, as `packwatch run` does, with the log's clock as wall clock
    #[arg(long, value_name = "DIR")]
    pub(crate) state: Option<PathBuf>,
    /// Start from a written state
    #[arg(long, value_name = "FILE")]
    pub(crate) restore: Option<PathBuf>,
    /// Age of that state, or unknown (default: as the journal says, else as its stamp does)
    #[arg(long, value_name = "SECONDS|unknown", requires = "restore", value_parser = away)]
    pub(crate) away: Option<Downtime>,
    /// Leave out what is before; as --snapshot-at
    #[arg(long, value_name = "WHEN", value_parser = when, allow_hyphen_values = true)]
    pub(crate) from: Option<LogTime>,
    /// Leave out what is after; as --snapshot-at
    #[arg(long, value_name = "WHEN", value_parser = when, allow_hyphen_values = true)]
    pub(crate) until: Option<LogTime>,
}

impl Args {
    fn results(&self) -> impl Iterator<Item = &Path> {
        [&self.estimates, &self.events, &self.frames, &self.snapshot].into_iter().filter_map(|path| path.as_deref())
    }

    /// Whether a result file goes to standard output, so that the summary must not.
    pub(crate) fn results_on_stdout(&self) -> bool {
        self.results().any(|path| path == Path::new("-"))
    }

    /// Checks that concern several arguments.
    pub(crate) fn check(&self) -> Result<(), Failure> {
        if self.each {
            // Results are folders, which have rules of their own.
            return Ok(());
        }
        let on_stdout = self.results().filter(|&path| path == Path::new("-")).count() + usize::from(self.json);
        if on_stdout > 1 {
            return Err(Failure::new("only one of the results and --json can go to standard output"));
        }
        let files: Vec<_> = self.results().filter(|&path| path != Path::new("-")).collect();
        for (index, file) in files.iter().enumerate() {
            if files[..index].contains(file) {
                return Err(Failure::new(format!("{}: named for two results", file.display())));
            }
            if self.logs.iter().any(|log| log == file) {
                return Err(Failure::new(format!("{}: is a log to read, cannot be a result", file.display())));
            }
        }
        Ok(())
    }
}

fn when(text: &str) -> Result<LogTime, String> {
    let after = text.strip_prefix('+').map(|s| stamp::parse_seconds(s.as_bytes()).map(|t| LogTime::After(t.nanos())));
    after
        .unwrap_or_else(|| stamp::parse_stamp(text).map(LogTime::At))
        .ok_or_else(|| "must be seconds, +seconds or like 2008-04-02T13:08:17.921".to_owned())
}
