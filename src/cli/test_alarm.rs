//! `packwatch test-alarm`: asks the running daemon to send a rule's alarm frame as a test, and reports the frames seen
//! on the bus.
//!
//! The command succeeds only if every interface received at least one test frame, and if all frames were intact and in
//! sequence.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

use super::common::control::{ControlArgs, rule_parser};
use super::common::numbers::above_0_to;
use super::common::output::{print, word};
use crate::alarm::{AlarmState, Rule};
use crate::config;
use crate::control::test_alarm::{self, ChannelReport};
use crate::io::stamp;
use crate::monitor::MAX_TEST_S;
use packwatch_host::failure::Failure;

/// Arguments of `test-alarm`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rule whose alarm frame is sent, for example capacity_low; no alarm is raised
    #[arg(value_name = "RULE", value_parser = rule_parser(), hide_possible_values = true)]
    rule: Rule,
    /// Configuration file of the daemon
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Duration of the test (s)
    #[arg(long = "for", value_name = "SECONDS", default_value_t = 5.0, value_parser = above_0_to(MAX_TEST_S, "seconds, "))]
    duration: f64,
    #[command(flatten)]
    control: ControlArgs,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let config = config::load(&args.config)?;
    let duration = Duration::from_secs_f64(args.duration);
    let reports = test_alarm::run(&config, &args.control.client(), args.rule, duration).map_err(Failure::new)?;
    print(&table(args.rule, &reports))?;
    let bad = reports.iter().filter(|report| !report.is_good());
    let bad: Vec<&str> = bad.map(|report| report.interface.as_str()).collect();
    if bad.is_empty() {
        return Ok(());
    }
    let path = args.config.display();
    Err(Failure::new(format!(
        "no test frame seen on {}; check that the interface is up and that the daemon runs with {path}",
        bad.join(", ")
    )))
}

fn table(rule: Rule, reports: &[ChannelReport]) -> String {
    let mut text = format!("test frames of {} seen on the interfaces:\n", rule.name());
    let _ = writeln!(
        text,
        "{:<12} {:>10} {:>6}  {:<27} {:<27} {:<7} end-to-end",
        "interface", "id", "frames", "first", "last", "ended"
    );
    for report in reports {
        let stamp = |time: Option<_>| time.map_or_else(|| "-".to_owned(), stamp::format_utc_micros);
        let _ = writeln!(
            text,
            "{:<12} {:>10} {:>6}  {:<27} {:<27} {:<7} {}",
            report.interface,
            report.id.to_string(),
            report.observed.tests,
            stamp(report.observed.first),
            stamp(report.observed.last),
            if report.observed.ended { "yes" } else { "no" },
            protection(report)
        );
        push_notes(&mut text, report);
    }
    text.push_str("all counted frames had the test marker\n");
    text
}

fn protection(report: &ChannelReport) -> String {
    let Some(counts) = &report.protection else { return "none".to_owned() };
    if report.is_intact() {
        return format!("intact, {} checked", counts.total());
    }
    let found =
        counts.iter().filter(|(_, count)| *count > 0).map(|(status, count)| format!("{} {count}", status.name()));
    format!("BROKEN: {}", found.collect::<Vec<_>>().join(", "))
}

/// The alarm states that an alarm frame can contain, one for each code of its state signal.
const ON_THE_WIRE: [AlarmState; 7] = [
    AlarmState::Inactive,
    AlarmState::Active,
    AlarmState::Cleared,
    AlarmState::Pending,
    AlarmState::Latched,
    AlarmState::Suppressed,
    AlarmState::Unknown,
];

fn push_notes(text: &mut String, report: &ChannelReport) {
    let observed = &report.observed;
    for (&(rule, state), count) in &observed.genuine {
        let _ = writeln!(text, "  also seen: {}, {count} frames", alarm_words(rule, state));
    }
    let others = [
        (observed.foreign, "test frames of other rules"),
        (observed.unreadable, "undecodable frames"),
        (report.dropped, "frames dropped by this computer"),
    ];
    for (count, what) in others.into_iter().filter(|(count, _)| *count > 0) {
        let _ = writeln!(text, "  also seen: {count} {what}");
    }
    if let Some(error) = &report.error {
        let _ = writeln!(text, "  listening stopped early: {error}");
    }
}

fn alarm_words(rule: u8, state: u8) -> String {
    let name = Rule::from_number(rule).map_or("unknown rule", Rule::name);
    let found = ON_THE_WIRE.into_iter().find(|known| known.wire_code() == state);
    let kind = if found.is_some_and(AlarmState::is_raised) { "REAL, " } else { "" };
    format!("{kind}without test marker: {name} {}", found.map_or_else(|| "in an unknown state".to_owned(), word))
}
