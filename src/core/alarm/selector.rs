//! Selects the alarms that a command changes, and reports the command's outcome.

use serde::{Deserialize, Serialize};

use super::rule::{Rule, Severity};
use crate::quantity::CellIndex;

/// Selects alarms by rule, severity and cell; a field without a value matches every alarm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Selector {
    pub rule: Option<Rule>,
    pub severity: Option<Severity>,
    /// The cell, counted from 0. If a cell is set, the pack's own alarms do not match.
    pub cell: Option<CellIndex>,
}

impl Selector {
    /// Whether the selector matches the alarm of a rule, a severity and a cell; `cell`: `None` = the pack.
    pub fn matches(&self, rule: Rule, severity: Severity, cell: Option<CellIndex>) -> bool {
        self.rule.is_none_or(|wanted| wanted == rule)
            && self.severity.is_none_or(|wanted| wanted == severity)
            && (self.cell.is_none() || self.cell == cell)
    }
}

/// Outcome of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct CommandOutcome {
    /// Number of changed alarms.
    pub changed: u32,
    /// Number of alarms that could not be cleared, because they are raised and their value is unhealthy, unknown, or
    /// not healthy for long enough.
    pub refused: u32,
}
