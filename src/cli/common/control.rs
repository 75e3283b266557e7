//! Arguments and functions shared by the commands to a running daemon: control socket, selection of alarms, replacement
//! of the pack.

use std::path::PathBuf;

use clap::builder::{PossibleValuesParser, TypedValueParser};

use crate::alarm::{Rule, Selector, Severity};
use packwatch_host::failure::Failure;

use super::numbers::cell_number;
use super::output::print;
use crate::control::client::ControlClient;
use crate::control::protocol::{CommandOutcome, Request};
use crate::monitor::Command;
use crate::quantity::CellIndex;

/// The socket of the daemon.
#[derive(Debug, clap::Args)]
pub(crate) struct ControlArgs {
    /// Control socket of the daemon [default: where `packwatch run` creates it]
    #[arg(long, value_name = "PATH")]
    control: Option<PathBuf>,
}

impl ControlArgs {
    /// Returns a client of the socket.
    pub(crate) fn client(&self) -> ControlClient {
        ControlClient::new(self.control.as_deref())
    }
}

/// A selection of alarms.
#[derive(Debug, clap::Args)]
#[group(id = "which", required = true, multiple = true)]
pub(crate) struct SelectorArgs {
    /// Select the alarms of this rule, for example capacity_low
    #[arg(value_name = "RULE", value_parser = rule_parser(), hide_possible_values = true, group = "which")]
    rule: Option<Rule>,
    /// Select the alarms of this severity
    #[arg(long, value_parser = severity_parser(), group = "which")]
    severity: Option<Severity>,
    /// Select the alarms of this cell, counted from 1
    #[arg(long, value_name = "N", value_parser = cell, group = "which")]
    cell: Option<CellIndex>,
    /// Select all alarms
    #[arg(long, conflicts_with_all = ["rule", "severity", "cell"], group = "which")]
    all: bool,
}

impl SelectorArgs {
    /// Returns the selection for the daemon.
    pub(crate) fn selector(&self) -> Selector {
        Selector { rule: self.rule, severity: self.severity, cell: self.cell }
    }
}

/// Reports to the running daemon that another pack is connected.
pub(crate) fn replace_pack(yes: bool, client: &ControlClient) -> Result<(), Failure> {
    if !yes {
        return Err(Failure::new(
            "not confirmed: add --yes if another pack is connected. The daemon then discards the learned values (capacity, resistance \
            and others) and the alarms about them, and restarts from the configuration. It writes the last values of the old pack \
            to its log and events",
        ));
    }
    let done: CommandOutcome = client.ask(Request::Command(Command::PackReplaced)).map_err(Failure::new)?;
    print(&format!("discarded the learned values of the old pack; alarms ended: {}\n", done.changed))?;
    check_stored(&done)
}

/// Fails if the change is not yet on disk.
pub(crate) fn check_stored(done: &CommandOutcome) -> Result<(), Failure> {
    if done.is_stored != Some(false) {
        return Ok(());
    }
    Err(Failure::new(
        "changed, but not stored yet: a power cut now would undo the change. The daemon stores it when the disk works again; \
        see `packwatch status`",
    ))
}

/// Parses the name of a rule. The error for an unknown name lists all names and suggests similar ones.
pub(crate) fn rule_parser() -> impl TypedValueParser<Value = Rule> {
    let find = |name: String| Rule::ALL.into_iter().find(|rule| rule.name() == name).ok_or("unknown rule");
    PossibleValuesParser::new(Rule::ALL.map(Rule::name)).try_map(find)
}

fn severity_parser() -> impl TypedValueParser<Value = Severity> {
    let find = |name: String| Severity::ALL.into_iter().find(|known| known.name() == name).ok_or("unknown severity");
    PossibleValuesParser::new(Severity::ALL.map(Severity::name)).try_map(find)
}

fn cell(text: &str) -> Result<CellIndex, String> {
    cell_number(text).map(|number| CellIndex(number - 1))
}
