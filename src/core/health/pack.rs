//! Computes the pack's values from its limiting cells, never from the mean of the cells.
//!
//! A series pack stops discharging when its weakest cell is empty and stops charging when its fullest cell is full.
//! * dischargeable charge = min_i SOC_i C_i
//! * chargeable charge = min_i (1 - SOC_i) C_i
//! * pack capacity = dischargeable + chargeable charge
//! * pack SOC = dischargeable charge / pack capacity
//!
//! For a pack of one cell, these are the values of that cell. Without cells or without capacity, the pack has no
//! values.

use serde::{Deserialize, Serialize};

use crate::filter::ScalarGaussian;
use crate::quantity::bounds;
use crate::quantity::{CellIndex, InvalidState};

/// One cell's contribution to the pack.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellShare {
    pub cell: CellIndex,
    /// State of charge, fraction.
    pub soc: ScalarGaussian,
    /// Capacity (Ah).
    pub capacity: ScalarGaussian,
}

/// Values of the pack, set by its limiting cells.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PackState {
    /// State of charge, fraction.
    pub soc: f64,
    /// Standard deviation of the limiting cell's SOC.
    pub soc_std: f64,
    /// Charge that the pack delivers if the discharge starts when the fullest cell is full and ends when the weakest
    /// cell is empty (Ah).
    pub capacity_ah: f64,
    /// Standard deviation of the limiting cell's capacity (Ah).
    pub capacity_std_ah: f64,
    /// The cell that is empty first.
    pub limiting_cell: CellIndex,
}

/// Combines the cells. Returns `None` without cells, or if the pack has no capacity because one cell is full while
/// another is empty.
pub fn combine(cells: impl Iterator<Item = CellShare>) -> Option<PackState> {
    let mut weakest: Option<(f64, CellShare)> = None;
    let mut chargeable_ah = f64::INFINITY;
    for share in cells {
        let dischargeable_ah = share.soc.mean * share.capacity.mean;
        chargeable_ah = chargeable_ah.min((1.0 - share.soc.mean) * share.capacity.mean);
        if weakest.is_none_or(|(least, _)| dischargeable_ah < least) {
            weakest = Some((dischargeable_ah, share));
        }
    }
    let (dischargeable_ah, limiting) = weakest?;
    let capacity_ah = dischargeable_ah + chargeable_ah;
    (capacity_ah > 0.0).then_some(PackState {
        soc: dischargeable_ah / capacity_ah,
        soc_std: limiting.soc.std(),
        capacity_ah,
        capacity_std_ah: limiting.capacity.std(),
        limiting_cell: limiting.cell,
    })
}

impl PackState {
    /// Checks the numbers of a stored state.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        bounds::STORED_SOC.check("the pack's SOC", self.soc)?;
        // The capacity is close to 0 while one cell is almost full and another is almost empty.
        let capacity_ah = self.capacity_ah;
        let is_possible = (0.0..=bounds::CAPACITY_AH.high).contains(&capacity_ah);
        InvalidState::unless(is_possible, "the pack's capacity", capacity_ah, "0 to 1e9 Ah")?;
        let natural = [self.soc_std, self.capacity_std_ah];
        InvalidState::unless_naturals("a deviation of the pack's values", natural)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn share(cell: u16, soc: f64, capacity_ah: f64) -> CellShare {
        let (soc, capacity) = (ScalarGaussian::from_std(soc, 0.01), ScalarGaussian::from_std(capacity_ah, 0.05));
        CellShare { cell: CellIndex(cell), soc, capacity }
    }

    #[test]
    fn pack_of_one_cell_has_cell_values() {
        let pack = combine([share(0, 0.4, 2.5)].into_iter()).expect("one cell");
        assert!((pack.soc - 0.4).abs() < 1e-15);
        assert!((pack.capacity_ah - 2.5).abs() < 1e-15);
    }

    #[test]
    fn weakest_cell_limits_discharge_and_fullest_limits_charge() {
        // Cell 1 has 1.0 Ah left, and cell 0 accepts only 0.5 Ah. The pack therefore has 1.5 Ah and a SOC of 2/3.
        let pack = combine([share(0, 0.8, 2.5), share(1, 0.4, 2.5)].into_iter()).expect("two cells");
        assert!((pack.capacity_ah - 1.5).abs() < 1e-12);
        assert!((pack.soc - 1.0 / 1.5).abs() < 1e-12);
        assert_eq!(pack.limiting_cell, CellIndex(1));
    }

    #[test]
    fn combine_without_cells_returns_none() {
        assert_eq!(combine(std::iter::empty()), None);
    }
}
