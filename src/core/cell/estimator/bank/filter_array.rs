//! The filters of a pack with one number of branches, in blocks of [`WIDTH`] lanes, and the steps of a batch over them.
//!
//! In: inputs of the blocks. Out: moved states and results; cells whose step the kernel did not make stay in `others`.

use std::array::from_fn;

use nalgebra::{SMatrix, SVector};

use super::input::{BlockInput, CellSlot, WIDTH};
use super::kernel::{
    self, CURVE_AH, CURVE_STD_AH, DecayFactors, FilterState, INFORMATION_S, KernelConstants, LOAD_A, MEAN_NIS,
    OFFSET_INFORMATION, OFFSET_SCORE, REST_S, SLOW_INFORMATION, SLOW_RATIO, SLOW_SCORE, SLOW_STD, at,
};
use super::tables::{LineCache, Tables};
use crate::cell::estimator::filter::Filter;
use crate::cell::estimator::memory::Memory;
use crate::cell::estimator::state_vector::CAPACITY;
use crate::cell::estimator::step::{CellStep, StepResult};
use crate::cell::model::CellModel;
use crate::filter::simd::Lanes;
use crate::filter::{CONSTANT_ERRORS, Gaussian};

/// Filters of N states, with T numbers of the covariance and tables of W columns.
#[derive(Debug, Clone)]
pub(super) struct FilterArray<const N: usize, const T: usize, const W: usize> {
    tables: Tables<W>,
    pub(super) blocks: Vec<FilterState<WIDTH, N, T>>,
    /// Per block, for steps of all its cells together, and per cell, for its own.
    cache: Vec<(LineCache<WIDTH, W>, [LineCache<1, W>; WIDTH])>,
    step_time: StepTime,
}

/// The last step time, s, with its decay factors: readings mostly arrive at one interval.
#[derive(Debug, Clone)]
struct StepTime {
    time_s: f64,
    decay: DecayFactors<1>,
}

impl StepTime {
    #[inline(always)]
    fn decay(&mut self, c: &KernelConstants, time_s: &Lanes<WIDTH>) -> DecayFactors<WIDTH> {
        if time_s.0.iter().fold(true, |same, &time_s| same & (time_s == self.time_s)) {
            return DecayFactors::splat(&self.decay);
        }
        let decay = DecayFactors::after(c, *time_s);
        *self = Self { time_s: time_s.0[0], decay: decay.lane(0) };
        decay
    }
}

/// The steps of a batch, for the machine's widest instructions.
pub(super) struct BatchStep<'a, const N: usize, const T: usize, const W: usize> {
    pub(super) lanes: &'a mut FilterArray<N, T, W>,
    pub(super) constants: &'a KernelConstants,
    pub(super) inputs: &'a mut [BlockInput],
    pub(super) cells: &'a mut [CellSlot],
    pub(super) results: &'a mut [StepResult],
    pub(super) others: &'a mut Vec<(usize, CellStep)>,
}

#[cfg(feature = "wide")]
impl<const N: usize, const T: usize, const W: usize> pulp::WithSimd for BatchStep<'_, N, T, W> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        if S::F64_LANES > 1 { self.run::<true>() } else { self.run::<false>() }
    }
}

impl<const N: usize, const T: usize, const W: usize> BatchStep<'_, N, T, W> {
    /// Makes the steps. Without wide instructions the same kernel steps the lanes one by one, with the same bits.
    #[inline(always)]
    pub(super) fn run<const WIDE: bool>(self) {
        self.lanes.step::<WIDE>(self.constants, self.inputs, self.cells, self.results);
        for (block, input) in self.inputs.iter_mut().enumerate().filter(|(_, input)| input.is_present.any()) {
            // The input was ordinary, but the kernel's outcome was not usable.
            for lane in 0..WIDTH {
                if input.is_present.lane(lane) {
                    input.is_present.set_lane(lane, false);
                    self.others.push((block * WIDTH + lane, input.step(lane)));
                }
            }
        }
    }
}

impl<const N: usize, const T: usize, const W: usize> FilterArray<N, T, W> {
    pub(super) fn new(model: &CellModel, blocks: usize) -> Self {
        let zero = Lanes::splat(0.0);
        // Every lane can be stepped, even one without a cell.
        let mut covariance = [zero; T];
        (0..N).for_each(|i| covariance[at(i, i)] = Lanes::splat(1.0));
        let mut mean = [zero; N];
        mean[CAPACITY] = Lanes::splat(1e3);
        let by_constant = [[zero; N]; CONSTANT_ERRORS];
        let state = FilterState { mean, covariance, by_constant, memory: [zero; kernel::MEMORY] };
        let tables = Tables::new(model);
        Self {
            cache: vec![(LineCache::new(&tables), from_fn(|_| LineCache::new(&tables))); blocks],
            tables,
            blocks: vec![state; blocks],
            step_time: StepTime { time_s: f64::NAN, decay: DecayFactors::NONE },
        }
    }

    /// Steps every block that has inputs. Cells whose steps were made are no longer present afterwards.
    #[inline(always)]
    fn step<const WIDE: bool>(
        &mut self,
        c: &KernelConstants,
        inputs: &mut [BlockInput],
        cells: &mut [CellSlot],
        results: &mut [StepResult],
    ) {
        let states = self.blocks.iter_mut().zip(&mut self.cache).zip(inputs);
        for (((state, cache), block), (cells, results)) in
            states.zip(cells.chunks_mut(WIDTH).zip(results.chunks_mut(WIDTH)))
        {
            if !block.is_present.any() {
                continue;
            }
            block.fill_absent();
            block.input.decay = self.step_time.decay(c, &block.input.measured_s);
            let (cache, own) = cache;
            if !WIDE || block.is_present.is_one() {
                for (lane, cell) in cells.iter_mut().zip(results).enumerate() {
                    if block.is_present.lane(lane) {
                        step_alone(&mut self.tables, &mut own[lane], c, state, block, lane, cell);
                    }
                }
                continue;
            }
            let (new, outcome) = kernel::step(&mut self.tables, cache, c, state, &block.input);
            let done = outcome.is_usable & block.is_present;
            if done.all() {
                *state = new;
            } else {
                state.take_where(done, &new);
            }
            for (lane, (cell, result)) in cells.iter_mut().zip(results).enumerate() {
                if done.lane(lane) {
                    block.input.note(lane, lane, &outcome, cell, result);
                }
            }
            block.is_present = block.is_present & !done;
        }
    }

    /// The first of the cells with the lowest and of those with the highest SOC.
    pub(super) fn extremes(&self, cells: usize) -> Option<(usize, usize)> {
        let all = self.blocks.iter().flat_map(|state| state.mean[0].0).take(cells).enumerate();
        let first = all.clone().next()?;
        let ends = all.fold((first, first), |(lowest, highest), cell| {
            (if cell.1 < lowest.1 { cell } else { lowest }, if cell.1 > highest.1 { cell } else { highest })
        });
        Some((ends.0.0, ends.1.0))
    }

    pub(super) fn filter(
        &self,
        block: usize,
        lane: usize,
        make: fn(Gaussian<N>) -> Filter,
    ) -> (Filter, [f64; kernel::MEMORY]) {
        let state = FilterState::of_lane(&self.blocks[block], lane);
        let mean = SVector::from_fn(|i, _| state.mean[i].0[0]);
        let covariance = SMatrix::from_fn(|i, j| state.covariance[at(i.max(j), i.min(j))].0[0]);
        let by_constant = SMatrix::from_fn(|i, k| state.by_constant[k][i].0[0]);
        (make(Gaussian { mean, covariance, by_constant }), state.memory.map(|number| number.0[0]))
    }

    /// Puts a filter into a lane, with the standard deviation of the slowest branch's ratio; returns true, the cell's new
    /// `has_filter`.
    pub(super) fn set(
        &mut self,
        block: usize,
        lane: usize,
        filter: &Gaussian<N>,
        memory: &Memory,
        slow_std: f64,
    ) -> bool {
        self.clear(block, lane, memory, slow_std);
        let state = &mut self.blocks[block];
        for i in 0..N {
            state.mean[i].0[lane] = filter.mean[i];
            for j in 0..=i {
                state.covariance[at(i, j)].0[lane] = filter.covariance[(i, j)];
            }
            for k in 0..CONSTANT_ERRORS {
                state.by_constant[k][i].0[lane] = filter.by_constant[(i, k)];
            }
        }
        true
    }

    /// Puts the memory of a cell without a filter into its lane; returns false, the cell's new `has_filter`.
    pub(super) fn clear(&mut self, block: usize, lane: usize, memory: &Memory, slow_std: f64) -> bool {
        let hot = &mut self.blocks[block].memory;
        hot[LOAD_A].0[lane] = memory.load_a;
        hot[MEAN_NIS].0[lane] = memory.mean_nis;
        hot[INFORMATION_S].0[lane] = memory.information_s;
        hot[REST_S].0[lane] = memory.rest_s;
        hot[OFFSET_INFORMATION].0[lane] = memory.offset_information;
        hot[OFFSET_SCORE].0[lane] = memory.offset_score;
        (hot[SLOW_RATIO].0[lane], hot[SLOW_STD].0[lane]) = (memory.slow_branch.ratio, slow_std);
        hot[SLOW_INFORMATION].0[lane] = memory.slow_branch.information;
        hot[SLOW_SCORE].0[lane] = memory.slow_branch.score;
        (hot[CURVE_AH].0[lane], hot[CURVE_STD_AH].0[lane]) = (memory.curve.mean, memory.curve.std());
        false
    }
}

/// Steps one cell of a block. Not inlined into the vector code: one copy serves all widths.
#[inline(never)]
fn step_alone<const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    cache: &mut LineCache<1, W>,
    c: &KernelConstants,
    state: &mut FilterState<WIDTH, N, T>,
    block: &mut BlockInput,
    lane: usize,
    (cell, result): (&mut CellSlot, &mut StepResult),
) {
    let one = FilterState::of_lane(state, lane);
    let (new, outcome) = kernel::step(tables, cache, c, &one, &block.input.lane(lane));
    if outcome.is_usable.lane(0) {
        state.set_lane(lane, &new);
        block.input.note(lane, 0, &outcome, cell, result);
        block.is_present.set_lane(lane, false);
    }
}
