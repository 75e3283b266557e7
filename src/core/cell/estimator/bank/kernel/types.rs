//! State, inputs, outcome and constants of the kernel, which is the vector code of the filter.
//!
//! In: the estimator's settings and the cell model. Out: values in the units of the states, one cell per lane. A
//! *constant error* is an error that does not change with time, for example the offset of a sensor.

use std::array::from_fn;

use nalgebra::{SMatrix, SVector};

use crate::cell::estimator::gaussian::Gaussian;
use crate::cell::estimator::state_vector::{BRANCHES, CONSTANT_ERRORS, square};
use crate::cell::{CellModel, Discretisation, EstimatorConfig, SensorErrors};
use crate::filter::simd::{Lanes, Mask};

/// Filter states of L cells: N means, and the T elements of the covariance's lower triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::cell::estimator::bank) struct FilterState<const L: usize, const N: usize, const T: usize> {
    pub(in crate::cell::estimator::bank) mean: [Lanes<L>; N],
    /// Covariance without the constant errors, row by row to the diagonal.
    pub(in crate::cell::estimator::bank) covariance: [Lanes<L>; T],
    /// Errors of the means caused by one standard deviation of each constant error.
    pub(in crate::cell::estimator::bank) by_constant: [[Lanes<L>; N]; CONSTANT_ERRORS],
    /// Values of the estimator's `Memory`, at the indices [`LOAD_A`] to [`SLOW_STD`].
    pub(in crate::cell::estimator::bank) memory: [Lanes<L>; MEMORY],
}

pub(in crate::cell::estimator::bank) type HotMemory = [Lanes<1>; MEMORY];

pub(in crate::cell::estimator::bank) const MEMORY: usize = 12;
// Indices in the memory. Steps read CURVE_AH, CURVE_STD_AH, SLOW_RATIO and SLOW_STD, but do not change them.
/// Low-pass of |current| (A).
pub(in crate::cell::estimator::bank) const LOAD_A: usize = 0;
pub(in crate::cell::estimator::bank) const MEAN_NIS: usize = 1;
pub(in crate::cell::estimator::bank) const INFORMATION_S: usize = 2;
pub(in crate::cell::estimator::bank) const REST_S: usize = 3;
pub(in crate::cell::estimator::bank) const OFFSET_INFORMATION: usize = 4;
pub(in crate::cell::estimator::bank) const OFFSET_SCORE: usize = 5;
pub(in crate::cell::estimator::bank) const CURVE_AH: usize = 6;
pub(in crate::cell::estimator::bank) const CURVE_STD_AH: usize = 7;

pub(in crate::cell::estimator::bank) const SLOW_INFORMATION: usize = 8;
pub(in crate::cell::estimator::bank) const SLOW_SCORE: usize = 9;
pub(in crate::cell::estimator::bank) const SLOW_RATIO: usize = 10;
pub(in crate::cell::estimator::bank) const SLOW_STD: usize = 11;

/// Index of the covariance of `i` and `j` <= `i`.
pub(in crate::cell::estimator::bank) const fn at(i: usize, j: usize) -> usize {
    i * (i + 1) / 2 + j
}

#[derive(Debug, Clone, Copy)]
pub(in crate::cell::estimator::bank) struct StepInput<const L: usize> {
    pub(in crate::cell::estimator::bank) measured_s: Lanes<L>,
    pub(in crate::cell::estimator::bank) charge_as: Lanes<L>,
    pub(in crate::cell::estimator::bank) offset_s: Lanes<L>,
    pub(in crate::cell::estimator::bank) current_a: Lanes<L>,
    pub(in crate::cell::estimator::bank) voltage_v: Lanes<L>,
    pub(in crate::cell::estimator::bank) temperature_c: Lanes<L>,
    pub(in crate::cell::estimator::bank) decay: DecayFactors<L>,
}

#[derive(Debug, Clone, Copy)]
pub(in crate::cell::estimator::bank) struct DecayFactors<const L: usize> {
    /// Decay of the load's low-pass.
    pub(super) load: Lanes<L>,
    /// Decay of the consistency monitor.
    pub(super) consistency: Lanes<L>,
    /// 1 / time (1/s); 0 if no time has passed.
    pub(super) per_s: Lanes<L>,
}

impl<const L: usize> DecayFactors<L> {
    pub(in crate::cell::estimator::bank) const NONE: Self =
        Self { load: Lanes([1.0; L]), consistency: Lanes([1.0; L]), per_s: Lanes([0.0; L]) };

    #[inline(always)]
    pub(in crate::cell::estimator::bank) fn after(c: &KernelConstants, time_s: Lanes<L>) -> Self {
        Self {
            load: (-(time_s / c.load_memory_s)).exp(),
            consistency: (-(time_s.at_least(1e-3) / c.consistency_window_s)).exp(),
            per_s: time_s.reciprocal().or_else(time_s.above_number(0.0), Lanes::splat(0.0)),
        }
    }

    pub(in crate::cell::estimator::bank) fn splat(one: &DecayFactors<1>) -> Self {
        let splat = |x: &Lanes<1>| Lanes::splat(x.0[0]);
        Self { load: splat(&one.load), consistency: splat(&one.consistency), per_s: splat(&one.per_s) }
    }

    pub(in crate::cell::estimator::bank) fn lane(&self, lane: usize) -> DecayFactors<1> {
        let take = |x: &Lanes<L>| Lanes([x.0[lane]]);
        DecayFactors { load: take(&self.load), consistency: take(&self.consistency), per_s: take(&self.per_s) }
    }
}

#[derive(Debug, Clone, Copy)]
pub(in crate::cell::estimator::bank) struct StepOutcome<const L: usize> {
    /// After an update: whether the covariance was positive definite and the variance of the innovation is positive.
    /// After a whole step: also whether the reading is within the gate and the new state is possible.
    pub(in crate::cell::estimator::bank) is_usable: Mask<L>,
    pub(in crate::cell::estimator::bank) is_accepted: Mask<L>,
    pub(in crate::cell::estimator::bank) innovation_v: Lanes<L>,
    pub(in crate::cell::estimator::bank) innovation_variance: Lanes<L>,
    pub(in crate::cell::estimator::bank) test_ratio: Lanes<L>,
}

/// Settings in the form that the kernel uses.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::cell::estimator::bank) struct KernelConstants {
    /// Factor s of the sigma points x +- s L_k (see [`super`]).
    pub(super) scale: f64,
    /// Factor of m m' in the covariance (see [`super`]): beta - alpha^2.
    pub(super) excess: f64,
    pub(super) euler: bool,
    pub(in crate::cell::estimator::bank) process: ProcessVariances,
    pub(super) reading: ReadingVariances,
    pub(in crate::cell::estimator::bank) sensor: SensorErrors,
    pub(super) rest_current_a: f64,
    pub(super) load_memory_s: f64,
    pub(super) max_information_s: f64,
    pub(super) consistency_window_s: f64,
}

/// Variances that the states gain through process noise.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::cell::estimator::bank) struct ProcessVariances {
    pub(in crate::cell::estimator::bank) soc_per_s: f64,
    pub(super) soc_per_charge: f64,
    pub(super) branch_per_s: f64,
    pub(super) log_resistance_per_s: f64,
}

/// Variances (V^2) of a voltage reading, and the settings of its gate.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ReadingVariances {
    pub(super) sensor: f64,
    /// Variance of the model's error over one second. Used only if the tables of the cell model state no error.
    pub(super) model: f64,
    /// Variance of the model's error over one second, per square of the voltage drop.
    pub(super) drop: f64,
    /// Variance of the model's error over one second, per square of the load's voltage drop.
    pub(super) load: f64,
    pub(super) gate: f64,
    /// Variance that the gate adds, per square of the open-circuit voltage's slope.
    pub(super) gate_soc: f64,
    /// Maximum test ratio of an accepted reading.
    pub(super) gate_limit: f64,
}

impl KernelConstants {
    #[inline(always)]
    pub(in crate::cell::estimator::bank) fn information_s<const L: usize>(
        &self,
        memory: &[Lanes<L>; MEMORY],
    ) -> Lanes<L> {
        memory[INFORMATION_S].at_least(1e-3).at_most(self.max_information_s)
    }

    pub(in crate::cell::estimator::bank) fn new(model: &CellModel, config: &EstimatorConfig) -> Self {
        let states = BRANCHES + model.branches.len();
        Self {
            scale: (square(config.points.alpha) * (states as f64 + config.points.kappa)).sqrt(),
            excess: config.points.beta - square(config.points.alpha),
            euler: config.discretisation == Discretisation::Euler,
            process: ProcessVariances {
                soc_per_s: square(config.process.soc_per_sqrt_s),
                soc_per_charge: square(config.process.charge_per_sqrt_soc),
                branch_per_s: square(config.process.branch_v_per_sqrt_s),
                log_resistance_per_s: square(config.process.log_resistance_per_sqrt_s),
            },
            reading: ReadingVariances {
                sensor: square(config.voltage.noise_v),
                model: square(config.voltage.model_error_v_sqrt_s),
                drop: square(config.voltage.drop_error_sqrt_s),
                load: square(config.voltage.load_error_sqrt_s),
                gate: square(config.voltage.noise_v) + square(config.gate.model_error_v),
                gate_soc: square(config.gate.soc_error),
                gate_limit: square(config.gate.sigma),
            },
            sensor: config.sensor,
            rest_current_a: config.gap.rest_current_a,
            load_memory_s: config.voltage.load_memory_s,
            max_information_s: config.voltage.max_information_s,
            consistency_window_s: config.consistency.window_s,
        }
    }
}

impl<const N: usize, const T: usize> FilterState<1, N, T> {
    pub(in crate::cell::estimator::bank) fn new(x: &Gaussian, memory: [Lanes<1>; MEMORY]) -> Self {
        let mut covariance = [Lanes([0.0]); T];
        for i in 0..N {
            for j in 0..=i {
                covariance[at(i, j)] = Lanes([x.covariance[(i, j)]]);
            }
        }
        Self {
            mean: from_fn(|i| Lanes([x.mean[i]])),
            covariance,
            by_constant: from_fn(|k| from_fn(|i| Lanes([x.by_constant[(i, k)]]))),
            memory,
        }
    }

    pub(in crate::cell::estimator::bank) fn gaussian(&self) -> Gaussian {
        let (mut mean, mut covariance, mut by_constant) = (SVector::zeros(), SMatrix::zeros(), SMatrix::zeros());
        for i in 0..N {
            mean[i] = self.mean[i].0[0];
            for j in 0..N {
                covariance[(i, j)] = self.covariance[at(i.max(j), i.min(j))].0[0];
            }
            for k in 0..CONSTANT_ERRORS {
                by_constant[(i, k)] = self.by_constant[k][i].0[0];
            }
        }
        Gaussian { states: N, mean, covariance, by_constant }
    }

    pub(in crate::cell::estimator::bank) fn of_lane<const L: usize>(all: &FilterState<L, N, T>, lane: usize) -> Self {
        let take = |x: &Lanes<L>| Lanes([x.0[lane]]);
        Self {
            mean: from_fn(|i| take(&all.mean[i])),
            covariance: from_fn(|i| take(&all.covariance[i])),
            by_constant: from_fn(|k| from_fn(|i| take(&all.by_constant[k][i]))),
            memory: from_fn(|i| take(&all.memory[i])),
        }
    }
}

impl<const L: usize, const N: usize, const T: usize> FilterState<L, N, T> {
    pub(in crate::cell::estimator::bank) fn set_lane(&mut self, lane: usize, one: &FilterState<1, N, T>) {
        for i in 0..N {
            self.mean[i].0[lane] = one.mean[i].0[0];
        }
        for i in 0..T {
            self.covariance[i].0[lane] = one.covariance[i].0[0];
        }
        for (all, one) in self.by_constant.iter_mut().flatten().zip(one.by_constant.iter().flatten()) {
            all.0[lane] = one.0[0];
        }
        for i in 0..MEMORY {
            self.memory[i].0[lane] = one.memory[i].0[0];
        }
    }

    /// Where the mask is true, replaces the state by `new`.
    #[inline(always)]
    pub(in crate::cell::estimator::bank) fn take_where(&mut self, mask: Mask<L>, new: &Self) {
        for i in 0..N {
            self.mean[i] = new.mean[i].or_else(mask, self.mean[i]);
        }
        for i in 0..T {
            self.covariance[i] = new.covariance[i].or_else(mask, self.covariance[i]);
        }
        for (old, new) in self.by_constant.iter_mut().flatten().zip(new.by_constant.iter().flatten()) {
            *old = new.or_else(mask, *old);
        }
        for i in 0..MEMORY {
            self.memory[i] = new.memory[i].or_else(mask, self.memory[i]);
        }
    }
}
