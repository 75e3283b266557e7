//! `packwatch doctor`: listens to a pack or replays logs, and reports probable faults of the wiring and of the
//! configuration.
//!
//! Exit codes: 0 = no errors and no warnings found; 1 = errors or warnings found, or the check failed; 78 = invalid
//! configuration (its readable parts are still checked).

mod page;

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::common::logs::{CsvSign, channel, charge_positive, column, print_tables};
use super::common::numbers::above_0_to;
use super::common::output::{failure, print_json, unless_closed};
use super::common::progress::{Bar, progress_bar};
use packwatch_host::failure::{EXIT_CONFIG, Failure};

use crate::io::csv_log::has_table_name;
use crate::io::log::{LogCounts, LogError};
use crate::replay::{LogReading, ReplayProgress};
use crate::wiring::{Severity, Topic, WiringFinding, WiringReport};
use crate::wiring_check::{self, Interrupt, Survey};

/// Arguments of `doctor`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file; may contain faults
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Listen on this interface instead of the configured one; repeat for several interfaces, in the order of the configuration.
    /// All other CAN interfaces of this computer are listened to as well
    #[arg(short, long = "interface", value_name = "IFACE")]
    interfaces: Vec<String>,
    /// Logs to replay instead of listening: journals, candump logs or CSV files, also .gz or .zst; - reads standard
    /// input
    #[arg(value_name = "LOG")]
    logs: Vec<PathBuf>,
    /// Time to listen, or time to read from the logs (s) [default: 60; with logs, all of them]
    #[arg(long = "for", value_name = "SECONDS", value_parser = above_0_to(86_400.0, "seconds, "))]
    seconds: Option<f64>,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
    /// Read a channel or interface of a log as this interface, as for `replay`
    #[arg(long = "channel", value_name = "CHANNEL=INTERFACE", value_parser = channel)]
    channels: Vec<(String, String)>,
    /// Name a CSV column, as for `replay`
    #[arg(long = "column", value_name = "ROLE=NAME", value_parser = column)]
    columns: Vec<(String, String)>,
    /// Direction of positive current in a CSV, as for `replay`
    #[arg(long, value_enum)]
    csv_sign: Option<CsvSign>,
    /// CSV table with the start time of each section of a CSV log, as for `replay`
    #[arg(long, value_name = "TABLE.csv")]
    start_times: Option<PathBuf>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let mut survey = wiring_check::survey(&args.config)?;
    rename_interfaces(args, &mut survey)?;
    survey.plan.is_csv = args.logs.iter().any(|log| has_table_name(log));
    let interrupt = Interrupt::watch().map_err(|error| Failure::new(format!("cannot handle Ctrl-C: {error}")))?;
    let mut report = if args.logs.is_empty() {
        listen(args, &survey, &interrupt)?
    } else {
        let (report, counts) = replay(&args.logs, &args.reading(), args.seconds, &survey, &interrupt)?;
        print_tables(&counts.tables);
        report
    };
    complete(&mut report, &survey);
    if !args.logs.is_empty() && args.logs.iter().all(|log| log.is_file()) {
        wiring_check::try_changes(&args.config, &mut report, &mut |other| again(args, other, &survey, &interrupt));
    }
    let source = source_name(args, &survey);
    if args.json {
        json(&report, &args.config, &source)?
    } else {
        page::print(&report, &args.config, &source)?
    }
    match (survey.faults.is_empty(), report.has_findings()) {
        (false, _) => Err(Failure { message: String::new(), code: EXIT_CONFIG }),
        (true, true) => Err(Failure::new("")),
        (true, false) => Ok(()),
    }
}

impl Args {
    fn reading(&self) -> LogReading {
        LogReading {
            strict: false,
            channels: self.channels.clone(),
            columns: self.columns.clone(),
            charge_positive: charge_positive(self.csv_sign),
            start_times: self.start_times.clone(),
        }
    }
}

/// Replaces the names of the configured interfaces by the names on the command line.
fn rename_interfaces(args: &Args, survey: &mut Survey) -> Result<(), Failure> {
    let configured = survey.plan.interfaces.len();
    if args.interfaces.len() > configured {
        let found = args.interfaces.len();
        let file = args.config.display();
        return Err(Failure::new(format!(
            "--interface is given {found} times, but {file} has {configured} interfaces"
        )));
    }
    for (interface, name) in survey.plan.interfaces.iter_mut().zip(&args.interfaces) {
        interface.name.clone_from(name);
    }
    Ok(())
}

fn source_name(args: &Args, survey: &Survey) -> String {
    if args.logs.is_empty() {
        let names: Vec<&str> = survey.plan.interfaces.iter().map(|interface| interface.name.as_str()).collect();
        return names.join(", ");
    }
    args.logs.iter().map(|log| log.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// Judges the logs with a changed configuration; `None` = they cannot be read again.
fn again(args: &Args, changed: &mut Survey, survey: &Survey, interrupt: &Interrupt) -> Option<WiringReport> {
    (changed.plan.is_csv, changed.plan.interfaces) = (survey.plan.is_csv, survey.plan.interfaces.clone());
    let reading = args.reading();
    let (mut report, _) = replay_with_bar(&args.logs, &reading, args.seconds, changed, interrupt).ok()?;
    complete(&mut report, changed);
    Some(report)
}

/// Judges logs with a configuration.
#[cfg(feature = "lab")]
pub(crate) fn judge(
    config: &Path,
    logs: &[PathBuf],
    reading: &LogReading,
) -> Result<(WiringReport, LogCounts), Failure> {
    let mut survey = wiring_check::survey(config)?;
    survey.plan.is_csv = logs.iter().any(|log| has_table_name(log));
    let (mut report, counts) = replay(logs, reading, None, &survey, &Interrupt::default())?;
    complete(&mut report, &survey);
    Ok((report, counts))
}

fn replay_with_bar(
    logs: &[PathBuf],
    reading: &LogReading,
    seconds: Option<f64>,
    survey: &Survey,
    interrupt: &Interrupt,
) -> Result<(WiringReport, LogCounts), LogError> {
    let bar = Bar::new(logs);
    let result = wiring_check::replay(survey, logs, reading, seconds, interrupt, &mut |progress| {
        let times_real_time = progress.seconds / bar.seconds();
        bar.show(ReplayProgress { bytes: progress.bytes, frames: progress.frames, times_real_time });
    });
    bar.clear();
    result
}

fn replay(
    logs: &[PathBuf],
    reading: &LogReading,
    seconds: Option<f64>,
    survey: &Survey,
    interrupt: &Interrupt,
) -> Result<(WiringReport, LogCounts), Failure> {
    let (mut report, counts) = replay_with_bar(logs, reading, seconds, survey, interrupt).map_err(failure)?;
    if let Some(first) = &counts.first_bad_line {
        let mut finding = WiringFinding::new(Severity::Note, Topic::Interface, "the log has malformed lines");
        finding.seen = format!("{} of {} lines cannot be read, first {first}", counts.bad_lines, counts.lines);
        report.add(finding);
    }
    Ok((report, counts))
}

fn listen(args: &Args, survey: &Survey, interrupt: &Interrupt) -> Result<WiringReport, Failure> {
    let wanted_s = args.seconds.unwrap_or(60.0);
    let bar = progress_bar((1000.0 * wanted_s) as u64, "listening {bar:32} {msg} (Ctrl-C ends early)");
    let result = wiring_check::listen(survey, Duration::from_secs_f64(wanted_s), interrupt, &mut |progress| {
        bar.set_position((1000.0 * progress.seconds) as u64);
        bar.set_message(format!("{:.0} of {wanted_s:.0} s, {} frames", progress.seconds, progress.frames));
    });
    bar.finish_and_clear();
    result.map_err(failure)
}

/// Combines all faults of the configuration in one finding; `None` = the configuration is valid.
fn invalid(faults: &[String]) -> Option<WiringFinding> {
    let (first, others) = faults.split_first()?;
    let title = match others.len() {
        0 => "the configuration is invalid".to_owned(),
        _ => format!("the configuration is invalid: {} faults", faults.len()),
    };
    let mut finding = WiringFinding::new(Severity::Error, Topic::Configuration, title);
    finding.seen.clone_from(first);
    finding.why = "packwatch run does not start with it; its readable parts are checked below".to_owned();
    finding.advice = Some("packwatch check shows every fault".to_owned()).filter(|_| !others.is_empty());
    finding.consequences = others.to_vec();
    Some(finding)
}

/// Adds the configuration's faults and warnings, and the position and value of each key to change.
fn complete(report: &mut WiringReport, survey: &Survey) {
    if let Some(finding) = invalid(&survey.faults) {
        report.add(finding);
        // A wrong layout in the DBC causes other faults, so the finding on the layout is listed first.
        if let Some(layout) =
            report.findings.iter().position(|f| (f.severity, f.topic) == (Severity::Error, Topic::Layout))
        {
            report.findings[..=layout].rotate_right(1);
        }
    }
    for warning in survey.config.iter().flat_map(|config| &config.warnings) {
        let mut finding = WiringFinding::new(Severity::Warning, Topic::Configuration, "the configuration looks wrong");
        finding.seen.clone_from(warning);
        finding.why = "packwatch run starts with it; packwatch check reports it too".to_owned();
        report.add(finding);
    }
    for change in report.findings.iter_mut().flat_map(|finding| &mut finding.changes) {
        if let Some((place, now)) = survey.locate(&change.table, &change.key) {
            (change.place, change.now) = (Some(place), now);
        }
    }
}

fn json(report: &WiringReport, config: &Path, source: &str) -> Result<(), Failure> {
    let document = serde_json::json!({
        "config": config.display().to_string(),
        "source": source,
        "ok": !report.has_findings(),
        "report": report,
    });
    unless_closed(print_json(&document))
}
