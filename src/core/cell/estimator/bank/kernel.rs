//! The ordinary step of L cells at once: predict over a measured time, update with a voltage that passes the gate.
//!
//! The same filter as [`Gaussian`](crate::filter::Gaussian) with the circuit of [`crate::cell::circuit`], to rounding.
//! It saves the following work, all exactly:
//! * With the points in pairs x +- s L_k (s = sqrt(N + lambda)) and f's odd and even parts over each pair, o_k = (f+ - f-) / 2s
//!   and e_k = ((f+ + f-) / 2 - f0) / s, the weighted sums become f0 + m with m = sum e_k / s for the mean, and
//!   sum (o_k o_k' + e_k e_k') plus beta - alpha^2 times m m' for the covariance. For a pair moved by a linear map, o_k is
//!   its image and e_k = 0.
//! * The state is ordered so that only the first three columns of the Cholesky factor L move states in which the circuit
//!   is not linear. The columns of the branches add up to P less the first three columns: they are never computed.
//! * SOC differs in one pair only, so each phase looks up the tables at three places instead of 2 N + 1.
//! * A cell's lines of the tables are cached from step to step: [`LineCache`].
//! * exp(x + d) = exp(x) exp(d), and exp(-2x) = exp(-x)^2 for the branches' noise.
//!
//! In: states, and for each the charge, time, current, temperature and voltage. Out: the new states, and a mask of
//! the usable ones: all numbers finite, the covariance positive definite, the reading within the gate.
#![expect(clippy::needless_range_loop, reason = "indices of states say more than iterators over parts of a matrix")]

mod points;
mod predict;
mod update;

use std::array::from_fn;

use predict::predict;
use update::update;

use super::super::noise::REST_REPEATS_S;
use super::super::{LOG_RESISTANCE, square};
use super::tables::{LineCache, Tables};
use crate::cell::config::{Discretisation, EstimatorConfig};
use crate::cell::model::CellModel;
use crate::filter::simd::{Lanes, Mask};

/// Filter states of L cells: N means each, the T numbers of the covariance's lower triangle, and a memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FilterState<const L: usize, const N: usize, const T: usize> {
    /// Means in the order of the estimator's state.
    pub(super) mean: [Lanes<L>; N],
    /// Covariance, row by row to the diagonal.
    pub(super) covariance: [Lanes<L>; T],
    /// Part of the estimator's `Memory`, see [`LOAD_A`] to [`REST_S`].
    pub(super) memory: [Lanes<L>; MEMORY],
}

/// Number of memory values that every step changes.
pub(super) const MEMORY: usize = 4;
/// |current| low-passed, A.
pub(super) const LOAD_A: usize = 0;
/// Mean normalised innovation squared.
pub(super) const MEAN_NIS: usize = 1;
/// Time that the next reading stands for, s.
pub(super) const INFORMATION_S: usize = 2;
/// Time at rest, s.
pub(super) const REST_S: usize = 3;

/// Index of the covariance of `i` and `j` <= `i`.
pub(super) const fn at(i: usize, j: usize) -> usize {
    i * (i + 1) / 2 + j
}

/// Inputs of L cells since their last step.
#[derive(Debug, Clone, Copy)]
pub(super) struct StepInput<const L: usize> {
    pub(super) measured_s: Lanes<L>,
    pub(super) charge_as: Lanes<L>,
    pub(super) current_a: Lanes<L>,
    pub(super) voltage_v: Lanes<L>,
    pub(super) temperature_c: Lanes<L>,
    /// Decay of the memories over the measured time.
    pub(super) decay: DecayFactors<L>,
}

/// Decay factors of a step time.
#[derive(Debug, Clone, Copy)]
pub(super) struct DecayFactors<const L: usize> {
    /// Of the load's low-pass.
    load: Lanes<L>,
    /// Of the consistency monitor.
    consistency: Lanes<L>,
    /// 1 / time, 1/s; 0 where no time passed.
    per_s: Lanes<L>,
}

impl<const L: usize> DecayFactors<L> {
    /// No decay.
    pub(super) const NONE: Self = Self { load: Lanes([1.0; L]), consistency: Lanes([1.0; L]), per_s: Lanes([0.0; L]) };

    #[inline(always)]
    pub(super) fn after(c: &KernelConstants, time_s: Lanes<L>) -> Self {
        Self {
            load: (-(time_s / c.load_memory_s)).exp(),
            consistency: (-(time_s.at_least(1e-3) / c.consistency_window_s)).exp(),
            per_s: time_s.reciprocal().or_else(time_s.above_number(0.0), Lanes::splat(0.0)),
        }
    }

    /// The same factors in every lane.
    pub(super) fn splat(one: &DecayFactors<1>) -> Self {
        let splat = |x: &Lanes<1>| Lanes::splat(x.0[0]);
        Self { load: splat(&one.load), consistency: splat(&one.consistency), per_s: splat(&one.per_s) }
    }

    pub(super) fn lane(&self, lane: usize) -> DecayFactors<1> {
        let take = |x: &Lanes<L>| Lanes([x.0[lane]]);
        DecayFactors { load: take(&self.load), consistency: take(&self.consistency), per_s: take(&self.per_s) }
    }
}

/// Outcome of a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct StepOutcome<const L: usize> {
    /// Whether the new state is usable.
    pub(super) is_usable: Mask<L>,
    pub(super) innovation_v: Lanes<L>,
    pub(super) innovation_variance: Lanes<L>,
    pub(super) test_ratio: Lanes<L>,
}

/// Settings in the form that the kernel uses.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct KernelConstants {
    /// s: spread of the sigma points.
    scale: f64,
    /// beta - alpha^2.
    excess: f64,
    euler: bool,
    soc_variance_per_s: f64,
    charge_variance_per_soc: f64,
    branch_variance_per_s: f64,
    log_resistance_variance_per_s: f64,
    sensor_variance: f64,
    /// One-second variance of the model's error, V^2, where the tables state none.
    model_variance: f64,
    drop_variance: f64,
    load_variance: f64,
    gate_variance: f64,
    gate_soc_variance: f64,
    gate_limit: f64,
    rest_current_a: f64,
    load_memory_s: f64,
    max_information_s: f64,
    consistency_window_s: f64,
    ocv_ageing_shift: f64,
    new_capacity_ah: f64,
}

impl KernelConstants {
    pub(super) fn new<const N: usize>(model: &CellModel, config: &EstimatorConfig) -> Self {
        Self {
            scale: (square(config.alpha) * (N as f64 + config.kappa)).sqrt(),
            excess: config.beta - square(config.alpha),
            euler: config.discretisation == Discretisation::Euler,
            soc_variance_per_s: square(config.soc_noise_per_sqrt_s),
            charge_variance_per_soc: square(config.charge_noise_per_sqrt_soc),
            branch_variance_per_s: square(config.branch_noise_v_per_sqrt_s),
            log_resistance_variance_per_s: square(config.log_resistance_noise_per_sqrt_s),
            sensor_variance: square(config.voltage_noise_v),
            model_variance: square(config.model_error_v_sqrt_s),
            drop_variance: square(config.drop_error_sqrt_s),
            load_variance: square(config.load_error_sqrt_s),
            gate_variance: square(config.voltage_noise_v) + square(config.gate_model_error_v),
            gate_soc_variance: square(config.gate_soc_error),
            gate_limit: square(config.gate_sigma),
            rest_current_a: config.rest_current_a,
            load_memory_s: config.load_memory_s,
            max_information_s: config.max_information_s,
            consistency_window_s: config.consistency_window_s,
            ocv_ageing_shift: model.ocv_ageing_shift,
            new_capacity_ah: model.capacity_ah,
        }
    }
}

impl<const N: usize, const T: usize> FilterState<1, N, T> {
    /// Copies the states of one lane.
    pub(super) fn of_lane<const L: usize>(all: &FilterState<L, N, T>, lane: usize) -> Self {
        let take = |x: &Lanes<L>| Lanes([x.0[lane]]);
        Self {
            mean: from_fn(|i| take(&all.mean[i])),
            covariance: from_fn(|i| take(&all.covariance[i])),
            memory: from_fn(|i| take(&all.memory[i])),
        }
    }
}

impl<const L: usize, const N: usize, const T: usize> FilterState<L, N, T> {
    /// Puts the state of one cell into a lane.
    pub(super) fn set_lane(&mut self, lane: usize, one: &FilterState<1, N, T>) {
        for i in 0..N {
            self.mean[i].0[lane] = one.mean[i].0[0];
        }
        for i in 0..T {
            self.covariance[i].0[lane] = one.covariance[i].0[0];
        }
        for i in 0..MEMORY {
            self.memory[i].0[lane] = one.memory[i].0[0];
        }
    }

    /// Takes the new state where the mask is true.
    #[inline(always)]
    pub(super) fn take_where(&mut self, mask: Mask<L>, new: &Self) {
        for i in 0..N {
            self.mean[i] = new.mean[i].or_else(mask, self.mean[i]);
        }
        for i in 0..T {
            self.covariance[i] = new.covariance[i].or_else(mask, self.covariance[i]);
        }
        for i in 0..MEMORY {
            self.memory[i] = new.memory[i].or_else(mask, self.memory[i]);
        }
    }
}

/// One ordinary step.
#[inline(always)]
pub(super) fn step<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    cache: &mut LineCache<L, W>,
    c: &KernelConstants,
    before: &FilterState<L, N, T>,
    input: &StepInput<L>,
) -> (FilterState<L, N, T>, StepOutcome<L>) {
    tables.refresh_temperatures(cache, &input.temperature_c);
    let ratio = before.mean[LOG_RESISTANCE].exp();
    let (mean, covariance, has_factor) = predict(tables, cache, c, before, input, ratio);
    let mut x = FilterState { mean, covariance, memory: before.memory };
    let information_s = update_memory(c, &mut x, input);
    let mut outcome = update(tables, cache, c, &mut x, input, ratio, information_s);
    x.memory[INFORMATION_S] = Lanes::splat(0.0);
    let forget = Lanes::splat(1.0) - input.decay.consistency;
    x.memory[MEAN_NIS] = x.memory[MEAN_NIS] + forget * (outcome.test_ratio - x.memory[MEAN_NIS]);
    // The sum is not finite when any of its numbers is not.
    let mut sum = outcome.innovation_variance + outcome.test_ratio;
    for i in 0..N {
        sum = sum + x.mean[i];
    }
    for i in 0..T {
        sum = sum + x.covariance[i];
    }
    let least = (1..N).fold(x.covariance[at(0, 0)], |least, i| least.smaller(x.covariance[at(i, i)]));
    outcome.is_usable = outcome.is_usable & has_factor & sum.is_finite() & least.above_number(0.0);
    (x, outcome)
}

/// Updates the load's low-pass and the time at rest; returns the time that the reading stands for, s.
#[inline(always)]
fn update_memory<const L: usize, const N: usize, const T: usize>(
    c: &KernelConstants,
    x: &mut FilterState<L, N, T>,
    input: &StepInput<L>,
) -> Lanes<L> {
    let dt = input.measured_s;
    let moved_as = input.charge_as.abs();
    let load_a = x.memory[LOAD_A];
    let mean_a = moved_as * input.decay.per_s;
    let kept_a = mean_a + (load_a - mean_a) * input.decay.load;
    x.memory[LOAD_A] = kept_a.or_else(dt.above_number(0.0), load_a);

    let is_loaded = moved_as.above(dt * c.rest_current_a);
    let rested_s = x.memory[REST_S] + dt;
    let mut new_s = dt;
    if (!is_loaded).any() {
        let repeats = Lanes::splat(REST_REPEATS_S);
        let logarithm = ((repeats + rested_s) / (repeats + x.memory[REST_S])).ln();
        new_s = dt.or_else(is_loaded, logarithm * REST_REPEATS_S);
    }
    x.memory[REST_S] = Lanes::splat(0.0).or_else(is_loaded, rested_s);
    (x.memory[INFORMATION_S] + new_s).at_least(1e-3).at_most(c.max_information_s)
}
