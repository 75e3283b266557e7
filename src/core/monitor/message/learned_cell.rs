//! Learned values of one cell from a history, used if the state of the last run is lost.

use crate::filter::ScalarGaussian;
use crate::quantity::CellIndex;

/// Learned values of one cell from a history.
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
