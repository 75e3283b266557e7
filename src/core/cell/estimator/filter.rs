//! The filter of one cell: sigma-point prediction through the circuit, and the update with a voltage.
//!
//! In: a step, a voltage reading. Out: the moved state, or a [`FilterError`] that leaves it unchanged.

use nalgebra::{SMatrix, SVector};

use super::noise::{self, VoltageReading};
use super::state_vector::{
    BRANCHES, CAPACITY, CURRENT_GAIN, CURRENT_OFFSET, KNOWN_VARIANCE, LOG_RESISTANCE, square, widened,
};
use super::step::CellStep;
use crate::cell::circuit::{self, BranchAt};
use crate::cell::{CellModel, EstimatorConfig, MAX_BRANCHES};
use crate::filter::{CONSTANT_ERRORS, FilterError, Gaussian, ScalarGaussian, SigmaPointWeights, Update};
use crate::quantity::bounds;

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
    /// Covariance of both without the constant errors.
    pub(super) covariance: f64,
    /// Errors of ln rho and of the capacity by the constant errors.
    pub(super) by_constant: SMatrix<f64, 2, CONSTANT_ERRORS>,
}

/// The state at a start: SOC and branches new, the rest as learned.
pub(super) fn initial_state<const N: usize>(
    soc: ScalarGaussian,
    branch_variance: &[f64; MAX_BRANCHES],
    kept: &LearnedState,
) -> Gaussian<N> {
    let mut mean = SVector::zeros();
    let mut variance = SVector::<f64, N>::from_fn(|i, _| branch_variance[i.saturating_sub(BRANCHES)]);
    (mean[0], variance[0]) = (soc.mean, soc.variance);
    let mut by_constant = SMatrix::<f64, N, CONSTANT_ERRORS>::zeros();
    for (k, (i, learned)) in [(LOG_RESISTANCE, kept.log_resistance), (CAPACITY, kept.capacity)].into_iter().enumerate()
    {
        let row = kept.by_constant.row(k);
        (mean[i], variance[i]) = (learned.mean, (learned.variance - row.norm_squared()).max(KNOWN_VARIANCE));
        by_constant.set_row(i, &row);
    }
    let mut covariance = SMatrix::from_diagonal(&variance);
    (covariance[(LOG_RESISTANCE, CAPACITY)], covariance[(CAPACITY, LOG_RESISTANCE)]) =
        (kept.covariance, kept.covariance);
    Gaussian { mean, covariance, by_constant }
}

/// Whether the state is one that a cell can have; a filter that has left it starts again.
pub(super) fn is_possible<const N: usize>(x: &Gaussian<N>) -> bool {
    bounds::FILTER_SOC.has(x.mean[0])
        && bounds::LOG_RESISTANCE.has(x.mean[LOG_RESISTANCE])
        && bounds::CAPACITY_AH.has(x.mean[CAPACITY])
        && (BRANCHES..N).all(|i| bounds::NUMBER.has(x.mean[i]))
        && (0..N).all(|i| (1e-40..=bounds::NUMBER.high).contains(&x.covariance[(i, i)]))
        && x.by_constant.iter().all(|error| bounds::NUMBER.has(*error))
}

fn spread<const N: usize>(config: &EstimatorConfig) -> SigmaPointWeights {
    SigmaPointWeights::new(N, config.points.alpha, config.points.beta, config.points.kappa)
}

/// Predicts over the measured and the unmeasured time of a step; `gap_std` is the deviation of the SOC that use in the
/// unmeasured time adds, fraction.
#[inline]
pub(super) fn predict<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    step: &CellStep,
    temperature_c: f64,
    gap_std: f64,
) -> Result<(), FilterError> {
    if step.measured_s > 0.0 || step.charge_as != 0.0 {
        let moved_soc = step.charge_as.abs() / (3600.0 * x.mean[CAPACITY]);
        let variance = square(config.process.soc_per_sqrt_s) * step.measured_s
            + square(config.process.charge_per_sqrt_soc) * moved_soc;
        propagate(x, model, config, temperature_c, (step.measured_s, step.charge_as, step.offset_s))?;
        x.covariance[(0, 0)] += variance;
    }
    if step.unmeasured_s > 0.0 {
        propagate(x, model, config, temperature_c, (step.unmeasured_s, 0.0, 0.0))?;
        let variance = square(config.gap.noise_per_sqrt_s) * step.unmeasured_s
            + square(config.gap.self_discharge_per_s * step.unmeasured_s)
            + square(gap_std);
        x.covariance[(0, 0)] = widened(x.covariance[(0, 0)], variance);
    }
    Ok(())
}

/// The circuit's equations over a time (s), the charge (A s) and the time with the current sensor's offset (s) in it, with
/// the noise of branches and resistance; the caller adds the SOC's.
fn propagate<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    temperature_c: f64,
    (dt_s, charge_as, offset_s): (f64, f64, f64),
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
    let here = position(x.mean[0]);
    let q = noise::process::<N>(model, config, &here, dt_s);

    // The constant errors: the circuit's derivatives at the mean, and the charge that the sensor counts too much.
    let mut by_constant = x.by_constant;
    let (per_as, ratio) = (1.0 / (3600.0 * x.mean[CAPACITY]), libm::exp(x.mean[LOG_RESISTANCE]));
    let mut excess_as = [0.0; CONSTANT_ERRORS];
    excess_as[CURRENT_OFFSET] = config.sensor.current_offset_a * offset_s;
    excess_as[CURRENT_GAIN] = config.sensor.current_gain * charge_as;
    for k in 0..CONSTANT_ERRORS {
        let moved_per_ah = charge_as * per_as / x.mean[CAPACITY];
        by_constant[(0, k)] += excess_as[k] * per_as + moved_per_ah * x.by_constant[(CAPACITY, k)];
    }
    for i in BRANCHES..N {
        let branch = BranchAt::new(model, i - BRANCHES, &here, ratio);
        let kept = branch.voltage_after(config.discretisation, 1.0, 0.0, dt_s);
        let gained_ohm = branch.voltage_after(config.discretisation, 0.0, 1.0, dt_s);
        for k in 0..CONSTANT_ERRORS {
            let excess_a = if dt_s > 0.0 { excess_as[k] / dt_s } else { 0.0 };
            let driven_a = mean_current_a * x.by_constant[(LOG_RESISTANCE, k)] - excess_a;
            by_constant[(i, k)] = kept * x.by_constant[(i, k)] + gained_ohm * driven_a;
        }
    }
    x.predict(&spread::<N>(config), f, &q)?;
    x.by_constant = by_constant;
    Ok(())
}

/// Updates with a voltage reading; also returns the effects of the constant errors on the innovation, V per standard
/// deviation.
#[inline]
pub(super) fn update<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    reading: &VoltageReading,
) -> Result<(Update, SVector<f64, CONSTANT_ERRORS>), FilterError> {
    let h = |x: &SVector<f64, N>| {
        let branches_v = reading.branches_v(x);
        let state = (x[0], libm::exp(x[LOG_RESISTANCE]), reading.curve.mean);
        circuit::aged_terminal_v(model, state, &reading.temperature, branches_v, reading.current_a)
    };
    let noise = reading.noise(x, model, config);
    let update = x.update(&spread::<N>(config), reading.voltage_v, h, &noise)?;
    Ok((update, noise.by_constant))
}
