//! Estimates one cell's state, sample by sample, with an unscented Kalman filter.
//!
//! State x = [SOC, ln rho, C, U_1 .. U_n]: state of charge (fraction), logarithm of the resistance relative to a new
//! cell, capacity (Ah), branch voltages (V); n = 1 to 3 branches. States in which the circuit is not linear come first, so
//! that the sigma points of the branches are moved by a linear map.
//! Predict over the charge q (A s) and time dt since the last sample:
//! SOC -= q / (3600 C); U_i by `circuit::BranchAt` with the mean current q/dt; ln rho and C stay.
//! Update with the voltage: V = OCV(SOC, T) - sum U_i - rho R0(SOC, T) I. Source: the paper, section 3.3.3.
//!
//! Deviation 1: ln rho is a state (random walk). Reason: a fixed model attributes grown resistance to lost charge in an
//! aged cell. Effect: without it the end of life of the measured cells comes 14-23 cycles early.
//! Deviation 2: C is a state ([`CapacityState::Joint`]). Reason: SOC error grows with the capacity's error in
//! proportion to the charge moved, and is correlated with it; a filter without that correlation counts its own
//! assumption as a measurement. `Held` gives the paper's filter (C known, variance 1e-12 Ah^2).
//! Deviation 3: process noises are densities per second, and the measurement variance is
//! sensor^2 + model^2 / dt: model error is slow, so information is counted per second, not per sample.
//! Effect: the sample rate does not change the result.
//!
//! Noise of a step and of a reading (deviation 4): [`noise`].
//! Deviation 5: the OCV curve shifts with lost capacity ([`CellModel::ocv_soc`]), where the model has such a shift. Effect:
//! the top and the bottom of an aged cell's curve give the same capacity.
//!
//! Use of the cell while the program does not run (deviation 6): [`downtime`].
//!
//! A reading beyond the gate leaves the state unchanged. After every reading has been beyond it for `lost_after_s`, the
//! filter restarts: SOC and branches from the voltage, resistance and capacity are kept.

use downtime::update_after_downtime;
use nalgebra::{SMatrix, SVector};
use noise::VoltageReading;
use serde::{Deserialize, Serialize};

use super::circuit::{self, BranchAt};
use super::config::{CapacityState, EstimatorConfig};
use super::model::{CellModel, MAX_BRANCHES};

use crate::filter::{FilterError, Gaussian, ScalarGaussian, SigmaPointWeights, Update};

pub use bank::EstimatorBank;
pub use state::CellState;

/// Variance of a known value: small against any noise, large against rounding.
const KNOWN_VARIANCE: f64 = 1e-12;

/// Variance of an unknown SOC: uniform over 0 to 1.
const UNKNOWN_SOC_VARIANCE: f64 = 1.0 / 12.0;

/// Index of ln rho in the state.
const LOG_RESISTANCE: usize = 1;
/// Index of the capacity in the state.
const CAPACITY: usize = 2;
/// Index of the first branch voltage in the state.
const BRANCHES: usize = 3;

/// Consecutive readings beyond the gate before the filter may restart: one or two can be glitches.
const MIN_REJECTED: u32 = 3;

/// Consecutive readings beyond the gate before a restart when the first one follows a gap: the record is incomplete.
const MIN_REJECTED_AFTER_GAP: u32 = 2;

/// Largest standard deviation that a load through a gap adds to the SOC, fraction.
const MAX_GAP_LOAD_STD: f64 = 0.3;

/// A voltage reading, and charge and time since the reading before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellStep {
    /// Time with a measured current, s.
    pub measured_s: f64,
    /// Charge taken out in that time, A s.
    pub charge_as: f64,
    /// Time without a current measurement, s (asleep, sensor lost).
    pub unmeasured_s: f64,
    /// Cell current at the reading, A; `None` = unknown, then the voltage is not used.
    pub current_a: Option<f64>,
    /// Cell temperature, degrees C; `None` = unknown, then the thermal model predicts it.
    pub temperature_c: Option<f64>,
    /// Temperature of the surroundings for the thermal model, degrees C.
    pub ambient_c: f64,
    /// Terminal voltage, V.
    pub voltage_v: f64,
}

/// Outcome of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepResult {
    /// The measurement update; `None` without a known current.
    pub update: Option<Update>,
    /// The filter has restarted from the voltage.
    pub reset: bool,
}

/// The estimator of one cell.
#[derive(Debug, Clone)]
pub struct CellEstimator {
    filter: Option<Filter>,
    memory: Memory,
}

/// State of the estimator in addition to its filter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Memory {
    /// Capacity, Ah, before the first voltage and across a restart.
    capacity: ScalarGaussian,
    log_resistance: ScalarGaussian,
    temperature_c: Option<f64>,
    last_current_a: f64,
    /// |current| low-passed over `load_memory_s`, A: the load that still drives slow diffusion.
    #[serde(default)]
    load_a: f64,
    /// Mean normalised innovation squared over the consistency window.
    mean_nis: f64,
    /// Time that the next voltage reading stands for, s: since the last one used.
    information_s: f64,
    /// How long the cell has rested, s.
    #[serde(default)]
    rest_s: f64,
    /// Standard deviation of the SOC change during downtime, until a voltage has been used.
    #[serde(default, rename = "away_std")]
    downtime_std: f64,
    /// No voltage has been used since the last sleep or unknown gap.
    #[serde(default)]
    is_unseen: bool,
    /// Consecutive readings beyond the gate.
    rejected: u32,
    /// Duration of that run, s.
    rejected_s: f64,
    /// Whether the first of that run followed a gap: then the gap is the cause, not the sensor.
    rejected_after_gap: bool,
}

/// One filter per number of branches: N = branches + 3.
#[derive(Debug, Clone)]
enum Filter {
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

mod bank;
mod downtime;
mod noise;
mod state;

impl CellEstimator {
    /// An estimator before its first measurement.
    pub fn new(config: &EstimatorConfig) -> Self {
        let (capacity, log_resistance) = configured(config);
        Self {
            filter: None,
            memory: Memory {
                capacity,
                log_resistance,
                temperature_c: None,
                last_current_a: 0.0,
                load_a: 0.0,
                mean_nis: 0.0,
                information_s: config.max_information_s,
                rest_s: 0.0,
                downtime_std: 0.0,
                is_unseen: false,
                rejected: 0,
                rejected_s: 0.0,
                rejected_after_gap: false,
            },
        }
    }

    /// Predicts over the time since the last reading, then updates with the voltage.
    pub fn step(&mut self, model: &CellModel, config: &EstimatorConfig, step: &CellStep) -> StepResult {
        self.memory.temperature_c = Some(self.temperature(model, step));
        let result = self.try_step(model, config, step);
        let reset = result.is_err() || self.lost(config);
        if reset {
            self.start(model, config, step);
            if result.is_err() {
                // The correlation may have prevented the factorisation.
                self.forget_correlation();
            }
        }
        StepResult { update: result.unwrap_or(None), reset }
    }

    fn try_step(
        &mut self,
        model: &CellModel,
        config: &EstimatorConfig,
        step: &CellStep,
    ) -> Result<Option<Update>, FilterError> {
        let temperature_c = self.memory.temperature_c.unwrap_or(step.ambient_c);
        if self.filter.is_none() {
            self.start(model, config, step);
        } else if let Some(filter) = &mut self.filter {
            let gap_load_a = self.memory.last_current_a.abs().max(step.current_a.unwrap_or(0.0).abs());
            each!(filter, x => predict(x, model, config, step, temperature_c, gap_load_a))?;
        }
        self.update_load_memory(model, config, step);
        self.memory.information_s += self.new_information_s(config, step);
        self.memory.last_current_a = step.current_a.unwrap_or(self.memory.last_current_a);
        let downtime_std = self.memory.downtime_std_if_any();
        let (Some(current_a), Some(filter)) = (step.current_a, &mut self.filter) else { return Ok(None) };
        let information_s = self.memory.information_s.clamp(1e-3, config.max_information_s);
        let load_a = self.memory.load_a;
        let temperature = model.temperature_position(temperature_c);
        let reading = VoltageReading { voltage_v: step.voltage_v, current_a, load_a, temperature, information_s };
        let update = match downtime_std {
            None => each!(filter, x => update(x, model, config, &reading))?,
            Some(std) => each!(filter, x => update_after_downtime(x, model, config, &reading, std))?,
        };
        (self.memory.downtime_std, self.memory.is_unseen) = (0.0, false);
        self.watch(config, step, &update);
        Ok(Some(update))
    }

    /// Consistency monitor: exponentially forgotten mean of the normalised innovation squared.
    fn watch(&mut self, config: &EstimatorConfig, step: &CellStep, update: &Update) {
        let elapsed_s = step.measured_s + step.unmeasured_s;
        let forget = -libm::expm1(-elapsed_s.max(1e-3) / config.consistency_window_s);
        self.memory.mean_nis += forget * (update.test_ratio - self.memory.mean_nis);
        if update.accepted {
            (self.memory.information_s, self.memory.rejected, self.memory.rejected_s) = (0.0, 0, 0.0);
        } else {
            // The time before the first rejected reading is not part of the run.
            if self.memory.rejected == 0 {
                (self.memory.rejected_s, self.memory.rejected_after_gap) = (0.0, step.unmeasured_s > 0.0);
            } else {
                self.memory.rejected_s += elapsed_s;
            }
            self.memory.rejected += 1;
        }
    }

    fn lost(&self, config: &EstimatorConfig) -> bool {
        let long_enough = self.memory.rejected >= MIN_REJECTED && self.memory.rejected_s >= config.lost_after_s;
        long_enough || (self.memory.rejected_after_gap && self.memory.rejected >= MIN_REJECTED_AFTER_GAP)
    }

    /// Starts SOC and branches from the voltage; keeps the learned resistance and capacity.
    fn start(&mut self, model: &CellModel, config: &EstimatorConfig, step: &CellStep) {
        let first = self.filter.is_none();
        if let Some(filter) = &self.filter {
            self.memory.capacity = each!(filter, x => marginal(x, CAPACITY));
            self.memory.log_resistance = each!(filter, x => marginal(x, LOG_RESISTANCE));
        }
        self.reset_unusable(config);
        let temperature_c = self.memory.temperature_c.unwrap_or(step.ambient_c);
        let configured = config.initial_soc.filter(|_| first);
        let soc = configured.unwrap_or_else(|| {
            let guess = model.grid_position(0.5, temperature_c);
            let load_v =
                model.r0_ohm(&guess) * libm::exp(self.memory.log_resistance.mean) * step.current_a.unwrap_or(0.0);
            model.soc_of_ocv(step.voltage_v + load_v, temperature_c)
        });
        let soc = ScalarGaussian { mean: soc, variance: square(config.initial_soc_std).max(KNOWN_VARIANCE) };
        let branch_variance = square(config.initial_branch_std_v).max(KNOWN_VARIANCE);
        let kept = LearnedState {
            log_resistance: self.memory.log_resistance,
            capacity: self.memory.capacity,
            covariance: self.capacity_resistance_covariance(),
        };
        self.filter = Some(match model.branches.len() {
            1 => Filter::One(initial_state(soc, branch_variance, &kept)),
            2 => Filter::Two(initial_state(soc, branch_variance, &kept)),
            _ => Filter::Three(initial_state(soc, branch_variance, &kept)),
        });
        // Trust returns through the window, not by a restart.
        self.memory.mean_nis = self.memory.mean_nis.min(config.consistency_limit * std::f64::consts::E);
        (self.memory.information_s, self.memory.downtime_std) = (config.max_information_s, 0.0);
        (self.memory.rejected, self.memory.rejected_s) = (0, 0.0);
    }

    /// Resets an unusable capacity or resistance to its configured value: the filter would otherwise restart at every
    /// reading.
    fn reset_unusable(&mut self, config: &EstimatorConfig) {
        let (capacity, log_resistance) = configured(config);
        let is_usable = |x: &ScalarGaussian| x.mean.is_finite() && x.variance.is_finite() && x.variance > 0.0;
        if !is_usable(&self.memory.capacity) || self.memory.capacity.mean <= 0.0 {
            self.memory.capacity = capacity;
        }
        if !is_usable(&self.memory.log_resistance) {
            self.memory.log_resistance = log_resistance;
        }
    }

    fn forget_correlation(&mut self) {
        if let Some(filter) = &mut self.filter {
            each!(filter, x => {
                let (r, c) = (LOG_RESISTANCE, CAPACITY);
                (x.covariance[(r, c)], x.covariance[(c, r)]) = (0.0, 0.0);
            });
        }
    }

    /// The sensor's value, or the thermal model's prediction from the last known one, degrees C.
    fn temperature(&self, model: &CellModel, step: &CellStep) -> f64 {
        step.temperature_c.unwrap_or_else(|| {
            let soc = self.soc().map_or(0.5, |soc| soc.mean);
            thermal_c(model, self.memory.temperature_c, soc, self.log_resistance().mean, step)
        })
    }

    /// Handles a gap of unknown length: the SOC becomes unknown, the branches may have relaxed.
    pub fn handle_unknown_gap(&mut self) {
        (self.memory.rest_s, self.memory.downtime_std, self.memory.is_unseen) = (0.0, 0.0, true);
        let Some(filter) = &mut self.filter else { return };
        each!(filter, x => {
            x.covariance[(0, 0)] = widened(x.covariance[(0, 0)], UNKNOWN_SOC_VARIANCE);
            for i in BRANCHES..x.mean.len() {
                x.mean[i] *= 0.5;
                x.covariance[(i, i)] += square(x.mean[i]);
            }
        });
    }

    /// State of charge; `None` before the first voltage.
    pub fn soc(&self) -> Option<ScalarGaussian> {
        let soc = self.filter.as_ref().map(|filter| each!(filter, x => marginal(x, 0)))?;
        let variance = self.memory.downtime_std_if_any().map_or(soc.variance, |std| widened(soc.variance, square(std)));
        Some(ScalarGaussian { variance, ..soc })
    }

    /// Branch voltages, V; NaN beyond the model's branches and before the first voltage.
    pub fn branch_v(&self) -> [f64; MAX_BRANCHES] {
        let mut branch_v = [f64::NAN; MAX_BRANCHES];
        if let Some(filter) = &self.filter {
            each!(filter, x => for i in BRANCHES..x.mean.len() { branch_v[i - BRANCHES] = x.mean[i]; });
        }
        branch_v
    }

    /// ln of the resistance relative to new.
    pub fn log_resistance(&self) -> ScalarGaussian {
        self.filter
            .as_ref()
            .map_or(self.memory.log_resistance, |filter| each!(filter, x => marginal(x, LOG_RESISTANCE)))
    }

    /// Capacity in the filter's present state, Ah.
    pub fn capacity(&self) -> ScalarGaussian {
        self.filter.as_ref().map_or(self.memory.capacity, |filter| each!(filter, x => marginal(x, CAPACITY)))
    }

    /// Covariance of capacity (Ah) and ln(resistance).
    pub fn capacity_resistance_covariance(&self) -> f64 {
        self.filter.as_ref().map_or(0.0, |filter| each!(filter, x => x.covariance[(LOG_RESISTANCE, CAPACITY)]))
    }

    /// Voltage that the load of the last minutes drops in the settled cell, V; 0 before the first voltage.
    pub fn load_v(&self, model: &CellModel) -> f64 {
        let Some(soc) = self.soc() else { return 0.0 };
        let position = model.grid_position(soc.mean, self.memory.temperature_c.unwrap_or(25.0));
        model.settled_ohm(&position) * libm::exp(self.log_resistance().mean) * self.memory.load_a
    }

    /// Replaces the capacity estimate (at transitions only).
    ///
    /// The filter's variance never falls by that: the evidence since the last call may have counted for too much.
    pub fn restate_capacity(&mut self, capacity: ScalarGaussian) {
        self.memory.capacity = capacity;
        if let Some(filter) = &mut self.filter {
            each!(filter, x => {
                x.mean[CAPACITY] = capacity.mean;
                // A smaller variance would not fit the covariances with the other states.
                let variance = &mut x.covariance[(CAPACITY, CAPACITY)];
                *variance = variance.max(capacity.variance);
            });
        }
    }

    /// Sets the capacity that the filter uses ([`CapacityState::Held`]), Ah.
    pub fn hold_capacity(&mut self, capacity_ah: f64) {
        self.memory.capacity.mean = capacity_ah;
        if let Some(filter) = &mut self.filter {
            each!(filter, x => x.mean[CAPACITY] = capacity_ah);
        }
    }

    /// Mean normalised innovation squared over the consistency window: about 1 or less when the filter is
    /// consistent.
    pub fn mean_nis(&self) -> f64 {
        self.memory.mean_nis
    }

    /// Temperature that the filter uses, degrees C.
    pub fn temperature_c(&self) -> Option<f64> {
        self.memory.temperature_c
    }
}

/// Predicts the temperature of a cell without a sensor value, degrees C, from the last known one.
fn thermal_c(model: &CellModel, last_c: Option<f64>, soc: f64, log_resistance: f64, step: &CellStep) -> f64 {
    let (Some(last_c), Some(thermal)) = (last_c, &model.thermal) else { return last_c.unwrap_or(step.ambient_c) };
    let mean_current_a = if step.measured_s > 0.0 { step.charge_as / step.measured_s } else { 0.0 };
    let ohm = model.settled_ohm(&model.grid_position(soc, last_c)) * libm::exp(log_resistance);
    let loaded_c =
        circuit::temperature_after(thermal, last_c, step.ambient_c, square(mean_current_a) * ohm, step.measured_s);
    circuit::temperature_after(thermal, loaded_c, step.ambient_c, 0.0, step.unmeasured_s)
}

/// Configured initial capacity (Ah) and ln(resistance).
fn configured(config: &EstimatorConfig) -> (ScalarGaussian, ScalarGaussian) {
    let capacity_variance = match config.capacity_state {
        CapacityState::Joint => square(config.initial_capacity_std_ah),
        CapacityState::Held => KNOWN_VARIANCE,
    };
    let log_variance = square(config.initial_log_resistance_std);
    (
        ScalarGaussian { mean: config.initial_capacity_ah, variance: capacity_variance.max(KNOWN_VARIANCE) },
        ScalarGaussian { mean: 0.0, variance: log_variance.max(KNOWN_VARIANCE) },
    )
}

fn square(x: f64) -> f64 {
    x * x
}

/// A SOC variance grown by `by`, at most to that of an unknown SOC.
fn widened(variance: f64, by: f64) -> f64 {
    variance.max((variance + by).min(UNKNOWN_SOC_VARIANCE))
}

fn marginal<const N: usize>(x: &Gaussian<N>, i: usize) -> ScalarGaussian {
    ScalarGaussian { mean: x.mean[i], variance: x.covariance[(i, i)] }
}

/// Learned quantities that a restart keeps.
struct LearnedState {
    log_resistance: ScalarGaussian,
    capacity: ScalarGaussian,
    covariance: f64,
}

fn initial_state<const N: usize>(soc: ScalarGaussian, branch_variance: f64, kept: &LearnedState) -> Gaussian<N> {
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
    SigmaPointWeights::new(N, config.alpha, config.beta, config.kappa)
}

fn predict<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    step: &CellStep,
    temperature_c: f64,
    gap_load_a: f64,
) -> Result<(), FilterError> {
    if step.measured_s > 0.0 || step.charge_as != 0.0 {
        let moved_soc = step.charge_as.abs() / (3600.0 * x.mean[CAPACITY]);
        let variance = square(config.soc_noise_per_sqrt_s) * step.measured_s
            + square(config.charge_noise_per_sqrt_soc) * moved_soc;
        propagate(x, model, config, temperature_c, step.measured_s, step.charge_as)?;
        x.covariance[(0, 0)] += variance;
    }
    if step.unmeasured_s > 0.0 {
        // The current of that time is unknown: 0 is assumed, but a load next to the gap may have continued through it.
        propagate(x, model, config, temperature_c, step.unmeasured_s, 0.0)?;
        let load_soc = gap_load_a * step.unmeasured_s / (3600.0 * x.mean[CAPACITY]);
        let load_std = if gap_load_a > config.rest_current_a { load_soc.min(MAX_GAP_LOAD_STD) } else { 0.0 };
        let variance = square(config.gap_noise_per_sqrt_s) * step.unmeasured_s
            + square(config.self_discharge_per_s * step.unmeasured_s)
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

fn update<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    reading: &VoltageReading,
) -> Result<Update, FilterError> {
    let h = |x: &SVector<f64, N>| {
        let branches_v: f64 = (BRANCHES..N).fold(0.0, |sum, i| sum + x[i]);
        let state = (x[0], libm::exp(x[LOG_RESISTANCE]), x[CAPACITY]);
        circuit::aged_terminal_v(model, state, &reading.temperature, branches_v, reading.current_a)
    };
    x.update(&spread::<N>(config), reading.voltage_v, h, &reading.noise(x, model, config))
}

#[cfg(test)]
pub(crate) mod tests;
