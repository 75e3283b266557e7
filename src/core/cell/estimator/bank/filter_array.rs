//! Stores the filters of a pack in blocks of [`WIDTH`] lanes, one cell per lane, and computes a batch of steps (at most
//! one step per cell).
//!
//! In: inputs of the blocks. Out: changed states, and results. If the result of a step is not usable, the step is added
//! to `others`, and the caller computes it again on its own.

use std::array::from_fn;

use super::input::{BlockInput, CellSlot, WIDTH};
use super::kernel::{
    self, CURVE_AH, DecayFactors, FilterState, HotMemory, KernelConstants, StepInput, at, has_variances,
};
use super::tables::{LineCache, Tables};
use crate::cell::estimator::gaussian::Gaussian;
use crate::cell::estimator::state_vector::{CAPACITY, CONSTANT_ERRORS, LOG_RESISTANCE};
use crate::cell::estimator::step::{CellStep, StepResult, Update};
use crate::cell::model::CellModel;
use crate::filter::simd::Lanes;

#[derive(Debug, Clone)]
pub(super) struct FilterArray<const N: usize, const T: usize, const W: usize> {
    tables: Tables<W>,
    pub(super) blocks: Vec<FilterState<WIDTH, N, T>>,
    /// Per block: one cache for steps of the whole block, and one cache per cell for steps of single cells.
    cache: Vec<(LineCache<WIDTH, W>, [LineCache<1, W>; WIDTH])>,
    step_time: StepTime,
}

/// The filters of a pack, by number of branches.
#[derive(Debug, Clone)]
pub(super) enum FilterArrays {
    One(FilterArray<4, 10, 16>),
    Two(FilterArray<5, 15, 20>),
    Three(FilterArray<6, 21, 24>),
}

macro_rules! each_array {
    ($filters:expr, $x:ident => $body:expr) => {
        match $filters {
            FilterArrays::One($x) => $body,
            FilterArrays::Two($x) => $body,
            FilterArrays::Three($x) => $body,
        }
    };
}
pub(super) use each_array;

/// The last step time (s) with its decay factors. Most readings arrive at equal intervals, so the factors can be
/// reused.
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

/// The steps of a batch, compiled for the widest vector instructions of the machine.
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
    /// Computes the steps. Without wide instructions, the kernel steps the lanes one by one and gives the same bits.
    #[inline(always)]
    pub(super) fn run<const WIDE: bool>(self) {
        self.lanes.step::<WIDE>(self.constants, self.inputs, self.cells, self.results);
        for (block, input) in self.inputs.iter_mut().enumerate().filter(|(_, input)| input.is_present.any()) {
            // `is_present` is still set if the outcome of a step was not usable. The bank then computes the step again
            // on its own, with the handling of special cases.
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
        // The kernel may step every lane, so lanes without a cell need valid states, too.
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

    /// Steps every block that has inputs. Clears `is_present` of each cell with a usable outcome.
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

    /// Indices of the cells with the lowest and with the highest SOC. If several cells have the same SOC, returns the
    /// first.
    pub(super) fn extremes(&self, cells: usize) -> Option<(usize, usize)> {
        let all = self.blocks.iter().flat_map(|state| state.mean[0].0).take(cells).enumerate();
        let first = all.clone().next()?;
        let ends = all.fold((first, first), |(lowest, highest), cell| {
            (if cell.1 < lowest.1 { cell } else { lowest }, if cell.1 > highest.1 { cell } else { highest })
        });
        Some((ends.0.0, ends.1.0))
    }

    pub(super) fn lane(&self, cell: usize) -> (Gaussian, HotMemory) {
        let state = FilterState::of_lane(&self.blocks[cell / WIDTH], cell % WIDTH);
        (state.gaussian(), state.memory)
    }

    /// Replaces state and memory of a lane; returns whether the cell has a filter.
    pub(super) fn set(&mut self, cell: usize, filter: Option<&Gaussian>, hot: HotMemory) -> bool {
        let (block, lane) = (&mut self.blocks[cell / WIDTH], cell % WIDTH);
        // The number of branches fits, because states are checked when they are restored.
        let Some(filter) = filter.filter(|filter| filter.states == N) else {
            block.memory.iter_mut().zip(hot).for_each(|(all, one)| all.0[lane] = one.0[0]);
            return false;
        };
        block.set_lane(lane, &FilterState::new(filter, hot));
        true
    }

    /// Predicts the state `x` of a cell; the cell's lane is neither read nor changed. If the prediction fails, returns
    /// `None` and leaves `x` unchanged.
    #[inline(never)]
    pub(super) fn predict(
        &mut self,
        c: &KernelConstants,
        (cell, x, hot): (usize, &mut Gaussian, HotMemory),
        input: &StepInput<1>,
        soc_per_s: f64,
    ) -> Option<()> {
        let state = FilterState::<1, N, T>::new(x, hot);
        let ratio = state.mean[LOG_RESISTANCE].exp();
        let (tables, cache) = self.own_tables(cell, &hot, input);
        let (new, has_factor) = kernel::predict(tables, cache, c, &state, input, (ratio, soc_per_s));
        (has_factor & has_variances(&new, Lanes([0.0]))).all().then(|| *x = new.gaussian())
    }

    /// Updates the state `x` of a cell with a voltage; the cell's lane is neither read nor changed. Also returns the
    /// memory with the new evidence. A voltage beyond the gate does not change `x`. If the update fails, returns `None`
    /// and leaves `x` unchanged.
    #[inline(never)]
    pub(super) fn update(
        &mut self,
        c: &KernelConstants,
        (cell, x, hot): (usize, &mut Gaussian, HotMemory),
        input: &StepInput<1>,
    ) -> Option<(Update, HotMemory)> {
        let mut state = FilterState::<1, N, T>::new(x, hot);
        let ratio = state.mean[LOG_RESISTANCE].exp();
        let weight = (ratio, c.information_s(&hot));
        let (tables, cache) = self.own_tables(cell, &hot, input);
        let outcome = kernel::update(tables, cache, c, &mut state, input, weight);
        let is_finite = (outcome.innovation_variance + outcome.test_ratio).is_finite();
        if !(outcome.is_usable & is_finite).all() {
            return None;
        }
        if outcome.is_accepted.all() {
            if !has_variances(&state, Lanes([0.0])).all() {
                return None;
            }
            *x = state.gaussian();
        }
        Some((outcome.lane(0), state.memory))
    }

    /// Updates the tables and the cell's cache to the cell's temperature and capacity, and returns both.
    fn own_tables(
        &mut self,
        cell: usize,
        hot: &HotMemory,
        input: &StepInput<1>,
    ) -> (&mut Tables<W>, &mut LineCache<1, W>) {
        let cache = &mut self.cache[cell / WIDTH].1[cell % WIDTH];
        self.tables.refresh_temperatures(cache, &input.temperature_c);
        self.tables.refresh_capacities(cache, &hot[CURVE_AH]);
        (&mut self.tables, cache)
    }
}

/// Steps one cell of a block. It is not inlined into the vector code, so that one copy serves all instruction widths.
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
