//! Selects random windows: the monitor receives only the rows in one window of each part of a file, as in a vehicle
//! that starts and stops at any time. A part is usually a half-cycle.
//!
//! The window covers a share of the charge that the part moves (|current| times time). A share of the time would mostly
//! cover the long end of a charge, in which the charger reduces the current. Share and position are uniformly
//! distributed. Rows outside the window are dropped, so the monitor receives a gap.

use std::ops::Range;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::measured::MeasuredPart;

/// Returns the rows in the window of part number `index`: at least one row, unless the part is empty. Without current,
/// the window is the whole part.
pub(super) fn rows(part: &MeasuredPart, index: usize, seed: u64, (least, most): (f64, f64)) -> Range<usize> {
    let moved = moved_as(part);
    let total = moved.last().copied().unwrap_or(0.0);
    if total <= 0.0 {
        return 0..part.len();
    }
    let mut generator = ChaCha8Rng::seed_from_u64(seed);
    // Each part has its own random stream, so its window depends only on the seed and on its number.
    generator.set_stream(index as u64);
    let share = least + (most - least) * uniform(&mut generator);
    let begin = (1.0 - share) * uniform(&mut generator);
    let first = moved.partition_point(|&charge| charge < begin * total).min(part.len() - 1);
    let end = moved.partition_point(|&charge| charge <= (begin + share) * total);
    first..end.max(first + 1)
}

/// Returns the charge moved up to each row (As), both directions added.
fn moved_as(part: &MeasuredPart) -> Vec<f64> {
    let mut total = 0.0;
    let mut before_s = part.time_s.first().copied().unwrap_or(0.0);
    let mut step = |(&time_s, &current_a): (&f64, &f64)| {
        if current_a.is_finite() {
            total += current_a.abs() * (time_s - before_s).max(0.0);
        }
        before_s = time_s;
        total
    };
    part.time_s.iter().zip(&part.current_a).map(&mut step).collect()
}

fn uniform(generator: &mut ChaCha8Rng) -> f64 {
    let unit = 1.0 / (1_u64 << 53) as f64;
    (generator.next_u64() >> 11) as f64 * unit
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates 1000 s at 2 A, then 1000 s of rest.
    fn part() -> MeasuredPart {
        let time_s: Vec<f64> = (0..=2000).map(f64::from).collect();
        let current_a = time_s.iter().map(|&t| if t <= 1000.0 { 2.0 } else { 0.0 }).collect();
        MeasuredPart { time_s, current_a, ..MeasuredPart::default() }
    }

    #[test]
    fn windows_cover_the_requested_share_anywhere() {
        let mut begins = Vec::new();
        for index in 0..400 {
            let rows = rows(&part(), index, 7, (0.4, 0.7));
            let share = (rows.len() - 1) as f64 / 1000.0;
            assert!((0.395..0.705).contains(&share), "{share}");
            begins.push(rows.start);
        }
        assert!(begins.iter().any(|&b| b < 30) && begins.iter().any(|&b| b > 500), "windows do not move");
    }

    #[test]
    fn seed_determines_the_windows() {
        let of = |seed: u64| (0..20).map(|index| rows(&part(), index, seed, (0.4, 0.7))).collect::<Vec<_>>();
        assert_eq!(of(1), of(1));
        assert_ne!(of(1), of(2));
    }

    #[test]
    fn part_without_current_is_visible_whole() {
        let rest = MeasuredPart { time_s: vec![0.0, 1.0], current_a: vec![0.0, f64::NAN], ..MeasuredPart::default() };
        assert_eq!(rows(&rest, 0, 1, (0.4, 0.7)), 0..2);
        assert_eq!(rows(&MeasuredPart::default(), 0, 1, (0.4, 0.7)), 0..0);
    }
}
