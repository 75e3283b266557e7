//! The filter of one cell: sigma-point prediction through the circuit, and the update with a voltage.
//!
//! In: a step, a voltage reading. Out: the moved state, or a [`FilterError`] that leaves it unchanged.

use nalgebra::{SMatrix, SVector};

use super::noise::{self, VoltageReading};
use super::state_vector::{BRANCHES, CAPACITY, LOG_RESISTANCE, square, widened};
use super::step::CellStep;
use crate::cell::circuit::{self, BranchAt};
use crate::cell::{CellModel, EstimatorConfig};
use crate::filter::{FilterError, Gaussian, ScalarGaussian, SigmaPointWeights, Update};

/// Largest standard deviation that a load through a gap adds to the SOC, fraction.
const MAX_GAP_LOAD_STD: f64 = 0.3;

/// One filter per number of branches: N = branches + 3.
#[derive(Debug, Clone)]
pub(super) enum Filter {
    One(Gaussian<4>),
    Two(Gaussian<5>),
    Three(Gaussian<6>),
}

/// Runs an expression for the filter's number of states.
macro_rules! each {
    ($filter:expr, $x:ident => $body:expr) => {
        match $filter {
            Filter::One($x) => $body,
            Filter::Two($x) => $body,
            Filter::Three($x) => $body,
        }
    };
}
pub(super) use each;

/// Learned quantities that a restart keeps.
pub(super) struct LearnedState {
    pub(super) log_resistance: ScalarGaussian,
    pub(super) capacity: ScalarGaussian,
    pub(super) covariance: f64,
}

/// The state at a start: SOC and branches new, the rest as learned.
pub(super) fn initial_state<const N: usize>(
    soc: ScalarGaussian,
    branch_variance: f64,
    kept: &LearnedState,
) -> Gaussian<N> {
    let mut mean = SVector::zeros();
    let mut variance = SVector::<f64, N>::repeat(branch_variance);
    (mean[0], variance[0]) = (soc.mean, soc.variance);
    (mean[LOG_RESISTANCE], variance[LOG_RESISTANCE]) = (kept.log_resistance.mean, kept.log_resistance.variance);
    (mean[CAPACITY], variance[CAPACITY]) = (kept.capacity.mean, kept.capacity.variance);
    let mut covariance = SMatrix::from_diagonal(&variance);
    (covariance[(LOG_RESISTANCE, CAPACITY)], covariance[(CAPACITY, LOG_RESISTANCE)]) =
        (kept.covariance, kept.covariance);
    Gaussian { mean, covariance }
}

fn spread<const N: usize>(config: &EstimatorConfig) -> SigmaPointWeights {
    SigmaPointWeights::new(N, config.points.alpha, config.points.beta, config.points.kappa)
}

/// Predicts over the measured and the unmeasured time of a step.
#[inline]
pub(super) fn predict<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    step: &CellStep,
    temperature_c: f64,
    gap_load_a: f64,
) -> Result<(), FilterError> {
    if step.measured_s > 0.0 || step.charge_as != 0.0 {
        let moved_soc = step.charge_as.abs() / (3600.0 * x.mean[CAPACITY]);
        let variance = square(config.process.soc_per_sqrt_s) * step.measured_s
            + square(config.process.charge_per_sqrt_soc) * moved_soc;
        propagate(x, model, config, temperature_c, step.measured_s, step.charge_as)?;
        x.covariance[(0, 0)] += variance;
    }
    if step.unmeasured_s > 0.0 {
        // The current of that time is unknown: 0 is assumed, but a load next to the gap may have continued through it.
        propagate(x, model, config, temperature_c, step.unmeasured_s, 0.0)?;
        let load_soc = gap_load_a * step.unmeasured_s / (3600.0 * x.mean[CAPACITY]);
        let load_std = if gap_load_a > config.gap.rest_current_a { load_soc.min(MAX_GAP_LOAD_STD) } else { 0.0 };
        let variance = square(config.gap.noise_per_sqrt_s) * step.unmeasured_s
            + square(config.gap.self_discharge_per_s * step.unmeasured_s)
            + square(load_std) / 3.0;
        x.covariance[(0, 0)] = widened(x.covariance[(0, 0)], variance);
    }
    Ok(())
}

/// The circuit's equations over `dt_s`, with the noise of branches and resistance; the caller adds the SOC's.
fn propagate<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    temperature_c: f64,
    dt_s: f64,
    charge_as: f64,
) -> Result<(), FilterError> {
    let mean_current_a = if dt_s > 0.0 { charge_as / dt_s } else { 0.0 };
    let temperature = model.temperature_position(temperature_c);
    // The branch parameters are those at the middle of the step's SOC, by the mean capacity: the capacity of each sigma
    // point would move it by the charge of a step times the capacity's relative deviation, 1e-6 of SOC at most.
    let half_soc = 0.5 * charge_as / (3600.0 * x.mean[CAPACITY]);
    let position = |soc: f64| model.grid_position_at(&temperature, soc - half_soc);
    let f = |x: &SVector<f64, N>| {
        let mut next = *x;
        next[0] = circuit::soc_after(x[0], charge_as, x[CAPACITY]);
        let position = position(x[0]);
        let ratio = libm::exp(x[LOG_RESISTANCE]);
        for i in BRANCHES..N {
            let branch = BranchAt::new(model, i - BRANCHES, &position, ratio);
            next[i] = branch.voltage_after(config.discretisation, x[i], mean_current_a, dt_s);
        }
        next
    };
    let q = noise::process::<N>(model, config, &position(x.mean[0]), dt_s);
    x.predict(&spread::<N>(config), f, &q)
}

/// Updates with a voltage reading.
#[inline]
pub(super) fn update<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    reading: &VoltageReading,
) -> Result<Update, FilterError> {
    let segment = model.aged_ocv.segment(x.mean[CAPACITY]);
    let h = |x: &SVector<f64, N>| {
        let branches_v: f64 = (BRANCHES..N).fold(0.0, |sum, i| sum + x[i]);
        let state = (x[0], libm::exp(x[LOG_RESISTANCE]), x[CAPACITY]);
        circuit::aged_terminal_v(model, state, segment, &reading.temperature, branches_v, reading.current_a)
    };
    x.update(&spread::<N>(config), reading.voltage_v, h, &reading.noise(x, model, config))
}
