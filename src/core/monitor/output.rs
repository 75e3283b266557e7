//! What is sent, when and where, and the commands that are taken.

use crate::can::encode::{CommandPlan, OutputPlan};
use crate::quantity::BusIndex;

/// The daemon's outgoing frames.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputConfig {
    /// Layouts and identifiers.
    pub plan: OutputPlan,
    /// Interfaces they go out on.
    pub buses: Vec<BusIndex>,
    /// Period of the status frame, s.
    pub status_period_s: f64,
    /// Period of the health frame (all its pages), s.
    pub health_period_s: f64,
    /// Period of the alarm frame while alarms are raised, one alarm each time in turn, s.
    pub alarm_period_s: f64,
}

/// Commands that come from the bus.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandConfig {
    /// Interface they come on.
    pub bus: BusIndex,
    /// What reads them; their protection is checked by one of the guards.
    pub plan: CommandPlan,
}
