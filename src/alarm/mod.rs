//! Rules over named values: debounce, hysteresis, severity. Sees values with age and validity, no estimator.
//!
//! In: a rule's value per cell or per pack, in the rule's unit, or `None` when it is not known. Out: alarms
//! raised and cleared. Promise: an unknown value neither raises nor clears; memory is bounded by rules x cells.
//! * [`machine`] holds the life of one alarm as a transition table;
//! * [`engine`] holds one such machine per rule and cell.

pub mod engine;
pub mod machine;

pub use engine::{ActiveAlarm, AlarmChange, AlarmEngine, AlarmState};
pub use machine::State;

use serde::{Deserialize, Serialize};

/// What an alarm can be about. The number is the one on the wire (`config/packwatch.dbc`), never reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Rule {
    /// Capacity (full to empty open-circuit) below the threshold, Ah.
    CapacityLow = 1,
    /// Usable capacity (configured load and cut-off) below the threshold, Ah.
    UsableCapacityLow = 2,
    /// Recharge period below the threshold, s.
    RechargePeriodLow = 3,
    /// A configured input has not come for too long; the value is its age, s.
    InputMissing = 4,
    /// A configured input keeps being implausible; the value is the share of bad readings, fraction.
    InputImplausible = 5,
    /// The estimator's innovations contradict its own covariance; the value is the mean normalised innovation squared.
    EstimateUntrusted = 6,
}

/// What a rule is about: the pack as a whole, its cells, or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// One value for the pack.
    Pack,
    /// One value per cell.
    Cell,
    /// One value per cell, and one for what belongs to no cell (the pack's current, say).
    Both,
}

/// Which side of a threshold is bad.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Raised below the threshold.
    Below,
    /// Raised above it.
    Above,
}

impl Rule {
    /// Every rule, in wire order.
    pub const ALL: [Self; 6] = [
        Self::CapacityLow,
        Self::UsableCapacityLow,
        Self::RechargePeriodLow,
        Self::InputMissing,
        Self::InputImplausible,
        Self::EstimateUntrusted,
    ];

    /// Pack, cells or both.
    pub const fn scope(self) -> Scope {
        match self {
            Self::CapacityLow | Self::UsableCapacityLow | Self::EstimateUntrusted => Scope::Cell,
            Self::RechargePeriodLow => Scope::Pack,
            Self::InputMissing | Self::InputImplausible => Scope::Both,
        }
    }

    /// Whether the rule has a value for each cell.
    pub const fn is_per_cell(self) -> bool {
        match self.scope() {
            Scope::Pack => false,
            Scope::Cell | Scope::Both => true,
        }
    }

    /// Which side of its threshold is bad.
    pub const fn direction(self) -> Direction {
        match self {
            Self::CapacityLow | Self::UsableCapacityLow | Self::RechargePeriodLow => Direction::Below,
            Self::InputMissing | Self::InputImplausible | Self::EstimateUntrusted => Direction::Above,
        }
    }

    /// Whether a value stays true until the next one, so that the time debounce may run out between them.
    ///
    /// What was learned at a transition does: a capacity is not less low because no cycle has ended since.
    /// What is measured all the time does not: if no new consistency figure comes, the old one proves nothing.
    pub const fn holds_between_values(self) -> bool {
        match self {
            Self::CapacityLow | Self::UsableCapacityLow | Self::RechargePeriodLow => true,
            Self::InputMissing | Self::InputImplausible | Self::EstimateUntrusted => false,
        }
    }
}

/// How bad, as on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Severity {
    /// Worth knowing.
    Info = 1,
    /// Plan a visit.
    Warning = 2,
    /// Act now.
    Severe = 3,
}

/// One rule's settings.
#[derive(Debug, Clone, PartialEq)]
pub struct RuleConfig {
    /// What it is about.
    pub rule: Rule,
    /// Raised when the value is beyond this (below for `*Low`, above for the others), in the rule's unit.
    pub threshold: f64,
    /// Cleared only when the value is back by this much on the healthy side of the threshold; never negative.
    pub hysteresis: f64,
    /// Must hold this long before it is raised, and be healthy this long before it clears, s.
    pub debounce_s: f64,
    /// Must hold for this many new values before it is raised or cleared, at least 1.
    pub debounce_events: u32,
    /// How bad it is.
    pub severity: Severity,
}
