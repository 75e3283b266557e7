//! Fits tables to records whose SOC is unknown: ordinary drives and charges that start at any SOC.
//!
//! Input: records with the charge taken out since their first row; priors of the open-circuit curve (mean in V,
//! covariance in V^2) and of the resistances; the capacity on the label (Ah). Output: tables, capacity, and the SOC at
//! which each record starts.
//!
//! `SOC = s_k - (q - o t) / C`. Here q is the charge taken out and t the time since the first row. The parameters are
//! the tables, the SOC s_k at the start of record k, ln C, and the offset o of the current sensor (A). All parameters
//! are estimated together (maximum a posteriori, Levenberg-Marquardt in [`super::solve`]). Values on which the records
//! contain no information stay at the prior. The positions of the rows in the tables depend on the SOC, so every pass
//! computes them again.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::fit::{FitSettings, FittedTables, MIN_ROWS, judge, space};
use super::grid::arrhenius;
use super::parameters::{Layout, ParameterTables};
use super::pass::{FreeScale, NormalEquations, accumulate, visits};
use super::prior::Prior;
use super::record::Record;
use super::solve::{Solution, Space, minimise};

/// Smallest and largest SOC at the start of a record.
const BEGINNING: (f64, f64) = (-0.05, 1.05);
/// Largest factor between the fitted capacity and the capacity on the label, in either direction.
const CAPACITY_FACTOR: f64 = 1.6;

/// Largest offset of the current sensor, in standard deviations of the offset's prior.
const MOST_OFFSETS: f64 = 4.0;

/// Standard deviation of the SOC at the end of a full charge.
const FULL_STD: f64 = 0.01;

/// Prior knowledge of a fit.
#[derive(Debug, Clone)]
pub struct Known {
    /// Means of the tables' parameters, in node order.
    pub tables: ParameterTables,
    /// Covariance of the open-circuit voltage between SOC breakpoints (V^2) at the temperature row `curve_row`.
    pub curve_covariance: DMatrix<f64>,
    /// Temperature row to which the covariance belongs.
    pub curve_row: usize,
    /// Capacity (Ah).
    pub capacity_ah: f64,
    /// Standard deviation of the capacity, fraction.
    pub capacity_std: f64,
    /// Standard deviation of the current sensor's offset (A).
    pub offset_std_a: f64,
}

/// A record whose rows have a charge instead of a SOC.
#[derive(Debug, Clone)]
pub struct UnanchoredRecord {
    /// Rows. `soc` is minus the charge taken out since the first row (Ah).
    pub record: Record,
    /// Weight of each second.
    pub scale: f64,
    /// Estimated SOC at the first row, with its standard deviation.
    pub beginning: (f64, f64),
    /// Charge taken out (Ah) and time (h) from the first row to the end of a full charge (SOC 1); `None` = the record
    /// has no full charge.
    pub full: Option<(f64, f64)>,
}

/// Result of a fit.
#[derive(Debug, Clone)]
pub struct UnanchoredFit {
    /// Tables.
    pub fitted: FittedTables,
    /// Capacity (Ah).
    pub capacity_ah: f64,
    /// Standard deviation of the capacity (Ah).
    pub capacity_std_ah: f64,
    /// Offset of the current sensor (A): measured minus true current.
    pub offset_a: f64,
    /// Standard deviation of the fitted open-circuit voltage (V), in node order.
    pub ocv_std_v: Vec<f64>,
    /// The records with the fitted SOC.
    pub records: Vec<Record>,
}

/// Prior of the curve, scaled to unit variance. The residuals are `whitening` x (OCV - mean).
struct CurvePriorRows {
    first: usize,
    whitening: DMatrix<f64>,
    mean_v: DVector<f64>,
}

impl CurvePriorRows {
    fn new(known: &Known, layout: &Layout) -> Result<Self, String> {
        let first = known.curve_row * layout.columns;
        let factor = known.curve_covariance.clone().cholesky().ok_or("the prior of the curve has no factor")?;
        let whitening = factor.l().try_inverse().ok_or("the prior of the curve has no inverse")?;
        let mean_v = DVector::from_column_slice(&known.tables.ocv_v[first..first + layout.columns]);
        Ok(Self { first, whitening, mean_v })
    }

    fn accumulate(&self, theta: &[f64], normal: &mut NormalEquations) {
        let n = self.mean_v.len();
        let off_v = DVector::from_column_slice(&theta[self.first..self.first + n]) - &self.mean_v;
        let residuals = &self.whitening * off_v;
        let index: Vec<usize> = (self.first..self.first + n).collect();
        for row in 0..n {
            let j: Vec<f64> = self.whitening.row(row).iter().copied().collect();
            normal.cost += 0.5 * residuals[row] * residuals[row];
            normal.add(&index, &j, residuals[row], 1.0);
        }
    }
}

/// The unknowns form one vector: the tables, ln(capacity), the current offset, and the SOC at the start of each record.
struct Problem<'a> {
    settings: &'a FitSettings,
    known: &'a Known,
    records: &'a [UnanchoredRecord],
    layout: Layout,
    prior: Prior,
    curve: CurvePriorRows,
}

impl<'a> Problem<'a> {
    fn new(
        settings: &'a FitSettings,
        known: &'a Known,
        records: &'a [UnanchoredRecord],
    ) -> Result<(Self, Vec<f64>, Space), String> {
        let layout = Layout::new(&settings.grid, known.tables.r_ohm.len());
        let ln = |values: &[f64]| values.iter().map(|&x| libm::log(x)).collect::<Vec<f64>>();
        let mut start = known.tables.ocv_v.clone();
        start.extend(ln(&known.tables.r0_ohm));
        for (r_ohm, tau_s) in known.tables.r_ohm.iter().zip(&known.tables.tau_s) {
            start.extend(ln(r_ohm));
            start.extend(ln(tau_s));
        }
        let mut space = space(settings, &layout, &start);
        let prior = Prior::about(&settings.grid, &layout, &start, &settings.deviations);
        let curve = CurvePriorRows::new(known, &layout)?;
        let mut push = |value: f64, low: f64, high: f64| {
            start.push(value);
            space.low.push(low);
            space.high.push(high);
        };
        let (log_label, reach) = (libm::log(known.capacity_ah), libm::log(CAPACITY_FACTOR));
        push(log_label, log_label - reach, log_label + reach);
        push(0.0, -MOST_OFFSETS * known.offset_std_a, MOST_OFFSETS * known.offset_std_a);
        records.iter().for_each(|record| push(record.beginning.0, BEGINNING.0, BEGINNING.1));
        Ok((Self { settings, known, records, layout, prior, curve }, start, space))
    }

    fn log_capacity(&self) -> usize {
        self.layout.len()
    }

    fn offset(&self) -> usize {
        self.layout.len() + 1
    }

    fn beginning(&self, k: usize) -> usize {
        self.layout.len() + 2 + k
    }

    fn placed(&self, theta: &[f64], k: usize) -> Record {
        let of_all = [theta[self.log_capacity()], theta[self.offset()]];
        place(&self.records[k].record, self.settings, theta[self.beginning(k)], of_all)
    }

    fn evaluate(&self, theta: &[f64]) -> NormalEquations {
        let tables = ParameterTables::new(&self.layout, theta);
        let of_record = |k: usize| {
            let mut normal = NormalEquations::new(theta.len());
            let free = FreeScale {
                grid: &self.settings.grid,
                log_capacity: self.log_capacity(),
                offset: self.offset(),
                capacity_ah: libm::exp(theta[self.log_capacity()]),
                beginning: self.beginning(k),
                beginning_soc: theta[self.beginning(k)],
            };
            let scale = self.records[k].scale;
            accumulate(&self.placed(theta, k), scale, &self.layout, &tables, Some(&free), &mut normal);
            normal
        };
        // Adding the sums in the order of the records makes the result independent of the threads.
        let sums: Vec<NormalEquations> = (0..self.records.len()).into_par_iter().map(of_record).collect();
        let mut normal = NormalEquations::new(theta.len());
        sums.iter().for_each(|sum| normal.add_all(sum));
        self.prior.accumulate(theta, &mut normal);
        self.curve.accumulate(theta, &mut normal);
        self.add_capacity_and_beginnings(theta, &mut normal);
        normal
    }

    /// Converts a solution. `std` returns the standard deviation of the unknown with this index.
    fn outcome(&self, solution: &Solution, std: impl Fn(usize) -> f64) -> UnanchoredFit {
        let theta = &solution.theta;
        let tables = ParameterTables::new(&self.layout, theta);
        let records: Vec<Record> = (0..self.records.len()).map(|k| self.placed(theta, k)).collect();
        let all: Vec<&Record> = records.iter().collect();
        let capacity_ah = libm::exp(theta[self.log_capacity()]);
        UnanchoredFit {
            capacity_ah,
            capacity_std_ah: capacity_ah * std(self.log_capacity()),
            offset_a: theta[self.offset()],
            ocv_std_v: (0..self.layout.nodes).map(&std).collect(),
            fitted: FittedTables {
                grid: self.settings.grid.clone(),
                total: judge(&records, &tables),
                visits_s: visits(&all, self.layout.nodes),
                tables,
                passes: solution.passes,
                converged: solution.converged,
            },
            records,
        }
    }

    /// Adds the priors of the capacity, of the current offset, and of each record's SOC at the start and at a full
    /// charge.
    fn add_capacity_and_beginnings(&self, theta: &[f64], normal: &mut NormalEquations) {
        let (log_capacity, offset) = (self.log_capacity(), self.offset());
        let mut near = |at: usize, mean: f64, std: f64| {
            let residual = (theta[at] - mean) / std;
            normal.cost += 0.5 * residual * residual;
            normal.add(&[at], &[1.0 / std], residual, 1.0);
        };
        near(log_capacity, libm::log(self.known.capacity_ah), self.known.capacity_std);
        near(offset, 0.0, self.known.offset_std_a);
        for (k, record) in self.records.iter().enumerate() {
            near(self.beginning(k), record.beginning.0, record.beginning.1);
        }
        let per_ah = libm::exp(-theta[log_capacity]);
        for (k, (full_ah, full_h)) in self.records.iter().enumerate().filter_map(|(k, it)| Some((k, it.full?))) {
            let taken = (full_ah - theta[offset] * full_h) * per_ah;
            let residual = (theta[self.beginning(k)] - taken - 1.0) / FULL_STD;
            normal.cost += 0.5 * residual * residual;
            let j = [taken / FULL_STD, full_h * per_ah / FULL_STD, 1.0 / FULL_STD];
            normal.add(&[log_capacity, offset, self.beginning(k)], &j, residual, 1.0);
        }
    }
}

/// Fits tables, capacity, offset and the SOC at the records' starts; `progress` receives the pass number and the cost.
///
/// # Errors
/// There are too few rows, or values are not finite.
pub fn fit(
    settings: &FitSettings,
    known: &Known,
    records: &[UnanchoredRecord],
    progress: impl FnMut(usize, f64),
) -> Result<UnanchoredFit, String> {
    let judged = records.iter().flat_map(|r| &r.record.rows).filter(|row| row.weight_s > 0.0).count();
    if judged < MIN_ROWS {
        return Err(format!("{judged} rows can be judged, at least {MIN_ROWS} are needed"));
    }
    let (problem, start, space) = Problem::new(settings, known, records)?;
    if !problem.evaluate(&space.inside(&start)).cost.is_finite() {
        return Err("the data or the starting values are not finite".to_owned());
    }
    let solution = minimise(&space, &start, |theta| problem.evaluate(theta), progress);
    let n = solution.theta.len();
    let information = DMatrix::from_vec(n, n, problem.evaluate(&solution.theta).symmetric());
    let covariance = information.cholesky().map(|factor| factor.inverse());
    let std = |at: usize| covariance.as_ref().map_or(f64::INFINITY, |covariance| covariance[(at, at)].sqrt());
    Ok(problem.outcome(&solution, std))
}

/// Returns the result of a fit to records that contain no information: the prior model.
///
/// # Errors
/// The prior has no inverse.
pub fn prior(settings: &FitSettings, known: &Known, records: &[UnanchoredRecord]) -> Result<UnanchoredFit, String> {
    let (problem, theta, _) = Problem::new(settings, known, records)?;
    let columns = problem.layout.columns;
    let std = |at: usize| {
        let variance = |s: usize| known.curve_covariance[(s, s)];
        if at == problem.log_capacity() { known.capacity_std } else { variance(at % columns).sqrt() }
    };
    let solution = Solution { cost: problem.evaluate(&theta).cost, theta, passes: 0, converged: true };
    Ok(problem.outcome(&solution, std))
}

fn place(record: &Record, settings: &FitSettings, beginning_soc: f64, [log_capacity, offset_a]: [f64; 2]) -> Record {
    let grid = &settings.grid;
    let per_ah = libm::exp(-log_capacity);
    let (coldest_c, warmest_c) = (grid.temperature_c[0], grid.temperature_c[grid.temperature_c.len() - 1]);
    let mut placed = record.clone();
    for row in &mut placed.rows {
        row.soc = beginning_soc + (row.soc + offset_a * row.time_s / 3600.0) * per_ah;
        let place = grid.place(row.soc, row.temperature_c);
        (row.ocv, row.resistance, row.tau) =
            (grid.ocv_corners(&place), grid.resistance_corners(&place), grid.tau_corners(&place));
        // Cells warm up during a drive, so resistances follow Arrhenius' law beyond the temperatures of the tables.
        let inside_c = row.temperature_c.clamp(coldest_c, warmest_c);
        let factor = arrhenius(row.temperature_c) / arrhenius(inside_c);
        row.resistance.weight.iter_mut().for_each(|weight| *weight *= factor);
    }
    placed
}
