//! Computes series over the life of a pack: the worst cell and the range over all cells after every half-cycle (a
//! charge or a discharge).

use super::data::{CapacityRecord, Data};
use crate::filter::ends;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CellStep {
    pub(super) time_s: f64,
    pub(super) cell: usize,
    /// Mean and standard deviation of the worst cell.
    pub(super) worst: (f64, f64),
    /// Lowest and highest mean over the cells.
    pub(super) range: (f64, f64),
}

/// Selects a value of a row: mean and standard deviation.
pub(super) type ValueSelector = fn(&CapacityRecord) -> Option<(f64, f64)>;

pub(super) fn capacity(row: &CapacityRecord) -> Option<(f64, f64)> {
    Some(row.capacity_ah).filter(|value| value.0.is_finite())
}

pub(super) fn usable(row: &CapacityRecord) -> Option<(f64, f64)> {
    row.usable_ah.filter(|value| value.0.is_finite())
}

/// Lithium lost, percent.
pub(super) fn lithium_lost(row: &CapacityRecord) -> Option<(f64, f64)> {
    row.losses.map(|losses| percent(losses[0]))
}

pub(super) fn negative_lost(row: &CapacityRecord) -> Option<(f64, f64)> {
    row.losses.map(|losses| percent(losses[1]))
}

pub(super) fn positive_lost(row: &CapacityRecord) -> Option<(f64, f64)> {
    row.losses.map(|losses| percent(losses[2]))
}

fn percent((mean, std): (f64, f64)) -> (f64, f64) {
    (100.0 * mean, 100.0 * std)
}

pub(super) fn resistance(row: &CapacityRecord) -> Option<(f64, f64)> {
    Some(row.resistance).filter(|value| value.0.is_finite())
}

/// Returns the worst cell after every half-cycle: the cell with the lowest value, or with the highest if `high_is_bad`.
/// A cell keeps its value until its next value is known.
pub(super) fn steps(data: &Data, pick: ValueSelector, high_is_bad: bool) -> Vec<CellStep> {
    let mut cells: Vec<Option<(f64, f64)>> = vec![None; data.cells()];
    let mut steps = Vec::new();
    for rows in data.learned.chunk_by(|a, b| a.time_s == b.time_s) {
        for row in rows {
            if let (Some(cell), Some(value)) = (cells.get_mut(row.cell), pick(row)) {
                *cell = Some(value);
            }
        }
        let known = || cells.iter().enumerate().filter_map(|(cell, value)| Some((cell, (*value)?)));
        let by_mean = |a: &(usize, (f64, f64)), b: &(usize, (f64, f64))| a.1.0.total_cmp(&b.1.0);
        if let (Some(low), Some(high)) = (known().min_by(by_mean), known().max_by(by_mean)) {
            let (cell, worst) = if high_is_bad { high } else { low };
            steps.push(CellStep { time_s: rows[0].time_s, cell, worst, range: (low.1.0, high.1.0) });
        }
    }
    steps
}

pub(super) fn temperatures(data: &Data) -> Vec<(f64, f64, f64)> {
    let rows = data.halves.chunk_by(|a, b| a.time_s == b.time_s);
    rows.filter_map(|rows| {
        let (low, high) = ends(rows.iter().filter_map(|row| row.mean_temperature_c));
        (low <= high).then_some((rows[0].time_s, low, high))
    })
    .collect()
}

/// Returns the equivalent full cycles of the most used cell: charge moved divided by twice the rated capacity. If the
/// rated capacity is unknown, the first learned capacity replaces it.
pub(super) fn full_cycles(data: &Data, rated_ah: Option<f64>) -> Option<f64> {
    let mut moved_ah = vec![0.0; data.cells()];
    data.halves.iter().for_each(|half| moved_ah[half.cell] += half.charge_ah.max(0.0));
    let full_ah = rated_ah.or_else(|| data.learned.first().map(|row| row.capacity_ah.0))?;
    let cycles = moved_ah.iter().map(|moved| moved / (2.0 * full_ah));
    cycles.filter(|cycles| cycles.is_finite()).reduce(f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Origin;

    fn pack() -> Data {
        let mut data = Data::new(Origin::Store);
        for (time_s, cell, ah) in [(10.0, 0, 2.0), (10.0, 1, 1.9), (20.0, 1, 2.1), (30.0, 0, 1.5)] {
            data.learned.push(CapacityRecord {
                time_s,
                cell,
                measured_ah: None,
                measured_std_ah: None,
                capacity_ah: (ah, 0.01),
                usable_ah: None,
                losses: None,
                resistance: (1.0, 0.1),
            });
        }
        data
    }

    #[test]
    fn weakest_cell_is_followed_and_values_are_held() {
        let steps = steps(&pack(), capacity, false);
        let seen: Vec<_> = steps.iter().map(|step| (step.cell, step.worst.0, step.range.1)).collect();
        assert_eq!(seen, [(1, 1.9, 2.0), (0, 2.0, 2.1), (0, 1.5, 2.1)]);
        assert!(super::steps(&pack(), usable, false).is_empty());
    }
}
