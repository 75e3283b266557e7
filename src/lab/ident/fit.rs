//! Runs a whole fit of a cell model: sets starting values and prior, and passes over all records in parallel until the
//! cost stops falling. The result also contains the residuals, and the seconds of data near each node.

use rayon::prelude::*;

use super::grid::{Grid, arrhenius, interpolate};
use super::parameters::{Layout, ParameterTables};
use super::pass::{NormalEquations, accumulate, residuals, visits};
use super::prior::{Prior, PriorDeviations, per_node};
use super::record::Record;
use super::solve::{Space, minimise};
use crate::filter::median;

/// Number of groups of records. Each group is summed separately, and the sums are added in the order of the groups, so
/// that the result does not depend on the number of cores.
const GROUPS: usize = 4;
/// Smallest number of rows that count in a fit.
pub const MIN_ROWS: usize = 50;
/// A node with fewer seconds of data nearby is reported as unsupported.
pub const SUPPORTED_S: f64 = 30.0;
/// A time constant stays within this factor of its starting value.
const TAU_FACTOR: f64 = 5.0;
/// Smallest rise of the open-circuit voltage (OCV), in V per unit of SOC.
pub const MIN_SLOPE_V: f64 = 0.02;
/// Steepest rise of the OCV (V per unit of SOC).
const MAX_SLOPE_V: f64 = 60.0;
/// Resistances stay within this factor of the starting value.
const R_FACTOR: f64 = 100.0;

/// A slow test (a discharge so slow that it shows the OCV): voltage over rising SOC at one temperature.
#[derive(Debug, Clone, PartialEq)]
pub struct OcvCurve {
    /// Cell temperature (degrees C).
    pub temperature_c: f64,
    /// SOC, strictly rising.
    pub soc: Vec<f64>,
    /// Voltage (V).
    pub voltage_v: Vec<f64>,
}

/// Settings of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct FitSettings {
    /// Breakpoints.
    pub grid: Grid,
    /// Starting time constants (s), one per branch, rising.
    pub tau_s: Vec<f64>,
    /// Lowest and highest voltage under load (V).
    pub voltage_v: (f64, f64),
    /// Slow tests, by rising temperature; empty = the data alone determine the OCV.
    pub ocv: Vec<OcvCurve>,
    /// Smallest rise of the OCV (V per unit of SOC), as `(from, slope)`: `slope` applies above the SOC `from`. If
    /// several entries apply, the largest slope counts.
    pub min_slope_v: Vec<(f64, f64)>,
    /// Standard deviations of the prior.
    pub deviations: PriorDeviations,
}

/// Error statistics of one record.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Residual {
    /// Seconds that the counted rows represent.
    pub seconds: f64,
    /// Root mean square (V), weighted by time.
    pub rmse_v: f64,
    /// Mean of measured minus modelled voltage (V).
    pub mean_v: f64,
    /// Residual with the largest absolute value (V).
    pub worst_v: f64,
}

/// Result of a fit.
#[derive(Debug, Clone)]
pub struct FittedTables {
    /// Breakpoints.
    pub grid: Grid,
    /// Values in node order.
    pub tables: ParameterTables,
    /// Residual over all records.
    pub total: Residual,
    /// Seconds of data near each node.
    pub visits_s: Vec<f64>,
    /// Number of passes over the data.
    pub passes: usize,
    /// Whether the cost stopped falling.
    pub converged: bool,
}

const NOT_FINITE: &str = "the data or the starting values are not finite: two slow tests at one temperature, or a value that is not a number";
const NO_EXCITATION: &str = "the current does not change, so no resistance can be separated from the open-circuit voltage; add a file with pulses or a drive";

/// Fits tables to `records`; `scale` is the weight of each record. `progress` receives the pass number and the cost.
///
/// # Errors
/// There are too few rows, or the current never changes.
pub fn fit(
    settings: &FitSettings,
    records: &[Record],
    scale: &[f64],
    progress: impl FnMut(usize, f64),
) -> Result<FittedTables, String> {
    let judged = records.iter().flat_map(|r| &r.rows).filter(|row| row.weight_s > 0.0).count();
    if judged < MIN_ROWS {
        return Err(format!("{judged} rows can be judged, at least {MIN_ROWS} are needed"));
    }
    let layout = Layout::new(&settings.grid, settings.tau_s.len());
    let start = start(settings, &layout, records)?;
    let space = space(settings, &layout, &start);
    let start = space.inside(&start);
    let prior = Prior::new(&settings.grid, &layout, &start, !settings.ocv.is_empty(), &settings.deviations);
    let groups = groups(records, scale);
    let evaluate = |theta: &[f64]| {
        let mut normal = sum_of_groups(&groups, &layout, theta);
        prior.accumulate(theta, &mut normal);
        normal
    };
    if !evaluate(&start).cost.is_finite() {
        return Err(NOT_FINITE.to_owned());
    }
    let solution = minimise(&space, &start, evaluate, progress);
    let tables = ParameterTables::new(&layout, &solution.theta);
    let total = judge(records, &tables);
    let all: Vec<&Record> = records.iter().collect();
    Ok(FittedTables {
        grid: settings.grid.clone(),
        total,
        visits_s: visits(&all, layout.nodes),
        tables,
        passes: solution.passes,
        converged: solution.converged,
    })
}

type Group<'a> = Vec<(&'a Record, f64)>;

/// Distributes the records over at most [`GROUPS`] groups, the longest first. Each record goes to the group with the
/// fewest rows, so that all groups take about equally long.
fn groups<'a>(records: &'a [Record], scale: &[f64]) -> Vec<Group<'a>> {
    let mut order: Vec<usize> = (0..records.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(records[i].rows.len()));
    let mut groups: Vec<Group<'a>> = vec![Vec::new(); GROUPS.min(records.len()).max(1)];
    let mut filled = vec![0; groups.len()];
    for i in order {
        let emptiest = (0..groups.len()).min_by_key(|&g| filled[g]).unwrap_or(0);
        filled[emptiest] += records[i].rows.len();
        groups[emptiest].push((&records[i], scale[i]));
    }
    groups
}

fn sum_of_groups(groups: &[Group<'_>], layout: &Layout, theta: &[f64]) -> NormalEquations {
    let tables = &ParameterTables::new(layout, theta);
    let of_group = |group: &Group<'_>| {
        let mut normal = NormalEquations::new(layout.len());
        for (record, scale) in group {
            accumulate(record, *scale, layout, tables, None, &mut normal);
        }
        normal
    };
    let sums: Vec<NormalEquations> = groups.par_iter().map(of_group).collect();
    sums.iter().fold(NormalEquations::new(layout.len()), |mut sum, group| {
        sum.add_all(group);
        sum
    })
}

/// Returns the starting values: the OCV of the slow test or a straight line, resistances from current steps, and the
/// time constants of the settings.
fn start(settings: &FitSettings, layout: &Layout, records: &[Record]) -> Result<Vec<f64>, String> {
    let grid = &settings.grid;
    let mut theta = match settings.ocv.is_empty() {
        true => grid.temperature_c.iter().flat_map(|_| straight_ocv(settings)).collect(),
        false => ocv_nodes(grid, &settings.ocv),
    };
    let r0_ohm = resistance_of_steps(records).ok_or(NO_EXCITATION)?;
    let ln_r = |ohm: f64| per_node(grid, |t| libm::log(ohm * arrhenius(t)));
    theta.extend(ln_r(r0_ohm));
    for &tau_s in &settings.tau_s {
        theta.extend(ln_r(0.5 * r0_ohm));
        theta.extend(vec![libm::log(tau_s); layout.nodes]);
    }
    Ok(theta)
}

fn straight_ocv(settings: &FitSettings) -> Vec<f64> {
    let (low, high) = settings.voltage_v;
    settings.grid.soc.iter().map(|s| low + s * (high - low)).collect()
}

/// Returns the OCV at every node from slow tests. It is linear between the temperatures of two tests. Outside these
/// temperatures, the nearest test applies.
pub fn ocv_nodes(grid: &Grid, curves: &[OcvCurve]) -> Vec<f64> {
    let temperatures: Vec<f64> = curves.iter().map(|c| c.temperature_c).collect();
    let at = |t: f64, soc: f64| {
        let voltages: Vec<f64> = (0..curves.len()).map(|c| curve_at(curves, c, soc)).collect();
        interpolate(&temperatures, &voltages, t)
    };
    grid.temperature_c
        .iter()
        .flat_map(|&t| grid.soc.iter().map(move |&soc| (t, soc)))
        .map(|(t, soc)| at(t, soc))
        .collect()
}

/// Returns the voltage of a curve. Below the SOC at which a cold test ended, the curve continues with the shape of the
/// next warmer curve.
fn curve_at(curves: &[OcvCurve], which: usize, soc: f64) -> f64 {
    let curve = &curves[which];
    let end = curve.soc[0];
    if soc >= end || which + 1 >= curves.len() {
        return interpolate(&curve.soc, &curve.voltage_v, soc);
    }
    curve.voltage_v[0] + curve_at(curves, which + 1, soc) - curve_at(curves, which + 1, end)
}

fn resistance_of_steps(records: &[Record]) -> Option<f64> {
    let mut found = Vec::new();
    for record in records {
        let largest = record.rows.iter().fold(0.0_f64, |most, row| most.max(row.current_a.abs()));
        for pair in record.rows.windows(2).filter(|pair| pair[1].dt_s <= 20.0) {
            let step_a = pair[1].current_a - pair[0].current_a;
            let ohm = (pair[0].voltage_v - pair[1].voltage_v) / step_a;
            if step_a.abs() > 0.2 * largest && ohm > 0.0 && ohm.is_finite() {
                found.push(ohm / arrhenius(pair[1].temperature_c));
            }
        }
    }
    median(found.into_iter())
}

pub(super) fn space(settings: &FitSettings, layout: &Layout, start: &[f64]) -> Space {
    let grid = &settings.grid;
    let (mut low, mut high) = (start.to_vec(), start.to_vec());
    let (least_v, most_v) = settings.voltage_v;
    for row in 0..grid.temperature_c.len() {
        let first = row * layout.columns;
        (low[first], high[first]) = (0.5 * least_v, most_v);
        for s in 1..layout.columns {
            let width = grid.soc[s] - grid.soc[s - 1];
            let slope = settings.min_slope_v.iter().filter(|(from, _)| grid.soc[s] > *from).map(|(_, slope)| *slope);
            low[first + s] = width * slope.fold(MIN_SLOPE_V, f64::max);
            high[first + s] = width * MAX_SLOPE_V;
        }
    }
    let mut within = |first: usize, factor: f64| {
        for at in first..first + layout.nodes {
            (low[at], high[at]) = (start[at] - libm::log(factor), start[at] + libm::log(factor));
        }
    };
    within(layout.r0(), R_FACTOR);
    for i in 0..layout.branches {
        within(layout.branch_r(i), R_FACTOR);
        within(layout.branch_tau(i), TAU_FACTOR);
    }
    let rising = (0..grid.temperature_c.len()).map(|row| (row * layout.columns, layout.columns)).collect();
    Space { low, high, rising }
}

/// Returns the residual over all records.
pub fn judge(records: &[Record], tables: &ParameterTables) -> Residual {
    let mut total = ResidualSums::default();
    for record in records {
        let mut sums = ResidualSums::default();
        for (row, e) in record.rows.iter().zip(residuals(record, tables)) {
            sums.add(row.weight_s, e);
        }
        total.join(&sums);
    }
    total.residual()
}

/// Running sums of weighted residuals.
#[derive(Debug, Clone, Copy, Default)]
pub struct ResidualSums {
    weight: f64,
    first: f64,
    second: f64,
    worst: f64,
}

impl ResidualSums {
    /// Adds one residual and the seconds it represents.
    pub fn add(&mut self, weight_s: f64, e: f64) {
        if weight_s > 0.0 {
            self.weight += weight_s;
            self.first += weight_s * e;
            self.second += weight_s * e * e;
            self.worst = if e.abs() > self.worst.abs() { e } else { self.worst };
        }
    }

    /// Adds the sums of another record.
    pub fn join(&mut self, other: &Self) {
        self.weight += other.weight;
        self.first += other.first;
        self.second += other.second;
        self.worst = if other.worst.abs() > self.worst.abs() { other.worst } else { self.worst };
    }

    /// Returns the statistics.
    pub fn residual(&self) -> Residual {
        if self.weight == 0.0 {
            return Residual::default();
        }
        Residual {
            seconds: self.weight,
            rmse_v: (self.second / self.weight).sqrt(),
            mean_v: self.first / self.weight,
            worst_v: self.worst,
        }
    }
}

impl FittedTables {
    /// Returns temperature and SOC of the nodes with less than [`SUPPORTED_S`] of data.
    pub fn unsupported(&self) -> Vec<(f64, f64)> {
        let columns = self.grid.soc.len();
        let weak = self.visits_s.iter().enumerate().filter(|(_, seconds)| **seconds < SUPPORTED_S);
        weak.map(|(node, _)| (self.grid.temperature_c[node / columns], self.grid.soc[node % columns])).collect()
    }

    /// Returns the open-circuit voltage averaged over SOC and temperature (V).
    pub fn mean_ocv_v(&self) -> f64 {
        let of_row = |row: &[f64]| -> f64 {
            let pairs = row.windows(2).zip(self.grid.soc.windows(2));
            pairs.map(|(v, soc)| 0.5 * (v[0] + v[1]) * (soc[1] - soc[0])).sum()
        };
        let rows = self.tables.ocv_v.chunks(self.grid.soc.len());
        rows.map(of_row).sum::<f64>() / self.grid.temperature_c.len() as f64
    }

    /// Returns the open-circuit voltage (V) of the temperature row nearest to `temperature_c`.
    pub fn ocv_v(&self, soc: f64, temperature_c: f64) -> f64 {
        let distance = |t: usize| (self.grid.temperature_c[t] - temperature_c).abs();
        let rows = 0..self.grid.temperature_c.len();
        let row = rows.min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap_or(0);
        let at = self.grid.place(soc, self.grid.temperature_c[row]);
        let values = &self.tables.ocv_v[row * self.grid.soc.len()..][..self.grid.soc.len()];
        values[at.s] + at.beyond_s * (values[at.s + 1] - values[at.s])
    }
}

#[cfg(test)]
mod tests;
