//! Computes the covariance of the rows' errors, and the cost of residuals.
//!
//! In: rows (means of readings over a short time) and their predictions. Out: the normal equations of the whitened
//! residuals, and the cost of the residuals (minus the logarithm of their probability density).

use nalgebra::{DMatrix, DVector};

use super::basis::{Basis, CURVE_AND_SOC, Prediction};
use crate::cell::notebook::{CurrentSteps, Row};
use crate::filter::bell;

const ROW_V: f64 = 0.006;
/// Residuals beyond this many standard deviations count linearly (Huber).
const HUBER: f64 = 3.0;

/// Standard deviations of the errors that repeat at nearly the same SOC: voltage (V), SOC (fraction), voltage drop
/// (fraction).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct RepeatedErrors {
    voltage_v: f64,
    soc: f64,
    drop: f64,
}

impl RepeatedErrors {
    /// Usual errors of circuit models, for fitting the capacity.
    pub(super) const USUAL: Self = Self { voltage_v: 0.012, soc: 0.01, drop: 0.2 };
    /// Smaller errors for fitting the tables. A deviation that many rows share then changes the tables instead of
    /// counting as an error.
    pub(super) const IN_TABLES: Self = Self { voltage_v: 0.004, soc: 0.004, drop: 0.05 };
}

pub(super) struct NormalEquations {
    pub(super) normal: DMatrix<f64>,
    pub(super) gradient: DVector<f64>,
    pub(super) cost: f64,
    pub(super) squares: f64,
}

impl NormalEquations {
    /// Adds a residual with its weight. `slope`: derivatives of the residual by the parameters in `index`.
    fn add(&mut self, index: &[usize], slope: &[f64], residual: f64, weight: f64) {
        for (&i, a) in index.iter().zip(slope) {
            self.gradient[i] += weight * a * residual;
            for (&j, b) in index.iter().zip(slope) {
                self.normal[(i, j)] += weight * a * b;
            }
        }
    }

    /// Adds all rows at the parameters `theta`; `None` if the covariance of the rows' errors has no Cholesky factor.
    pub(super) fn add_rows(&mut self, basis: &Basis<'_>, theta: &DVector<f64>, errors: &RepeatedErrors) -> Option<()> {
        let predictions: Vec<Prediction> = (0..basis.rows.len()).map(|at| basis.predict(theta, at)).collect();
        let (count, size) = (predictions.len(), theta.len());
        let lower = covariance(&predictions, errors).cholesky()?.unpack();
        // Residuals and derivatives are in one matrix, so that they are whitened together.
        let mut all = DMatrix::zeros(count, size + 1);
        for (at, prediction) in predictions.iter().enumerate() {
            all[(at, size)] = prediction.voltage_v - f64::from(basis.rows[at].voltage_v);
            for (&i, slope) in prediction.index.iter().zip(&prediction.slope) {
                all[(at, i)] += slope;
            }
        }
        if !lower.solve_lower_triangular_mut(&mut all) {
            return None;
        }
        let mut slope = vec![0.0; size];
        for at in 0..count {
            let residual = all[(at, size)];
            let deviations = residual.abs();
            let is_usual = deviations <= HUBER;
            self.squares += deviations * deviations;
            self.cost += libm::log(lower[(at, at)] / ROW_V);
            self.cost += if is_usual { 0.5 * deviations * deviations } else { HUBER * (deviations - 0.5 * HUBER) };
            let weight = if is_usual { 1.0 } else { HUBER / deviations };
            slope.iter_mut().enumerate().for_each(|(i, slope)| *slope = all[(at, i)]);
            for (i, &of_i) in slope.iter().enumerate() {
                self.gradient[i] += weight * of_i * residual;
                let column = self.normal.column_mut(i);
                column.into_iter().zip(&slope).for_each(|(sum, of_j)| *sum += weight * of_i * of_j);
            }
        }
        for (row, prediction) in basis.rows.iter().zip(&predictions) {
            self.add_steps(row, prediction);
        }
        Some(())
    }

    /// Adds the information of a row's current steps about the series resistance and the fastest branch. The row
    /// contains the sums of the least-squares problem v = - R0 i - R1 x (symbols as in [`CurrentSteps`]). The Cholesky
    /// factor of the sums of i and x turns this problem into two equations.
    fn add_steps(&mut self, row: &Row, prediction: &Prediction) {
        let CurrentSteps { ii, ix, xx, iv, xv } = row.steps;
        let [ii, ix, xx, iv, xv] = [ii, ix, xx, iv, xv].map(f64::from);
        if ii <= 1e-12 {
            return;
        }
        let of_i = [ii.sqrt(), ix / ii.sqrt()];
        let of_x = (xx - of_i[1] * of_i[1]).max(0.0).sqrt();
        let v_i = iv / of_i[0];
        let v_x = if of_x > 0.0 { (xv - of_i[1] * v_i) / of_x } else { 0.0 };
        // The voltage of a step has an error of 10 mV. The steps of one row determine a resistance to 20 % at best.
        let weight = f64::min(1.0 / (0.01 * 0.01), 1.0 / (0.2 * 0.2 * v_i * v_i));
        let Prediction { ohm: [series_ohm, fast_ohm, ..], by_factor, index, .. } = prediction;
        let residuals_v = [v_i + of_i[0] * series_ohm + of_i[1] * fast_ohm, v_x + of_x * fast_ohm];
        let slope = |per_series: f64, per_fast: f64| {
            let of = |per: f64| by_factor.map(|factor| per * factor);
            [of(per_series * series_ohm), of(per_fast * fast_ohm)].concat()
        };
        let index = &index[CURVE_AND_SOC..CURVE_AND_SOC + 2 * by_factor.len()];
        self.add(index, &slope(of_i[0], of_i[1]), residuals_v[0], weight);
        self.add(index, &slope(0.0, of_x), residuals_v[1], weight);
        self.cost += 0.5 * weight * (residuals_v[0] * residuals_v[0] + residuals_v[1] * residuals_v[1]);
    }
}

fn covariance(predictions: &[Prediction], errors: &RepeatedErrors) -> DMatrix<f64> {
    let drop_v: Vec<f64> = predictions.iter().map(|it| it.drop_v * (1.0 + 3.0 * it.drop_v.abs())).collect();
    DMatrix::from_fn(predictions.len(), predictions.len(), |a, b| {
        let (x, y) = (&predictions[a], &predictions[b]);
        // The errors that repeat at nearly the same SOC are correlated over 12 % of SOC.
        let near = bell((x.soc - y.soc) / 0.12);
        let of = |v: f64, soc: f64, drop: f64| {
            v * v + soc * soc * x.slope_v * y.slope_v + drop * drop * drop_v[a] * drop_v[b]
        };
        // Each row also has independent errors.
        let own = if a == b { of(ROW_V, 0.01, 0.08) } else { 0.0 };
        own + near * of(errors.voltage_v, errors.soc, errors.drop)
    })
}
