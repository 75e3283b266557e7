//! Makes one pass over the data: computes the residuals, their exact Jacobian, and the normal equations.
//!
//! The residual of a row is e = V - (OCV(s,T) - sum U_i - R0(s,T) I). Between rows, the voltage U of a branch has an
//! exact solution:
//!
//! `U' = R I + x (U - R I)` with `x = exp(-dt / tau)`.
//!
//! The derivatives of U are exact too:
//!
//! `dU' = x dU + (1 - x) I dR + (U - R I) x dt / tau^2 dtau`.
//!
//! Derivatives decay with the branch voltage and are dropped below [`FADED_V`]. A row therefore affects only a few
//! nodes, and the work per row does not grow with the tables.
//!
//! Beyond [`HUBER_V`], the cost grows linearly (Huber), so that errors that no circuit can explain do not distort the
//! tables. If the SOC is unknown ([`FreeScale`]), each residual is divided by the circuit model's usual error at the
//! row's voltage drop and temperature ([`circuit_error_v`]). Without this division, the model's larger error in the
//! cold would be mistaken for lost capacity.

use super::grid::{Corners, Grid, arrhenius};
use super::parameters::{Layout, ParameterTables};
use super::record::{FitRow, Record};

/// Smaller derivatives are dropped (V per unit of a log parameter): a thousandth of the voltage resolution.
const FADED_V: f64 = 1e-6;
/// Residual above which the cost grows linearly (V).
pub const HUBER_V: f64 = 0.05;
/// Standard deviation of an independent residual (V): the error of a good circuit model.
const SIGMA_V: f64 = 0.010;
/// Correlation time of the model error (s). All residuals within this time count as one independent residual.
const REPEATS_S: f64 = 50.0;
/// Correlation time of the model error if the SOC is unknown (s). The fit of a cell with a flat curve (EVE) needs at
/// least this value. For Panasonic 18650PF cells and a simulated LG M50, values from 50 to 500 s change the mean SOC
/// errors by less than 0.1 points. Changes of [`DROP_ERROR`] and [`COLD_POWER`] have equally small effects.
const FREE_REPEATS_S: f64 = 250.0;
/// Error of a circuit model, as a share of the voltage drop.
const DROP_ERROR: f64 = 0.05;
/// Power of the Arrhenius factor with which a circuit model's error grows in the cold.
pub const COLD_POWER: f64 = 0.7;
/// The cost grows linearly beyond this multiple of the circuit model's error.
const HUBER_ERRORS: f64 = 3.0;

/// Normal equations of the node parameters.
#[derive(Debug, Clone)]
pub struct NormalEquations {
    n: usize,
    /// Matrix, row-major. The product of two parameters is stored in only one of its two symmetric places;
    /// [`NormalEquations::symmetric`] fills the other.
    h: Vec<f64>,
    /// Gradient of the cost.
    pub g: Vec<f64>,
    /// Cost: half the weighted sum of squares (beyond the Huber limit: linear).
    pub cost: f64,
}

impl NormalEquations {
    /// Creates empty equations for `n` parameters.
    pub fn new(n: usize) -> Self {
        Self { n, h: vec![0.0; n * n], g: vec![0.0; n], cost: 0.0 }
    }

    /// Adds an observation. `j` contains the derivatives de/dtheta of the residual e = measured - model with respect to
    /// the parameters in `index`.
    pub fn add(&mut self, index: &[usize], j: &[f64], residual: f64, weight: f64) {
        for (a, &row) in index.iter().enumerate() {
            let weighted = weight * j[a];
            self.g[row] += weighted * residual;
            let line = &mut self.h[row * self.n..(row + 1) * self.n];
            for (&column, &value) in index[a..].iter().zip(&j[a..]) {
                line[column] += weighted * value;
            }
        }
    }

    /// Adds other equations.
    pub fn add_all(&mut self, other: &Self) {
        self.h.iter_mut().zip(&other.h).for_each(|(a, b)| *a += b);
        self.g.iter_mut().zip(&other.g).for_each(|(a, b)| *a += b);
        self.cost += other.cost;
    }

    /// Returns the full symmetric matrix, row-major.
    pub fn symmetric(&self) -> Vec<f64> {
        let n = self.n;
        let mut full = self.h.clone();
        for a in 0..n {
            for b in a + 1..n {
                let sum = self.h[a * n + b] + self.h[b * n + a];
                (full[a * n + b], full[b * n + a]) = (sum, sum);
            }
        }
        full
    }
}

struct BranchRun {
    voltage_v: f64,
    by_r: Vec<f64>,
    by_tau: Vec<f64>,
    alive: Vec<usize>,
    is_alive: Vec<bool>,
}

impl BranchRun {
    fn new(nodes: usize) -> Self {
        let zero = vec![0.0; nodes];
        Self { voltage_v: 0.0, by_r: zero.clone(), by_tau: zero, alive: Vec::new(), is_alive: vec![false; nodes] }
    }

    fn relax(&mut self) {
        self.voltage_v = 0.0;
        for node in self.alive.drain(..) {
            (self.by_r[node], self.by_tau[node], self.is_alive[node]) = (0.0, 0.0, false);
        }
    }

    /// Advances the voltage by the step of a row, but not the stored derivatives. Returns the decay x and the
    /// derivative dU'/dtau of this step.
    fn step_voltage(&mut self, row: &FitRow, r_ohm: &[f64], tau_s: &[f64]) -> (f64, f64) {
        let (r, tau) = (row.resistance.at(r_ohm), row.tau.at(tau_s));
        let settled = r * row.mean_current_a;
        let decay = libm::exp(-row.dt_s / tau);
        let above = self.voltage_v - settled;
        self.voltage_v = settled + decay * above;
        (decay, above * decay * row.dt_s / (tau * tau))
    }

    fn step(&mut self, row: &FitRow, r_ohm: &[f64], tau_s: &[f64]) {
        let (decay, by_tau) = self.step_voltage(row, r_ohm, tau_s);
        self.fade(decay);
        let by_r = (1.0 - decay) * row.mean_current_a;
        for (node, weight) in row.resistance.iter() {
            self.wake(node);
            self.by_r[node] += by_r * weight * r_ohm[node];
        }
        for (node, weight) in row.tau.iter() {
            self.wake(node);
            self.by_tau[node] += by_tau * weight * tau_s[node];
        }
    }

    fn wake(&mut self, node: usize) {
        if !self.is_alive[node] {
            self.is_alive[node] = true;
            self.alive.push(node);
        }
    }

    fn fade(&mut self, decay: f64) {
        let Self { by_r, by_tau, alive, is_alive, .. } = self;
        alive.retain(|&node| {
            by_r[node] *= decay;
            by_tau[node] *= decay;
            let keep = by_r[node].abs() > FADED_V || by_tau[node].abs() > FADED_V;
            if !keep {
                (by_r[node], by_tau[node], is_alive[node]) = (0.0, 0.0, false);
            }
            keep
        });
    }
}

/// Returns the residuals of a record (V): one per row, including rows that do not count in the fit.
pub fn residuals(record: &Record, tables: &ParameterTables) -> Vec<f64> {
    let mut branches: Vec<_> = tables.r_ohm.iter().map(|_| BranchRun::new(0)).collect();
    let of_row = |row: &FitRow| {
        let mut model_v = row.ocv.at(&tables.ocv_v) - row.resistance.at(&tables.r0_ohm) * row.current_a;
        for (i, branch) in branches.iter_mut().enumerate() {
            if row.relaxed {
                branch.voltage_v = 0.0;
            } else {
                branch.step_voltage(row, &tables.r_ohm[i], &tables.tau_s[i]);
            }
            model_v -= branch.voltage_v;
        }
        row.voltage_v - model_v
    };
    record.rows.iter().map(of_row).collect()
}

/// Unknowns of a record without measured SOC: the SOC at the beginning, the capacity, and the offset of the current
/// sensor. SOC = beginning - (charge - offset x time) / capacity.
#[derive(Debug, Clone, Copy)]
pub struct FreeScale<'a> {
    /// Breakpoints.
    pub grid: &'a Grid,
    /// Index of ln(capacity).
    pub log_capacity: usize,
    /// Index of the current sensor's offset (A).
    pub offset: usize,
    /// Capacity (Ah).
    pub capacity_ah: f64,
    /// Index of the SOC at the record's first row.
    pub beginning: usize,
    /// SOC at the record's first row.
    pub beginning_soc: f64,
}

impl FreeScale<'_> {
    /// Adds the derivatives of a row's residual with respect to these unknowns. Only the effect of the SOC on the
    /// open-circuit voltage is included.
    fn derivatives(&self, row: &FitRow, tables: &ParameterTables, index: &mut Vec<usize>, j: &mut Vec<f64>) {
        let place = self.grid.place(row.soc, row.temperature_c);
        let columns = self.grid.soc.len();
        let rise_v = |t: usize| {
            let first = t * columns + place.s;
            tables.ocv_v[first + 1] - tables.ocv_v[first]
        };
        let upper_v = if place.along_t == 0.0 { 0.0 } else { place.along_t * rise_v(place.t + 1) };
        let slope_v =
            ((1.0 - place.along_t) * rise_v(place.t) + upper_v) / (self.grid.soc[place.s + 1] - self.grid.soc[place.s]);
        index.extend([self.log_capacity, self.offset, self.beginning]);
        let by_offset = row.time_s / 3600.0 / self.capacity_ah;
        j.extend([-slope_v * (self.beginning_soc - row.soc), -slope_v * by_offset, -slope_v]);
    }
}

/// Adds the residuals and derivatives of a record to `normal`. The weights of the record's rows are multiplied by
/// `scale`. If `free` is given, the derivatives with respect to the unknowns of `free` are also added.
pub fn accumulate(
    record: &Record,
    scale: f64,
    layout: &Layout,
    tables: &ParameterTables,
    free: Option<&FreeScale<'_>>,
    normal: &mut NormalEquations,
) {
    let mut branches: Vec<_> = (0..layout.branches).map(|_| BranchRun::new(layout.nodes)).collect();
    let (mut index, mut j) = (Vec::with_capacity(128), Vec::with_capacity(128));
    for row in &record.rows {
        let mut model_v = row.ocv.at(&tables.ocv_v) - row.resistance.at(&tables.r0_ohm) * row.current_a;
        for (i, branch) in branches.iter_mut().enumerate() {
            if row.relaxed {
                branch.relax();
            } else {
                branch.step(row, &tables.r_ohm[i], &tables.tau_s[i]);
            }
            model_v -= branch.voltage_v;
        }
        if row.weight_s > 0.0 {
            derivatives(row, layout, tables, &branches, &mut index, &mut j);
            if let Some(free) = free {
                free.derivatives(row, tables, &mut index, &mut j);
            }
            let residual = row.voltage_v - model_v;
            let (cost, weight) = if free.is_some() {
                let drop_v = row.ocv.at(&tables.ocv_v) - model_v;
                free_cost(residual, circuit_error_v(drop_v, row.temperature_c))
            } else {
                let (cost, robust) = huber(residual);
                let scale = 1.0 / (SIGMA_V * SIGMA_V * REPEATS_S);
                (scale * cost, scale * robust)
            };
            normal.cost += scale * row.weight_s * cost;
            normal.add(&index, &j, residual, scale * row.weight_s * weight);
        }
    }
}

fn derivatives(
    row: &FitRow,
    layout: &Layout,
    tables: &ParameterTables,
    branches: &[BranchRun],
    index: &mut Vec<usize>,
    j: &mut Vec<f64>,
) {
    index.clear();
    j.clear();
    let mut push = |at: usize, value: f64| {
        index.push(at);
        j.push(value);
    };
    for (node, weight) in row.ocv.iter() {
        push(node, -weight);
    }
    for (node, weight) in row.resistance.iter() {
        push(layout.r0() + node, weight * tables.r0_ohm[node] * row.current_a);
    }
    for (i, branch) in branches.iter().enumerate() {
        for &node in &branch.alive {
            push(layout.branch_r(i) + node, branch.by_r[node]);
            push(layout.branch_tau(i) + node, branch.by_tau[node]);
        }
    }
}

/// Returns the error of a circuit model (V) that is expected at a voltage drop and a temperature.
fn circuit_error_v(drop_v: f64, temperature_c: f64) -> f64 {
    SIGMA_V.hypot(DROP_ERROR * drop_v) * libm::pow(arrhenius(temperature_c).max(1.0), COLD_POWER)
}

/// Returns the cost per second of a residual with the expected error `error_v`, and the weight of its square in the
/// normal equations. The expected error depends on the parameters, because it grows with the voltage drop. Therefore
/// the cost includes the logarithm of the expected error.
fn free_cost(residual: f64, error_v: f64) -> (f64, f64) {
    let errors = residual.abs() / error_v;
    let (cost, robust) = if errors <= HUBER_ERRORS {
        (0.5 * errors * errors, 1.0)
    } else {
        (HUBER_ERRORS * (errors - 0.5 * HUBER_ERRORS), HUBER_ERRORS / errors)
    };
    ((cost + libm::log(error_v / SIGMA_V)) / FREE_REPEATS_S, robust / (error_v * error_v * FREE_REPEATS_S))
}

/// Returns the cost of a residual, and the weight of its square in the normal equations.
fn huber(residual: f64) -> (f64, f64) {
    let size = residual.abs();
    if size <= HUBER_V { (0.5 * residual * residual, 1.0) } else { (HUBER_V * (size - 0.5 * HUBER_V), HUBER_V / size) }
}

/// Returns the seconds of data near each node.
pub fn visits(records: &[&Record], nodes: usize) -> Vec<f64> {
    let mut seconds = vec![0.0; nodes];
    let mut visit = |corners: &Corners, weight_s: f64| {
        for (node, weight) in corners.iter() {
            seconds[node] += weight.clamp(0.0, 1.0) * weight_s;
        }
    };
    for row in records.iter().flat_map(|record| &record.rows) {
        visit(&row.resistance, row.weight_s);
    }
    seconds
}
