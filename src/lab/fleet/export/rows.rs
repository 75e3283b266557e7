//! Defines the rows of the exported tables.

use std::sync::Arc;

use crate::alarm::Rule;
use crate::cell::LossModes;
use crate::fields::Fields;
use crate::health::RemainingLife;
use crate::monitor::Estimate;
use crate::quantity::Timestamp;

/// An estimate of a cell.
pub(super) struct EstimateRow {
    pub(super) log: Arc<str>,
    pub(super) since_s: f64,
    pub(super) estimate: Estimate,
}

/// A half-cycle of a cell, what was learned from the half-cycle, and the remaining life of the cell.
pub(super) struct HalfCycleRow {
    pub(super) log: Arc<str>,
    pub(super) time: Timestamp,
    pub(super) since_s: f64,
    pub(super) full_cycles: f64,
    /// Values of the event `HalfCycle`.
    pub(super) half: Fields,
    /// Values of the event `Capacity`.
    pub(super) capacity: Fields,
    /// Lithium and active material that the cell has lost; `None` = unknown.
    pub(super) losses: Option<LossModes>,
    /// Remaining life of the cell; `None` = there are not enough data.
    pub(super) remaining: Option<RemainingLife>,
}

/// A change of an alarm.
pub(super) struct AlarmRow {
    pub(super) log: Arc<str>,
    pub(super) time: Timestamp,
    pub(super) since_s: f64,
    pub(super) rule: Rule,
    /// Values of the event `Alarm`.
    pub(super) alarm: Fields,
}
