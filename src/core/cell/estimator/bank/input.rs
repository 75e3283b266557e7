//! Collects the inputs of a block of cells for the filter's vector code ([`super::kernel`]), and records the results of
//! their steps. Each cell has one lane of the block.
//!
//! In: steps (V, A, s, degrees C). Out: the inputs of the kernel. If the kernel's outcome for a cell is not usable,
//! [`BlockInput::step`] returns the cell's step, so that the bank can compute this step again, alone.

use super::kernel::{DecayFactors, StepInput, StepOutcome};
use crate::cell::estimator::memory::Memory;
use crate::cell::estimator::step::{CellStep, StepResult, Update};
use crate::filter::simd::{Lanes, Mask};

/// Number of cells in a block: one AVX-512 vector or two AVX2 vectors. Blocks of 4 and of 16 cells were slower in
/// measurements.
pub(super) const WIDTH: usize = 8;

/// Data of a cell, in addition to the data in its lane.
#[derive(Debug, Clone)]
pub(super) struct CellSlot {
    /// The lane holds the present load, consistency, information, rest and evidence of the cell. Their copies in this
    /// memory are out of date.
    pub(super) memory: Memory,
    pub(super) has_filter: bool,
}

impl CellSlot {
    /// Whether the next step can be an ordinary step (defined in [`super`]), if the current is measured during the
    /// whole step.
    #[inline]
    pub(super) fn is_ordinary(&self) -> bool {
        self.has_filter
            && self.memory.rejected == 0
            && !self.memory.is_soc_unknown
            && !self.memory.is_current_unknown
            && self.memory.downtime_std_if_any().is_none()
    }
}

impl<const L: usize> StepOutcome<L> {
    #[inline(always)]
    pub(super) fn lane(&self, lane: usize) -> Update {
        Update {
            innovation: self.innovation_v.0[lane],
            innovation_variance: self.innovation_variance.0[lane],
            test_ratio: self.test_ratio.0[lane],
            accepted: self.is_accepted.lane(lane),
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct BlockInput {
    pub(super) is_present: Mask<WIDTH>,
    pub(super) input: StepInput<WIDTH>,
}

impl BlockInput {
    pub(super) const NONE: Self = Self {
        is_present: Mask::splat(false),
        input: StepInput {
            measured_s: Lanes([1.0; WIDTH]),
            charge_as: Lanes([0.0; WIDTH]),
            offset_s: Lanes([0.0; WIDTH]),
            current_a: Lanes([0.0; WIDTH]),
            voltage_v: Lanes([0.0; WIDTH]),
            temperature_c: Lanes([25.0; WIDTH]),
            decay: DecayFactors::NONE,
        },
    };

    /// Gives each lane without a step the time of a lane with a step, so that all lanes can share the decay factors.
    /// The results of lanes without a step are discarded.
    #[inline(always)]
    pub(super) fn fill_absent(&mut self) {
        if !self.is_present.all() {
            let present = (0..WIDTH).position(|lane| self.is_present.lane(lane)).unwrap_or(0);
            let time_s = Lanes::splat(self.input.measured_s.0[present]);
            self.input.measured_s = self.input.measured_s.or_else(self.is_present, time_s);
        }
    }

    pub(super) fn step(&self, lane: usize) -> CellStep {
        let input = &self.input;
        CellStep {
            measured_s: input.measured_s.0[lane],
            charge_as: input.charge_as.0[lane],
            offset_s: input.offset_s.0[lane],
            unmeasured_s: 0.0,
            current_a: Some(input.current_a.0[lane]),
            temperature_c: Some(input.temperature_c.0[lane]),
            // Not used, because the step has a temperature.
            ambient_c: input.temperature_c.0[lane],
            voltage_v: input.voltage_v.0[lane],
            is_voltage_frozen: false,
        }
    }
}

impl StepInput<WIDTH> {
    #[inline(always)]
    pub(super) fn lane(&self, lane: usize) -> StepInput<1> {
        let take = |x: &Lanes<WIDTH>| Lanes([x.0[lane]]);
        StepInput {
            measured_s: take(&self.measured_s),
            charge_as: take(&self.charge_as),
            offset_s: take(&self.offset_s),
            current_a: take(&self.current_a),
            voltage_v: take(&self.voltage_v),
            temperature_c: take(&self.temperature_c),
            decay: self.decay.lane(lane),
        }
    }

    /// Records the outcome of lane `lane`'s step. This outcome is in lane `from` of `outcome`.
    #[inline(always)]
    pub(super) fn note<const L: usize>(
        &self,
        lane: usize,
        from: usize,
        outcome: &StepOutcome<L>,
        cell: &mut CellSlot,
        result: &mut StepResult,
    ) {
        cell.memory.last_current_a = self.current_a.0[lane];
        cell.memory.temperature_c = Some(self.temperature_c.0[lane]);
        cell.memory.innovation_v = outcome.innovation_v.0[from];
        cell.memory.end_downtime();
        *result = StepResult { update: Some(outcome.lane(from)), reset: false, jumped: false };
    }
}
