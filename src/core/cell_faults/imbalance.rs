//! Computes how much charge the pack loses by imbalance and by its weakest cell, and which cells limit the pack.
//!
//! In: each cell's difference from the middle of the pack in SOC, capacity and resistance; SOC and capacity of the
//! middle cell (the robust mean of the cells). Out: [`Imbalance`], in fractions of the mean of the cells' capacities. A
//! charge ends when the first cell is full, a discharge when the first cell is empty. With the SOC s and the capacity C
//! of each cell:
//!
//! ```text
//! usable            = min s C + min (1 - s) C
//! lost by imbalance = min C - usable            recoverable by balancing
//! lost by weakest   = mean C - min C
//! ```
//!
//! Standard deviations are propagated to first order from the states of the limiting cells. Assumptions:
//! * the errors of different cells, and the errors of one cell's SOC and capacity, are independent;
//! * the middle cell's SOC is exact. An error e of this SOC would change `usable` by e times the difference between the
//!   capacities of the two limiting cells.
//!
//! The minimum of many uncertain values tends to lie below the true minimum. If the cells differ by no more than their
//! standard deviations, the losses are therefore overestimated.
//!
//! Cells whose channel is faulty or whose difference is still uncertain are left out. If fewer than three cells, or
//! fewer than half of the cells, remain, the imbalance is unknown.

use serde::Serialize;

use super::detector::{CellFaultDetector, LEAST_CELLS};
use super::difference::{CAPACITY, RESISTANCE, SOC};
use super::fault::CellFaultKind;
use crate::cell::CellModel;
use crate::filter::ScalarGaussian;
use crate::quantity::{CellIndex, Timestamp};

/// If the standard deviation of a cell's SOC or capacity is at least this (fraction), the cell counts as unknown. The
/// two limits are half of the standard deviations with which the filter of the differences starts.
const UNKNOWN_SOC_STD: f64 = 0.025;
const UNKNOWN_CAPACITY_STD: f64 = 0.05;
const OCV_PARTS: u32 = 100;

/// Cost of the differences between cells. All charges are fractions of the mean of the cells' capacities.
#[derive(Debug, Clone, PartialEq)]
pub struct Imbalance {
    /// Time of the last comparison.
    pub time: Timestamp,
    /// Number of compared cells.
    pub cells: usize,
    /// Mean of the cells' capacities (Ah).
    pub mean_ah: ScalarGaussian,
    /// Charge that the pack delivers from the time when its first cell is full until its first cell is empty,
    /// fraction.
    pub usable: ScalarGaussian,
    /// Charge that balancing would recover, fraction.
    pub lost_by_imbalance: ScalarGaussian,
    /// Charge that a balanced pack of equal mean cells would deliver, minus the charge that this pack would deliver
    /// after balancing; fraction.
    pub lost_by_weakest: ScalarGaussian,
    /// The cell with the smallest capacity.
    pub weakest: CellIndex,
    /// The cell that is empty first.
    pub discharge_limit: LimitingCell,
    /// The cell that is full first.
    pub charge_limit: LimitingCell,
    /// Differences of SOC, fraction.
    pub soc: CellSpread,
    /// Differences of capacity, fraction of the middle cell's capacity.
    pub capacity: CellSpread,
    /// Differences of resistance, fraction of the middle cell's resistance.
    pub resistance: CellSpread,
    /// Cells that are not compared, each with the reason.
    pub left_out: Vec<(CellIndex, LeftOut)>,
}

/// The first cell to be full or empty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LimitingCell {
    /// Index of the cell.
    pub cell: CellIndex,
    /// Reason why the cell limits the pack. It belongs to the larger of `by_charge` and `by_capacity`.
    pub reason: LimitReason,
    /// Charge that is missing because the cell's SOC differs from that of the mean cell, fraction of the mean capacity.
    /// The cell that is empty first cannot deliver this charge, and the cell that is full first cannot accept it.
    pub by_charge: f64,
    /// Charge that is missing because the cell's capacity is smaller than that of the mean cell, fraction of the mean
    /// capacity.
    pub by_capacity: f64,
}

/// Reason why a cell limits the pack.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LimitReason {
    /// The cell has less charge than the others when the pack is full.
    LeastCharge,
    /// The cell has more charge than the others when the pack is empty.
    MostCharge,
    /// The cell has less capacity than the others.
    LeastCapacity,
    /// A finding says that the cell leaks.
    Leak,
    /// A finding says that the cell is weak.
    WeakCell,
}

impl LimitReason {
    /// Text for reports.
    pub const fn words(self) -> &'static str {
        match self {
            Self::LeastCharge => "least charge",
            Self::MostCharge => "most charge",
            Self::LeastCapacity => "least capacity",
            Self::Leak => "leak",
            Self::WeakCell => "weak cell",
        }
    }
}

/// Spread of one quantity between the cells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellSpread {
    /// Standard deviation of the cells' estimates.
    pub std: f64,
    /// Root mean square of the standard deviations of the single estimates. If `std` is below this value, the spread is
    /// not significant.
    pub error: f64,
    /// Cell with the lowest value, and the difference of this value from the middle of the pack.
    pub lowest: (CellIndex, f64),
    /// Cell with the highest value, and the difference of this value from the middle of the pack.
    pub highest: (CellIndex, f64),
}

/// Reason why a cell is not compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LeftOut {
    /// The cell's voltage reading is wrong or belongs to another cell.
    FaultyChannel,
    /// The cell's SOC or capacity relative to the others is still uncertain.
    NotKnown,
}

/// Reason why a pack's imbalance is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum UnknownImbalance {
    /// No row (a few minutes of samples) has ended since the start or since a gap of unknown length.
    #[error("the cells have not been compared yet")]
    NotCompared,
    /// Too few cells can be compared.
    #[error("{known} of {cells} cells can be compared, at least {least} are required")]
    TooFewCells {
        /// Number of cells that can be compared.
        known: usize,
        /// Number of cells of the pack.
        cells: usize,
        /// Minimum number of cells required.
        least: usize,
    },
}

impl Imbalance {
    /// Converts a fraction of the cells' mean capacity to Ah.
    pub fn ah(&self, part: ScalarGaussian) -> ScalarGaussian {
        let mean = part.mean * self.mean_ah.mean;
        let variance = part.variance * self.mean_ah.mean * self.mean_ah.mean
            + part.mean * part.mean * self.mean_ah.variance
            + part.variance * self.mean_ah.variance;
        ScalarGaussian { mean, variance }
    }
}

impl CellFaultDetector {
    /// Computes the imbalance. `middle_ah`: capacity of the middle cell (Ah).
    pub fn imbalance(&self, middle_ah: ScalarGaussian) -> Result<Imbalance, UnknownImbalance> {
        let (time, middle_soc) = self.middle_soc().ok_or(UnknownImbalance::NotCompared)?;
        let (mut known, mut left_out) = (Vec::new(), Vec::new());
        for cell in (0..).map(CellIndex) {
            let Some(states) = self.relative(cell) else { break };
            let (Some(soc), Some(capacity), Some(resistance)) = (states[SOC], states[CAPACITY], states[RESISTANCE])
            else {
                continue;
            };
            if self.has_channel_fault(cell) == Some(true) {
                left_out.push((cell, LeftOut::FaultyChannel));
            } else if soc.std() >= UNKNOWN_SOC_STD || capacity.std() >= UNKNOWN_CAPACITY_STD {
                left_out.push((cell, LeftOut::NotKnown));
            } else {
                let has = |kind| self.findings().iter().any(|found| found.kind == kind && found.is_of(cell));
                let (leaks, is_weak) = (has(CellFaultKind::Leak), has(CellFaultKind::WeakCell));
                known.push(ComparedCell { cell, soc, capacity, resistance, middle_soc, leaks, is_weak });
            }
        }
        let cells = known.len() + left_out.len();
        let least = LEAST_CELLS.max(cells.div_ceil(2));
        if known.len() < least {
            return Err(UnknownImbalance::TooFewCells { known: known.len(), cells, least });
        }
        Ok(Imbalance { left_out, ..imbalance(time, &known, middle_ah) })
    }
}

/// Mean open-circuit voltage, between empty and full, of a cell that has aged to `capacity_ah` (V).
pub fn mean_ocv_v(model: &CellModel, capacity_ah: f64) -> f64 {
    let soc = |part: u32| (f64::from(part) + 0.5) / f64::from(OCV_PARTS);
    let ocv_v = |part| model.aged_ocv_v(&model.grid_position(soc(part), 25.0), capacity_ah);
    (0..OCV_PARTS).map(ocv_v).sum::<f64>() / f64::from(OCV_PARTS)
}

#[derive(Debug, Clone, Copy)]
struct ComparedCell {
    cell: CellIndex,
    soc: ScalarGaussian,
    /// Difference in capacity, fraction of the middle cell's capacity.
    capacity: ScalarGaussian,
    /// Difference in resistance, fraction of the middle cell's resistance.
    resistance: ScalarGaussian,
    middle_soc: f64,
    leaks: bool,
    is_weak: bool,
}

impl ComparedCell {
    /// Capacity, fraction of the middle cell's capacity.
    fn capacity(&self) -> f64 {
        1.0 + self.capacity.mean
    }

    fn own_soc(&self) -> f64 {
        self.middle_soc + self.soc.mean
    }

    /// Charge that the cell delivers until it is empty, fraction of the middle cell's capacity.
    fn dischargeable(&self) -> f64 {
        self.own_soc() * self.capacity()
    }

    /// Charge that the cell accepts until it is full, fraction of the middle cell's capacity.
    fn chargeable(&self) -> f64 {
        (1.0 - self.own_soc()) * self.capacity()
    }

    fn reason(&self, by_charge: f64, by_capacity: f64, charge: LimitReason) -> LimitReason {
        match (by_capacity > by_charge, charge) {
            (true, _) if self.is_weak => LimitReason::WeakCell,
            (true, _) => LimitReason::LeastCapacity,
            (false, LimitReason::LeastCharge) if self.leaks => LimitReason::Leak,
            (false, charge) => charge,
        }
    }
}

/// Imbalance of the cells. `cells` must not be empty.
fn imbalance(time: Timestamp, cells: &[ComparedCell], middle_ah: ScalarGaussian) -> Imbalance {
    let mean = |value: fn(&ComparedCell) -> f64| cells.iter().map(value).sum::<f64>() / cells.len() as f64;
    let (mean_capacity, each) = (mean(ComparedCell::capacity), 1.0 / cells.len() as f64);
    let weakest = least(cells, ComparedCell::capacity);
    let (first_empty, first_full) = (least(cells, ComparedCell::dischargeable), least(cells, ComparedCell::chargeable));
    let usable = first_empty.dischargeable() + first_full.chargeable();
    // Derivatives with respect to a cell's SOC and capacity.
    let usable_slopes = |it: &ComparedCell| {
        let (empty, full) = (is(it, first_empty), is(it, first_full));
        [(empty - full) * it.capacity(), empty * it.own_soc() + full * (1.0 - it.own_soc())]
    };
    let lost_slopes = |it: &ComparedCell| {
        let [by_soc, by_capacity] = usable_slopes(it);
        [-by_soc, is(it, weakest) - by_capacity]
    };
    let part = |mean: f64, variance: f64| ScalarGaussian {
        mean: mean / mean_capacity,
        variance: variance / (mean_capacity * mean_capacity),
    };
    // Compared with the mean cell: missing dischargeable charge = missing capacity + excess chargeable charge. The same
    // holds with discharge and charge exchanged.
    let less = |it: &ComparedCell, other_end: fn(&ComparedCell) -> f64, charge| {
        let by_capacity = (mean_capacity - it.capacity()) / mean_capacity;
        let by_charge = (other_end(it) - mean(other_end)) / mean_capacity;
        LimitingCell { cell: it.cell, reason: it.reason(by_charge, by_capacity, charge), by_charge, by_capacity }
    };
    Imbalance {
        time,
        cells: cells.len(),
        mean_ah: ScalarGaussian {
            mean: middle_ah.mean * mean_capacity,
            variance: middle_ah.variance * mean_capacity * mean_capacity,
        },
        usable: part(usable, variance(cells, usable_slopes)),
        lost_by_imbalance: part(weakest.capacity() - usable, variance(cells, lost_slopes)),
        lost_by_weakest: part(mean_capacity - weakest.capacity(), variance(cells, |it| [0.0, each - is(it, weakest)])),
        weakest: weakest.cell,
        discharge_limit: less(first_empty, ComparedCell::chargeable, LimitReason::LeastCharge),
        charge_limit: less(first_full, ComparedCell::dischargeable, LimitReason::MostCharge),
        soc: spread(cells, |it| it.soc),
        capacity: spread(cells, |it| it.capacity),
        resistance: spread(cells, |it| it.resistance),
        left_out: Vec::new(),
    }
}

fn least(cells: &[ComparedCell], value: fn(&ComparedCell) -> f64) -> &ComparedCell {
    cells.iter().fold(&cells[0], |least, it| if value(it) < value(least) { it } else { least })
}

/// 1 if `a` and `b` are the same cell, otherwise 0.
fn is(a: &ComparedCell, b: &ComparedCell) -> f64 {
    f64::from(u8::from(a.cell == b.cell))
}

fn variance(cells: &[ComparedCell], slopes: impl Fn(&ComparedCell) -> [f64; 2]) -> f64 {
    let of_cell = |it: &ComparedCell| {
        let [by_soc, by_capacity] = slopes(it);
        by_soc * by_soc * it.soc.variance + by_capacity * by_capacity * it.capacity.variance
    };
    cells.iter().map(of_cell).sum()
}

fn spread(cells: &[ComparedCell], state: fn(&ComparedCell) -> ScalarGaussian) -> CellSpread {
    let count = cells.len() as f64;
    let mean = cells.iter().map(|it| state(it).mean).sum::<f64>() / count;
    let squares: f64 = cells.iter().map(|it| (state(it).mean - mean).powi(2)).sum();
    let errors: f64 = cells.iter().map(|it| state(it).variance).sum();
    let by_value = |a: &&ComparedCell, b: &&ComparedCell| state(a).mean.total_cmp(&state(b).mean);
    let shown = |it: Option<&ComparedCell>| it.map_or((CellIndex(0), mean), |it| (it.cell, state(it).mean));
    CellSpread {
        std: (squares / (count - 1.0).max(1.0)).sqrt(),
        error: (errors / count).sqrt(),
        lowest: shown(cells.iter().min_by(by_value)),
        highest: shown(cells.iter().max_by(by_value)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;

    const MIDDLE_AH: ScalarGaussian = ScalarGaussian { mean: 50.0, variance: 1.0 };

    /// Ten cells; the middle cell has the SOC 0.6. `others`: cell, difference in SOC, difference in capacity
    /// (fractions).
    fn pack(others: &[(u16, f64, f64)]) -> Vec<ComparedCell> {
        let known = |mean, std| ScalarGaussian::from_std(mean, std);
        let cell = |cell| {
            let (_, soc, capacity) = others.iter().copied().find(|it| it.0 == cell).unwrap_or((cell, 0.0, 0.0));
            ComparedCell {
                cell: CellIndex(cell),
                soc: known(soc, 0.003),
                capacity: known(capacity, 0.006),
                resistance: known(0.0, 0.04),
                middle_soc: 0.6,
                leaks: false,
                is_weak: false,
            }
        };
        (0..10).map(cell).collect()
    }

    fn of(cells: &[ComparedCell]) -> Imbalance {
        imbalance(Timestamp::ZERO, cells, MIDDLE_AH)
    }

    fn assert_near(found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-12, "{found}, not {expected}");
    }

    #[test]
    fn balanced_pack_of_equal_cells_loses_nothing() {
        let found = of(&pack(&[]));
        assert_near(found.usable.mean, 1.0);
        assert_near(found.lost_by_imbalance.mean, 0.0);
        assert_near(found.lost_by_weakest.mean, 0.0);
        assert_eq!((found.cells, found.soc.std), (10, 0.0));
        assert_near(found.soc.error, 0.003);
    }

    #[test]
    fn cell_with_least_charge_limits_discharge() {
        // The pack delivers 0.55 until cell 3 is empty, and accepts 0.4 until the other cells are full.
        let found = of(&pack(&[(3, -0.05, 0.0)]));
        assert_near(found.usable.mean, 0.95);
        assert_near(found.lost_by_imbalance.mean, 0.05);
        assert_near(found.lost_by_weakest.mean, 0.0);
        // The variance comes from cell 3 and from the first full cell. The errors of their SOC have the weight 1, and
        // the errors of their capacity have the weights 0.55 and 0.4.
        let expected: f64 = 2.0 * 0.003f64.powi(2) + (0.55f64.powi(2) + 0.4f64.powi(2)) * 0.006f64.powi(2);
        assert_near(found.usable.variance, expected);
        let LimitingCell { cell, reason, by_charge, by_capacity } = found.discharge_limit;
        assert_eq!((cell, reason), (CellIndex(3), LimitReason::LeastCharge));
        assert_near(by_charge, 0.05 - 0.005);
        assert_near(by_capacity, 0.0);
        assert_eq!(found.soc.lowest, (CellIndex(3), -0.05));
    }

    #[test]
    fn weak_cell_full_with_others_loses_nothing_by_imbalance() {
        // Cell 3 has the capacity 0.9 and accepts 0.4 like the other cells, so its SOC is 1 - 0.4 / 0.9 = 5 / 9.
        let found = of(&pack(&[(3, 5.0 / 9.0 - 0.6, -0.1)]));
        assert_near(found.usable.mean, 0.9 / 0.99);
        assert_near(found.lost_by_imbalance.mean, 0.0);
        assert_near(found.lost_by_weakest.mean, 0.09 / 0.99);
        assert_eq!((found.weakest, found.discharge_limit.cell), (CellIndex(3), CellIndex(3)));
        assert_eq!(found.discharge_limit.reason, LimitReason::LeastCapacity);
    }

    #[test]
    fn limit_reason_is_larger_cause_or_finding() {
        // Capacity 0.9, and SOC 0.05 below the balanced value: the cell delivers 0.9 * (5/9 - 0.05) and the pack
        // accepts 0.4.
        let mut cells = pack(&[(3, 5.0 / 9.0 - 0.6 - 0.05, -0.1)]);
        let found = of(&cells);
        assert_near(found.usable.mean, (0.5 - 0.045 + 0.4) / 0.99);
        assert_near(found.lost_by_imbalance.mean, 0.045 / 0.99);
        assert_eq!(found.discharge_limit.reason, LimitReason::LeastCapacity);
        cells[3].is_weak = true;
        assert_eq!(of(&cells).discharge_limit.reason, LimitReason::WeakCell);
        let mut cells = pack(&[(3, -0.2, -0.05)]);
        assert_eq!(of(&cells).discharge_limit.reason, LimitReason::LeastCharge);
        cells[3].leaks = true;
        assert_eq!(of(&cells).discharge_limit.reason, LimitReason::Leak);
    }

    #[test]
    fn cell_with_most_charge_limits_charge() {
        let found = of(&pack(&[(7, 0.04, 0.0)]));
        assert_near(found.lost_by_imbalance.mean, 0.04);
        assert_eq!((found.charge_limit.cell, found.charge_limit.reason), (CellIndex(7), LimitReason::MostCharge));
        // A weak cell that becomes empty together with the other cells is full first.
        let found = of(&pack(&[(7, 0.6 / 0.9 - 0.6, -0.1)]));
        assert_near(found.lost_by_imbalance.mean, 0.0);
        assert_eq!((found.charge_limit.cell, found.charge_limit.reason), (CellIndex(7), LimitReason::LeastCapacity));
    }

    #[test]
    fn charge_in_ah_includes_capacity_deviation() {
        let found = of(&pack(&[(3, -0.05, 0.0)]));
        let lost = found.ah(found.lost_by_imbalance);
        assert_near(lost.mean, 2.5);
        assert!(lost.std() > 50.0 * found.lost_by_imbalance.std());
        assert!((mean_ocv_v(&small_model(), 2.0) - 3.6).abs() < 0.1, "{}", mean_ocv_v(&small_model(), 2.0));
    }

    #[test]
    fn imbalance_without_rows_is_unknown() {
        assert_eq!(CellFaultDetector::new(2).imbalance(MIDDLE_AH), Err(UnknownImbalance::NotCompared));
        assert_eq!(CellFaultDetector::new(12).imbalance(MIDDLE_AH), Err(UnknownImbalance::NotCompared));
    }
}
