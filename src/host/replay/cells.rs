//! The cells at the end of a replay, for its summary.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::monitor::{Estimate, Monitor};
use crate::quantity::CellIndex;

/// A cell at the end.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CellSummary {
    /// Counted from 0.
    pub cell: u16,
    /// Fraction.
    pub soc: f64,
    /// Fraction.
    pub soc_std: f64,
    /// Ah.
    pub capacity_ah: f64,
    /// Ah.
    pub capacity_std_ah: f64,
    /// Ah, after the last capacity update; `None` = unknown.
    pub usable_capacity_ah: Option<f64>,
    /// Ah.
    pub usable_capacity_std_ah: Option<f64>,
    /// Relative to new.
    pub resistance_ratio: f64,
    /// Relative to new.
    pub resistance_ratio_std: f64,
}

/// The latest estimate of every cell that has one, with its usable capacity.
pub(super) fn summaries(
    monitor: &Monitor,
    usable: &BTreeMap<CellIndex, (Option<f64>, Option<f64>)>,
) -> Vec<CellSummary> {
    let of = |estimate: Estimate| {
        let (usable_capacity_ah, usable_capacity_std_ah) = usable.get(&estimate.cell).copied().unwrap_or_default();
        CellSummary {
            cell: estimate.cell.0,
            soc: estimate.soc,
            soc_std: estimate.soc_std,
            capacity_ah: estimate.capacity_ah,
            capacity_std_ah: estimate.capacity_std_ah,
            usable_capacity_ah,
            usable_capacity_std_ah,
            resistance_ratio: estimate.resistance_ratio,
            resistance_ratio_std: estimate.resistance_ratio_std,
        }
    };
    monitor.latest().flatten().map(of).collect()
}
