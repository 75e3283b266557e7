//! `packwatch acknowledge`, `clear` and `pack-replaced`: what people tell the running daemon.
//!
//! Success when something changed or there was nothing to change; a failure names every alarm that was refused, and why.

use std::fmt::Write as _;

use super::Failure;
use super::alarms::{cell, severity, with_unit};
use super::control_args::{ControlArgs, SelectorArgs, print};
use crate::alarm::Alarm;
use crate::control::answer::refusal;
use crate::control::client::ControlClient;
use crate::control::protocol::{Done, Request};
use crate::monitor::Command;

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
    /// Really: what was learned of the old pack is forgotten
    #[arg(long)]
    yes: bool,
    #[command(flatten)]
    control: ControlArgs,
}

/// Runs `acknowledge`.
pub(crate) fn acknowledge(args: &AlarmArgs) -> Result<(), Failure> {
    tell(&args.control.client(), Command::Acknowledge(args.which.selector()), "acknowledged")
}

/// Runs `clear`.
pub(crate) fn clear(args: &AlarmArgs) -> Result<(), Failure> {
    tell(&args.control.client(), Command::Clear(args.which.selector()), "cleared")
}

/// Runs `pack-replaced`.
pub(crate) fn pack_replaced(args: &ReplacedArgs) -> Result<(), Failure> {
    replace_pack(args.yes, &args.control.client())
}

/// Tells the running daemon that another pack is connected.
pub(super) fn replace_pack(yes: bool, client: &ControlClient) -> Result<(), Failure> {
    if !yes {
        return Err(Failure::new(
            "another pack is connected? then say --yes: the daemon forgets the capacity, the resistance and the other \
             values it has learned, and the alarms about them, and starts again from the configuration; what it knew of \
             the old pack goes into its log and events once more",
        ));
    }
    let done: Done = client.ask(Request::Command(Command::PackReplaced)).map_err(Failure::new)?;
    print(&format!("what was learned of the old pack is forgotten; alarms about it that ended: {}\n", done.changed))
}

fn tell(client: &ControlClient, command: Command, word: &str) -> Result<(), Failure> {
    let done: Done = client.ask(Request::Command(command)).map_err(Failure::new)?;
    if done.changed > 0 || done.refused == 0 {
        print(&match done.changed {
            0 => format!("nothing to be {word}\n"),
            1 => format!("1 alarm {word}\n"),
            changed => format!("{changed} alarms {word}\n"),
        })?;
    }
    if done.refused == 0 { Ok(()) } else { Err(Failure::new(refusals(&done, word))) }
}

fn refusals(done: &Done, word: &str) -> String {
    let alarms = if done.refused == 1 { "alarm" } else { "alarms" };
    let mut text = format!("{} {alarms} not {word}:", done.refused);
    for alarm in &done.refused_alarms {
        let Alarm { rule, threshold, .. } = *alarm;
        let value = alarm.value.map_or_else(|| "unknown".to_owned(), |value| with_unit(rule, value));
        let _ = write!(
            text,
            "\n  {} {}, cell {}: {} (value {value}, threshold {})",
            rule.name(),
            severity(alarm.severity),
            cell(alarm.cell),
            refusal(alarm),
            with_unit(rule, threshold)
        );
    }
    let told = u32::try_from(done.refused_alarms.len()).unwrap_or(u32::MAX);
    if done.refused > told {
        let _ = write!(text, "\n  and {} more", done.refused - told);
    }
    text
}
