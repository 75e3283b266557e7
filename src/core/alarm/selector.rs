//! Which alarms a command means, and what became of them.

use serde::{Deserialize, Serialize};

use super::{Rule, Severity};
use crate::quantity::CellIndex;

/// Alarms of a rule, a severity and a cell; what is not given means all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Selector {
    /// Which rule.
    pub rule: Option<Rule>,
    /// Which severity.
    pub severity: Option<Severity>,
    /// Which cell, counted from 0; the pack's own alarms are meant only without it.
    pub cell: Option<CellIndex>,
}

impl Selector {
    /// Whether it means that alarm (`cell`: `None` = the pack's).
    pub fn matches(&self, rule: Rule, severity: Severity, cell: Option<CellIndex>) -> bool {
        self.rule.is_none_or(|wanted| wanted == rule)
            && self.severity.is_none_or(|wanted| wanted == severity)
            && (self.cell.is_none() || self.cell == cell)
    }
}

/// What became of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Outcome {
    /// Alarms changed.
    pub changed: u32,
    /// Alarms that were to be cleared, but are raised and not healthy (or their value is not known).
    pub refused: u32,
}
