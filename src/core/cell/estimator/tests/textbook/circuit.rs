//! The unscented Kalman filter of one cell in the form of a textbook, with which the tests compare the fast filter. It
//! predicts all sigma points through the circuit, and updates them with a voltage.

use nalgebra::SVector;

use super::noise::{self, VoltageReading};
use super::unscented::{FilterError, Gaussian, SigmaPointWeights};
use crate::cell::circuit::{self, BranchAt};
use crate::cell::estimator::state_vector::{
    BRANCHES, CAPACITY, CONSTANT_ERRORS, CURRENT_GAIN, CURRENT_OFFSET, LOG_RESISTANCE, square, widened,
};
use crate::cell::{CellModel, CellStep, EstimatorConfig, Update};

fn spread<const N: usize>(config: &EstimatorConfig) -> SigmaPointWeights {
    SigmaPointWeights::new(N, config.points.alpha, config.points.beta, config.points.kappa)
}

/// Predicts over the time of a step with a measured current, then over the time without one. The cell may have been
/// used in the time without a measurement: `gap_std` is the standard deviation of the SOC change by this use
/// (fraction).
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

/// Predicts the state after `dt_s` with the circuit's equations. `charge_as` is the charge moved (A s). The current
/// sensor's offset was part of this charge for `offset_s` seconds. Adds the noise of all states except the SOC. The
/// caller adds the noise of the SOC.
fn propagate<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    temperature_c: f64,
    (dt_s, charge_as, offset_s): (f64, f64, f64),
) -> Result<(), FilterError> {
    let mean_current_a = if dt_s > 0.0 { charge_as / dt_s } else { 0.0 };
    let temperature = model.temperature_position(temperature_c);
    // The branch parameters are read at the SOC in the middle of the step. This SOC is computed with the mean capacity
    // for all sigma points. The capacity of each sigma point would change it by at most 1e-6.
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

    // `by_constant` is the shift of each state by one standard deviation of each constant error (an error that does not
    // change with time, such as a sensor offset). The prediction changes this shift in two ways: the circuit passes the
    // old shift on, and the sensor counts excess charge.
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

/// Updates with a voltage reading. Also returns, for each constant error, by how much one standard deviation of the
/// error shifts the innovation (V).
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
