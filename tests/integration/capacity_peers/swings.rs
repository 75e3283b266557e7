//! Computes swings from the voltage alone: the SOC at both ends comes from the inverted open-circuit curve.
//!
//! The open-circuit voltage is V + I R0 rho + sum U, with V the cell's voltage, I the current (positive = discharge),
//! R0 the series resistance, rho the filter's resistance ratio and U the voltages of the RC branches. The voltages U
//! are simulated in open loop, starting at 0. If the record begins under load, readings count only after 180 s.
//!
//! Each end of a swing is a mean over the swing's first or last 60 s. A capacity is assumed only to compute how ageing
//! changes the shape of the curve.

use packwatch::cell::aged_ocv::SHIFT_STD;
use packwatch::cell::circuit::BranchAt;
use packwatch::cell::{CellModel, Discretisation, MAX_BRANCHES};
use packwatch::health::CapacityConfig;

use super::least_squares::Swing;

/// If two readings are more than this apart (s), the charge between them is unknown.
const GAP_S: f64 = 60.0;
/// Current below which the cell counts as resting (A).
const REST_A: f64 = 0.05;
/// Three time constants of the models' slowest RC branch (s). Then the branch's unknown initial voltage has decayed.
const SETTLING_S: f64 = 180.0;
/// Length of each end of a swing (s).
const END_S: f64 = 60.0;
/// A swing ends when this fraction of the model's capacity has flowed back.
const REVERSAL: f64 = 0.02;
/// Smallest swing used, as a fraction of the model's capacity.
const MIN_SWING: f64 = 0.05;
/// White noise of a voltage reading (V).
const VOLTAGE_NOISE_V: f64 = 0.005;

/// One reading, with the resistance ratio at that time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Reading {
    pub(crate) time_s: f64,
    pub(crate) voltage_v: f64,
    pub(crate) current_a: f64,
    pub(crate) temperature_c: f64,
    pub(crate) resistance_ratio: f64,
    pub(crate) soc: f64,
    pub(crate) soc_variance: f64,
}

/// SOC, charge and variance of one reading, or means over several readings.
#[derive(Debug, Clone, Copy, Default)]
struct Point {
    time_s: f64,
    /// SOC according to the open-circuit curve of the new cell.
    new_soc: f64,
    variance: f64,
    /// Charge removed since the start (Ah).
    charge_ah: f64,
    soc: f64,
    soc_variance: f64,
    known: bool,
}

/// The two ends of a swing, before a capacity is assumed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VoltageSwing {
    pub(crate) start_s: f64,
    pub(crate) end_s: f64,
    ends: [Point; 2],
}

impl VoltageSwing {
    /// Swing for a cell of assumed capacity `capacity_ah`, which determines the curve's shape.
    pub(crate) fn swing(&self, model: &CellModel, config: &CapacityConfig, capacity_ah: f64) -> Swing {
        let lost = 1.0 - capacity_ah / model.capacity_ah;
        let [(a, a_variance), (b, b_variance)] = self.ends.map(|end| {
            let soc = aged_soc(model, end.new_soc, capacity_ah);
            let shape = SHIFT_STD * lost * soc * (1.0 - soc);
            (soc, end.variance + shape * shape)
        });
        self.between(config, a - b, a_variance + b_variance)
    }

    /// Swing of the filter's SOC between the same ends.
    pub(crate) fn filter_swing(&self, config: &CapacityConfig) -> Swing {
        let [a, b] = &self.ends;
        self.between(config, a.soc - b.soc, a.soc_variance + b.soc_variance)
    }

    fn between(&self, config: &CapacityConfig, fall: f64, x_variance: f64) -> Swing {
        let moved_ah = self.ends[1].charge_ah - self.ends[0].charge_ah;
        let (x, y_ah) = (fall * moved_ah.signum(), moved_ah.abs());
        Swing { x, x_variance, y_ah, y_variance: charge_variance(config, y_ah, self.end_s - self.start_s) }
    }
}

/// Variance of a charge from the sensor's gain and offset (Ah^2).
pub(crate) fn charge_variance(config: &CapacityConfig, charge_ah: f64, duration_s: f64) -> f64 {
    let gain_ah = config.current_gain_std * charge_ah;
    let offset_ah = config.current_offset_std_a * duration_s / 3600.0;
    // The configuration may give neither gain nor offset. The standard deviation is therefore at least 0.1 % of the
    // charge.
    (gain_ah * gain_ah + offset_ah * offset_ah).max(1e-6 * charge_ah * charge_ah)
}

/// SOC at which the aged cell has the same open-circuit voltage as a new cell at `new_soc`.
fn aged_soc(model: &CellModel, new_soc: f64, capacity_ah: f64) -> f64 {
    const ANY_C: f64 = 25.0;
    let voltage_v = model.ocv_v(&model.grid_position(new_soc, ANY_C));
    model.soc_of_aged_ocv(&model.temperature_position(ANY_C), capacity_ah, voltage_v)
}

/// Readings that form the ends of a swing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ends {
    /// All readings, including those at rest.
    Outer,
    /// Only readings with current.
    Loaded,
}

/// All swings of a life.
pub(crate) fn weigh(model: &CellModel, config: &CapacityConfig, ends: Ends, readings: &[Reading]) -> Vec<VoltageSwing> {
    let mut swings = Vec::new();
    let mut points: Vec<Point> = Vec::new();
    let mut circuit = Circuit::default();
    for reading in readings {
        if circuit.last.is_none_or(|last| reading.time_s - last.time_s > GAP_S) {
            swings.extend(between_ends(model, &points));
            points.clear();
            circuit.begin(reading);
        }
        let mut point = circuit.step(model, config, reading);
        point.known &= ends == Ends::Outer || reading.current_a.abs() >= REST_A;
        points.push(point);
        if let Some(turn) = reversal(model, &points) {
            let after = points.split_off(turn);
            swings.extend(between_ends(model, &points));
            points = after;
        }
    }
    swings.extend(between_ends(model, &points));
    swings
}

/// Index of the point at which the current reversed, once enough charge has flowed back.
fn reversal(model: &CellModel, points: &[Point]) -> Option<usize> {
    let (first, last) = (points.first()?.charge_ah, points.last()?.charge_ah);
    // Checking every 32nd point is enough because the reverse charge takes many points to flow.
    if !points.len().is_multiple_of(32) {
        return None;
    }
    let by =
        |a: &usize, b: &usize| (points[*a].charge_ah - first).abs().total_cmp(&(points[*b].charge_ah - first).abs());
    let turn = (0..points.len()).max_by(by)?;
    let back_ah = (points[turn].charge_ah - last).abs();
    let gone_ah = (points[turn].charge_ah - first).abs();
    (back_ah > REVERSAL * model.capacity_ah && gone_ah > REVERSAL * model.capacity_ah && turn > 0).then_some(turn)
}

fn between_ends(model: &CellModel, points: &[Point]) -> Option<VoltageSwing> {
    let start_s = points.iter().find(|point| point.known)?.time_s;
    let end_s = points.iter().rfind(|point| point.known)?.time_s;
    if end_s - start_s < 2.0 * END_S {
        return None;
    }
    let ends = [(start_s, start_s + END_S), (end_s - END_S, end_s)]
        .map(|(from, to)| mean(points.iter().filter(|p| p.known && (from..=to).contains(&p.time_s))));
    let moved_ah = (ends[1].charge_ah - ends[0].charge_ah).abs();
    (moved_ah > MIN_SWING * model.capacity_ah).then_some(VoltageSwing { start_s, end_s, ends })
}

/// Mean of points. The curve's errors are the same at all points, so averaging does not reduce the variance.
fn mean<'a>(points: impl Iterator<Item = &'a Point> + Clone) -> Point {
    let n = points.clone().count() as f64;
    let of = |value: fn(&Point) -> f64| points.clone().map(value).sum::<f64>() / n;
    Point {
        time_s: of(|p| p.time_s),
        new_soc: of(|p| p.new_soc),
        variance: of(|p| p.variance),
        charge_ah: of(|p| p.charge_ah),
        soc: of(|p| p.soc),
        soc_variance: of(|p| p.soc_variance),
        known: true,
    }
}

#[derive(Debug, Default)]
struct Circuit {
    last: Option<Reading>,
    branch_v: [f64; MAX_BRANCHES],
    known_from_s: f64,
    charge_ah: f64,
}

impl Circuit {
    fn begin(&mut self, reading: &Reading) {
        self.branch_v = [0.0; MAX_BRANCHES];
        let rested = reading.current_a.abs() < REST_A;
        self.known_from_s = reading.time_s + if rested { 0.0 } else { SETTLING_S };
        self.last = None;
    }

    fn step(&mut self, model: &CellModel, config: &CapacityConfig, reading: &Reading) -> Point {
        let &Reading { time_s, voltage_v, current_a, temperature_c, resistance_ratio, .. } = reading;
        let mut load_v = self.branch_v.iter().sum::<f64>();
        // The resistance depends on the SOC, and the SOC depends on the resistance. Three passes converge.
        let mut soc = 0.5;
        for _ in 0..3 {
            let r0_ohm = model.r0_ohm(&model.grid_position(soc, temperature_c)) * resistance_ratio;
            soc = model.soc_of_ocv(voltage_v + load_v + current_a * r0_ohm, temperature_c);
        }
        let place = model.grid_position(soc, temperature_c);
        if let Some(last) = self.last {
            let (dt_s, mean_a) = (time_s - last.time_s, 0.5 * (current_a + last.current_a));
            self.charge_ah += mean_a * dt_s / 3600.0;
            for (i, v) in self.branch_v.iter_mut().enumerate().take(model.branches.len()) {
                let branch = BranchAt::new(model, i, &place, resistance_ratio);
                *v = branch.voltage_after(Discretisation::Exact, *v, mean_a, dt_s);
            }
            load_v = self.branch_v.iter().sum();
        }
        load_v += current_a * model.r0_ohm(&place) * resistance_ratio;
        let new_soc = model.soc_of_ocv(voltage_v + load_v, temperature_c);
        let volts = config.end_error_v.unwrap_or(0.0).hypot(0.25 * VOLTAGE_NOISE_V);
        let deviation = volts / model.ocv_slope_v(&model.grid_position(new_soc, temperature_c), model.capacity_ah);
        self.last = Some(*reading);
        Point {
            time_s,
            new_soc,
            variance: deviation * deviation,
            charge_ah: self.charge_ah,
            soc: reading.soc,
            soc_variance: reading.soc_variance,
            known: time_s >= self.known_from_s,
        }
    }
}
