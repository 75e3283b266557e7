//! The frames the daemon sends, as a layout gives them.
//!
//! Any DBC serves that has the message and signal names of the shipped `config/packwatch.dbc`. An unknown value is sent
//! as the code the DBC's value table calls "not available", else as all ones (unsigned), the lowest code (signed) or
//! NaN (float). A known value never takes that code: it saturates before it. Where the layout has end-to-end protection,
//! its header is written with the counter that the caller keeps ([`SendCounters`]).
//!
//! A DBC that lacks something, or in which a value could be read as another rule's or page's, is refused with all its
//! faults at once.

use serde::{Deserialize, Serialize};

use super::layout::LaidOut;
use super::message::MessagePlan;
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::Protection;
use crate::can::{CanId, Frame};
use crate::quantity::{CellIndex, Mode};

/// Everything an [`OutputPlan`] misses in its DBC, one line each.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct PlanFaults(pub Vec<String>);

/// Signals of the status frame.
const STATUS: [&str; 8] =
    ["Soc", "SocStd", "Mode", "Validity", "HighestSeverity", "ActiveAlarms", "LimitingCell", "UnknownRules"];

/// Signals of the health frame, whatever its pages.
const HEALTH: [&str; 8] = [
    "Capacity",
    "CapacityStd",
    "Soh",
    "RechargePeriod",
    "NormalizedRechargePeriod",
    "UsableCapacity",
    "UsableCapacityStd",
    "ResistanceRatio",
];

/// Signals on every page of the alarm frame.
const ALARM: [&str; 6] = ["Rule", "State", "Severity", "Test", "Cell", "Acknowledged"];

/// The alarm rules in the order of their numbers, which start at 1: each has its `Value_...` and `Threshold_...`, for
/// their units differ.
pub(super) const RULES: [&str; 14] = [
    "CapacityLow",
    "UsableCapacityLow",
    "RechargePeriodLow",
    "InputMissing",
    "InputImplausible",
    "EstimateUntrusted",
    "ResistanceHigh",
    "SocLow",
    "TemperatureHigh",
    "CellImbalance",
    "RemainingLifeLow",
    "BmsDisagrees",
    "StoreFailed",
    "BusFault",
];

/// Contents of the status frame; `None` = not available.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StatusFields {
    /// Fraction.
    pub soc: Option<f64>,
    /// Fraction.
    pub soc_std: Option<f64>,
    /// What the pack does.
    pub mode: Option<Mode>,
    /// Code of the wire: 0 unavailable, 1 valid, 2 degraded, 3 untrusted.
    pub validity: u8,
    /// Code of the wire: 0 none, 1 info, 2 warning, 3 severe.
    pub highest_severity: Option<u8>,
    /// Number of active alarms.
    pub active_alarms: Option<u16>,
    /// The cell that limits discharge.
    pub limiting_cell: Option<CellIndex>,
    /// Code of the wire: rules that cannot be judged: 0 none, 1 some, 2 all.
    pub unknown_rules: Option<u8>,
}

/// Contents of all pages of the health frame; `None` = not available.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct HealthFields {
    /// Ah.
    pub capacity_ah: Option<f64>,
    /// Ah.
    pub capacity_std_ah: Option<f64>,
    /// Fraction of the rated capacity.
    pub soh: Option<f64>,
    /// s.
    pub recharge_period_s: Option<f64>,
    /// s.
    pub normalized_recharge_period_s: Option<f64>,
    /// Ah.
    pub usable_capacity_ah: Option<f64>,
    /// Ah.
    pub usable_capacity_std_ah: Option<f64>,
    /// Relative to new, 1 = as new.
    pub resistance_ratio: Option<f64>,
    /// Equivalent full cycles until the end of life, median. As the next two, only where the DBC has a signal for it.
    pub remaining_cycles: Option<f64>,
    /// Its 5 % quantile.
    pub remaining_cycles_low: Option<f64>,
    /// Days, median.
    pub remaining_days: Option<f64>,
}

/// Contents of one alarm frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AlarmFields {
    /// Number of the rule.
    pub rule: u8,
    /// Code of the wire: 0 inactive, 1 active, 2 cleared, 3 pending, 4 latched, 5 suppressed (raised, its input is not
    /// valid now), 6 unknown (cannot be judged); `None` = not available.
    pub state: Option<u8>,
    /// Code of the wire: 1 info, 2 warning, 3 severe; `None` = unknown.
    pub severity: Option<u8>,
    /// A test, not a real alarm.
    pub test: bool,
    /// Somebody has taken note of it.
    pub acknowledged: bool,
    /// `None` = the pack as a whole.
    pub cell: Option<CellIndex>,
    /// In the rule's inside unit.
    pub value: Option<f64>,
    /// In the rule's inside unit.
    pub threshold: Option<f64>,
}

/// The next counter of each message's end-to-end protection. To be kept over a restart: a receiver that sees the counter
/// jump back takes the frame for an old one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SendCounters {
    status: u8,
    health: u8,
    alarm: u8,
}

/// How to make the daemon's frames.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputPlan {
    status: MessagePlan,
    health: MessagePlan,
    alarm: MessagePlan,
    /// Selector codes of the health frame, ascending.
    pages: Vec<u64>,
}

impl OutputPlan {
    /// Finds every message and signal the daemon sends.
    ///
    /// # Errors
    /// All that is missing or cannot be written, by name.
    pub fn new(database: &Database) -> Result<Self, PlanFaults> {
        let mut faults = Vec::new();
        let mut message =
            |which: LaidOut, required: &[&str]| MessagePlan::new(database, which.message(), required, &mut faults);
        let (status, health) = (message(LaidOut::Status, &STATUS), message(LaidOut::Health, &HEALTH));
        let alarm = message(LaidOut::Alarm, &ALARM);
        if let Some(alarm) = &alarm {
            alarm.check_rules(&RULES, &mut faults);
        }
        match (status, health, alarm) {
            (Some(status), Some(health), Some(alarm)) if faults.is_empty() => {
                let pages = health.page_codes();
                Ok(Self { status, health, alarm, pages })
            }
            _ => Err(PlanFaults(faults)),
        }
    }

    fn messages(&self) -> [&MessagePlan; 3] {
        [&self.status, &self.health, &self.alarm]
    }

    /// Identifiers of status, health and alarm frame.
    pub fn ids(&self) -> [CanId; 3] {
        self.messages().map(|message| message.id)
    }

    /// Kinds of status, health and alarm frame.
    pub fn formats(&self) -> [FrameFormat; 3] {
        self.messages().map(|message| message.format)
    }

    /// End-to-end protection of status, health and alarm frame.
    pub fn protections(&self) -> [Option<Protection>; 3] {
        self.messages().map(|message| message.protection)
    }

    /// Cycle times of status, health and alarm frame, ms.
    pub fn cycle_times_ms(&self) -> [u32; 3] {
        self.messages().map(|message| message.cycle_time_ms)
    }

    /// Pages the health frame has, at least 1.
    pub fn health_pages(&self) -> usize {
        self.pages.len()
    }

    /// The status frame.
    pub fn status(&self, fields: &StatusFields, counters: &mut SendCounters) -> Frame {
        let mode = fields.mode.map(|mode| match mode {
            Mode::Unknown => 0.0,
            Mode::Charge => 1.0,
            Mode::Rest => 2.0,
            Mode::Discharge => 3.0,
        });
        self.status.frame(0, &mut counters.status, |name| match name {
            "Soc" => fields.soc,
            "SocStd" => fields.soc_std,
            "Mode" => mode,
            "Validity" => Some(f64::from(fields.validity)),
            "HighestSeverity" => fields.highest_severity.map(f64::from),
            "ActiveAlarms" => fields.active_alarms.map(f64::from),
            "LimitingCell" => fields.limiting_cell.map(|cell| f64::from(cell.0)),
            "UnknownRules" => fields.unknown_rules.map(f64::from),
            _ => None,
        })
    }

    /// One page of the health frame, counted from 0; beyond the last it starts again.
    pub fn health(&self, page: usize, fields: &HealthFields, counters: &mut SendCounters) -> Frame {
        let code = self.pages.get(page % self.pages.len().max(1)).copied().unwrap_or(0);
        self.health.frame(code, &mut counters.health, |name| match name {
            "Capacity" => fields.capacity_ah,
            "CapacityStd" => fields.capacity_std_ah,
            "Soh" => fields.soh,
            "RechargePeriod" => fields.recharge_period_s,
            "NormalizedRechargePeriod" => fields.normalized_recharge_period_s,
            "UsableCapacity" => fields.usable_capacity_ah,
            "UsableCapacityStd" => fields.usable_capacity_std_ah,
            "ResistanceRatio" => fields.resistance_ratio,
            "RemainingCycles" => fields.remaining_cycles,
            "RemainingCyclesLow" => fields.remaining_cycles_low,
            "RemainingDays" => fields.remaining_days,
            _ => None,
        })
    }

    /// One alarm. Value and threshold go into the rule's own `Value_...` and `Threshold_...`.
    pub fn alarm(&self, fields: &AlarmFields, counters: &mut SendCounters) -> Frame {
        let bit = |set: bool| Some(if set { 1.0 } else { 0.0 });
        self.alarm.frame(u64::from(fields.rule), &mut counters.alarm, |name| match name {
            "State" => fields.state.map(f64::from),
            "Severity" => fields.severity.map(f64::from),
            "Test" => bit(fields.test),
            "Acknowledged" => bit(fields.acknowledged),
            "Cell" => fields.cell.map(|cell| f64::from(cell.0)),
            name if name.starts_with("Value_") => fields.value,
            name if name.starts_with("Threshold_") => fields.threshold,
            _ => None,
        })
    }
}

#[cfg(test)]
mod tests;
