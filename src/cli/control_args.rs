//! Arguments that the commands to a running daemon share: its socket, and the selection of alarms.

use std::path::PathBuf;

use clap::builder::{PossibleValuesParser, TypedValueParser};

use crate::alarm::{Rule, Selector, Severity};
use crate::control::client::ControlClient;
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
