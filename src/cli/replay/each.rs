//! `packwatch replay --each`: replays every log separately, several at a time; results are in the order of the logs.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::available_parallelism;
use std::time::Instant;

use indicatif::ProgressBar;

use super::args::Args;
use super::report;
use packwatch_host::failure::Failure;

use crate::cli::common::logs::print_tables;
use crate::cli::common::output::{check_distinct, create_folder, failure};
use crate::cli::common::progress::bar;
use crate::config::Config;
use crate::io::log::LogSource;
use crate::io::result_file::check_place;
use crate::monitor::Monitor;
use crate::replay::{self, ReplayError, ReplayProgress, ReplaySummary, Sinks, in_order};

pub(super) fn run(args: &Args, config: &Config) -> Result<(), Failure> {
    check(args)?;
    for folder in folders(args).into_iter().flatten() {
        create_folder(folder)?;
    }
    for log in &args.logs {
        results(args, log)
            .into_iter()
            .flatten()
            .try_for_each(|path| check_place(&path, args.logs.iter()).map_err(Failure::new))?;
    }
    let jobs = args.jobs.map_or_else(|| available_parallelism().map_or(1, usize::from), usize::from);
    let bar = EachBar::new(&args.logs);
    let (mut failed, mut written) = (Vec::new(), Ok(()));
    in_order(
        &args.logs,
        jobs,
        |log| replay_one(args, config, log, &bar),
        |log, result| {
            bar.finished();
            written = bar.bar.suspend(|| print(args, log, &result));
            let failure = result.map_or_else(Some, |summary| summary.failure.map(ReplayError::Unused));
            failed.extend(failure.map(|error| named(log, &error)));
            written.is_ok()
        },
    );
    bar.bar.finish_and_clear();
    match written {
        // If the reader has closed the output early, this is not an error.
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => {}
        written => written.map_err(failure)?,
    }
    if failed.is_empty() { Ok(()) } else { Err(Failure::new(failed.join("\n"))) }
}

fn check(args: &Args) -> Result<(), Failure> {
    if args.logs.iter().any(|log| log == Path::new("-")) {
        return Err(Failure::new("-: --each cannot read standard input; give files"));
    }
    if folders(args).into_iter().flatten().any(|folder| folder == Path::new("-")) {
        return Err(Failure::new("-: --each writes one file per log; give a folder, not -"));
    }
    check_distinct(&args.logs)?;
    let mut names: BTreeMap<String, &PathBuf> = BTreeMap::new();
    for log in &args.logs {
        let has_results = folders(args).into_iter().flatten().next().is_some();
        if let Some(other) = names.insert(name(log), log).filter(|_| has_results) {
            let (log, other) = (log.display(), other.display());
            return Err(Failure::new(format!(
                "{log}: its results would replace those of {other}, because the names are equal; rename one of them"
            )));
        }
    }
    Ok(())
}

fn folders(args: &Args) -> [Option<&Path>; 3] {
    [args.estimates.as_deref(), args.events.as_deref(), args.frames.as_deref()]
}

/// The result files of one log.
fn results(args: &Args, log: &Path) -> [Option<PathBuf>; 3] {
    let [estimates, events, frames] = folders(args);
    let file = |folder: Option<&Path>, ending: &str| folder.map(|folder| folder.join(name(log) + ending));
    [file(estimates, ".csv"), file(events, ".jsonl"), file(frames, ".log")]
}

/// Name of a log without folder and suffixes.
fn name(log: &Path) -> String {
    let packed = log.extension().is_some_and(|ending| ending == "gz" || ending == "zst");
    let stem = if packed { log.file_stem().map(Path::new).unwrap_or(log) } else { log };
    stem.file_stem().map(OsStr::to_string_lossy).unwrap_or_default().into_owned()
}

fn replay_one(args: &Args, config: &Config, log: &Path, bar: &EachBar) -> Result<ReplaySummary, ReplayError> {
    let create = |path: &Option<PathBuf>| super::create(path.as_deref());
    let [estimates, events, frames] = results(args, log);
    let sinks = Sinks {
        estimates: create(&estimates)?,
        events: super::events_file(events.as_deref(), config)?,
        frames: create(&frames)?,
        ..Sinks::default()
    };
    let mut source = LogSource::new([log.to_owned()], super::log_options(&args.input, config));
    let settings = super::plain_settings(args, config);
    let mut progress_of_log = LogProgress { bar, began: Instant::now(), bytes: 0, frames: 0, awake_s: 0.0 };
    let result = replay::run(&mut source, Monitor::new(config.monitor.clone()), sinks, settings, &mut |progress| {
        progress_of_log.show(progress)
    });
    let bytes = source.read_bytes().load(Ordering::Relaxed);
    progress_of_log.show(ReplayProgress { bytes, frames: source.counts().frames, times_real_time: 0.0 });
    result.map(|(summary, _)| summary)
}

/// Adds the log's name to an error that does not begin with it.
fn named(log: &Path, error: &ReplayError) -> String {
    let (name, text) = (log.display().to_string(), error.to_string());
    if text.starts_with(&name) { text } else { format!("{name}: {text}") }
}

fn print(args: &Args, log: &Path, result: &Result<ReplaySummary, ReplayError>) -> io::Result<()> {
    if let Ok(summary) = result {
        print_tables(&summary.log.tables);
    }
    let mut out = io::stdout().lock();
    match result {
        Ok(summary) if args.json => report::json_line(&mut out, log, summary),
        Err(error) if args.json => {
            let document = serde_json::json!({ "name": log.display().to_string(), "error": error.to_string() });
            writeln!(out, "{document}")
        }
        Ok(summary) => {
            writeln!(out, "{}", log.display())?;
            report::write_table(&mut out, summary)?;
            writeln!(out)
        }
        Err(error) => writeln!(out, "{}\nfailed: {error}\n", log.display()),
    }?;
    out.flush()
}

/// Progress of all logs on standard error, if that is a terminal.
struct EachBar {
    bar: ProgressBar,
    logs: usize,
    finished: AtomicU64,
    frames: AtomicU64,
    /// Recorded time already replayed, without sleep gaps, ms.
    awake_ms: AtomicU64,
}

impl EachBar {
    fn new(logs: &[PathBuf]) -> Self {
        let bar = bar(logs);
        Self {
            bar,
            logs: logs.len(),
            finished: AtomicU64::new(0),
            frames: AtomicU64::new(0),
            awake_ms: AtomicU64::new(0),
        }
    }

    fn finished(&self) {
        self.finished.fetch_add(1, Ordering::Relaxed);
    }

    fn show(&self) {
        if self.bar.is_hidden() {
            return;
        }
        let seconds = self.bar.elapsed().as_secs_f64().max(1e-3);
        let count = |of: &AtomicU64| of.load(Ordering::Relaxed) as f64;
        let (frames, awake_s) = (count(&self.frames), count(&self.awake_ms) * 1e-3);
        let done = self.finished.load(Ordering::Relaxed);
        let (logs, rate, times) = (self.logs, frames / seconds, awake_s / seconds);
        self.bar.set_message(format!("{done}/{logs} logs, {rate:.0} frames/s, {times:.0} x real time"));
    }
}

struct LogProgress<'a> {
    bar: &'a EachBar,
    began: Instant,
    bytes: u64,
    frames: u64,
    awake_s: f64,
}

impl LogProgress<'_> {
    /// Adds the progress since the last call.
    fn show(&mut self, now: ReplayProgress) {
        let awake_s = (now.times_real_time * self.began.elapsed().as_secs_f64()).max(self.awake_s);
        self.bar.frames.fetch_add(now.frames.saturating_sub(self.frames), Ordering::Relaxed);
        // The cast saturates only at times that are far longer than any log.
        self.bar.awake_ms.fetch_add(((awake_s - self.awake_s) * 1e3) as u64, Ordering::Relaxed);
        self.bar.bar.inc(now.bytes.saturating_sub(self.bytes));
        (self.bytes, self.frames, self.awake_s) = (now.bytes, now.frames, awake_s);
        self.bar.show();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_named_after_their_log() {
        for log in ["a/trip.1.log", "trip.1.log.gz", "trip.1.csv.zst", "trip.1.journal"] {
            assert_eq!(name(Path::new(log)), "trip.1", "{log}");
        }
        assert_eq!(name(Path::new("plain")), "plain");
    }
}
