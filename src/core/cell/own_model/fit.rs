//! Fits a model to the rows of a notebook: the most likely one (maximum a posteriori), by Gauss-Newton.
//!
//! In: a [`Label`] and rows. Out: a [`Fit`]. Unknown are the open-circuit curve at the SOC breakpoints, the resistances relative to
//! the label's at a few SOC and by temperature, ln C, and the SOC at which each stretch began: SOC = s_k - q / C. The voltage of a
//! row is linear in all resistances. What the rows do not show stays as the label says. The prior of the curve is that of
//! [`Label::curve`]; those of the resistances are in this file.

use nalgebra::{DMatrix, DVector};

use super::{FACTOR_NODES, OwnModel, SOC_NODES};
use crate::cell::chemistry::curve::CurvePrior;
use crate::cell::chemistry::{FACTOR_SOC, Label, RESISTANCES, ResistanceFactors, SOC, TEMPERATURE_C};
use crate::cell::model::{CellModel, arrhenius};
use crate::cell::notebook::{CurrentSteps, Row};
use crate::filter::ScalarGaussian;

/// Fewest rows, and least part of the capacity that they span.
const LEAST_ROWS: usize = 12;
const LEAST_SPAN: f64 = 0.15;
/// Standard deviation of a row's voltage: of its own, V, and in proportion to the drop.
const ROW_V: f64 = 0.006;
const ROW_DROP: f64 = 0.08;
/// Residual, in standard deviations, from which on it counts linearly (Huber).
const HUBER: f64 = 3.0;
/// The same of a step of the current.
const STEP_V: f64 = 0.005;
/// Least sum of squared steps that says something, A^2.
const LEAST_STEPS_A2: f64 = 1e-12;
/// Most that the steps of one row say of a resistance: its standard deviation of ln.
const STEPS_LOG_STD: f64 = 0.05;
/// Deviations of ln(resistance) between cells: common to all parts of one cell, of each part, over SOC; and of the part of its
/// activation energy. As between the five cells of the chemistry's resistances.
const COMMON_LOG_STD: f64 = 0.35;
const PART_LOG_STD: [f64; RESISTANCES] = [0.3, 0.4, 0.4, 0.5];
const SHAPE_LOG_STD: f64 = 0.15;
const BY_TEMPERATURE_STD: f64 = 0.25;
/// Standard deviation of ln(capacity) from the label.
const CAPACITY_STD: f64 = 0.1;
/// Roughness of a curve beside the modes of its prior, V.
const ROUGH_V: f64 = 0.002;
/// Least rise of the curve between breakpoints, V.
const LEAST_RISE_V: f64 = 2e-4;
/// Standard deviation of the SOC at which a stretch begins: it is found from the voltages.
const BEGINNING_STD: f64 = 0.5;
const BEGINNING: (f64, f64) = (-0.05, 1.05);
const MOST_PASSES: usize = 40;

/// First indices of the parameters.
const FACTORS: usize = SOC_NODES;
const BY_TEMPERATURE: usize = FACTORS + RESISTANCES * FACTOR_NODES;
const LOG_CAPACITY: usize = BY_TEMPERATURE + RESISTANCES;
const BEGINNINGS: usize = LOG_CAPACITY + 1;
/// Parameters of SOC and capacity among those of a row.
const SOC_AND_CAPACITY: usize = 4;

/// A fit.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The model.
    pub own: OwnModel,
    /// Present SOC, fraction; `None` = the present stretch has no rows.
    pub soc: Option<ScalarGaussian>,
    /// Covariance of that with the capacity, Ah.
    pub soc_by_capacity: f64,
    /// Minus the logarithm of the posterior density, up to a constant that is the same for every label.
    pub cost: f64,
}

/// The label as the fit uses it.
struct Basis<'a> {
    model: CellModel,
    curve: CurvePrior,
    rows: &'a [Row],
    /// Stretch of each row, counted from 0.
    stretch: Vec<usize>,
}

/// The voltage of a row by parameters, and its derivatives.
struct Prediction {
    voltage_v: f64,
    drop_v: f64,
    ohm: [f64; RESISTANCES],
    /// Change of ln of a resistance with each of its three parameters.
    by_factor: [f64; 3],
    /// Parameters on which the voltage depends: four of SOC and capacity, then three of each resistance.
    index: Vec<usize>,
    slope: Vec<f64>,
}

/// Fits; `None` when the rows say too little, or the label has no model. `present` is the number of the present stretch and
/// the charge taken out in it so far, Ah.
pub fn fit(label: &Label, rows: &[Row], present: Option<(u32, f64)>) -> Option<Fit> {
    let soc_span = span_ah(rows) / label.rated_ah;
    if rows.len() < LEAST_ROWS || soc_span < LEAST_SPAN {
        return None;
    }
    let basis = Basis::new(label, rows)?;
    let size = BEGINNINGS + basis.stretches();
    let prior = prior(&basis.curve, size)?;
    let mut theta = DVector::zeros(size);
    theta[LOG_CAPACITY] = libm::log(label.rated_ah);
    basis.set_beginnings(&mut theta);
    let start = theta.clone();
    let (mut normal, mut slope, mut cost) = basis.normal(&theta, &start, &prior);
    let mut damping = 1e-3;
    for _ in 0..MOST_PASSES {
        let mut damped = normal.clone();
        (0..size).for_each(|i| damped[(i, i)] *= 1.0 + damping);
        let step = damped.cholesky()?.solve(&slope);
        let tried = bounded(&(&theta - &step), label);
        let (next_normal, next_slope, next_cost) = basis.normal(&tried, &start, &prior);
        if next_cost.is_finite() && next_cost <= cost {
            let gained = cost - next_cost;
            (theta, normal, slope, cost) = (tried, next_normal, next_slope, next_cost);
            damping = (damping * 0.2).max(1e-9);
            if gained < 1e-4 {
                break;
            }
        } else if damping > 1e6 {
            break;
        } else {
            damping *= 8.0;
        }
    }
    basis.finish(&theta, normal, cost, present)
}

/// Cost of rows by a model, `None` = that of the label: minus the logarithm of their density, with the most likely SOC at the
/// beginning of each stretch. `None` when the label has no model, or there are no rows.
pub(super) fn rows_cost(label: &Label, own: Option<&OwnModel>, rows: &[Row]) -> Option<f64> {
    let basis = Basis::new(label, rows)?;
    let mut theta = DVector::zeros(BEGINNINGS + basis.stretches());
    theta[LOG_CAPACITY] = libm::log(own.map_or(label.rated_ah, |own| own.capacity.mean));
    if let Some(own) = own {
        (0..SOC_NODES).for_each(|s| theta[s] = own.curve_v[s] - basis.curve.mean_v[s]);
        for j in 0..RESISTANCES {
            (0..FACTOR_NODES).for_each(|n| theta[FACTORS + j * FACTOR_NODES + n] = own.factors.ln[j][n]);
            theta[BY_TEMPERATURE + j] = own.factors.by_temperature[j];
        }
    }
    basis.set_beginnings(&mut theta);
    let cost = (0..rows.len()).map(|at| basis.row_cost(&basis.predict(&theta, at), at).0).sum();
    (!rows.is_empty()).then_some(cost)
}

/// Charge over which the longest stretch spans, Ah.
fn span_ah(rows: &[Row]) -> f64 {
    let of_stretch = |rows: &[Row]| {
        let charges = rows.iter().map(|row| f64::from(row.charge_ah));
        let (low, high) = charges.fold((f64::MAX, f64::MIN), |(low, high), q| (low.min(q), high.max(q)));
        high - low
    };
    rows.chunk_by(|a, b| a.stretch == b.stretch).map(of_stretch).fold(0.0, f64::max)
}

fn bounded(theta: &DVector<f64>, label: &Label) -> DVector<f64> {
    let mut theta = theta.clone();
    let log_rated = libm::log(label.rated_ah);
    theta[LOG_CAPACITY] = theta[LOG_CAPACITY].clamp(log_rated - 0.5, log_rated + 0.5);
    theta.iter_mut().skip(BEGINNINGS).for_each(|soc| *soc = soc.clamp(BEGINNING.0, BEGINNING.1));
    theta.iter_mut().skip(FACTORS).take(BY_TEMPERATURE - FACTORS).for_each(|ln| *ln = ln.clamp(-2.5, 2.5));
    theta.iter_mut().skip(BY_TEMPERATURE).take(RESISTANCES).for_each(|part| *part = part.clamp(-1.5, 1.5));
    theta
}

/// Information matrix of the prior about the label's values; `None` when a covariance has no factor.
fn prior(curve: &CurvePrior, size: usize) -> Option<DMatrix<f64>> {
    let mut prior = DMatrix::zeros(size, size);
    let own = DMatrix::from_diagonal_element(SOC_NODES, SOC_NODES, ROUGH_V * ROUGH_V);
    let curve = (&curve.covariance + own).cholesky()?.inverse();
    prior.view_mut((0, 0), (SOC_NODES, SOC_NODES)).copy_from(&curve);
    let count = RESISTANCES * FACTOR_NODES;
    let covariance = DMatrix::from_fn(count, count, |a, b| {
        let ((i, n), (j, m)) = ((a / FACTOR_NODES, a % FACTOR_NODES), (b / FACTOR_NODES, b % FACTOR_NODES));
        let apart = (FACTOR_SOC[n] - FACTOR_SOC[m]) / 0.3;
        let shape = SHAPE_LOG_STD * SHAPE_LOG_STD * libm::exp(-0.5 * apart * apart);
        let part = if i == j { PART_LOG_STD[i] * PART_LOG_STD[i] + shape } else { 0.0 };
        COMMON_LOG_STD * COMMON_LOG_STD + part + if a == b { 1e-4 } else { 0.0 }
    });
    prior.view_mut((FACTORS, FACTORS), (count, count)).copy_from(&covariance.cholesky()?.inverse());
    let mut near = |i: usize, std: f64| prior[(i, i)] = 1.0 / (std * std);
    (BY_TEMPERATURE..LOG_CAPACITY).for_each(|i| near(i, BY_TEMPERATURE_STD));
    near(LOG_CAPACITY, CAPACITY_STD);
    (BEGINNINGS..size).for_each(|i| near(i, BEGINNING_STD));
    Some(prior)
}

/// Interval of `x` among rising `nodes` and the weight of its upper end, within 0 to 1.
fn interval(nodes: &[f64], x: f64) -> (usize, f64) {
    let at = nodes[1..nodes.len() - 1].iter().take_while(|&&node| x >= node).count();
    (at, ((x - nodes[at]) / (nodes[at + 1] - nodes[at])).clamp(0.0, 1.0))
}

impl<'a> Basis<'a> {
    fn new(label: &Label, rows: &'a [Row]) -> Option<Self> {
        let stretches = rows.chunk_by(|a, b| a.stretch == b.stretch);
        let stretch = stretches.enumerate().flat_map(|(k, rows)| vec![k; rows.len()]).collect();
        Some(Self { model: label.model()?, curve: label.curve()?, rows, stretch })
    }

    /// Number of stretches.
    fn stretches(&self) -> usize {
        self.stretch.last().map_or(0, |last| last + 1)
    }

    /// Sets the SOC at which each stretch most likely began.
    fn set_beginnings(&self, theta: &mut DVector<f64>) {
        (0..self.stretches()).for_each(|k| theta[BEGINNINGS + k] = self.likeliest_beginning(theta, k));
    }

    fn predict(&self, theta: &DVector<f64>, at: usize) -> Prediction {
        let row = &self.rows[at];
        let beginning = BEGINNINGS + self.stretch[at];
        let capacity_ah = libm::exp(theta[LOG_CAPACITY]);
        let moved = f64::from(row.charge_ah) / capacity_ah;
        let soc = theta[beginning] - moved;
        let temperature_c = f64::from(row.temperature_c);
        let position = self.model.grid_position(soc, temperature_c);
        let (node, along) = interval(&SOC, soc);
        let own_v = theta[node] + along * (theta[node + 1] - theta[node]);
        let own_slope_v =
            if (0.0..1.0).contains(&soc) { (theta[node + 1] - theta[node]) / (SOC[node + 1] - SOC[node]) } else { 0.0 };
        let slope_v = self.model.ocv_slope_v(&position, capacity_ah) + own_slope_v;
        let (per_ah_v, _) = self.model.aged_ocv_changes_v(&position, capacity_ah);
        let mut index = vec![node, node + 1, LOG_CAPACITY, beginning];
        let mut slope = vec![1.0 - along, along, slope_v * moved + per_ah_v * capacity_ah, slope_v];
        let (low, part) = interval(&FACTOR_SOC, soc);
        let by_temperature = libm::log(arrhenius(temperature_c));
        let by_factor = [1.0 - part, part, by_temperature];
        let mut drop_v = 0.0;
        let ohm: [f64; RESISTANCES] = std::array::from_fn(|j| {
            let first = FACTORS + j * FACTOR_NODES + low;
            let ln =
                theta[first] + part * (theta[first + 1] - theta[first]) + by_temperature * theta[BY_TEMPERATURE + j];
            let label_ohm = match j {
                0 => self.model.r0_ohm(&position),
                j => self.model.branch_r_ohm(j - 1, &position),
            };
            let ohm = label_ohm * libm::exp(ln);
            let current_a = f64::from(if j == 0 { row.current_a } else { row.filtered_a[j - 1] });
            let part_v = ohm * current_a;
            drop_v += part_v;
            index.extend([first, first + 1, BY_TEMPERATURE + j]);
            slope.extend(by_factor.map(|factor| -factor * part_v));
            ohm
        });
        let voltage_v = self.model.aged_ocv_v(&position, capacity_ah) + own_v - drop_v;
        Prediction { voltage_v, drop_v, ohm, by_factor, index, slope }
    }

    /// The SOC at which a stretch most likely began, with the other parameters as they are.
    fn likeliest_beginning(&self, theta: &DVector<f64>, k: usize) -> f64 {
        let mut theta = theta.clone();
        let rows: Vec<usize> = (0..self.rows.len()).filter(|&at| self.stretch[at] == k).collect();
        let mut cost = |soc: f64| {
            theta[BEGINNINGS + k] = soc;
            rows.iter().map(|&at| self.row_cost(&self.predict(&theta, at), at).0).sum::<f64>()
        };
        let tried = (0..=42).map(|step| BEGINNING.0 + (BEGINNING.1 - BEGINNING.0) * f64::from(step) / 42.0);
        tried.map(|soc| (soc, cost(soc))).min_by(|a, b| a.1.total_cmp(&b.1)).map_or(0.5, |found| found.0)
    }

    /// Cost of a row's residual, the residual (V) and its weight.
    fn row_cost(&self, prediction: &Prediction, at: usize) -> (f64, f64, f64) {
        let residual_v = prediction.voltage_v - f64::from(self.rows[at].voltage_v);
        let variance = ROW_V * ROW_V + (ROW_DROP * prediction.drop_v).powi(2);
        let deviations = residual_v.abs() / variance.sqrt();
        // The variance grows with the drop, so its logarithm counts.
        let scale = 0.5 * libm::log(variance / (ROW_V * ROW_V));
        if deviations <= HUBER {
            (0.5 * deviations * deviations + scale, residual_v, 1.0 / variance)
        } else {
            (HUBER * (deviations - 0.5 * HUBER) + scale, residual_v, HUBER / deviations / variance)
        }
    }

    /// Normal matrix, gradient and cost at `theta`.
    fn normal(
        &self,
        theta: &DVector<f64>,
        start: &DVector<f64>,
        prior: &DMatrix<f64>,
    ) -> (DMatrix<f64>, DVector<f64>, f64) {
        let off = theta - start;
        let mut gradient = prior * &off;
        let mut cost = 0.5 * off.dot(&gradient);
        let mut normal = prior.clone();
        let mut add = |index: &[usize], slope: &[f64], residual: f64, weight: f64| {
            for (&i, a) in index.iter().zip(slope) {
                gradient[i] += weight * a * residual;
                for (&j, b) in index.iter().zip(slope) {
                    normal[(i, j)] += weight * a * b;
                }
            }
        };
        for at in 0..self.rows.len() {
            let prediction = self.predict(theta, at);
            let (row_cost, residual_v, weight) = self.row_cost(&prediction, at);
            cost += row_cost;
            add(&prediction.index, &prediction.slope, residual_v, weight);
            cost += add_steps(&self.rows[at], &prediction, &mut add);
        }
        (normal, gradient, cost)
    }

    fn finish(
        &self,
        theta: &DVector<f64>,
        normal: DMatrix<f64>,
        cost: f64,
        present: Option<(u32, f64)>,
    ) -> Option<Fit> {
        let predictions: Vec<Prediction> = (0..self.rows.len()).map(|at| self.predict(theta, at)).collect();
        let rows = self.rows.len() as f64;
        let (mut squares, mut squares_v) = (0.0, 0.0);
        for (at, prediction) in predictions.iter().enumerate() {
            let (_, residual_v, weight) = self.row_cost(prediction, at);
            squares += weight * residual_v * residual_v;
            squares_v += residual_v * residual_v;
        }
        // Residuals larger than expected: every row says less.
        let covariance = normal.cholesky()?.inverse() * (squares / rows).max(1.0);
        let capacity_ah = libm::exp(theta[LOG_CAPACITY]);
        let capacity = ScalarGaussian {
            mean: capacity_ah,
            variance: capacity_ah * capacity_ah * covariance[(LOG_CAPACITY, LOG_CAPACITY)],
        };
        let mut mean_v: Vec<f64> = (0..SOC_NODES).map(|s| self.curve.mean_v[s] + theta[s]).collect();
        for s in 1..SOC_NODES {
            mean_v[s] = mean_v[s].max(mean_v[s - 1] + LEAST_RISE_V);
        }
        let posterior = CurvePrior {
            soc: SOC.to_vec(),
            mean_v,
            covariance: covariance.view((0, 0), (SOC_NODES, SOC_NODES)).into_owned(),
            electrodes: None,
        };
        let (modes_v, rest_v) = posterior.modes_v();
        let factors = ResistanceFactors {
            ln: std::array::from_fn(|j| std::array::from_fn(|n| theta[FACTORS + j * FACTOR_NODES + n])),
            by_temperature: std::array::from_fn(|j| theta[BY_TEMPERATURE + j]),
        };
        let log_capacity_variance = covariance[(LOG_CAPACITY, LOG_CAPACITY)];
        let last = self.rows.last().zip(self.stretch.last());
        let present = present.zip(last).filter(|((number, _), (row, _))| *number == row.stretch);
        let soc = present.map(|((_, present_ah), (_, k))| {
            let (k, moved) = (BEGINNINGS + k, present_ah / capacity_ah);
            let with_capacity = covariance[(k, LOG_CAPACITY)];
            let variance = covariance[(k, k)] + moved * moved * log_capacity_variance + 2.0 * moved * with_capacity;
            let soc = ScalarGaussian { mean: theta[k] - moved, variance: variance.max(0.0) };
            (soc, capacity_ah * (with_capacity + moved * log_capacity_variance))
        });
        let array = |values: &[f64]| std::array::from_fn(|s| values[s]);
        Some(Fit {
            own: OwnModel {
                curve_v: array(&posterior.mean_v),
                modes_v: modes_v.each_ref().map(|mode_v| array(mode_v)),
                rest_v: array(&rest_v),
                factors,
                drop_std: std::array::from_fn(|t| self.drop_std(theta, &covariance, TEMPERATURE_C[t])),
                capacity,
                residual_v: (squares_v / rows).sqrt(),
            },
            soc: soc.map(|(soc, _)| soc),
            soc_by_capacity: soc.map_or(0.0, |(_, by_capacity)| by_capacity),
            cost,
        })
    }

    /// Standard deviation of ln(drop) at half charge and a temperature.
    fn drop_std(&self, theta: &DVector<f64>, covariance: &DMatrix<f64>, temperature_c: f64) -> f64 {
        let position = self.model.grid_position(0.5, temperature_c);
        let by_temperature = libm::log(arrhenius(temperature_c));
        let (low, part) = interval(&FACTOR_SOC, 0.5);
        let mut share = DVector::zeros(theta.len());
        let mut settled_ohm = 0.0;
        for j in 0..RESISTANCES {
            let first = FACTORS + j * FACTOR_NODES + low;
            let ln =
                theta[first] + part * (theta[first + 1] - theta[first]) + by_temperature * theta[BY_TEMPERATURE + j];
            let label_ohm =
                if j == 0 { self.model.r0_ohm(&position) } else { self.model.branch_r_ohm(j - 1, &position) };
            let ohm = label_ohm * libm::exp(ln);
            settled_ohm += ohm;
            share[first] += (1.0 - part) * ohm;
            share[first + 1] += part * ohm;
            share[BY_TEMPERATURE + j] += by_temperature * ohm;
        }
        share /= settled_ohm;
        share.dot(&(covariance * &share)).max(0.0).sqrt()
    }
}

/// Adds what the steps of the current within a row say of the series resistance and the fastest branch; its cost.
///
/// The least squares v = - R0 i - R1 x, of which the row has the sums, in two rows (Cholesky factor of the sums of i and x).
fn add_steps(row: &Row, prediction: &Prediction, add: &mut impl FnMut(&[usize], &[f64], f64, f64)) -> f64 {
    let CurrentSteps { ii, ix, xx, iv, xv } = row.steps;
    let [ii, ix, xx, iv, xv] = [ii, ix, xx, iv, xv].map(f64::from);
    if ii <= LEAST_STEPS_A2 {
        return 0.0;
    }
    let of_i = [ii.sqrt(), ix / ii.sqrt()];
    let of_x = (xx - of_i[1] * of_i[1]).max(0.0).sqrt();
    let v_i = iv / of_i[0];
    let v_x = if of_x > 0.0 { (xv - of_i[1] * v_i) / of_x } else { 0.0 };
    let weight = (1.0 / (STEP_V * STEP_V)).min(1.0 / (STEPS_LOG_STD * v_i).powi(2));
    let Prediction { ohm: [series_ohm, fast_ohm, ..], by_factor, index, .. } = prediction;
    let residuals_v = [v_i + of_i[0] * series_ohm + of_i[1] * fast_ohm, v_x + of_x * fast_ohm];
    let slope = |per_series: f64, per_fast: f64| {
        let of = |per: f64| by_factor.map(|factor| per * factor);
        [of(per_series * series_ohm), of(per_fast * fast_ohm)].concat()
    };
    // The parameters of the series resistance and of the fastest branch.
    let index = &index[SOC_AND_CAPACITY..SOC_AND_CAPACITY + 2 * by_factor.len()];
    add(index, &slope(of_i[0], of_i[1]), residuals_v[0], weight);
    add(index, &slope(0.0, of_x), residuals_v[1], weight);
    0.5 * weight * (residuals_v[0].powi(2) + residuals_v[1].powi(2))
}
