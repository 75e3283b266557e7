//! Runs the kernel, which is the vector code of the filter, for one cell. The estimator uses it for every step that is
//! not ordinary, for example a step after a gap (see [`super`]).
//!
//! In: a step, and a copy of a cell's filter state and of its [`Memory`]. Out: the changed copy. If the step cannot be
//! computed, returns `None` and leaves the copy unchanged.

use super::filter_array::{FilterArrays, each_array};
use super::kernel::{
    CURVE_AH, CURVE_STD_AH, DecayFactors, EVIDENCE, HotMemory, INFORMATION_S, KernelConstants, LOAD_A, MEAN_NIS,
    MEMORY, OFFSET_INFORMATION, OFFSET_SCORE, REST_S, SLOW_INFORMATION, SLOW_RATIO, SLOW_SCORE, SLOW_STD, StepInput,
    update_memory,
};
use crate::cell::estimator::gaussian::Gaussian;
use crate::cell::estimator::memory::Memory;
use crate::cell::estimator::step::{CellStep, Update};
use crate::filter::simd::Lanes;
use crate::quantity::bounds;

/// The kernel for one cell. Every step must have a temperature.
pub(in crate::cell::estimator) struct SingleCell<'a> {
    filters: &'a mut FilterArrays,
    constants: &'a KernelConstants,
    cell: usize,
}

impl<'a> SingleCell<'a> {
    pub(super) fn new(filters: &'a mut FilterArrays, constants: &'a KernelConstants, cell: usize) -> Self {
        Self { filters, constants, cell }
    }

    fn input(&self, step: &CellStep, time_s: f64) -> StepInput<1> {
        let measured_s = Lanes([time_s]);
        StepInput {
            measured_s,
            charge_as: Lanes([step.charge_as]),
            offset_s: Lanes([step.offset_s]),
            current_a: Lanes([step.current_a.unwrap_or(0.0)]),
            voltage_v: Lanes([step.voltage_v]),
            temperature_c: Lanes([step.temperature_c.unwrap_or(step.ambient_c)]),
            decay: DecayFactors::after(self.constants, measured_s),
        }
    }

    pub(in crate::cell::estimator) fn predict_measured(
        &mut self,
        (x, memory): (&mut Gaussian, &Memory),
        step: &CellStep,
    ) -> Option<()> {
        let input = self.input(step, step.measured_s);
        self.predict((x, memory), &input, self.constants.process.soc_per_s)
    }

    /// Predicts over the part of a step in which the current was not measured, and assumes that no current flowed. The
    /// caller adds the noise of the SOC.
    pub(in crate::cell::estimator) fn predict_unmeasured(
        &mut self,
        (x, memory): (&mut Gaussian, &Memory),
        step: &CellStep,
    ) -> Option<()> {
        let rest = CellStep { charge_as: 0.0, offset_s: 0.0, ..*step };
        let input = self.input(&rest, step.unmeasured_s);
        self.predict((x, memory), &input, 0.0)
    }

    fn predict(&mut self, (x, memory): (&mut Gaussian, &Memory), input: &StepInput<1>, soc_per_s: f64) -> Option<()> {
        let (c, hot) = (self.constants, hot(memory, self.constants));
        each_array!(&mut *self.filters, array => array.predict(c, (self.cell, x, hot), input, soc_per_s))
    }

    pub(in crate::cell::estimator) fn pass_measured(&self, memory: &mut Memory, step: &CellStep) {
        let mut hot = hot(memory, self.constants);
        update_memory(self.constants, &mut hot, &self.input(step, step.measured_s));
        *memory = with_hot(memory, &hot);
    }

    /// Updates with the voltage of a step whose current is known. If the voltage is within the gate, the state changes,
    /// and the memory gains evidence about two errors: the offset of the current sensor, and the resistance ratio of
    /// the slowest branch.
    pub(in crate::cell::estimator) fn update(
        &mut self,
        (x, memory): (&mut Gaussian, &mut Memory),
        step: &CellStep,
    ) -> Option<Update> {
        let input = self.input(step, step.measured_s);
        let (c, mut hot) = (self.constants, hot(memory, self.constants));
        let (update, after) = each_array!(&mut *self.filters, array => array.update(c, (self.cell, x, hot), &input))?;
        if update.accepted {
            // Limit the evidence to numbers that can be stored; ignore NaN.
            for i in EVIDENCE.into_iter().filter(|&i| !after[i].0[0].is_nan()) {
                hot[i] = after[i].at_least(bounds::NUMBER.low).at_most(bounds::NUMBER.high);
            }
            *memory = with_hot(memory, &hot);
        }
        Some(update)
    }
}

pub(super) fn hot(memory: &Memory, c: &KernelConstants) -> HotMemory {
    let mut hot = [0.0; MEMORY];
    hot[LOAD_A] = memory.load_a;
    hot[MEAN_NIS] = memory.mean_nis;
    hot[INFORMATION_S] = memory.information_s;
    hot[REST_S] = memory.rest_s;
    hot[OFFSET_INFORMATION] = memory.offset_information;
    hot[OFFSET_SCORE] = memory.offset_score;
    (hot[SLOW_RATIO], hot[SLOW_STD]) = (memory.slow_branch.ratio, memory.slow_branch.std(c.sensor.slow_branch));
    hot[SLOW_INFORMATION] = memory.slow_branch.information;
    hot[SLOW_SCORE] = memory.slow_branch.score;
    (hot[CURVE_AH], hot[CURVE_STD_AH]) = (memory.curve.mean, memory.curve.std());
    hot.map(|number| Lanes([number]))
}

/// The memory with the values that the kernel has changed.
pub(super) fn with_hot(memory: &Memory, hot: &HotMemory) -> Memory {
    let mut memory = *memory;
    let number = |i: usize| hot[i].0[0];
    memory.load_a = number(LOAD_A);
    memory.mean_nis = number(MEAN_NIS);
    memory.information_s = number(INFORMATION_S);
    memory.rest_s = number(REST_S);
    memory.offset_information = number(OFFSET_INFORMATION);
    memory.offset_score = number(OFFSET_SCORE);
    memory.slow_branch.information = number(SLOW_INFORMATION);
    memory.slow_branch.score = number(SLOW_SCORE);
    memory
}
