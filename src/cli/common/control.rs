//! What the commands to a running daemon share: its socket, the selection of alarms, the exchange of the pack.

use std::path::PathBuf;

use clap::builder::{PossibleValuesParser, TypedValueParser};

use crate::alarm::{Rule, Selector, Severity};
use packwatch_host::failure::Failure;

use super::output::print;
use crate::control::client::ControlClient;
use crate::control::protocol::{CommandOutcome, Request};
use crate::monitor::Command;
use crate::quantity::{CellIndex, MAX_CELLS};

/// The socket of the daemon.
#[derive(Debug, clap::Args)]
pub(crate) struct ControlArgs {
    /// Control socket of the daemon (default: where `packwatch run` creates it)
    #[arg(long, value_name = "PATH")]
    control: Option<PathBuf>,
}

impl ControlArgs {
    /// A client of that socket.
    pub(crate) fn client(&self) -> ControlClient {
        ControlClient::new(self.control.as_deref())
    }
}

/// A selection of alarms.
#[derive(Debug, clap::Args)]
#[group(id = "which", required = true, multiple = true)]
pub(crate) struct SelectorArgs {
    /// Alarms of this rule
    #[arg(value_name = "RULE", value_parser = rule_parser(), hide_possible_values = true, group = "which")]
    rule: Option<Rule>,
    /// Alarms of this severity
    #[arg(long, value_parser = severity_parser(), group = "which")]
    severity: Option<Severity>,
    /// Alarms of this cell, the first is 1
    #[arg(long, value_name = "N", value_parser = cell, group = "which")]
    cell: Option<CellIndex>,
    /// All alarms
    #[arg(long, conflicts_with_all = ["rule", "severity", "cell"], group = "which")]
    all: bool,
}

impl SelectorArgs {
    /// The selection, for the daemon.
    pub(crate) fn selector(&self) -> Selector {
        Selector { rule: self.rule, severity: self.severity, cell: self.cell }
    }
}

/// Informs the running daemon that another pack is connected.
pub(crate) fn replace_pack(yes: bool, client: &ControlClient) -> Result<(), Failure> {
    if !yes {
        return Err(Failure::new(
            "another pack is connected? then add --yes: the daemon forgets the capacity, the resistance and the other \
             values it has learned, and the alarms about them, and starts again from the configuration; it writes the \
             last values of the old pack to its log and events",
        ));
    }
    let done: CommandOutcome = client.ask(Request::Command(Command::PackReplaced)).map_err(Failure::new)?;
    print(&format!(
        "the learned values of the old pack are forgotten; alarms about it that ended: {}\n",
        done.changed
    ))?;
    check_stored(&done)
}

/// A failure when what the command has changed is not on the disk.
pub(crate) fn check_stored(done: &CommandOutcome) -> Result<(), Failure> {
    if done.is_stored != Some(false) {
        return Ok(());
    }
    Err(Failure::new(
        "done, but not on the disk yet: a power cut now would undo it; the daemon stores it when the disk answers again \
         (`packwatch status`)",
    ))
}

/// Parses a rule's name; an unknown one gets the list of names and the nearest.
pub(crate) fn rule_parser() -> impl TypedValueParser<Value = Rule> {
    let find = |name: String| Rule::ALL.into_iter().find(|rule| rule.name() == name).ok_or("no such rule");
    PossibleValuesParser::new(Rule::ALL.map(Rule::name)).try_map(find)
}

fn severity_parser() -> impl TypedValueParser<Value = Severity> {
    let find = |name: String| Severity::ALL.into_iter().find(|known| known.name() == name).ok_or("no such one");
    PossibleValuesParser::new(Severity::ALL.map(Severity::name)).try_map(find)
}

fn cell(text: &str) -> Result<CellIndex, String> {
    let number = text.parse::<u16>().ok().filter(|number| (1..=MAX_CELLS).contains(&usize::from(*number)));
    number.map(|number| CellIndex(number - 1)).ok_or_else(|| format!("must be a cell's number, 1 to {MAX_CELLS}"))
}
