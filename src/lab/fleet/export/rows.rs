//! Rows of the exported tables, and what they take from the core's events.

use std::sync::Arc;

use crate::alarm::{AlarmState, Change, Rule, Severity};
use crate::health::RemainingLife;
use crate::monitor::{Estimate, EventKind};
use crate::quantity::{CellIndex, Mode, Timestamp};

/// An estimate of a cell.
pub(super) struct EstimateRow {
    pub(super) log: Arc<str>,
    pub(super) since_s: f64,
    pub(super) estimate: Estimate,
}

/// A half-cycle of a cell, what was learned from it, and what remained of the cell's life after it.
pub(super) struct HalfCycleRow {
    pub(super) log: Arc<str>,
    pub(super) time: Timestamp,
    pub(super) since_s: f64,
    pub(super) full_cycles: f64,
    pub(super) half: HalfCycle,
    pub(super) learned: Learned,
    /// `None` = too little was known.
    pub(super) remaining: Option<RemainingLife>,
}

/// Something that became of an alarm.
pub(super) struct AlarmRow {
    pub(super) log: Arc<str>,
    pub(super) time: Timestamp,
    pub(super) since_s: f64,
    pub(super) alarm: Alarm,
}

/// As [`EventKind::HalfCycle`].
pub(super) struct HalfCycle {
    pub(super) cell: CellIndex,
    pub(super) mode: Mode,
    pub(super) charge_ah: f64,
    pub(super) swing: Option<f64>,
    pub(super) swing_std: Option<f64>,
    pub(super) duration_s: f64,
    pub(super) mean_current_a: f64,
    pub(super) mean_temperature_c: Option<f64>,
}

impl HalfCycle {
    /// `None` = another event.
    pub(super) fn of(kind: &EventKind) -> Option<Self> {
        let EventKind::HalfCycle {
            cell,
            mode,
            charge_ah,
            swing,
            swing_std,
            duration_s,
            mean_current_a,
            mean_temperature_c,
        } = *kind
        else {
            return None;
        };
        Some(Self { cell, mode, charge_ah, swing, swing_std, duration_s, mean_current_a, mean_temperature_c })
    }
}

/// As [`EventKind::Capacity`].
pub(super) struct Learned {
    pub(super) measured_ah: Option<f64>,
    pub(super) measured_std_ah: Option<f64>,
    pub(super) capacity_ah: f64,
    pub(super) capacity_std_ah: f64,
    pub(super) usable_capacity_ah: Option<f64>,
    pub(super) usable_capacity_std_ah: Option<f64>,
    pub(super) resistance_ratio: f64,
    pub(super) resistance_ratio_std: f64,
}

impl Learned {
    /// Of which cell, and what; `None` = another event.
    pub(super) fn of(kind: &EventKind) -> Option<(CellIndex, Self)> {
        let EventKind::Capacity {
            cell,
            measured_ah,
            measured_std_ah,
            capacity_ah,
            capacity_std_ah,
            usable_capacity_ah,
            usable_capacity_std_ah,
            resistance_ratio,
            resistance_ratio_std,
        } = *kind
        else {
            return None;
        };
        let learned = Self {
            measured_ah,
            measured_std_ah,
            capacity_ah,
            capacity_std_ah,
            usable_capacity_ah,
            usable_capacity_std_ah,
            resistance_ratio,
            resistance_ratio_std,
        };
        Some((cell, learned))
    }
}

/// As [`EventKind::Alarm`].
pub(super) struct Alarm {
    pub(super) rule: Rule,
    /// `None` = the pack.
    pub(super) cell: Option<CellIndex>,
    pub(super) change: Change,
    pub(super) state: AlarmState,
    pub(super) active: bool,
    pub(super) severity: Severity,
    pub(super) value: Option<f64>,
    pub(super) probability: Option<f64>,
    pub(super) threshold: f64,
    pub(super) occurrences: u32,
    pub(super) acknowledged: bool,
}

impl Alarm {
    /// `None` = another event.
    pub(super) fn of(kind: &EventKind) -> Option<Self> {
        let EventKind::Alarm {
            rule,
            cell,
            change,
            state,
            active,
            severity,
            value,
            probability,
            threshold,
            occurrences,
            acknowledged,
        } = *kind
        else {
            return None;
        };
        Some(Self {
            rule,
            cell,
            change,
            state,
            active,
            severity,
            value,
            probability,
            threshold,
            occurrences,
            acknowledged,
        })
    }
}
