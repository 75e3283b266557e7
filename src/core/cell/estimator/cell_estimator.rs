//! The estimator of one cell. [`super::bank`] steps many cells at once, if their steps are ordinary: the current was
//! measured since the last voltage, and the voltage is within the gate. This module computes all other steps of a cell,
//! its restarts, its learning and its estimates.
//!
//! In: one [`CellStep`] per voltage reading. Out: a [`StepResult`], and estimates with their variances. The gate is a
//! bound on measured minus predicted voltage. A reading beyond the gate does not correct the state. If a step cannot be
//! computed, the filter restarts. Constant errors are errors that do not change with time, such as the offset of a
//! sensor.

use nalgebra::SMatrix;

use super::bank::SingleCell;
use super::downtime::update_after_downtime;
use super::gaussian::{Gaussian, LearnedState};
use super::memory::{Memory, USED_PRIOR};
use super::slow_branch::SlowBranch;
use super::state_vector::{
    BRANCHES, CAPACITY, CONSTANT_ERRORS, CURRENT_OFFSET, CURVE_CAPACITY, KNOWN_VARIANCE, LOG_RESISTANCE, SLOW_BRANCH,
    square, widened,
};
use super::step::{CellStep, StepResult, Update};
use crate::cell::circuit;
use crate::cell::{CellModel, EstimatorConfig, MAX_BRANCHES, SensorErrors};
use crate::filter::ScalarGaussian;
use crate::quantity::bounds;

/// A gap is a time without a measured current. The SOC has jumped over a gap if it changed by more than the counted
/// charge explains. The unexplained part must exceed both this fraction and [`JUMP_SIGMA`] standard deviations of the
/// SOC before the step.
const JUMP: f64 = 0.05;
const JUMP_SIGMA: f64 = 4.0;

/// State from which a cell continues with another model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdoptedState {
    /// SOC (fraction); `None` = start from the next voltage.
    pub soc: Option<ScalarGaussian>,
    /// Covariance of SOC and capacity (Ah).
    pub soc_by_capacity: f64,
    /// Capacity (Ah).
    pub capacity: ScalarGaussian,
    /// ln of the resistance relative to the model.
    pub log_resistance: f64,
    /// For each RC branch, the current (A) after a first-order low-pass filter with the time constant of the branch;
    /// `None` = the branches have relaxed.
    pub filtered_a: Option<[f64; MAX_BRANCHES]>,
}

/// The estimator of one cell.
#[derive(Debug, Clone)]
pub struct CellEstimator {
    pub(super) filter: Option<Gaussian>,
    pub(super) memory: Memory,
}

impl CellEstimator {
    /// An estimator before its first measurement.
    pub fn new(config: &EstimatorConfig) -> Self {
        Self { filter: None, memory: Memory::new(config) }
    }

    /// Computes a step that is not ordinary (see the head of this file): a prediction over the time since the last
    /// reading, then an update with the voltage.
    pub(super) fn rare_step(
        &mut self,
        mut kernel: SingleCell,
        model: &CellModel,
        config: &EstimatorConfig,
        step: &CellStep,
    ) -> StepResult {
        let step = CellStep { temperature_c: Some(self.temperature(model, step)), ..*step };
        self.memory.temperature_c = step.temperature_c;
        let has_gap = step.unmeasured_s > 0.0 || self.memory.downtime_std_if_any().is_some();
        let before = self.marginal(0).filter(|_| has_gap);
        let result = self.try_step(&mut kernel, model, config, &step);
        let result = result.filter(|_| self.filter.as_ref().is_none_or(Gaussian::is_possible));
        let reset = result.is_none() || self.memory.has_lost_cell(config);
        if reset {
            self.start(model, config, &step);
        }
        if let (None, Some(x)) = (&result, &mut self.filter) {
            // If a step fails, the correlation or the constant errors may have made the covariance indefinite. Remove
            // them.
            x.correlate(LOG_RESISTANCE, CAPACITY, 0.0);
            x.by_constant.fill(0.0);
        }
        let counted = step.charge_as / (3600.0 * self.capacity().mean);
        let jumped = before.zip(self.marginal(0)).is_some_and(|(before, after)| {
            (after.mean - before.mean + counted).abs() > JUMP.max(JUMP_SIGMA * before.std())
        });
        StepResult { update: result.flatten(), reset, jumped }
    }

    fn try_step(
        &mut self,
        kernel: &mut SingleCell,
        model: &CellModel,
        config: &EstimatorConfig,
        step: &CellStep,
    ) -> Option<Option<Update>> {
        if self.filter.is_none() || (self.memory.is_soc_unknown && step.current_a.is_some()) {
            self.start(model, config, step);
        } else if let Some(x) = &mut self.filter {
            let gap_std = self.memory.note_gap(config, step, x.mean[CAPACITY]);
            if step.measured_s > 0.0 || step.charge_as != 0.0 {
                kernel.predict_measured((x, &self.memory), step)?;
            }
            if step.unmeasured_s > 0.0 {
                kernel.predict_unmeasured((x, &self.memory), step)?;
                let variance = square(config.gap.noise_per_sqrt_s) * step.unmeasured_s
                    + square(config.gap.self_discharge_per_s * step.unmeasured_s)
                    + square(gap_std);
                x.covariance[(0, 0)] = widened(x.covariance[(0, 0)], variance);
            }
        }
        let memory = &mut self.memory;
        let elapsed_s = memory.information_s + step.measured_s + step.unmeasured_s;
        kernel.pass_measured(memory, step);
        if step.unmeasured_s > 0.0 {
            memory.pass_gap(model, config, step);
            memory.information_s = elapsed_s;
        }
        memory.last_current_a = step.current_a.unwrap_or(memory.last_current_a);
        let Some(x) = &mut self.filter else { return Some(None) };
        if step.current_a.is_none() {
            memory.note_voltage(model, config, step, x.mean[LOG_RESISTANCE]);
            return Some(None);
        }
        let update = match memory.downtime_std_if_any() {
            None => {
                x.covariance[(0, 0)] = widened(x.covariance[(0, 0)], square(memory.downtime_std));
                kernel.update((x, memory), step)?
            }
            Some(_) => update_after_downtime(kernel, (x, memory), (model, config), step)?,
        };
        memory.end_downtime();
        memory.record_update(config, step, &update);
        Some(Some(update))
    }

    /// Starts SOC and branches, and keeps the learned resistance and capacity. The SOC comes from the voltage. At the
    /// first start, a configured SOC has priority.
    fn start(&mut self, model: &CellModel, config: &EstimatorConfig, step: &CellStep) {
        let first = self.filter.is_none();
        (self.memory.capacity, self.memory.log_resistance) = (self.capacity(), self.log_resistance());
        self.memory.reset_unusable(config);
        let temperature_c = self.memory.temperature_c.unwrap_or(step.ambient_c);
        let configured = config.initial.soc.filter(|_| first);
        let soc = configured.unwrap_or_else(|| {
            let guess = model.grid_position(0.5, temperature_c);
            let load_v =
                model.r0_ohm(&guess) * libm::exp(self.memory.log_resistance.mean) * step.current_a.unwrap_or(0.0);
            let temperature = model.temperature_position(temperature_c);
            // Where the OCV curve is flat at its end, a small voltage error can give an SOC far outside 0 to 1. The SOC
            // is therefore limited.
            model.soc_of_aged_ocv(&temperature, self.memory.curve.mean, step.voltage_v + load_v).clamp(-0.05, 1.05)
        });
        let soc = ScalarGaussian { mean: soc, variance: square(config.initial.soc_std).max(KNOWN_VARIANCE) };
        let branch_variance = self.first_branch_variance(model, config, step, soc.mean);
        let kept = LearnedState {
            log_resistance: self.memory.log_resistance,
            capacity: self.memory.capacity,
            covariance: self.capacity_resistance_covariance(),
            by_constant: self.learned_by_constant(),
        };
        self.filter = Some(Gaussian::at_start(soc, &branch_variance[..model.branches.len()], &kept));
        // A restart alone does not make the estimate trusted again. The consistency monitor first needs about one
        // window of readings that fit.
        self.memory.mean_nis = self.memory.mean_nis.min(config.consistency.limit * std::f64::consts::E);
        self.memory.information_s = config.voltage.max_information_s;
        (self.memory.downtime_std, self.memory.used_prior, self.memory.noted_s) = (0.0, 0.0, 0.0);
        self.memory.by_voltage = None;
        (self.memory.rejected, self.memory.rejected_s) = (0, 0.0);
        self.memory.innovation_v = 0.0;
        self.memory.is_soc_unknown = false;
    }

    /// Continues with the new `model` from `state`, which was determined with the new model. The estimates that were
    /// made with the old model are discarded.
    pub fn adopt(&mut self, model: &CellModel, config: &EstimatorConfig, state: &AdoptedState) {
        let temperature_c = self.memory.temperature_c;
        self.memory.capacity = state.capacity;
        self.memory.curve = state.capacity;
        self.memory.log_resistance = ScalarGaussian::from_std(state.log_resistance, config.initial.log_resistance_std);
        (self.memory.slow_branch, self.memory.rejected, self.memory.rejected_s) = (SlowBranch::default(), 0, 0.0);
        (self.memory.offset_information, self.memory.offset_score) = (0.0, 0.0);
        self.memory.innovation_v = 0.0;
        let Some(soc) = state.soc.filter(|_| self.filter.is_some()) else {
            self.filter = None;
            return;
        };
        let kept = LearnedState {
            log_resistance: self.memory.log_resistance,
            capacity: state.capacity,
            covariance: 0.0,
            by_constant: SMatrix::zeros(),
        };
        // If no temperature is known, assume 25 degrees C.
        let position = model.grid_position(soc.mean, temperature_c.unwrap_or(25.0));
        let ratio = libm::exp(state.log_resistance);
        let filtered_a = state.filtered_a.unwrap_or_default();
        let branch_v = |i: usize| model.branch_r_ohm(i, &position) * ratio * filtered_a[i];
        let own_variance = square(config.initial.branch_std_v).max(KNOWN_VARIANCE);
        let mut branch_variance = [own_variance; MAX_BRANCHES];
        for (i, variance) in branch_variance.iter_mut().enumerate().take(model.branches.len()) {
            *variance += square(config.initial.log_resistance_std * branch_v(i));
        }
        let mut x = Gaussian::at_start(soc, &branch_variance[..model.branches.len()], &kept);
        // Rounding must not make the correlation larger than 1, so it is limited to 0.99.
        let most = 0.99 * (x.covariance[(0, 0)] * x.covariance[(CAPACITY, CAPACITY)]).sqrt();
        x.correlate(0, CAPACITY, state.soc_by_capacity.clamp(-most, most));
        (0..model.branches.len()).for_each(|i| x.mean[BRANCHES + i] = branch_v(i));
        self.filter = Some(x);
    }

    /// Variance of each branch's voltage when the filter starts (V^2). If the cell is under load at the start, this
    /// load may already have charged the branches for an unknown time.
    fn first_branch_variance(
        &self,
        model: &CellModel,
        config: &EstimatorConfig,
        step: &CellStep,
        soc: f64,
    ) -> [f64; MAX_BRANCHES] {
        let position = model.grid_position(soc, self.memory.temperature_c.unwrap_or(step.ambient_c));
        let ratio = libm::exp(self.memory.log_resistance.mean);
        let is_loaded = step.current_a.is_some_and(|current_a| current_a.abs() > config.gap.rest_current_a);
        // A load of C/2 is assumed.
        let load_a = if is_loaded { 0.5 * model.rated_capacity_ah } else { 0.0 };
        let mut variance = [square(config.initial.branch_std_v).max(KNOWN_VARIANCE); MAX_BRANCHES];
        for (i, variance) in variance.iter_mut().enumerate().take(model.branches.len()) {
            *variance += square(model.branch_r_ohm(i, &position) * ratio * load_a);
            *variance = variance.min(bounds::NUMBER.high);
        }
        variance
    }

    fn temperature(&self, model: &CellModel, step: &CellStep) -> f64 {
        step.temperature_c.unwrap_or_else(|| {
            let soc = self.soc().map_or(0.5, |soc| soc.mean);
            thermal_c(model, self.memory.temperature_c, soc, self.log_resistance().mean, step)
        })
    }

    /// Handles a gap of unknown length: the SOC becomes unknown, and the branches may have relaxed.
    pub fn handle_unknown_gap(&mut self) {
        self.memory.end_downtime();
        (self.memory.rest_s, self.memory.is_unseen, self.memory.is_soc_unknown) = (0.0, true, true);
        if let Some(x) = &mut self.filter {
            x.widen_after_unknown_gap();
        }
    }

    /// State of charge, limited to 0 to 1; `None` before the first voltage.
    pub fn soc(&self) -> Option<ScalarGaussian> {
        Some(self.memory.published(self.marginal(0)?))
    }

    /// Branch voltages (V); NaN for branches that the model does not have, and before the first voltage.
    pub fn branch_v(&self) -> [f64; MAX_BRANCHES] {
        let mut branch_v = [f64::NAN; MAX_BRANCHES];
        if let Some(x) = &self.filter {
            let branches = x.states - BRANCHES;
            branch_v[..branches].copy_from_slice(x.mean.rows(BRANCHES, branches).as_slice());
            branch_v[branches - 1] *= self.memory.slow_branch.ratio;
        }
        branch_v
    }

    /// ln of the resistance relative to a new cell.
    pub fn log_resistance(&self) -> ScalarGaussian {
        self.marginal(LOG_RESISTANCE).unwrap_or(self.memory.log_resistance)
    }

    /// Capacity in the present state of the filter (Ah).
    pub fn capacity(&self) -> ScalarGaussian {
        self.marginal(CAPACITY).unwrap_or(self.memory.capacity)
    }

    fn marginal(&self, state: usize) -> Option<ScalarGaussian> {
        self.filter.as_ref().map(|x| x.marginal(state))
    }

    fn learned_by_constant(&self) -> SMatrix<f64, 2, CONSTANT_ERRORS> {
        let rows = |x: &Gaussian| x.by_constant.fixed_rows::<2>(LOG_RESISTANCE).into_owned();
        self.filter.as_ref().map_or_else(SMatrix::zeros, rows)
    }

    /// Corrects the state after the current sensor's offset was found to differ from its assumed value by `deviations`
    /// standard deviations. Multiplies the standard deviation of the offset by `remains`.
    pub fn absorb_current_offset(&mut self, deviations: f64, remains: f64) {
        (self.memory.offset_information, self.memory.offset_score) = (0.0, 0.0);
        self.absorb(CURRENT_OFFSET, deviations, remains);
    }

    /// If the cell has several branches, corrects the resistance ratio of the slowest branch with the evidence since
    /// the last correction. If the cell has one branch, discards the evidence.
    pub fn learn_slow_branch(&mut self, config: &EstimatorConfig) {
        if self.filter.as_ref().is_none_or(|x| x.states == BRANCHES + 1) {
            (self.memory.slow_branch.information, self.memory.slow_branch.score) = (0.0, 0.0);
        } else if let Some(correction) = self.memory.slow_branch.correct(config.sensor.slow_branch) {
            self.absorb(SLOW_BRANCH, correction.deviations, correction.remains);
            self.absorb(SLOW_BRANCH, 0.0, correction.widened);
        }
    }

    /// Resistance ratio of the slowest branch, in addition to the resistance ratio of the cell.
    pub fn slow_ratio(&self, config: &EstimatorConfig) -> ScalarGaussian {
        let slow_branch = &self.memory.slow_branch;
        ScalarGaussian::from_std(slow_branch.ratio, slow_branch.std(config.sensor.slow_branch))
    }

    fn absorb(&mut self, constant_error: usize, deviations: f64, remains: f64) {
        if let Some(x) = &mut self.filter {
            x.absorb(constant_error, deviations, remains);
        }
    }

    /// Rescales the effects of the constant errors to new standard deviations of these errors.
    pub(super) fn restate_constant_errors(&mut self, old: &SensorErrors, new: &SensorErrors) {
        let Some(x) = &mut self.filter else { return };
        let deviations =
            |of: &SensorErrors| [of.voltage_offset_v, of.current_offset_a, of.current_gain, of.slow_branch];
        for (k, (old, new)) in deviations(old).into_iter().zip(deviations(new)).enumerate() {
            let factor = if old > 0.0 { new / old } else { 1.0 };
            x.by_constant.column_mut(k).scale_mut(factor);
        }
    }

    /// Covariance of capacity (Ah) and ln(resistance). The part that constant errors cause is not included.
    pub fn capacity_resistance_covariance(&self) -> f64 {
        self.filter.as_ref().map_or(0.0, |x| x.covariance[(LOG_RESISTANCE, CAPACITY)])
    }

    /// Capacity that selects the open-circuit curve of the aged cell (Ah).
    pub fn curve(&self) -> ScalarGaussian {
        self.memory.curve
    }

    /// Derivative of the capacity estimate with respect to the capacity that selects the open-circuit curve. Only the
    /// readings since the last call of [`Self::restate_capacity`] contribute to it.
    pub fn capacity_by_curve(&self) -> f64 {
        let std_ah = self.memory.curve.std();
        let by_curve = |x: f64| if std_ah > 0.0 { -x / std_ah } else { 0.0 };
        self.filter.as_ref().map_or(0.0, |x| by_curve(x.by_constant[(CAPACITY, CURVE_CAPACITY)]))
    }

    /// Replaces the capacity estimate and the capacity that selects the open-circuit curve by `capacity`. The caller
    /// does this at the end of a charge or discharge, and when another value replaces the learned capacity or the
    /// learned capacity is no longer trusted. The state is corrected as if the new curve had been used since the last
    /// call.
    ///
    /// The filter's variance of the capacity is never reduced, because the evidence since the last call may have had
    /// too much weight.
    pub fn restate_capacity(&mut self, capacity: ScalarGaussian) {
        self.memory.capacity = capacity;
        let before = self.memory.curve;
        self.memory.curve = capacity;
        let Some(x) = &mut self.filter else { return };
        let column = x.by_constant.column(CURVE_CAPACITY).into_owned();
        if before.variance > 0.0 {
            x.mean += column * ((before.mean - capacity.mean) / before.std());
        }
        // The remaining error of the curve becomes an error of the capacity.
        x.covariance += column * column.transpose();
        x.by_constant.column_mut(CURVE_CAPACITY).fill(0.0);
        x.mean[CAPACITY] = capacity.mean;
        // A smaller variance would not fit the covariances with the other states.
        let missing = capacity.variance - x.marginal(CAPACITY).variance;
        x.covariance[(CAPACITY, CAPACITY)] += missing.max(0.0);
    }

    /// Sets ln of the resistance relative to a new cell, for the next start of the filter.
    pub fn relearn_resistance(&mut self, log_resistance: ScalarGaussian) {
        self.memory.log_resistance = log_resistance;
    }

    /// Sets the filter's capacity (Ah), for [`CapacityState::Held`](crate::cell::CapacityState::Held).
    pub fn hold_capacity(&mut self, capacity_ah: f64) {
        self.memory.capacity.mean = capacity_ah;
        self.memory.curve = ScalarGaussian { mean: capacity_ah, variance: 0.0 };
        if let Some(x) = &mut self.filter {
            x.mean[CAPACITY] = capacity_ah;
        }
    }

    /// Handles a sleep: until the next voltage is used, the SOC is marked as carried over from before the sleep.
    pub fn note_sleep(&mut self) {
        self.memory.is_unseen = self.filter.is_some();
    }

    /// Adds a downtime of `downtime_s`. The uncertainty of the SOC grows by the charge that may have moved in either
    /// direction.
    pub fn note_downtime(&mut self, config: &EstimatorConfig, downtime_s: f64) {
        let downtime_s = downtime_s.max(0.0);
        self.memory.note_downtime(config.gap.away_use_per_s * downtime_s, USED_PRIOR);
        self.memory.noted_s += downtime_s;
    }
}

/// Predicts the temperature (degrees C) of a cell without a sensor value, starting from the last known temperature.
pub(super) fn thermal_c(model: &CellModel, last_c: Option<f64>, soc: f64, log_resistance: f64, step: &CellStep) -> f64 {
    let (Some(last_c), Some(thermal)) = (last_c, &model.thermal) else { return last_c.unwrap_or(step.ambient_c) };
    let mean_current_a = if step.measured_s > 0.0 { step.charge_as / step.measured_s } else { 0.0 };
    let ohm = model.settled_ohm(&model.grid_position(soc, last_c)) * libm::exp(log_resistance);
    let loaded_c =
        circuit::temperature_after(thermal, last_c, step.ambient_c, square(mean_current_a) * ohm, step.measured_s);
    let predicted_c = circuit::temperature_after(thermal, loaded_c, step.ambient_c, 0.0, step.unmeasured_s);
    // An impossible current would give an impossible temperature.
    predicted_c.clamp(bounds::TEMPERATURE_C.low, bounds::TEMPERATURE_C.high)
}
