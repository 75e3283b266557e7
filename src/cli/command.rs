//! `packwatch acknowledge`, `clear`, `pack-replaced` and `poll`: commands to the running daemon.
//!
//! A command fails if the daemon refuses any part of it. The error message lists the refused alarms with their reasons.

use std::fmt::Write as _;

use super::common::alarms::cell;
use super::common::control::{ControlArgs, SelectorArgs, check_stored, replace_pack};
use super::common::output::print;
use crate::alarm::Alarm;
use crate::control::answer::refusal;
use crate::control::client::ControlClient;
use crate::control::protocol::{CommandOutcome, Request};
use crate::monitor::Command;
use packwatch_host::failure::Failure;

/// Arguments of `acknowledge` and `clear`.
#[derive(Debug, clap::Args)]
pub(crate) struct AlarmArgs {
    #[command(flatten)]
    which: SelectorArgs,
    #[command(flatten)]
    control: ControlArgs,
}

/// Arguments of `pack-replaced`.
#[derive(Debug, clap::Args)]
pub(crate) struct ReplacedArgs {
    /// Confirm that everything learned about the old pack is discarded
    #[arg(long)]
    yes: bool,
    #[command(flatten)]
    control: ControlArgs,
}

/// Arguments of `poll`.
#[derive(Debug, clap::Args)]
pub(crate) struct PollArgs {
    /// `standby` suspends the requests, `resume` sends them again
    action: PollAction,
    #[command(flatten)]
    control: ControlArgs,
}

/// Action on the daemon's diagnostic requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum PollAction {
    /// Send no requests until `resume` or a restart, for example while another tester is connected
    Standby,
    /// Send requests again
    Resume,
}

pub(crate) fn poll(args: &PollArgs) -> Result<(), Failure> {
    let standby = args.action == PollAction::Standby;
    let request = Request::Command(Command::Poll { standby });
    let done: CommandOutcome = args.control.client().ask(request).map_err(Failure::new)?;
    match (done.refused, standby) {
        (0, true) => print("diagnostic requests are suspended until `packwatch poll resume`\n"),
        (0, false) => {
            print("diagnostic requests are no longer suspended; `packwatch status` shows whether they are sent\n")
        }
        _ => Err(Failure::new("diagnostic requests are off: set [poll] enabled = true in the daemon's configuration")),
    }
}

pub(crate) fn acknowledge(args: &AlarmArgs) -> Result<(), Failure> {
    send(&args.control.client(), Command::Acknowledge(args.which.selector()), "acknowledged")
}

pub(crate) fn clear(args: &AlarmArgs) -> Result<(), Failure> {
    send(&args.control.client(), Command::Clear(args.which.selector()), "cleared")
}

pub(crate) fn pack_replaced(args: &ReplacedArgs) -> Result<(), Failure> {
    replace_pack(args.yes, &args.control.client())
}

fn send(client: &ControlClient, command: Command, word: &str) -> Result<(), Failure> {
    let done: CommandOutcome = client.ask(Request::Command(command)).map_err(Failure::new)?;
    if done.changed > 0 || done.refused == 0 {
        print(&match done.changed {
            0 => format!("0 alarms {word}\n"),
            1 => format!("1 alarm {word}\n"),
            changed => format!("{changed} alarms {word}\n"),
        })?;
    }
    if done.refused == 0 { check_stored(&done) } else { Err(Failure::new(refusals(&done, word))) }
}

fn refusals(done: &CommandOutcome, word: &str) -> String {
    let alarms = if done.refused == 1 { "alarm" } else { "alarms" };
    let mut text = format!("{} {alarms} not {word}:", done.refused);
    for alarm in &done.refused_alarms {
        let Alarm { rule, threshold, .. } = *alarm;
        let value = alarm.value.map_or_else(|| "unknown".to_owned(), |value| rule.with_unit(value));
        let _ = write!(
            text,
            "\n  {} {}, cell {}: {} (value {value}, threshold {})",
            rule.name(),
            alarm.severity.name(),
            cell(alarm.cell),
            refusal(alarm),
            rule.with_unit(threshold)
        );
    }
    let named = u32::try_from(done.refused_alarms.len()).unwrap_or(u32::MAX);
    if done.refused > named {
        let _ = write!(text, "\n  and {} more", done.refused - named);
    }
    text
}
