//! `packwatch replay`: replays logs through the same core that handles live data, or sends their frames on an
//! interface.

mod args;
mod each;
mod report;

use std::io;
use std::path::Path;

use super::common::logs::{log_options, print_tables};
use super::common::output::{failure, print_json};
use super::common::progress::Bar;
use crate::config::{self, Config};
use crate::io::event_log;
use crate::io::log::LogSource;
use crate::io::result_file::ResultFile;
use crate::io::snapshot_file;
use crate::io::socket::CanSender;
use crate::monitor::Monitor;
use crate::replay::{self, ReplayError, ReplaySettings, ReplaySummary, Sinks};
use crate::store::Recorder;
use packwatch_host::failure::Failure;

pub(crate) use args::Args;

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    args.check()?;
    let config = config::load(&args.config)?;
    if args.each {
        return each::run(args, &config);
    }
    let mut source = LogSource::new(args.logs.clone(), log_options(&args.input, &config));
    let settings = settings(args, &config)?;
    let result = match &args.to {
        Some(interface) => play(args, &mut source, &settings, interface),
        None => replay_all(args, &mut source, config, settings),
    };
    match result {
        // It is not an error if the reader of the output has closed it early.
        Err(ReplayError::Write(error)) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => result.map_err(failure),
    }
}

fn replay_all(
    args: &Args,
    source: &mut LogSource,
    config: Config,
    settings: ReplaySettings,
) -> Result<(), ReplayError> {
    let sinks = Sinks {
        estimates: create(args.estimates.as_deref())?,
        events: events_file(args.events.as_deref(), &config)?,
        frames: create(args.frames.as_deref())?,
        ..Sinks::default()
    };
    let bar = Bar::new(&args.logs);
    let monitor = Monitor::new(config.monitor);
    let result = replay::run(source, monitor, sinks, settings, &mut |progress| bar.show(progress));
    bar.clear();
    print_tables(&source.counts().tables);
    let (summary, snapshot) = result?;
    if let (Some(path), Some(snapshot)) = (&args.snapshot, snapshot) {
        snapshot_file::write(path, &snapshot)?;
    }
    print_summary(args, &summary)?;
    summary.failure.map_or(Ok(()), |failure| Err(ReplayError::Unused(failure)))
}

fn play(args: &Args, source: &mut LogSource, settings: &ReplaySettings, interface: &str) -> Result<(), ReplayError> {
    let sender = CanSender::open(interface, true)?;
    let bar = Bar::new(&args.logs);
    let result = replay::play(source, settings, &mut |_, frame| sender.send(frame), &mut |p| bar.show(p));
    bar.clear();
    print_tables(&source.counts().tables);
    let sent = result?;
    report::played(sent, interface, source.counts(), args.json)?;
    Ok(())
}

fn settings(args: &Args, config: &Config) -> Result<ReplaySettings, Failure> {
    // Without `--speed`, frames sent on an interface keep their timing, and a replay through the core runs as fast as
    // possible.
    let speed = args.speed.or(args.to.is_some().then_some(1.0));
    Ok(ReplaySettings {
        speed: speed.filter(|speed| speed.is_finite()),
        snapshot: args.snapshot.is_some(),
        snapshot_at: args.snapshot_at,
        restore: args.restore.as_deref().map(snapshot_file::read).transpose().map_err(Failure::new)?,
        away: args.away,
        store: args
            .state
            .as_deref()
            .map(|path| Recorder::create(path, &config.store, &config.vehicle))
            .transpose()
            .map_err(Failure::new)?,
        ..plain_settings(args, config)
    })
}

/// Settings for a replay of the selected part of the log at full speed, without storing anything.
fn plain_settings(args: &Args, config: &Config) -> ReplaySettings {
    let plain = ReplaySettings::plain(args.input.sleep_gap_s(&config.monitor), config.interface_names());
    ReplaySettings { from: args.from, until: args.until, ..plain }
}

fn create(path: Option<&Path>) -> io::Result<Option<ResultFile>> {
    path.map(ResultFile::create).transpose()
}

/// Creates an event file. Like the event file of `run`, it begins with the vehicle's identity.
fn events_file(path: Option<&Path>, config: &Config) -> io::Result<Option<ResultFile>> {
    let mut file = create(path)?;
    if let Some(file) = &mut file {
        event_log::write_head(file, &config.vehicle)?;
    }
    Ok(file)
}

fn print_summary(args: &Args, summary: &ReplaySummary) -> io::Result<()> {
    if args.json { print_json(summary) } else { report::table(summary, args.results_on_stdout()) }
}
