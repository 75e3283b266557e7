//! Present values of cells and pack for status, tables and reports. `None` = not known yet, or no longer known.

use serde::{Deserialize, Serialize};

use super::event::ModelState;
use super::outputs::Validity;
use crate::cell::Chemistry;
use crate::health::UseRecord;
use crate::monitor::stage::learning::moved::MovedSums;
use crate::quantity::catalogue::{CellValues, PackValues};
use crate::quantity::{CellIndex, Mode};

/// Present values of one cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellView {
    pub cell: CellIndex,
    /// Values of the cell. Measured values are known while their readings are fresh. State of charge and resistance are
    /// known while the voltage is fresh. Learned values are known after the first half-cycle that measured the
    /// capacity.
    #[serde(flatten)]
    pub values: CellValues,
    /// Reason why the remaining life is unknown.
    #[serde(default)]
    pub remaining_unknown: Option<String>,
    /// Whether the cell's estimate is trusted; `None` while its SOC is unknown.
    pub trusted: Option<bool>,
}

/// Present values of the pack.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PackView {
    pub validity: Validity,
    pub mode: Mode,
    /// The cell that is empty first.
    pub limiting_cell: Option<CellIndex>,
    /// The cell that limits the 10 s discharge power, and the cell that limits the 10 s charge power.
    #[serde(default)]
    pub power_limiting_cells: Option<[CellIndex; 2]>,
    /// The cell with the lowest capacity, once every cell's capacity has been learned.
    pub weakest_cell: Option<CellIndex>,
    /// The cell with the shortest remaining life, once every cell's remaining life is known.
    #[serde(default)]
    pub shortest_lived_cell: Option<CellIndex>,
    /// State of the cell model; `None` in documents of earlier versions.
    #[serde(default)]
    pub model_state: Option<ModelState>,
    /// The chemistry that explains the voltages better than the label's chemistry.
    #[serde(default)]
    pub model_fits_better: Option<Chemistry>,
    /// Charge and energy that moved through the pack while the program ran; `None` in documents of earlier versions.
    #[serde(default)]
    pub moved: Option<MovedSums>,
    /// Counters of how the pack was used while the program ran; `None` in documents of earlier versions.
    #[serde(default)]
    pub use_record: Option<UseRecord>,
    #[serde(flatten)]
    pub values: PackValues,
}
