//! Learned values of one cell from a history. These values replace a lost stored state.

use crate::filter::ScalarGaussian;
use crate::quantity::CellIndex;

/// Learned values of one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearnedCell {
    pub cell: CellIndex,
    /// Capacity (Ah).
    pub capacity: ScalarGaussian,
    /// Usable capacity (Ah).
    pub usable: Option<ScalarGaussian>,
    /// Resistance relative to the resistance of a new cell.
    pub resistance: Option<ScalarGaussian>,
}
