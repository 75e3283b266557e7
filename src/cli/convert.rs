//! `packwatch convert`: writes the frames of logs in any known format as a candump log, MF4 or MCAP.

mod candump;
mod estimates;
mod mcap;
mod output;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use packwatch_host::failure::Failure;

use self::output::{Format, Output};
use super::common::logs::{InputArgs, log_options};
use super::common::numbers::{NamedValue, one_of};
use super::common::output::{failure, named, note, unless_closed};
use super::common::progress::Bar;
use crate::config::{self, Config};
use crate::io::csv_log::CsvOptions;
use crate::io::log::{LogOptions, LogSource};
use crate::io::result_file::check_place;
use crate::monitor::{BusEvent, RecordKind};
use crate::quantity::Timestamp;
use crate::replay::ReplayProgress;

const REPORT_EVERY: u64 = 4096;

const FORMATS: [NamedValue<Format>; 3] = [
    ("candump", Format::Candump, "text as `candump -L` writes it: .log, also .gz and .zst"),
    ("mf4", Format::Mf4, "ASAM MDF 4 with bus logging: .mf4"),
    ("mcap", Format::Mcap, "MCAP with JSON messages, for Foxglove and PlotJuggler: .mcap"),
];

/// Arguments of `convert`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The last file is the output; its name states the format. Frames keep their times. Channels of other tools become interfaces as for `replay`. \
MCAP has a topic per interface (/can/can0); with --config, it also has a topic with the estimates of each cell (/cells/0). With --config, \
CSV logs are converted too. If no frame is found, nothing is written and the exit code is 1.")]
pub(crate) struct Args {
    /// Logs in any known format, read in this order; - reads standard input
    #[arg(required = true, value_name = "IN")]
    logs: Vec<PathBuf>,
    /// File to write; - writes to standard output (not MF4)
    #[arg(required = true, value_name = "OUT")]
    out: PathBuf,
    /// Format, instead of the one that the name of OUT states
    #[arg(long, value_name = "FORMAT", value_parser = one_of(&FORMATS))]
    to: Option<Format>,
    /// Replace OUT if it exists
    #[arg(long)]
    force: bool,
    /// Configuration file: names the interfaces, reads CSV logs, and adds the estimates to MCAP
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    input: InputArgs,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    check_place(&args.out, args.logs.iter()).map_err(Failure::new)?;
    if !args.force && args.out.is_file() {
        return Err(named(&args.out, "exists; --force replaces it"));
    }
    let format = args.to.or_else(|| Format::of_name(&args.out)).ok_or_else(|| {
        named(
            &args.out,
            "the name does not state a format: must end in .log, .log.gz, .log.zst, .mf4 or .mcap, or give --to",
        )
    })?;
    if format == Format::Mf4 && args.out == Path::new("-") {
        return Err(Failure::new("-: MF4 cannot be written to standard output, give a file"));
    }
    let config = args.config.as_deref().map(config::load).transpose()?;
    let has_estimates = format == Format::Mcap && config.is_some();
    if has_estimates && args.logs.iter().any(|log| log == Path::new("-")) {
        return Err(Failure::new("-: standard input is read once, but MCAP with --config reads the logs twice"));
    }
    let mut output = Output::create(&args.out, format).map_err(failure)?;
    let summary = write_frames(args, config.as_ref(), &mut output)?;
    if let (true, Some(config)) = (has_estimates, config) {
        output = estimates::write(args, config, output)?;
    }
    unless_closed(output.finish())?;
    note(summary.text(&args.out));
    Ok(())
}

#[derive(Default)]
struct Summary {
    frames: u64,
    error_frames: u64,
    interfaces: String,
    times: Option<(Timestamp, Timestamp)>,
}

impl Summary {
    fn note(&mut self, time: Timestamp) {
        let (first, last) = self.times.unwrap_or((time, time));
        self.times = Some((first.min(time), last.max(time)));
    }

    fn seconds(&self) -> f64 {
        self.times.map_or(0.0, |(first, last)| last.since(first))
    }

    fn text(&self, out: &Path) -> String {
        let Self { frames, error_frames, interfaces, .. } = self;
        let errors = if *error_frames > 0 { format!(", {error_frames} error frames") } else { String::new() };
        format!("{} written: {frames} frames{errors} of {interfaces} in {:.1} s", out.display(), self.seconds())
    }
}

fn write_frames(args: &Args, config: Option<&Config>, output: &mut Output) -> Result<Summary, Failure> {
    let mut source = LogSource::new(args.logs.clone(), options(args, config));
    source.adopt_foreign();
    let (bar, mut summary, mut records) = (Bar::new(&args.logs), Summary::default(), 0_u64);
    while let Some(record) = source.next_record().map_err(failure)? {
        let written = match &record.kind {
            RecordKind::Frame { bus, frame } | RecordKind::SecuredFrame { bus, frame, .. } => {
                summary.frames += 1;
                output.write_frame(record.time, *bus, source.interfaces(), frame)
            }
            RecordKind::Bus { bus, event: BusEvent::ErrorFrame { class } } => {
                summary.error_frames += 1;
                output.write_error_frame(record.time, *bus, source.interfaces(), *class)
            }
            _ => continue,
        };
        summary.note(record.time);
        if written.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::BrokenPipe) {
            break;
        }
        written.map_err(failure)?;
        records += 1;
        if records.is_multiple_of(REPORT_EVERY) {
            let bytes = source.read_bytes().load(Ordering::Relaxed);
            let times_real_time = summary.seconds() / bar.seconds();
            bar.show(ReplayProgress { bytes, frames: summary.frames, times_real_time });
        }
    }
    bar.clear();
    let counts = source.counts();
    counts.inputs.iter().for_each(note);
    if let Some(first) = &counts.first_bad_line {
        note(format_args!("{} of {} lines cannot be read, first {first}", counts.bad_lines, counts.lines));
    }
    if source.has_moved_stamps() {
        note("a log begins before the end of the log before it, so its stamps were moved to follow that log");
    }
    summary.interfaces = source.interfaces().join(", ");
    let good = summary.frames + summary.error_frames;
    if good > counts.bad_lines {
        return Ok(summary);
    }
    if good > 0 {
        let bad = counts.bad_lines;
        return Err(named(
            &args.out,
            format!("not written, because {bad} lines are bad and only {good} frames are good"),
        ));
    }
    let first = counts.first_ignored_line.as_ref().map_or_else(String::new, |line| format!(", first line {line}"));
    let names: Vec<_> = args.logs.iter().map(|log| log.display().to_string()).collect();
    Err(Failure::new(format!("{}: no CAN frame, nothing is written{first}", names.join(", "))))
}

fn options(args: &Args, config: Option<&Config>) -> LogOptions {
    match config {
        Some(config) => log_options(&args.input, config),
        None => LogOptions {
            interfaces: Vec::new(),
            channels: args.input.channels.clone(),
            strict: args.input.strict,
            csv: CsvOptions { cells: 1, series: 1, pack_total: true, ..CsvOptions::default() },
            encode_row: Box::new(|_, _| 0),
        },
    }
}
