//! Calibrates the local width of an interval on forecasts with known errors. The window of a forecast contains the row
//! and the preceding rows from which the forecast is made. If the error of the forecast is known, its window is called
//! a judged window.
//!
//! The errors of a cell's voltage are tiny during a charge at constant voltage and large at the end of a discharge. A
//! single width would be too wide in the charge and too narrow at the end of the discharge. The width is therefore
//! computed in three steps:
//!
//! * ratio = |error| / standard deviation, for every judged window.
//! * spread of a window = (sum of the ratios of its n nearest judged windows + k m) / ((n + k) m), where m is the mean
//!   of all ratios and k is [`SHRINKAGE`].
//! * factor = 95 % quantile of ratio / spread over all judged windows. Here the spread of a judged window excludes the
//!   window itself and the windows that overlap it.
//!
//! Half the width of the interval at a window is factor x spread x standard deviation.

use crate::regress::GAUSSIAN;

/// Number of nearest judged windows (n) that determine the spread of a window.
const NEAR: usize = 20;
/// Weight of the mean of all ratios relative to one window.
const SHRINKAGE: f64 = 4.0;
/// With fewer judged windows, all windows have the same spread, and the interval is at least as wide as that of a
/// normal distribution.
const FEWEST: usize = 100;

#[derive(Debug)]
pub(super) struct Spread {
    pub(super) factor: f64,
    width: usize,
    /// Rows of the judged windows, in rising order. The ratios are in the same order.
    rows: Vec<usize>,
    ratios: Vec<f64>,
    mean: f64,
    windows: Vec<f64>,
    units: Vec<f64>,
}

impl Spread {
    /// Calibrates on judged windows with these rows (rising), features and ratios. Windows less than `overlap` rows
    /// apart overlap.
    pub(super) fn new(rows: Vec<usize>, features: &[f64], ratios: Vec<f64>, overlap: usize) -> Self {
        let count = rows.len();
        let width = features.len().checked_div(count).unwrap_or(0);
        let units: Vec<f64> = (0..width).map(|k| deviation(features.iter().skip(k).step_by(width))).collect();
        let windows = scaled(features, &units);
        let mean = ratios.iter().sum::<f64>() / count.max(1) as f64;
        let mut spread = Self { factor: GAUSSIAN, width, rows, ratios, mean, windows, units };
        let relative = |k: usize| {
            let window = &spread.windows[k * width..][..width];
            spread.ratios[k] / spread.at(window, Some((spread.rows[k], overlap)))
        };
        spread.factor = factor((0..count).map(relative).collect());
        spread
    }

    pub(super) fn count(&self) -> usize {
        self.rows.len()
    }

    pub(super) fn half_width(&self, features: &[f64]) -> f64 {
        if self.rows.len() < FEWEST {
            return self.factor;
        }
        self.factor * self.at(&scaled(features, &self.units), None)
    }

    /// Returns the spread of a window with scaled features. `but` = (row, overlap) excludes the windows that overlap
    /// the window at this row.
    fn at(&self, window: &[f64], but: Option<(usize, usize)>) -> f64 {
        if self.rows.len() < FEWEST || self.mean <= 0.0 {
            return 1.0;
        }
        let apart = |row: usize| but.is_none_or(|(own, overlap)| row.abs_diff(own) >= overlap.max(1));
        let distance = |k: usize| -> f64 {
            self.windows[k * self.width..][..self.width].iter().zip(window).map(|(a, b)| (a - b) * (a - b)).sum()
        };
        let mut near: Vec<(f64, usize)> =
            (0..self.rows.len()).filter(|k| apart(self.rows[*k])).map(|k| (distance(k), k)).collect();
        if near.len() > NEAR {
            near.select_nth_unstable_by(NEAR - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            near.truncate(NEAR);
        }
        let sum: f64 = near.iter().map(|(_, k)| self.ratios[*k]).sum();
        (sum + SHRINKAGE * self.mean) / (near.len() as f64 + SHRINKAGE) / self.mean
    }
}

fn scaled(features: &[f64], units: &[f64]) -> Vec<f64> {
    features.iter().enumerate().map(|(at, value)| value / units[at % units.len()]).collect()
}

/// Returns the standard deviation of the values, or 1 if they are equal.
fn deviation<'a>(values: impl Iterator<Item = &'a f64> + Clone) -> f64 {
    let count = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / count;
    let deviation = (values.map(|value| (value - mean) * (value - mean)).sum::<f64>() / count).sqrt();
    if deviation > 1e-12 * mean.abs() { deviation } else { 1.0 }
}

/// Returns the 95 % quantile, corrected for small samples. With few ratios, it is at least the value of a normal
/// distribution, because chance could make the interval too narrow.
fn factor(mut ratios: Vec<f64>) -> f64 {
    ratios.sort_by(f64::total_cmp);
    let rank = ((ratios.len() + 1) as f64 * 0.95).ceil() as usize;
    match ratios.get(rank - 1) {
        Some(quantile) if ratios.len() < FEWEST => quantile.max(GAUSSIAN),
        Some(quantile) => *quantile,
        None => ratios.last().copied().unwrap_or(GAUSSIAN).max(GAUSSIAN),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factor_is_a_quantile_and_never_too_narrow() {
        let of =
            |ratios: Vec<f64>| Spread::new((0..ratios.len()).collect(), &vec![0.0; ratios.len()], ratios, 1).factor;
        assert_eq!(of((1..=99).map(|k| f64::from(k) / 10.0).collect()), 9.5);
        assert_eq!((of(vec![]), of(vec![0.1, 0.2]), of(vec![0.1, 7.0])), (GAUSSIAN, GAUSSIAN, 7.0));
        assert_eq!(of((1..=50).map(|k| f64::from(k) / 100.0).collect()), GAUSSIAN);
        let none = Spread::new(vec![], &[], vec![], 1);
        assert_eq!((none.half_width(&[1.0, 2.0]), none.count()), (GAUSSIAN, 0));
    }

    #[test]
    fn intervals_are_wide_where_errors_were_large() {
        // Every tenth window belongs to a second regime, in which errors are ten times larger.
        let large = |k: usize| k % 10 == 3;
        let ratio = |k: usize| (k * 7919 % 1000) as f64 / 1000.0 * if large(k) { 10.0 } else { 1.0 };
        let features: Vec<f64> = (0..2000).flat_map(|k| [if large(k) { 5.0 } else { 0.0 }, (k % 7) as f64]).collect();
        let spread = Spread::new((0..2000).collect(), &features, (0..2000).map(ratio).collect(), 5);
        let (narrow, wide) = (spread.half_width(&[0.0, 3.0]), spread.half_width(&[5.0, 3.0]));
        assert!(narrow < 2.5 && wide > 5.0, "{narrow}, {wide}");
        let inside = |k: &usize| ratio(*k) <= spread.half_width(&features[2 * k..][..2]);
        let held = (0..2000).filter(inside).count();
        assert!((1860..=1960).contains(&held), "{held}");
        assert!((0..2000).filter(|k| large(*k)).filter(inside).count() > 120);
    }
}
