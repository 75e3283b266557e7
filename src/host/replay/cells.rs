//! Collects the state of the cells at the end of a replay, for the replay's summary.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::monitor::{Estimate, Monitor};
use crate::quantity::CellIndex;
use crate::quantity::catalogue::{Quantity, RecordedValues};

/// State of a cell at the end of a replay.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CellSummary {
    /// Cell, counted from 0.
    pub cell: u16,
    /// SOC, fraction.
    pub soc: f64,
    /// Standard deviation of the SOC, fraction.
    pub soc_std: f64,
    /// Capacity and resistance (relative to a new cell) of the latest estimate, and the usable capacity after the last
    /// capacity update.
    #[serde(flatten)]
    pub values: RecordedValues,
}

/// The latest estimate of each cell (if it has one), combined with the cell's last learned values.
pub(super) fn summaries(monitor: &Monitor, learned: &BTreeMap<CellIndex, RecordedValues>) -> Vec<CellSummary> {
    let of = |estimate: Estimate| {
        let learned = learned.get(&estimate.cell).copied().unwrap_or_default();
        CellSummary {
            cell: estimate.cell.0,
            soc: estimate.soc,
            soc_std: estimate.soc_std,
            values: learned
                .with(Quantity::Capacity, Some((estimate.capacity_ah, estimate.capacity_std_ah)))
                .with(Quantity::ResistanceRatio, Some((estimate.resistance_ratio, estimate.resistance_ratio_std))),
        }
    };
    monitor.latest().flatten().map(of).collect()
}
