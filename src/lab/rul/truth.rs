//! Finds the end of a cell's life: the use (cycles or days) at which the isotonic (non-increasing least-squares) fit of
//! the capacities falls below the threshold.

use super::History;

/// Returns the use at which the fit falls below the threshold; `None` = the fit never falls below the threshold, or
/// starts below it. The use lies between two readings: the first reading at which the fit is below the threshold, and
/// the reading before it. If the threshold lies between their measured capacities, the use is interpolated. Otherwise,
/// returns the use of the later reading.
pub fn end_of_life(history: &History, threshold_ah: f64) -> Option<f64> {
    let capacities: Vec<f64> = history.rows.iter().map(|row| row.capacity_ah).collect();
    let line = non_increasing(&capacities);
    let index = line.iter().position(|&fitted| fitted < threshold_ah)?;
    let [before, after] = [history.rows.get(index.checked_sub(1)?)?, history.rows.get(index)?];
    let drop = before.capacity_ah - after.capacity_ah;
    if before.capacity_ah < threshold_ah || after.capacity_ah >= threshold_ah || drop <= 0.0 {
        return Some(after.used);
    }
    Some(before.used + (after.used - before.used) * (before.capacity_ah - threshold_ah) / drop)
}

/// Returns the non-increasing sequence with the smallest sum of squared differences. Rising neighbours are replaced by
/// their mean.
fn non_increasing(values: &[f64]) -> Vec<f64> {
    let mut blocks: Vec<(f64, usize)> = Vec::with_capacity(values.len());
    for &value in values {
        let mut block = (value, 1);
        while let Some(&(mean, count)) = blocks.last()
            && mean < block.0
        {
            let all = count + block.1;
            block = ((mean * count as f64 + block.0 * block.1 as f64) / all as f64, all);
            blocks.pop();
        }
        blocks.push(block);
    }
    blocks.into_iter().flat_map(|(mean, count)| std::iter::repeat_n(mean, count)).collect()
}

#[cfg(test)]
mod tests {
    use super::super::MeasuredCapacity;
    use super::*;
    use crate::health::Axis;

    fn history(capacities: &[f64]) -> History {
        let row = |(index, &capacity_ah): (u32, &f64)| MeasuredCapacity {
            used: f64::from(index),
            capacity_ah,
            ..MeasuredCapacity::default()
        };
        History { axis: Axis::Cycles, rows: (0..).zip(capacities).map(row).collect() }
    }

    #[test]
    fn end_is_interpolated_between_readings() {
        assert_eq!(end_of_life(&history(&[2.0, 1.8, 1.6, 1.2]), 1.5), Some(2.25));
        assert_eq!(end_of_life(&history(&[2.0, 1.8, 1.6]), 1.5), None);
        assert_eq!(end_of_life(&history(&[1.4, 1.3]), 1.5), None);
    }

    #[test]
    fn temporary_dip_or_recovery_does_not_move_the_end() {
        assert_eq!(end_of_life(&history(&[2.0, 1.45, 1.8, 1.7, 1.6, 1.4]), 1.5), Some(4.5));
        assert_eq!(end_of_life(&history(&[2.0, 1.6, 1.4, 1.3, 1.52, 1.2]), 1.5), Some(1.5));
    }

    #[test]
    fn rising_neighbours_are_replaced_by_their_mean() {
        assert_eq!(non_increasing(&[3.0, 1.0, 2.0, 0.5]), [3.0, 1.5, 1.5, 0.5]);
        assert_eq!(non_increasing(&[1.0, 2.0, 3.0]), [2.0; 3]);
    }
}
