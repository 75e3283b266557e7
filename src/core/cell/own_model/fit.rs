//! Fits a cell model to recorded rows. The fit is repeated for each capacity of a grid.
//!
//! In: a [`Label`] and the rows of a [`Notebook`](crate::cell::notebook::Notebook) (readings of the mean cell, averaged
//! over a short time). Out: a [`Fit`].
//!
//! For each capacity C of the grid, damped Gauss-Newton steps find the most likely values of the other parameters
//! (maximum a posteriori). Some parameters change the voltages of the open-circuit curve, and its decrease at low
//! temperature. Others are factors of the resistances that the label's model has, over SOC and temperature. The last
//! parameters are the offset of the current sensor, and the SOC s_k at the start of each stretch (a period with a
//! continuously measured current). After the charge q, corrected for the offset, SOC = s_k - q / C.
//!
//! The probability density of a capacity is the density of its best fit times the volume of the other parameters around
//! this fit (Laplace's approximation). If the rows allow two capacities, the density has two maxima.
//!
//! # Errors of a row
//! Rows at nearly the same SOC have the same errors of voltage, SOC and voltage drop, so their errors are correlated
//! over 12 % of SOC. The error of a row has three parts: a constant, a part proportional to the slope of the curve, and
//! a part that grows with the voltage drop. The third part grows faster than the drop, because charge transfer is not
//! linear (Butler-Volmer).
//!
//! The constants were chosen with three cells at 25 degrees C: LG HG2, LG M50 (simulated) and a Leaf cell.

mod basis;
mod noise;
mod prior;

use nalgebra::{DMatrix, DVector};

use super::{FACTOR_NODES, OwnModel, SOC_NODES};
use crate::cell::chemistry::curve::CurvePrior;
use crate::cell::chemistry::{Label, LabelPrior, ResistanceFactors, SOC, TEMPERATURE_C, usual_cold_sag_v};
use crate::cell::notebook::{PresentStretch, Row};
use crate::filter::ScalarGaussian;
use crate::filter::levenberg_marquardt::{Damping, minimise};
use basis::{BEGINNINGS, BY_TEMPERATURE, Basis, COLD_SAG, FACTORS, LOG_CAPACITY, OFFSET};
use noise::{NormalEquations, RepeatedErrors};

const DAMPING: Damping =
    Damping { first: 1e-3, fall: 0.2, fall_after_growth: 0.2, growth: 8.0, least: 1e-9, most: 8e6 };
/// Step of the capacity grid, relative to the rated capacity. The grid has `CAPACITIES` points; the lowest is 0.52
/// times the rated capacity. The search starts at the point `FIRST_CAPACITY`, which is the rated capacity.
const CAPACITY_STEP: f64 = 0.04;
const CAPACITIES: usize = 20;
const FIRST_CAPACITY: usize = 12;
/// The search in one direction ends if the cost exceeds the lowest cost by more than this.
const HOPELESS: f64 = 25.0;
/// Number of points per step of the capacity grid at which the density is evaluated.
const FINE: usize = 20;

/// A fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// The model.
    pub own: OwnModel,
    /// Root mean square of the rows' residuals, in standard deviations. It is about 1 if the cells have the label's
    /// chemistry and the assumed errors of the circuit model are right.
    pub misfit: f64,
    /// Start of the last stretch; `None` without rows.
    beginning: Option<Beginning>,
}

/// Start of a stretch. After the charge q and the time t, the SOC is soc - (q - t offset) / capacity.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Beginning {
    stretch: u32,
    /// SOC at the start, and offset of the current sensor (A). `covariance` is their covariance if the capacity equals
    /// its fitted value.
    means: [f64; 2],
    covariance: [[f64; 2]; 2],
    /// Change of each mean per standard deviation of the capacity.
    by_capacity: [f64; 2],
}

impl Fit {
    /// Present SOC (fraction), and covariance of the SOC with the capacity (Ah). `None` if no stretch is in progress,
    /// or if the present stretch has no rows.
    pub fn soc(&self, present: Option<PresentStretch>) -> Option<(ScalarGaussian, f64)> {
        let (present, beginning) = present.zip(self.beginning)?;
        let Beginning { stretch, means, covariance, by_capacity } = beginning;
        if present.number != stretch {
            return None;
        }
        let (capacity_ah, std_ah) = (self.own.capacity.mean, self.own.capacity.std());
        let hours = present.elapsed_s / 3600.0;
        let moved = (present.charge_ah - hours * means[1]) / capacity_ah;
        let by_offset = hours / capacity_ah;
        let by_capacity = by_capacity[0] + by_offset * by_capacity[1] + moved * std_ah / capacity_ah;
        let own = covariance[0][0] + by_offset * (2.0 * covariance[0][1] + by_offset * covariance[1][1]);
        let soc = ScalarGaussian { mean: means[0] - moved, variance: own + by_capacity * by_capacity };
        Some((soc, by_capacity * std_ah))
    }
}

#[derive(Debug, Clone)]
struct Conditional {
    theta: DVector<f64>,
    /// Information matrix of all parameters except the capacity.
    normal: DMatrix<f64>,
    /// Minus the logarithm of the capacity's density, up to a constant that depends only on the prior.
    cost: f64,
    misfit: f64,
}

struct Search<'a> {
    basis: Basis<'a>,
    prior: DMatrix<f64>,
    expected: DVector<f64>,
    rated_ah: f64,
}

/// Whether the rows contain enough information for a fit.
pub fn says_enough(label: &Label, rows: &[Row]) -> bool {
    rows.len() >= 12 && span_ah(rows) >= 0.15 * label.rated_ah
}

/// Fits a model. Returns `None` if the rows contain too little information, or if the capacity is far from the label's
/// capacity.
pub fn fit(prior: &LabelPrior, rows: &[Row]) -> Option<Fit> {
    if !says_enough(&prior.label, rows) {
        return None;
    }
    let (search, start) = Search::new(prior, rows)?;
    let capacity = search.capacity(&start)?;
    search.finish(capacity, &start)
}

/// Minus the logarithm of the rows' probability with a label, minimised over `capacities_ah` (Ah). Values of different
/// labels can be compared.
pub fn label_cost(prior: &LabelPrior, rows: &[Row], capacities_ah: &[f64]) -> Option<f64> {
    let (search, start) = Search::new(prior, rows)?;
    let costs = capacities_ah.iter().filter_map(|&ah| search.conditional(ah, &start).map(|found| found.cost));
    Some(costs.min_by(f64::total_cmp)? - 0.5 * prior::log_determinant(&search.prior)?)
}

/// Cost of rows: minus the logarithm of the probability density that the model `own` gives the rows (`None` = the
/// label's model). Each stretch starts at its most likely SOC. Returns `None` without rows.
pub(super) fn rows_cost(prior: &LabelPrior, own: Option<&OwnModel>, rows: &[Row]) -> Option<f64> {
    let basis = Basis::new(prior, rows);
    let theta = basis.parameters(own);
    let size = basis.size();
    let mut sums =
        NormalEquations { normal: DMatrix::zeros(size, size), gradient: DVector::zeros(size), cost: 0.0, squares: 0.0 };
    sums.add_rows(&basis, &theta, &RepeatedErrors::USUAL)?;
    (!rows.is_empty()).then_some(sums.cost)
}

fn span_ah(rows: &[Row]) -> f64 {
    let of_stretch = |rows: &[Row]| {
        let charges = rows.iter().map(|row| f64::from(row.charge_ah));
        let (low, high) = charges.fold((f64::MAX, f64::MIN), |(low, high), q| (low.min(q), high.max(q)));
        high - low
    };
    rows.chunk_by(|a, b| a.stretch == b.stretch).map(of_stretch).fold(0.0, f64::max)
}

impl<'a> Search<'a> {
    fn new(prior: &'a LabelPrior, rows: &'a [Row]) -> Option<(Self, DVector<f64>)> {
        let rated_ah = prior.label.rated_ah;
        let basis = Basis::new(prior, rows);
        let prior = prior::information(prior, basis.size())?;
        let start = basis.parameters(None);
        let mut expected = start.clone();
        (BEGINNINGS..basis.size()).for_each(|k| expected[k] = 0.5);
        Some((Self { basis, prior, expected, rated_ah }, start))
    }

    /// Normal equations of rows and prior at `theta`. The capacity's gradient is set to 0, so that a step keeps the
    /// capacity.
    fn sums(&self, theta: &DVector<f64>, errors: &RepeatedErrors) -> Option<NormalEquations> {
        let off = theta - &self.expected;
        let gradient = &self.prior * &off;
        let cost = 0.5 * off.dot(&gradient);
        let mut sums = NormalEquations { normal: self.prior.clone(), gradient, cost, squares: 0.0 };
        sums.add_rows(&self.basis, theta, errors)?;
        sums.gradient[LOG_CAPACITY] = 0.0;
        sums.normal.row_mut(LOG_CAPACITY).fill(0.0);
        sums.normal.column_mut(LOG_CAPACITY).fill(0.0);
        sums.normal[(LOG_CAPACITY, LOG_CAPACITY)] = 1.0;
        sums.cost.is_finite().then_some(sums)
    }

    /// The most likely values of the other parameters at a capacity (Ah), searched from `start` (Levenberg-Marquardt).
    fn conditional(&self, capacity_ah: f64, start: &DVector<f64>) -> Option<Conditional> {
        self.conditional_with(&RepeatedErrors::USUAL, capacity_ah, start)
    }

    fn conditional_with(&self, errors: &RepeatedErrors, capacity_ah: f64, start: &DVector<f64>) -> Option<Conditional> {
        let mut theta = start.clone();
        theta[LOG_CAPACITY] = libm::log(capacity_ah);
        let sums = self.sums(&theta, errors)?;
        let step = |(theta, sums): &(DVector<f64>, NormalEquations), damping: f64| {
            let mut damped = sums.normal.clone();
            (0..theta.len()).for_each(|i| damped[(i, i)] *= 1.0 + damping);
            let mut tried = theta - damped.cholesky()?.solve(&sums.gradient);
            Basis::bound(&mut tried);
            let next = self.sums(&tried, errors).filter(|next| next.cost <= sums.cost)?;
            Some((tried, next))
        };
        let (theta, sums) =
            minimise(&DAMPING, 12, (theta, sums), step, |from, to, _| from.1.cost - to.1.cost < 0.02).best;
        let cost = sums.cost + 0.5 * prior::log_determinant(&sums.normal)?;
        let misfit = (sums.squares / self.basis.rows.len() as f64).sqrt();
        Some(Conditional { theta, normal: sums.normal, cost, misfit })
    }

    /// Mean and variance of the capacity (Ah). `None` if the capacity does not fit this label.
    fn capacity(&self, start: &DVector<f64>) -> Option<ScalarGaussian> {
        let at = |k: usize| self.rated_ah * (0.52 + CAPACITY_STEP * k as f64);
        let mut found: Vec<Option<f64>> = vec![None; CAPACITIES];
        let first = self.conditional(at(FIRST_CAPACITY), start)?;
        let mut least = first.cost;
        found[FIRST_CAPACITY] = Some(first.cost);
        let (above, below) = (FIRST_CAPACITY + 1..CAPACITIES, (0..FIRST_CAPACITY).rev());
        for side in [above.collect::<Vec<_>>(), below.collect()] {
            let mut theta = first.theta.clone();
            for k in side {
                let Some(next) = self.conditional(at(k), &theta) else { break };
                found[k] = Some(next.cost);
                least = least.min(next.cost);
                if next.cost > least + HOPELESS {
                    break;
                }
                theta = next.theta;
            }
        }
        // If the maximum of the density lies outside the grid, the capacity does not fit this label.
        let is_open = |end: Option<f64>| end.is_some_and(|cost| cost < least + 3.0);
        if is_open(found[0]) || is_open(found[CAPACITIES - 1]) {
            return None;
        }
        let (first, last) = (found.iter().position(Option::is_some)?, found.iter().rposition(Option::is_some)?);
        let costs: Vec<f64> = found[first..=last].iter().map(|cost| cost.unwrap_or(least + HOPELESS)).collect();
        let (mean, variance) = moments(&costs, least);
        let step_ah = CAPACITY_STEP * self.rated_ah;
        let capacity_ah = at(first) + step_ah * mean;
        // Adds errors that the fit cannot detect, such as the gain and the offset of the current sensor.
        let std_ah = (1.4 * step_ah * variance.sqrt()).hypot(0.015 * capacity_ah);
        Some(ScalarGaussian::from_std(capacity_ah, std_ah))
    }

    fn finish(&self, capacity: ScalarGaussian, start: &DVector<f64>) -> Option<Fit> {
        let Conditional { theta, normal, misfit, .. } = self.conditional(capacity.mean, start)?;
        let std_ah = capacity.std();
        let [low, high] = [-0.5, 0.5].map(|part| self.conditional(capacity.mean + part * std_ah, &theta));
        // Change of each parameter per standard deviation of the capacity. The entry of the capacity is the change of
        // its logarithm.
        let by_capacity = high?.theta - low?.theta;
        let theta = self.conditional_with(&RepeatedErrors::IN_TABLES, capacity.mean, &theta)?.theta;
        let mut covariance = normal.cholesky()?.inverse();
        let last = self.basis.rows.last().zip(self.basis.stretch.last());
        let beginning = last.map(|(row, stretch)| {
            let of = [BEGINNINGS + stretch, OFFSET];
            Beginning {
                stretch: row.stretch,
                means: of.map(|i| theta[i]),
                covariance: of.map(|i| of.map(|j| covariance[(i, j)])),
                by_capacity: of.map(|i| by_capacity[i]),
            }
        });
        covariance[(LOG_CAPACITY, LOG_CAPACITY)] = 0.0;
        covariance += &by_capacity * by_capacity.transpose();
        Some(Fit { own: self.own_model(&theta, &covariance, capacity), misfit, beginning })
    }

    fn own_model(&self, theta: &DVector<f64>, covariance: &DMatrix<f64>, capacity: ScalarGaussian) -> OwnModel {
        let Basis { curve, rows, .. } = &self.basis;
        let residual_v = |(at, row): (usize, &Row)| self.basis.predict(theta, at).voltage_v - f64::from(row.voltage_v);
        let squares_v2: f64 = rows.iter().enumerate().map(residual_v).map(|v| v * v).sum();
        let mut mean_v: Vec<f64> = (0..SOC_NODES).map(|s| curve.mean_v[s] + theta[s]).collect();
        for s in 1..SOC_NODES {
            mean_v[s] = mean_v[s].max(mean_v[s - 1] + 2e-4);
        }
        let covariance_v2 = covariance.view((0, 0), (SOC_NODES, SOC_NODES)).into_owned();
        let posterior = CurvePrior { soc: SOC.to_vec(), mean_v, covariance: covariance_v2, electrodes: None };
        let (modes_v, rest_v) = posterior.modes_v();
        let array = |values: &[f64]| std::array::from_fn(|s| values[s]);
        OwnModel {
            curve_v: array(&posterior.mean_v),
            modes_v: modes_v.each_ref().map(|mode_v| array(mode_v)),
            rest_v: array(&rest_v),
            factors: ResistanceFactors {
                ln: std::array::from_fn(|j| std::array::from_fn(|n| theta[FACTORS + j * FACTOR_NODES + n])),
                by_temperature: std::array::from_fn(|j| theta[BY_TEMPERATURE + j]),
            },
            drop_std: TEMPERATURE_C.map(|temperature_c| self.basis.drop_std(theta, covariance, temperature_c)),
            cold_sag_v: ScalarGaussian {
                mean: usual_cold_sag_v().mean + theta[COLD_SAG],
                variance: covariance[(COLD_SAG, COLD_SAG)],
            },
            capacity,
            residual_v: (squares_v2 / rows.len() as f64).sqrt(),
        }
    }
}

/// Mean and variance, in steps of the grid, of the density exp(least - cost). `costs` has one cost per point of the
/// grid; cubics (Catmull-Rom) interpolate between the points.
fn moments(costs: &[f64], least: f64) -> (f64, f64) {
    let last = costs.len() - 1;
    let slope = |k: usize| {
        let (low, high) = (k.saturating_sub(1), (k + 1).min(last));
        (costs[high] - costs[low]) / (high - low).max(1) as f64
    };
    let cost = |k: usize, t: f64| {
        let (a, b) = (costs[k], costs[k + 1]);
        let (t2, t3) = (t * t, t * t * t);
        let values = (2.0 * t3 - 3.0 * t2 + 1.0) * a + (3.0 * t2 - 2.0 * t3) * b;
        values + (t3 - 2.0 * t2 + t) * slope(k) + (t3 - t2) * slope(k + 1)
    };
    let points = (0..last).flat_map(|k| (0..FINE).map(move |i| (k, i as f64 / FINE as f64)));
    let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
    for (k, t) in points.chain(last.checked_sub(1).map(|k| (k, 1.0))) {
        let (x, weight) = (k as f64 + t, libm::exp(least - cost(k, t)) / FINE as f64);
        sum += weight;
        first += weight * x;
        second += weight * x * x;
    }
    if sum <= 0.0 {
        return (0.0, 0.0);
    }
    let mean = first / sum;
    (mean, (second / sum - mean * mean).max(0.0))
}

#[cfg(test)]
mod tests;
