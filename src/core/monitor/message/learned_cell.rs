//! What a history has kept of one cell: it comes in where the state of the last run is lost.

use crate::filter::ScalarGaussian;
use crate::quantity::CellIndex;

/// What a history has kept of one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearnedCell {
    /// The cell.
    pub cell: CellIndex,
    /// Capacity, Ah.
    pub capacity: ScalarGaussian,
    /// Usable capacity, Ah.
    pub usable: Option<ScalarGaussian>,
    /// Resistance relative to new.
    pub resistance: Option<ScalarGaussian>,
}
