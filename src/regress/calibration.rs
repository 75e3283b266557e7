//! Calibrates the width of the interval that contains a given fraction of the measurements.
//!
//! A Gaussian interval contains its nominal fraction of the measurements only if the residuals are Gaussian and have
//! the predicted width everywhere. Measured residuals rarely meet this condition. For example, the residuals of a
//! cell's voltage are twice as wide at rest as during a charge. The interval is therefore calibrated with training
//! rows:
//!
//! 1. A seeded selection of training rows is predicted, each row from all other training rows. Each prediction gives a
//!    `ratio = |residual| / standard deviation`.
//! 2. The *spread* at a row is the mean ratio of the nearest selected rows, shrunk towards the mean ratio of all
//!    selected rows, and divided by this overall mean.
//! 3. The factor is the 95 % quantile of `ratio / spread`. For few rows, the quantile has the correction of split
//!    conformal prediction.
//! 4. The half width of the interval is `factor * spread * standard deviation`.
//!
//! Held-out rows of a cross-validation are not used. If there are too few rows, the interval stays Gaussian.

use super::kd_tree::KdTree;
use super::scale::StandardisedRows;

/// Nominal coverage of the interval, as a fraction.
pub(super) const LEVEL: f64 = 0.95;
/// Half width of a Gaussian interval with the coverage [`LEVEL`], in standard deviations.
pub const GAUSSIAN: f64 = 1.959_963_984_540_054;
/// Maximum number of rows that are left out, one at a time. The standard error of the factor is then below 1 %.
pub(super) const CALIBRATION_ROWS: usize = 8000;
/// Weight of the overall mean in the spread at a row, as a number of rows.
const SHRINKAGE: f64 = 20.0;

#[derive(Debug, Clone)]
pub(super) struct Calibration {
    pub factor: f64,
    /// Numbers of the selected rows. `ratios` has the same order.
    pub rows: Vec<u32>,
    pub ratios: Vec<f64>,
    near: usize,
    mean: f64,
    tree: Option<KdTree>,
}

impl Calibration {
    pub(super) fn none() -> Self {
        Self { factor: GAUSSIAN, rows: vec![], ratios: vec![], near: 0, mean: 1.0, tree: None }
    }

    /// Calibrates with the selected rows and their leave-one-out ratios. Without rows, the interval is Gaussian.
    pub(super) fn new(data: &StandardisedRows, rows: Vec<u32>, ratios: Vec<f64>) -> Self {
        // The spread at a row is computed from a twentieth of the selected rows, at most 200.
        let near = (ratios.len() / 20).min(200);
        let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
        let inputs: Vec<f64> = rows.iter().flat_map(|row| data.row(*row as usize).to_vec()).collect();
        let tree =
            // If `near` is below 20 (fewer than 400 selected rows), the spread is 1 everywhere.
            (near >= 20 && mean > 0.0).then(|| KdTree::new(&inputs, &inverse_deviations(&inputs, data)));
        let mut calibration = Self { factor: GAUSSIAN, rows, ratios, near, mean, tree };
        let d = data.dimensions;
        let relative = |(k, ratio): (usize, &f64)| ratio / calibration.spread(&inputs[k * d..][..d], Some(k));
        let mut relative: Vec<f64> = calibration.ratios.iter().enumerate().map(relative).collect();
        relative.sort_by(f64::total_cmp);
        let rank = ((relative.len() + 1) as f64 * LEVEL).ceil() as usize;
        // With too few rows, the factor stays Gaussian.
        if rank > 0 && rank <= relative.len() {
            calibration.factor = relative[rank - 1];
        }
        calibration
    }

    /// Returns the width of the residuals at a standardised row, relative to the mean over all selected rows.
    /// `excluded` is the index of a selected row that is ignored.
    fn spread(&self, row: &[f64], excluded: Option<usize>) -> f64 {
        let Some(tree) = &self.tree else { return 1.0 };
        let near = tree.nearest(row, self.near, self.ratios.len(), excluded);
        let sum: f64 = near.iter().map(|k| self.ratios[*k as usize]).sum();
        (sum + SHRINKAGE * self.mean) / (near.len() as f64 + SHRINKAGE) / self.mean
    }

    /// Returns the half width of the interval at a standardised row, in standard deviations of a measurement.
    pub(super) fn half_width(&self, row: &[f64]) -> f64 {
        self.factor * self.spread(row, None)
    }
}

/// Returns the weights that give all weighted inputs the same standard deviation.
fn inverse_deviations(inputs: &[f64], data: &StandardisedRows) -> Vec<f64> {
    let (d, n) = (data.dimensions, inputs.len() as f64 / data.dimensions as f64);
    let of = |column: usize| {
        let values = || inputs.iter().skip(column).step_by(d);
        let mean = values().sum::<f64>() / n;
        let variance = values().map(|x| (x - mean) * (x - mean)).sum::<f64>() / n;
        if variance > 0.0 { variance.sqrt().recip() } else { 1.0 }
    };
    (0..d).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::basis::Basis;

    fn data(rows: usize) -> StandardisedRows {
        let inputs = (0..rows).map(|k| k as f64).collect();
        StandardisedRows { dimensions: 1, inputs, targets: vec![0.0; rows], basis: Basis::Zero }
    }

    #[test]
    fn few_rows_give_common_factor_and_fewer_gaussian() {
        let ratios: Vec<f64> = (1..=200).map(|k| f64::from(k) / 100.0).collect();
        let of = |n: usize| Calibration::new(&data(200), (0..n as u32).collect(), ratios[..n].to_vec());
        assert_eq!((of(200).factor, of(200).half_width(&[7.0])), (1.91, 1.91));
        assert_eq!((of(10).factor, of(0).factor, Calibration::none().factor), (GAUSSIAN, GAUSSIAN, GAUSSIAN));
    }

    #[test]
    fn intervals_are_wider_where_residuals_are_wider() {
        // Ratios are between 0 and 1 in the first half, and between 0 and 3 in the second.
        let ratio = |k: u32| f64::from(k * 7919 % 1000) / 1000.0 * if k < 2000 { 1.0 } else { 3.0 };
        let calibration = Calibration::new(&data(4000), (0..4000).collect(), (0..4000).map(ratio).collect());
        let (narrow, wide) = (calibration.half_width(&[800.0]), calibration.half_width(&[3100.0]));
        assert!((0.90..1.1).contains(&narrow) && (2.6..2.95).contains(&wide), "{narrow}, {wide}");
        let held = |from: u32, half: f64| (from..from + 2000).filter(|k| ratio(*k) <= half).count();
        // Shrinkage makes the interval slightly too wide in the first half and too narrow in the second. Together, both
        // intervals contain 95 %.
        let (first, second) = (held(0, narrow), held(2000, wide));
        assert!(second >= 1760 && (3740..=3860).contains(&(first + second)), "{first}, {second}");
    }
}
