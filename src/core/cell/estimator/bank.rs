//! The estimators of all cells of a pack, stepped together.
//!
//! Almost every step is an ordinary one: the current was measured all the time since the last voltage, and the voltage is
//! within the gate. Those are made by the [`kernel`], [`WIDTH`] cells at a time, over structures of arrays; wider
//! instructions are chosen at run time (without the feature `lab` there are none, and cells are stepped one by one).
//! Whatever else there is (a first voltage, a gap, no current, a reading beyond the gate, a covariance without a factor)
//! is done by the readable [`CellEstimator`], which is also what the kernel is tested against: SOC within 1e-9 over 100,000
//! steps. Which of the two steps a cell takes depends on that cell alone, and a
//! lane's bits do not depend on the lanes beside it, so a cell's estimates are the same in any company.

mod input;
mod kernel;
mod tables;

use std::array::from_fn;

use input::BlockInput;
use kernel::{Constants, DecayFactors, INFORMATION_S, LOAD_A, MEAN_NIS, REST_S, State, at};
use nalgebra::{SMatrix, SVector};
use tables::{Around, Tables};

use super::{CAPACITY, CellEstimator, CellStep, Filter, LOG_RESISTANCE, Memory, StepResult, thermal_c, widened};
use crate::cell::config::EstimatorConfig;
use crate::cell::model::{CellModel, MAX_BRANCHES};
use crate::filter::simd::Lanes;
use crate::filter::{Gaussian, ScalarGaussian};

/// Cells of a block: one of AVX-512's vectors, two of AVX2's (4 and 16 were measured, too: slower with either).
const WIDTH: usize = 8;

/// The estimators of a pack's cells.
#[derive(Debug, Clone)]
pub struct EstimatorBank {
    model: CellModel,
    config: EstimatorConfig,
    constants: Constants,
    filters: Filters,
    cells: Vec<Cell>,
    /// The steps of the batch; what is left of an earlier one is not looked at.
    inputs: Vec<BlockInput>,
    results: Vec<StepResult>,
    /// Cells of the batch that have no ordinary step.
    others: Vec<(usize, CellStep)>,
    #[cfg(feature = "wide")]
    machine: pulp::Arch,
}

/// What is kept of a cell beside its lane.
#[derive(Debug, Clone)]
struct Cell {
    /// What the kernel works with (load, consistency, information, rest) is in the lane.
    memory: Memory,
    has_filter: bool,
}

impl Cell {
    /// Whether a step that measured the current all the time can be an ordinary one.
    fn is_ordinary(&self) -> bool {
        self.has_filter && self.memory.rejected == 0 && self.memory.away_std_if_any().is_none()
    }
}

/// The lanes of a pack, by number of branches.
#[derive(Debug, Clone)]
enum Filters {
    One(Lane<4, 10, 10>),
    Two(Lane<5, 15, 14>),
    Three(Lane<6, 21, 18>),
}

#[derive(Debug, Clone)]
struct Lane<const N: usize, const T: usize, const W: usize> {
    tables: Tables<W>,
    blocks: Vec<State<WIDTH, N, T>>,
    /// Of each block, for steps of all its cells together, and of each cell, for its own.
    around: Vec<(Around<WIDTH, W>, [Around<1, W>; WIDTH])>,
    rhythm: Rhythm,
}

/// The time cells last stepped over, s, and what it leaves: readings mostly come in one rhythm.
#[derive(Debug, Clone)]
struct Rhythm {
    time_s: f64,
    kept: DecayFactors<1>,
}

/// Runs an expression for the pack's number of branches.
macro_rules! each_lane {
    ($filters:expr, $x:ident => $body:expr) => {
        match $filters {
            Filters::One($x) => $body,
            Filters::Two($x) => $body,
            Filters::Three($x) => $body,
        }
    };
}

impl EstimatorBank {
    /// Estimators of `cells` cells of which nothing was measured yet.
    pub fn new(model: &CellModel, config: &EstimatorConfig, cells: usize) -> Self {
        let blocks = cells.div_ceil(WIDTH);
        let filters = match model.branches.len() {
            1 => Filters::One(Lane::new(model, blocks)),
            2 => Filters::Two(Lane::new(model, blocks)),
            _ => Filters::Three(Lane::new(model, blocks)),
        };
        let memory = CellEstimator::new(config).memory;
        let cell = Cell { memory, has_filter: false };
        let idle = StepResult { update: None, reset: false };
        let mut bank = Self {
            constants: each_lane!(&filters, x => x.constants(model, config)),
            model: model.clone(),
            config: *config,
            filters,
            cells: vec![cell; cells],
            inputs: vec![BlockInput::NONE; blocks],
            results: vec![idle; cells],
            others: Vec::with_capacity(cells),
            #[cfg(feature = "wide")]
            machine: pulp::Arch::new(),
        };
        (0..cells).for_each(|cell| bank.put(cell, &CellEstimator::new(config)));
        bank
    }

    /// Other settings and tables for the same cells; the model has as many branches.
    pub fn reconfigure(&mut self, model: &CellModel, config: &EstimatorConfig) {
        if (&self.model, &self.config) == (model, config) {
            return;
        }
        let mut new = Self::new(model, config, self.cells.len());
        (0..self.cells.len()).for_each(|cell| new.put(cell, &self.cell(cell)));
        new.results = std::mem::take(&mut self.results);
        *self = new;
    }

    /// The cell model.
    pub fn model(&self) -> &CellModel {
        &self.model
    }

    /// The settings.
    pub fn config(&self) -> &EstimatorConfig {
        &self.config
    }

    /// Adds a cell's voltage reading to the batch: each cell's at most once.
    ///
    /// # Panics
    /// When there is no such cell.
    #[inline]
    pub fn add(&mut self, cell: usize, step: &CellStep) {
        let (Some(current_a), true) = (step.current_a, step.unmeasured_s == 0.0 && self.cells[cell].is_ordinary())
        else {
            return self.others.push((cell, *step));
        };
        let temperature_c = match step.temperature_c {
            Some(measured_c) => measured_c,
            None => self.modelled_c(cell, step),
        };
        let (block, lane) = (&mut self.inputs[cell / WIDTH], cell % WIDTH);
        block.is_present.set_lane(lane, true);
        let input = &mut block.input;
        input.temperature_c.0[lane] = temperature_c;
        input.measured_s.0[lane] = step.measured_s;
        input.charge_as.0[lane] = step.charge_as;
        input.current_a.0[lane] = current_a;
        input.voltage_v.0[lane] = step.voltage_v;
    }

    /// Makes the steps of the batch; what became of each: [`Self::result`].
    pub fn step(&mut self) {
        #[cfg(feature = "wide")]
        let machine = self.machine;
        let Self { constants, filters, inputs, cells, results, others, .. } = self;
        each_lane!(filters, lanes => {
            let all = StepAll { lanes, constants, inputs, cells, results, others };
            #[cfg(feature = "wide")]
            machine.dispatch(all);
            #[cfg(not(feature = "wide"))]
            all.run::<false>();
        });
        for at in 0..self.others.len() {
            let (cell, step) = self.others[at];
            let mut estimator = self.cell(cell);
            self.results[cell] = estimator.step(&self.model, &self.config, &step);
            self.put(cell, &estimator);
        }
        self.others.clear();
    }

    /// What became of a cell's last step.
    #[inline]
    pub fn result(&self, cell: usize) -> &StepResult {
        &self.results[cell]
    }

    /// Temperature of a cell without a sensor's, degrees C.
    fn modelled_c(&self, cell: usize, step: &CellStep) -> f64 {
        let soc = self.soc(cell).map_or(0.5, |soc| soc.mean);
        thermal_c(&self.model, self.cells[cell].memory.temperature_c, soc, self.log_resistance(cell).mean, step)
    }

    /// Whether a cell has a state of charge.
    #[inline]
    pub fn is_started(&self, cell: usize) -> bool {
        self.cells[cell].has_filter
    }

    /// State of charge as the filter has it: what may have happened while the program did not run is not in it.
    pub fn filtered_soc(&self, cell: usize) -> Option<ScalarGaussian> {
        self.is_started(cell).then(|| self.belief(cell, 0))
    }

    /// State of charge; `None` before the first voltage.
    #[inline]
    pub fn soc(&self, cell: usize) -> Option<ScalarGaussian> {
        let Cell { memory, has_filter, .. } = &self.cells[cell];
        has_filter.then(|| {
            let soc = self.belief(cell, 0);
            let away = memory.away_std_if_any();
            ScalarGaussian { variance: away.map_or(soc.variance, |std| widened(soc.variance, std * std)), ..soc }
        })
    }

    /// State of charge of the emptiest and the fullest cell; `None` when one's is not known, or of before time away.
    pub fn extremes(&self) -> Option<(ScalarGaussian, ScalarGaussian)> {
        let is_present =
            |cell: &Cell| cell.has_filter && !cell.memory.is_unseen && cell.memory.away_std_if_any().is_none();
        if !self.cells.iter().all(is_present) {
            return None;
        }
        let (lowest, highest) = each_lane!(&self.filters, x => x.extremes(self.cells.len()))?;
        Some((self.belief(lowest, 0), self.belief(highest, 0)))
    }

    /// ln of the resistance relative to new.
    #[inline]
    pub fn log_resistance(&self, cell: usize) -> ScalarGaussian {
        let Cell { memory, has_filter, .. } = &self.cells[cell];
        if *has_filter { self.belief(cell, LOG_RESISTANCE) } else { memory.log_resistance }
    }

    /// Capacity as the filter works with it now, Ah.
    #[inline]
    pub fn capacity(&self, cell: usize) -> ScalarGaussian {
        let Cell { memory, has_filter, .. } = &self.cells[cell];
        if *has_filter { self.belief(cell, CAPACITY) } else { memory.capacity }
    }

    /// Branch voltages, V; NaN beyond the model's branches and before the first voltage.
    pub fn branch_v(&self, cell: usize) -> [f64; MAX_BRANCHES] {
        self.cell(cell).branch_v()
    }

    /// Mean normalised innovation squared: [`CellEstimator::mean_nis`].
    #[inline]
    pub fn mean_nis(&self, cell: usize) -> f64 {
        let (block, lane) = (cell / WIDTH, cell % WIDTH);
        each_lane!(&self.filters, x => x.blocks[block].memory[MEAN_NIS].0[lane])
    }

    /// The largest of all cells', not below 0; one that is no number counts as infinite.
    pub fn worst_nis(&self) -> f64 {
        let larger = |a: f64, b: f64| match () {
            () if b <= a => a,
            () if b > a => b,
            () => f64::INFINITY,
        };
        let worst = each_lane!(&self.filters, x => x.blocks.iter().fold([0.0; WIDTH], |worst, block| {
            std::array::from_fn(|lane| larger(worst[lane], block.memory[MEAN_NIS].0[lane]))
        }));
        worst.into_iter().fold(0.0, larger)
    }

    /// Temperature the filter works with, degrees C.
    #[inline]
    pub fn temperature_c(&self, cell: usize) -> Option<f64> {
        self.cells[cell].memory.temperature_c
    }

    /// Whether the SOC is still the one from before time away: no voltage has been taken in since.
    pub fn is_of_before(&self, cell: usize) -> bool {
        let Cell { memory, .. } = &self.cells[cell];
        memory.is_unseen || memory.away_std_if_any().is_some()
    }

    /// Voltage the load of the last minutes drops in the settled cell, V; 0 before the first voltage.
    pub fn load_v(&self, cell: usize) -> f64 {
        self.cell(cell).load_v(&self.model)
    }

    /// A cell's estimator, as it stands.
    pub fn cell(&self, cell: usize) -> CellEstimator {
        let (block, lane) = (cell / WIDTH, cell % WIDTH);
        let Cell { memory, has_filter, .. } = self.cells[cell];
        let (filter, hot) = match &self.filters {
            Filters::One(x) => x.filter(block, lane, Filter::One),
            Filters::Two(x) => x.filter(block, lane, Filter::Two),
            Filters::Three(x) => x.filter(block, lane, Filter::Three),
        };
        let memory = Memory {
            load_a: hot[LOAD_A],
            mean_nis: hot[MEAN_NIS],
            information_s: hot[INFORMATION_S],
            rest_s: hot[REST_S],
            ..memory
        };
        CellEstimator { filter: has_filter.then_some(filter), memory }
    }

    /// Puts a cell's estimator in place of the present one.
    pub fn put(&mut self, cell: usize, estimator: &CellEstimator) {
        let (block, lane) = (cell / WIDTH, cell % WIDTH);
        let CellEstimator { filter, memory } = estimator;
        self.cells[cell].memory = *memory;
        self.cells[cell].has_filter = match (&mut self.filters, filter) {
            (Filters::One(x), Some(Filter::One(filter))) => x.set(block, lane, filter, memory),
            (Filters::Two(x), Some(Filter::Two(filter))) => x.set(block, lane, filter, memory),
            (Filters::Three(x), Some(Filter::Three(filter))) => x.set(block, lane, filter, memory),
            // A filter of another number of branches cannot be: states are checked when they are taken up.
            (filters, _) => each_lane!(filters, x => x.clear(block, lane, memory)),
        };
    }

    /// Changes a cell's estimator.
    pub fn change<R>(&mut self, cell: usize, change: impl FnOnce(&mut CellEstimator) -> R) -> R {
        let mut estimator = self.cell(cell);
        let result = change(&mut estimator);
        self.put(cell, &estimator);
        result
    }

    /// Changes every cell's estimator.
    pub fn change_all(&mut self, mut change: impl FnMut(&mut CellEstimator)) {
        (0..self.cells.len()).for_each(|cell| self.change(cell, &mut change));
    }

    #[inline]
    fn belief(&self, cell: usize, i: usize) -> ScalarGaussian {
        let (block, lane) = (cell / WIDTH, cell % WIDTH);
        each_lane!(&self.filters, x => {
            let state = &x.blocks[block];
            ScalarGaussian { mean: state.mean[i].0[lane], variance: state.covariance[at(i, i)].0[lane] }
        })
    }
}

impl Rhythm {
    #[inline(always)]
    fn kept(&mut self, c: &Constants, time_s: &Lanes<WIDTH>) -> DecayFactors<WIDTH> {
        if time_s.0.iter().fold(true, |same, &time_s| same & (time_s == self.time_s)) {
            return DecayFactors::splat(&self.kept);
        }
        let kept = DecayFactors::after(c, *time_s);
        *self = Self { time_s: time_s.0[0], kept: kept.lane(0) };
        kept
    }
}

/// The steps of a batch, to be made with the machine's widest instructions.
struct StepAll<'a, const N: usize, const T: usize, const W: usize> {
    lanes: &'a mut Lane<N, T, W>,
    constants: &'a Constants,
    inputs: &'a mut [BlockInput],
    cells: &'a mut [Cell],
    results: &'a mut [StepResult],
    others: &'a mut Vec<(usize, CellStep)>,
}

#[cfg(feature = "wide")]
impl<const N: usize, const T: usize, const W: usize> pulp::WithSimd for StepAll<'_, N, T, W> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        if S::F64_LANES > 1 { self.run::<true>() } else { self.run::<false>() }
    }
}

impl<const N: usize, const T: usize, const W: usize> StepAll<'_, N, T, W> {
    /// Without wide instructions the lanes are stepped one by one: the same bits, and no second kernel.
    #[inline(always)]
    fn run<const WIDE: bool>(self) {
        self.lanes.step::<WIDE>(self.constants, self.inputs, self.cells, self.results);
        for (block, input) in self.inputs.iter_mut().enumerate().filter(|(_, input)| input.is_present.any()) {
            // Ordinary by its input, but not by what came of it.
            for lane in 0..WIDTH {
                if input.is_present.lane(lane) {
                    input.is_present.set_lane(lane, false);
                    self.others.push((block * WIDTH + lane, input.step(lane)));
                }
            }
        }
    }
}

impl<const N: usize, const T: usize, const W: usize> Lane<N, T, W> {
    fn new(model: &CellModel, blocks: usize) -> Self {
        let zero = Lanes::splat(0.0);
        // Any lane can be stepped, even one that is no cell's.
        let mut covariance = [zero; T];
        (0..N).for_each(|i| covariance[at(i, i)] = Lanes::splat(1.0));
        let mut mean = [zero; N];
        mean[CAPACITY] = Lanes::splat(1e3);
        let state = State { mean, covariance, memory: [zero; kernel::MEMORY] };
        let tables = Tables::new(model);
        Self {
            around: vec![(Around::new(&tables), from_fn(|_| Around::new(&tables))); blocks],
            tables,
            blocks: vec![state; blocks],
            rhythm: Rhythm { time_s: f64::NAN, kept: DecayFactors::NONE },
        }
    }

    fn constants(&self, model: &CellModel, config: &EstimatorConfig) -> Constants {
        Constants::new::<N>(model, config)
    }

    /// Steps every block that has inputs. Those whose steps are made are no longer present afterwards.
    #[inline(always)]
    fn step<const WIDE: bool>(
        &mut self,
        c: &Constants,
        inputs: &mut [BlockInput],
        cells: &mut [Cell],
        results: &mut [StepResult],
    ) {
        let states = self.blocks.iter_mut().zip(&mut self.around).zip(inputs);
        for (((state, around), block), (cells, results)) in
            states.zip(cells.chunks_mut(WIDTH).zip(results.chunks_mut(WIDTH)))
        {
            if !block.is_present.any() {
                continue;
            }
            block.fill_absent();
            block.input.kept = self.rhythm.kept(c, &block.input.measured_s);
            let (around, own) = around;
            if !WIDE || block.is_present.is_one() {
                for (lane, cell) in cells.iter_mut().zip(results).enumerate() {
                    if block.is_present.lane(lane) {
                        step_alone(&mut self.tables, &mut own[lane], c, state, block, lane, cell);
                    }
                }
                continue;
            }
            let (new, outcome) = kernel::step(&mut self.tables, around, c, state, &block.input);
            let made = outcome.is_usable & block.is_present;
            if made.all() {
                *state = new;
            } else {
                state.take_where(made, &new);
            }
            for (lane, (cell, result)) in cells.iter_mut().zip(results).enumerate() {
                if made.lane(lane) {
                    block.input.note(lane, lane, &outcome, cell, result);
                }
            }
            block.is_present = block.is_present & !made;
        }
    }

    /// The first of the cells with the lowest and of those with the highest SOC.
    fn extremes(&self, cells: usize) -> Option<(usize, usize)> {
        let all = self.blocks.iter().flat_map(|state| state.mean[0].0).take(cells).enumerate();
        let first = all.clone().next()?;
        let ends = all.fold((first, first), |(lowest, highest), cell| {
            (if cell.1 < lowest.1 { cell } else { lowest }, if cell.1 > highest.1 { cell } else { highest })
        });
        Some((ends.0.0, ends.1.0))
    }

    fn filter(&self, block: usize, lane: usize, make: fn(Gaussian<N>) -> Filter) -> (Filter, [f64; kernel::MEMORY]) {
        let state = State::of_lane(&self.blocks[block], lane);
        let mean = SVector::from_fn(|i, _| state.mean[i].0[0]);
        let covariance = SMatrix::from_fn(|i, j| state.covariance[at(i.max(j), i.min(j))].0[0]);
        (make(Gaussian { mean, covariance }), state.memory.map(|number| number.0[0]))
    }

    /// Puts a filter into a lane; that there is one.
    fn set(&mut self, block: usize, lane: usize, filter: &Gaussian<N>, memory: &Memory) -> bool {
        self.clear(block, lane, memory);
        let state = &mut self.blocks[block];
        for i in 0..N {
            state.mean[i].0[lane] = filter.mean[i];
            for j in 0..=i {
                state.covariance[at(i, j)].0[lane] = filter.covariance[(i, j)];
            }
        }
        true
    }

    /// Puts the memory of a cell without a filter into its lane; that there is none.
    fn clear(&mut self, block: usize, lane: usize, memory: &Memory) -> bool {
        let hot = &mut self.blocks[block].memory;
        hot[LOAD_A].0[lane] = memory.load_a;
        hot[MEAN_NIS].0[lane] = memory.mean_nis;
        hot[INFORMATION_S].0[lane] = memory.information_s;
        hot[REST_S].0[lane] = memory.rest_s;
        false
    }
}

/// The step of one cell of a block. Not a part of the vector code: it is needed once, not once per width.
#[inline(never)]
fn step_alone<const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    around: &mut Around<1, W>,
    c: &Constants,
    state: &mut State<WIDTH, N, T>,
    block: &mut BlockInput,
    lane: usize,
    (cell, result): (&mut Cell, &mut StepResult),
) {
    let one = State::of_lane(state, lane);
    let (new, outcome) = kernel::step(tables, around, c, &one, &block.input.lane(lane));
    if outcome.is_usable.lane(0) {
        state.set_lane(lane, &new);
        block.input.note(lane, 0, &outcome, cell, result);
        block.is_present.set_lane(lane, false);
    }
}

#[cfg(test)]
mod tests;
