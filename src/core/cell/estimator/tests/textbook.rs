//! The filter in its textbook form, as a reference for the kernel (the vector code of the filter): here, every sigma
//! point passes through the whole circuit.
//!
//! After a start, a downtime or learning, the textbook filter copies the state of the estimator under test. It computes
//! all other steps by itself.

mod circuit;
mod noise;
mod unscented;

use nalgebra::{SMatrix, SVector};

use self::noise::VoltageReading;
use self::unscented::Gaussian;
use super::*;
use crate::cell::Update;
use crate::cell::estimator::memory::Memory;
use crate::cell::estimator::state_vector::{CURRENT_OFFSET, SLOW_BRANCH, square};

pub(in crate::cell::estimator) struct Textbook<const N: usize> {
    x: Gaussian<N>,
    memory: Memory,
}

impl<const N: usize> Textbook<N> {
    pub(in crate::cell::estimator) fn new(config: &EstimatorConfig) -> Self {
        let x = Gaussian { mean: SVector::zeros(), covariance: SMatrix::identity(), by_constant: SMatrix::zeros() };
        Self { x, memory: Memory::new(config) }
    }

    pub(in crate::cell::estimator) fn copy(&mut self, estimator: &CellEstimator) {
        self.memory = estimator.memory;
        if let Some(x) = &estimator.filter {
            self.x = Gaussian {
                mean: x.mean.fixed_rows::<N>(0).into_owned(),
                covariance: x.covariance.fixed_view::<N, N>(0, 0).into_owned(),
                by_constant: x.by_constant.fixed_rows::<N>(0).into_owned(),
            };
        }
    }

    /// Computes the step that has led an estimator from `before` to `after`. Returns `None` if it copies the state
    /// `after` instead.
    pub(in crate::cell::estimator) fn step(
        &mut self,
        model: &CellModel,
        config: &EstimatorConfig,
        step: &CellStep,
        (before, after, reset): (&CellEstimator, &CellEstimator, bool),
    ) -> Option<Option<Update>> {
        if before.filter.is_none() || before.memory.is_soc_unknown || reset {
            self.copy(after);
            return None;
        }
        let temperature_c = after.memory.temperature_c.expect("every step has one");
        let gap_std = self.memory.note_gap(config, step, self.x.mean[2]);
        circuit::predict(&mut self.x, model, config, step, temperature_c, gap_std).expect("a sound state");
        self.pass_time(model, config, step);
        self.memory.temperature_c = after.memory.temperature_c;
        let Some(current_a) = step.current_a else { return Some(None) };
        self.memory.last_current_a = current_a;
        if self.memory.downtime_std_if_any().is_some() {
            self.copy(after);
            return None;
        }
        let Memory { load_a, curve, slow_branch, .. } = self.memory;
        let reading = VoltageReading {
            voltage_v: step.voltage_v,
            current_a,
            load_a,
            temperature: model.temperature_position(temperature_c),
            information_s: self.memory.information_s.clamp(1e-3, config.voltage.max_information_s),
            curve,
            slow_ratio: slow_branch.ratio,
            slow_std: slow_branch.std(config.sensor.slow_branch),
        };
        let (update, effects_v) = circuit::update(&mut self.x, model, config, &reading).expect("a sound state");
        self.memory.end_downtime();
        if update.accepted {
            let evidence = |effect_v: f64| {
                let per_variance = effect_v / (update.innovation_variance - square(effect_v));
                (per_variance * effect_v, per_variance * update.innovation)
            };
            let (information, score) = evidence(effects_v[CURRENT_OFFSET]);
            self.memory.offset_information += information;
            self.memory.offset_score += score;
            let (information, score) = evidence(effects_v[SLOW_BRANCH]);
            self.memory.slow_branch.information += information;
            self.memory.slow_branch.score += score;
        }
        self.memory.record_update(config, step, &update);
        Some(Some(update))
    }

    /// Advances the memory's load, rest time and information time by the duration of a step.
    fn pass_time(&mut self, model: &CellModel, config: &EstimatorConfig, step: &CellStep) {
        const REST_REPEATS_S: f64 = 1000.0;
        let memory = &mut self.memory;
        if step.measured_s > 0.0 {
            let mean_a = step.charge_as.abs() / step.measured_s;
            let kept = libm::exp(-step.measured_s / config.voltage.load_memory_s);
            memory.load_a = mean_a + (memory.load_a - mean_a) * kept;
        }
        let elapsed_s = step.measured_s + step.unmeasured_s;
        if step.unmeasured_s > 0.0 {
            memory.pass_gap(model, config, step);
        }
        if step.charge_as.abs() > config.gap.rest_current_a * step.measured_s || step.unmeasured_s > 0.0 {
            memory.rest_s = 0.0;
            memory.information_s += elapsed_s;
        } else {
            let before_s = memory.rest_s;
            memory.rest_s += elapsed_s;
            let ratio = (REST_REPEATS_S + memory.rest_s) / (REST_REPEATS_S + before_s);
            memory.information_s += REST_REPEATS_S * libm::log(ratio);
        }
    }

    /// Returns the difference of the SOC, and the maximum difference of all other values. Numbers of the memory above 1
    /// are compared relative to their size.
    pub(in crate::cell::estimator) fn differences(&self, estimator: &CellEstimator) -> (f64, f64) {
        let near = |a: ScalarGaussian, b: ScalarGaussian| (a.mean - b.mean).abs().max((a.std() - b.std()).abs());
        let x = estimator.filter.as_ref().expect("started");
        let others = (1..N).map(|i| near(self.x.marginal(i), x.marginal(i)));
        let numbers = |memory: &Memory| {
            let Memory { load_a, mean_nis, information_s, rest_s, offset_information, offset_score, .. } = *memory;
            let slow = memory.slow_branch;
            [load_a, mean_nis, information_s, rest_s, offset_information, offset_score, slow.information, slow.score]
        };
        let pairs = numbers(&self.memory).into_iter().zip(numbers(&estimator.memory));
        let memory = pairs.map(|(ours, theirs)| (ours - theirs).abs() / theirs.abs().max(1.0));
        (near(self.x.marginal(0), x.marginal(0)), others.chain(memory).fold(0.0, f64::max))
    }

    pub(in crate::cell::estimator) fn set_curve(&mut self, curve: ScalarGaussian) {
        self.memory.curve = curve;
    }
}
