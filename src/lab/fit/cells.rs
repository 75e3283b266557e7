//! Determines how each cell of a pack differs from the mean cell in capacity, resistance and charge. Writes notes on
//! outliers.
//!
//! Input: the voltage of every cell minus the mean voltage (V), and the fitted records of the mean cell. All cells
//! share one curve and one current sensor, so errors of the model and of the current cancel. The voltage difference d
//! is linear in the deviations of the cell:
//!
//! `d = slope (dSOC + (q / C) dlnC - (t / C) leakage) - drop dlnR + offset`
//!
//! Here `slope` is the slope of the OCV over SOC, `drop` is the voltage drop under load, q is the charge taken out, t
//! is the time, and C is the capacity. One least-squares solution per cell gives the deviations.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use crate::filter::median;
use crate::ident::parameters::ParameterTables;
use crate::ident::pass::residuals;
use crate::ident::record::Record;

/// Shortest time between two recorded differences (s). More frequent differences add hardly any information, because
/// their errors are correlated over [`REPEATS_S`].
const PERIOD_S: f64 = 5.0;
/// Standard deviations before the fit: ln capacity, ln resistance, sensor offset (V), leakage (share of the capacity
/// per h), SOC.
const PRIOR: [f64; OWN + 1] = [0.15, 0.4, 0.003, 0.002, 0.15];
/// Number of unknowns of a cell, not counting its SOC at the start of each stretch (a part of a log without gaps).
const OWN: usize = 4;
/// Standard deviation of the error of a difference (V).
const DISTANCE_V: f64 = 0.002;
/// Correlation time of the error of a difference (s).
const REPEATS_S: f64 = 50.0;
const LEAST_CELLS: usize = 4;
/// Smallest distance of an outlier from the median, in robust standard deviations of all cells. The limits
/// [`OWN_DEVIATIONS`] and [`FLOOR`] apply too.
const SPREADS: f64 = 5.0;
/// Smallest distance of an outlier from the median, in standard deviations of its own value. Not applied to the
/// residual.
const OWN_DEVIATIONS: f64 = 3.0;
/// Smallest distance of an outlier from the median: capacity (relative), resistance (relative), residual (V), leakage
/// (share of the capacity per h).
const FLOOR: [f64; 4] = [0.03, 0.15, 0.004, 0.0005];

#[derive(Debug, Clone, Default)]
pub(super) struct CellDistances {
    pub(super) time_s: Vec<f64>,
    pub(super) distance_v: Vec<f32>,
}

impl CellDistances {
    /// Records the differences of the cells from their mean `mean_v`, at most once per [`PERIOD_S`].
    pub(super) fn push(&mut self, time_s: f64, mean_v: f64, voltage_v: &[f64]) {
        if voltage_v.len() >= LEAST_CELLS && self.time_s.last().is_none_or(|last_s| time_s - last_s >= PERIOD_S) {
            self.time_s.push(time_s);
            self.distance_v.extend(voltage_v.iter().map(|v| (v - mean_v) as f32));
        }
    }
}

/// Deviation of one cell from the mean cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellDeviation {
    /// Capacity relative to the mean cell, with its standard deviation.
    pub capacity_ratio: (f64, f64),
    /// Resistance relative to the mean cell, with its standard deviation.
    pub resistance_ratio: (f64, f64),
    /// Leakage in excess of the mean cell, share of the capacity per h, with its standard deviation.
    pub leakage_per_h: (f64, f64),
    /// SOC minus the mean cell's SOC at the start of the first stretch, fraction.
    pub soc_offset: f64,
    /// Root mean square of the unexplained difference (V).
    pub residual_v: f64,
}

struct Factors {
    stretch: usize,
    weight: f64,
    slope_v: f64,
    charge_v: f64,
    hours_v: f64,
    drop_v: f64,
}

/// Returns the deviations of all cells; empty = there are fewer than [`LEAST_CELLS`] cells, or no differences.
pub(super) fn fit(
    cells: usize,
    distances: &[&CellDistances],
    records: &[Record],
    tables: &ParameterTables,
    soc: &[f64],
) -> Vec<CellDeviation> {
    if cells < LEAST_CELLS {
        return vec![];
    }
    let factors: Vec<Factors> = distances
        .iter()
        .zip(records)
        .enumerate()
        .flat_map(|(stretch, (distances, record))| factors(stretch, distances, record, tables, soc))
        .collect();
    if factors.is_empty() {
        return vec![];
    }
    let all_v: Vec<&[f32]> = distances.iter().flat_map(|it| it.distance_v.chunks_exact(cells)).collect();
    (0..cells).into_par_iter().map(|cell| fit_cell(cell, distances.len(), &factors, &all_v)).collect()
}

/// Returns the coefficients of the equation of each difference. They come from the latest row that is not after the
/// difference.
fn factors(
    stretch: usize,
    distances: &CellDistances,
    record: &Record,
    tables: &ParameterTables,
    soc: &[f64],
) -> Vec<Factors> {
    let residual_v = residuals(record, tables);
    let first_soc = record.rows.first().map_or(0.0, |row| row.soc);
    let mut last_s = f64::NEG_INFINITY;
    let begin_s = distances.time_s.first().copied().unwrap_or(0.0);
    let of_time = |&time_s: &f64| {
        let at = record.rows.partition_point(|row| row.time_s <= time_s - begin_s).saturating_sub(1);
        let row = &record.rows[at];
        let columns = soc.len();
        let low = row.ocv.iter().map(|(node, _)| node).min().unwrap_or(0);
        let s = (low % columns).min(columns - 2);
        let first = low - low % columns;
        let slope_v = (tables.ocv_v[first + s + 1] - tables.ocv_v[first + s]) / (soc[s + 1] - soc[s]);
        let drop_v = row.ocv.at(&tables.ocv_v) - (row.voltage_v - residual_v[at]);
        let weight = (time_s - last_s).min(REPEATS_S) / REPEATS_S;
        last_s = time_s;
        Factors {
            stretch,
            weight,
            slope_v,
            charge_v: slope_v * (first_soc - row.soc),
            hours_v: slope_v * row.time_s / 3600.0,
            drop_v,
        }
    };
    distances.time_s.iter().map(of_time).collect()
}

fn fit_cell(cell: usize, stretches: usize, factors: &[Factors], all_v: &[&[f32]]) -> CellDeviation {
    let size = OWN + stretches;
    let prior = |i: usize| PRIOR[i.min(OWN)];
    let mut normal = DMatrix::from_fn(size, size, |a, b| if a == b { 1.0 / (prior(a) * prior(a)) } else { 0.0 });
    let mut right = DVector::zeros(size);
    let rows = || factors.iter().zip(all_v).filter(|(_, v)| v[cell].is_finite());
    for (at, v) in rows() {
        let weight = at.weight / (DISTANCE_V * DISTANCE_V);
        let terms = at.terms();
        for (i, a) in terms {
            right[i] += weight * a * f64::from(v[cell]);
            for (j, b) in terms {
                normal[(i, j)] += weight * a * b;
            }
        }
    }
    // The prior makes the matrix positive definite.
    let Some(inverse) = normal.cholesky().map(|factor| factor.inverse()) else { return CellDeviation::unknown() };
    let x = &inverse * right;
    let (mut squares, mut weights) = (0.0, 0.0);
    for (at, v) in rows() {
        let model_v: f64 = at.terms().iter().map(|&(i, term)| term * x[i]).sum();
        squares += at.weight * (f64::from(v[cell]) - model_v).powi(2);
        weights += at.weight;
    }
    if weights <= 0.0 {
        return CellDeviation::unknown();
    }
    let residual_v = (squares / weights).sqrt();
    // If the residual exceeds [`DISTANCE_V`], the standard deviations grow in proportion.
    let scale = (residual_v / DISTANCE_V).max(1.0);
    let ratio = |i: usize| {
        let ratio = libm::exp(x[i]);
        (ratio, ratio * scale * inverse[(i, i)].sqrt())
    };
    let leakage_per_h = (x[3], scale * inverse[(3, 3)].sqrt());
    CellDeviation {
        capacity_ratio: ratio(0),
        resistance_ratio: ratio(1),
        leakage_per_h,
        soc_offset: x[OWN],
        residual_v,
    }
}

impl Factors {
    /// Returns the unknowns on which the difference depends, each as index and factor.
    fn terms(&self) -> [(usize, f64); OWN + 1] {
        let soc = (OWN + self.stretch, self.slope_v);
        [(0, self.charge_v), (1, -self.drop_v), (2, 1.0), (3, -self.hours_v), soc]
    }
}

impl CellDeviation {
    fn unknown() -> Self {
        let unknown = (f64::NAN, f64::INFINITY);
        Self {
            capacity_ratio: unknown,
            resistance_ratio: unknown,
            leakage_per_h: unknown,
            soc_offset: f64::NAN,
            residual_v: f64::NAN,
        }
    }
}

pub(super) fn notes(cells: &[CellDeviation]) -> Vec<String> {
    if cells.is_empty() {
        return vec![];
    }
    let capacity = Spread::of(cells.iter().map(|cell| cell.capacity_ratio.0));
    let resistance = Spread::of(cells.iter().map(|cell| cell.resistance_ratio.0));
    let leakage = Spread::of(cells.iter().map(|cell| cell.leakage_per_h.0));
    let residual = Spread::of(cells.iter().map(|cell| cell.residual_v));
    let (percent, of) = (|x: f64| 100.0 * x, OWN_DEVIATIONS);
    let mut notes = vec![format!(
        "{} cells: standard deviation of the capacity {:.1} %, of the resistance {:.1} %",
        cells.len(),
        percent(capacity.deviation),
        percent(resistance.deviation)
    )];
    for (number, cell) in (1..).zip(cells) {
        let mut what = Vec::new();
        let [(c, c_std), (r, r_std)] = [cell.capacity_ratio, cell.resistance_ratio];
        if capacity.is_far(c, FLOOR[0]) && (c - capacity.median).abs() > of * c_std {
            what.push(format!("capacity {:+.1} +/- {:.1} %", percent(c / capacity.median - 1.0), percent(c_std)));
        }
        if resistance.is_far(r, FLOOR[1]) && (r - resistance.median).abs() > of * r_std {
            what.push(format!("resistance {:+.0} +/- {:.0} %", percent(r / resistance.median - 1.0), percent(r_std)));
        }
        let (l, l_std) = cell.leakage_per_h;
        if leakage.is_far(l, FLOOR[3]) && (l - leakage.median).abs() > of * l_std {
            what.push(format!(
                "loses {:.2} % of its charge per hour more than the others",
                percent(l - leakage.median)
            ));
        }
        if residual.is_far(cell.residual_v, FLOOR[2]) {
            what.push(format!("voltage differs from the others by {:.1} mV rms", 1e3 * cell.residual_v));
        }
        if cell.capacity_ratio.0.is_nan() {
            what.push("no reading".to_owned());
        }
        if !what.is_empty() {
            notes.push(format!("cell {number} is an outlier: {}", what.join(", ")));
        }
    }
    notes
}

struct Spread {
    median: f64,
    deviation: f64,
}

impl Spread {
    fn of(values: impl Iterator<Item = f64> + Clone) -> Self {
        let centre = median(values.clone()).unwrap_or(f64::NAN);
        let distance = median(values.map(|value| (value - centre).abs())).unwrap_or(f64::NAN);
        // Ratio of the standard deviation of a normal distribution to its median absolute deviation.
        Self { median: centre, deviation: 1.4826 * distance }
    }

    fn is_far(&self, value: f64, floor: f64) -> bool {
        (value - self.median).abs() > (SPREADS * self.deviation).max(floor)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(capacity: f64, resistance: f64, residual_v: f64) -> CellDeviation {
        let (capacity_ratio, resistance_ratio) = ((capacity, 0.005), (resistance, 0.01));
        CellDeviation { capacity_ratio, resistance_ratio, leakage_per_h: (0.0, 1e-5), soc_offset: 0.0, residual_v }
    }

    #[test]
    fn only_cells_far_from_the_others_are_outliers() {
        let mut cells: Vec<CellDeviation> =
            (0..20).map(|k| cell(1.0 + 0.002 * f64::from(k % 5), 1.0 + 0.01 * f64::from(k % 3), 0.001)).collect();
        assert_eq!(notes(&cells).len(), 1, "{:?}", notes(&cells));
        cells[3] = cell(0.92, 1.0, 0.001);
        cells[7] = cell(1.0, 1.5, 0.001);
        cells[9] = cell(1.0, 1.0, 0.02);
        let found = notes(&cells);
        assert!(found[1].starts_with("cell 4 is an outlier: capacity -8."), "{found:?}");
        assert!(found[2].starts_with("cell 8 is an outlier: resistance +4"), "{found:?}");
        assert!(found[3].starts_with("cell 10 is an outlier: voltage differs from the others by 20.0 mV"), "{found:?}");
        assert_eq!(found.len(), 4);
        // A difference within the uncertainty of the cell's own value is not an outlier.
        cells[3].capacity_ratio.1 = 0.05;
        assert_eq!(notes(&cells).len(), 3);
    }

    #[test]
    fn small_differences_between_equal_cells_are_ignored() {
        let mut cells = vec![cell(1.0, 1.0, 0.0); 8];
        cells[0] = cell(0.98, 1.1, 0.003);
        assert_eq!(notes(&cells).len(), 1);
        assert!(
            fit(3, &[], &[], &ParameterTables { ocv_v: vec![], r0_ohm: vec![], r_ohm: vec![], tau_s: vec![] }, &[])
                .is_empty()
        );
    }
}
