//! The present values of cells and pack, for readers: status, tables, reports. `None` = not known (any more).

use serde::{Deserialize, Serialize};

use super::event::ModelState;
use super::outputs::Validity;
use crate::cell::Chemistry;
use crate::quantity::catalogue::{CellValues, PackValues};
use crate::quantity::{CellIndex, Mode};

/// One cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellView {
    /// Its number.
    pub cell: CellIndex,
    /// Its values. Measured ones are known while their readings are fresh, the state of charge and the resistance while the voltage
    /// is, learned ones once a half-cycle taught something.
    #[serde(flatten)]
    pub values: CellValues,
    /// Why the remaining life is not known.
    #[serde(default)]
    pub remaining_unknown: Option<String>,
    /// Whether its innovations agree with their covariance; `None` while there is no SOC.
    pub trusted: Option<bool>,
}

/// The pack, as its limiting cells determine it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PackView {
    /// Validity of the estimates.
    pub validity: Validity,
    /// Charge, rest or discharge.
    pub mode: Mode,
    /// The cell that ends a discharge.
    pub limiting_cell: Option<CellIndex>,
    /// The cell with the least capacity, once the capacity of every cell was learned.
    pub weakest_cell: Option<CellIndex>,
    /// The cell whose life ends first, once the remaining life of every cell is known.
    #[serde(default)]
    pub shortest_lived_cell: Option<CellIndex>,
    /// How well the model of the cells is known; `None` in documents of earlier programs.
    #[serde(default)]
    pub model_state: Option<ModelState>,
    /// The chemistry that explains the voltages better than that on the label.
    #[serde(default)]
    pub model_fits_better: Option<Chemistry>,
    /// Its values.
    #[serde(flatten)]
    pub values: PackValues,
}
