//! Rules over named values: debounce, hysteresis, severity. Sees values with age and validity, no estimator.

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
