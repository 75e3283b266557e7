//! The alarms that a command selects, and its outcome.

use serde::{Deserialize, Serialize};

use super::rule::{Rule, Severity};
use crate::quantity::CellIndex;

/// Alarms of a rule, a severity and a cell; a field without a value selects all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Selector {
    /// Which rule.
    pub rule: Option<Rule>,
    /// Which severity.
    pub severity: Option<Severity>,
    /// Which cell, counted from 0; the pack's own alarms are selected only without it.
    pub cell: Option<CellIndex>,
}

impl Selector {
    /// Whether it selects that alarm (`cell`: `None` = the pack's).
    pub fn matches(&self, rule: Rule, severity: Severity, cell: Option<CellIndex>) -> bool {
        self.rule.is_none_or(|wanted| wanted == rule)
            && self.severity.is_none_or(|wanted| wanted == severity)
            && (self.cell.is_none() || self.cell == cell)
    }
}

/// Outcome of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct CommandOutcome {
    /// Alarms changed.
    pub changed: u32,
    /// Alarms that were to be cleared, but are raised and not healthy (or their value is not known).
    pub refused: u32,
}
