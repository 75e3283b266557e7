//! Steps the estimators of all cells of one type together.
//!
//! In: one [`CellStep`] per cell and batch (V, A, s, degrees C). Out: a [`StepResult`] and estimates per cell.
//!
//! Almost every step is ordinary: the current was measured for the whole time since the last voltage, and the voltage
//! is within the gate, which means close enough to the predicted voltage. The [`kernel`] computes ordinary steps for
//! [`WIDTH`] cells at a time, with one cell per vector lane. With the feature `wide`, the bank uses the machine's
//! widest vector instructions. Without such instructions, it steps the cells one by one. All other steps use parts of
//! the same kernel with one lane ([`SingleCell`]). Examples are a first voltage, a gap, an unknown current, and a
//! reading beyond the gate.
//!
//! A cell's estimates do not depend on the other cells of the pack. Whether a step is ordinary depends only on the cell
//! itself, and the bits of a lane do not depend on other lanes.
//!
//! The tests compare the kernel with the textbook filter: the SOC agrees within 1e-9 over 100,000 steps.

mod filter_array;
mod input;
mod kernel;
mod single;
mod tables;

use filter_array::{BatchStep, FilterArray, FilterArrays, each_array};
use input::{BlockInput, CellSlot, WIDTH};
use kernel::{KernelConstants, MEAN_NIS, OFFSET_INFORMATION, OFFSET_SCORE, at};
pub(super) use single::SingleCell;
use single::{hot, with_hot};

use super::cell_estimator::{CellEstimator, thermal_c};
use super::memory::Memory;
use super::state_vector::{CAPACITY, LOG_RESISTANCE, VOLTAGE_OFFSET};
use super::step::{CellStep, StepResult};
use super::voltage_reach::VoltageReach;
use crate::cell::{CellModel, EstimatorConfig, MAX_BRANCHES};
use crate::filter::ScalarGaussian;
use crate::quantity::bounds;

/// The estimators of a pack's cells.
#[derive(Debug, Clone)]
pub struct EstimatorBank {
    model: CellModel,
    config: EstimatorConfig,
    constants: KernelConstants,
    voltage_reach: VoltageReach,
    plausible_ah: (f64, f64),
    filters: FilterArrays,
    cells: Vec<CellSlot>,
    /// If a cell is not in the batch, its input comes from an earlier batch, and the result is discarded.
    inputs: Vec<BlockInput>,
    results: Vec<StepResult>,
    others: Vec<(usize, CellStep)>,
    #[cfg(feature = "wide")]
    machine: pulp::Arch,
}

impl EstimatorBank {
    /// Estimators of `cells` cells before their first measurement.
    pub fn new(model: &CellModel, config: &EstimatorConfig, cells: usize) -> Self {
        let blocks = cells.div_ceil(WIDTH);
        let filters = match model.branches.len() {
            1 => FilterArrays::One(FilterArray::new(model, blocks)),
            2 => FilterArrays::Two(FilterArray::new(model, blocks)),
            _ => FilterArrays::Three(FilterArray::new(model, blocks)),
        };
        let cell = CellSlot { memory: Memory::new(config), has_filter: false };
        let idle = StepResult { update: None, reset: false, jumped: false };
        let mut bank = Self {
            constants: KernelConstants::new(model, config),
            voltage_reach: VoltageReach::new(model, config.sensor.voltage_offset_v, config.voltage.noise_v),
            plausible_ah: plausible_ah(model, config),
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

    /// Replaces settings and tables for the same cells. The new model must have the same number of branches.
    pub fn reconfigure(&mut self, model: &CellModel, config: &EstimatorConfig) {
        if (&self.model, &self.config) == (model, config) {
            return;
        }
        let mut new = Self::new(model, config, self.cells.len());
        for cell in 0..self.cells.len() {
            let mut estimator = self.cell(cell);
            estimator.restate_constant_errors(&self.config.sensor, &config.sensor);
            new.put(cell, &estimator);
        }
        new.results = std::mem::take(&mut self.results);
        *self = new;
    }

    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.cells.len()
    }

    /// The cell model.
    pub fn model(&self) -> &CellModel {
        &self.model
    }

    /// The settings.
    pub fn config(&self) -> &EstimatorConfig {
        &self.config
    }

    /// Adds a cell's voltage reading to the batch. A batch has at most one reading per cell.
    ///
    /// # Panics
    /// If there is no such cell.
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
        input.offset_s.0[lane] = step.offset_s;
        input.current_a.0[lane] = current_a;
        input.voltage_v.0[lane] = step.voltage_v;
    }

    /// Computes the steps of the batch; [`Self::result`] returns their outcomes.
    pub fn step(&mut self) {
        #[cfg(feature = "wide")]
        let machine = self.machine;
        let Self { constants, filters, inputs, cells, results, others, .. } = self;
        each_array!(filters, lanes => {
            let all = BatchStep { lanes, constants, inputs, cells, results, others };
            #[cfg(feature = "wide")]
            machine.dispatch(all);
            #[cfg(not(feature = "wide"))]
            all.run::<false>();
        });
        for at in 0..self.others.len() {
            let (cell, step) = self.others[at];
            let mut estimator = self.cell(cell);
            let kernel = SingleCell::new(&mut self.filters, &self.constants, cell);
            self.results[cell] = estimator.rare_step(kernel, &self.model, &self.config, &step);
            self.put(cell, &estimator);
        }
        self.others.clear();
    }

    /// Outcome of a cell's last step.
    #[inline]
    pub fn result(&self, cell: usize) -> &StepResult {
        &self.results[cell]
    }

    fn modelled_c(&self, cell: usize, step: &CellStep) -> f64 {
        let soc = self.soc(cell).map_or(0.5, |soc| soc.mean);
        thermal_c(&self.model, self.cells[cell].memory.temperature_c, soc, self.log_resistance(cell).mean, step)
    }

    /// Whether a cell has a state of charge.
    #[inline]
    pub fn is_started(&self, cell: usize) -> bool {
        self.cells[cell].has_filter
    }

    /// State of charge as the filter holds it: not limited to 0 to 1, and without the additional uncertainty after
    /// downtime.
    pub fn filtered_soc(&self, cell: usize) -> Option<ScalarGaussian> {
        self.is_started(cell).then(|| self.marginal(cell, 0))
    }

    /// State of charge, limited to 0 to 1; `None` before the first voltage.
    #[inline]
    pub fn soc(&self, cell: usize) -> Option<ScalarGaussian> {
        let CellSlot { memory, has_filter, .. } = &self.cells[cell];
        has_filter.then(|| {
            let soc = self.marginal(cell, 0);
            let linear = self.soc_by_voltage(cell);
            let reach = self.voltage_reach.std(soc.mean, linear, memory.innovation_v);
            let variance = soc.variance + reach * reach - linear * linear;
            memory.published(ScalarGaussian { variance, ..soc })
        })
    }

    /// State of charge of the emptiest and of the fullest cell. `None` if a cell has no SOC yet, or if a cell's SOC is
    /// [carried over](Self::is_carried_over).
    pub fn extremes(&self) -> Option<(ScalarGaussian, ScalarGaussian)> {
        if !self.cells.iter().all(|cell| cell.has_filter && !cell.memory.is_carried_over()) {
            return None;
        }
        let (lowest, highest) = each_array!(&self.filters, x => x.extremes(self.cells.len()))?;
        Some((self.soc(lowest)?, self.soc(highest)?))
    }

    /// ln of the resistance relative to a new cell.
    #[inline]
    pub fn log_resistance(&self, cell: usize) -> ScalarGaussian {
        let CellSlot { memory, has_filter, .. } = &self.cells[cell];
        if *has_filter { self.marginal(cell, LOG_RESISTANCE) } else { memory.log_resistance }
    }

    /// Branch voltages (V); NaN for branches that the model does not have, and before the first voltage.
    pub fn branch_v(&self, cell: usize) -> [f64; MAX_BRANCHES] {
        self.cell(cell).branch_v()
    }

    /// Mean normalised innovation squared over a configured time (`consistency_window_s`): about 1 or less for a
    /// consistent filter.
    #[inline]
    pub fn mean_nis(&self, cell: usize) -> f64 {
        let (block, lane) = (cell / WIDTH, cell % WIDTH);
        each_array!(&self.filters, x => x.blocks[block].memory[MEAN_NIS].0[lane])
    }

    /// Whether this cell's SOC, resistance and capacity are plausible for a cell of the model. True before the first
    /// voltage.
    #[inline]
    pub fn is_plausible(&self, cell: usize) -> bool {
        let (block, lane) = (cell / WIDTH, cell % WIDTH);
        let [soc, log_resistance, capacity_ah] = each_array!(&self.filters, x => {
            let mean = &x.blocks[block].mean;
            [mean[0].0[lane], mean[LOG_RESISTANCE].0[lane], mean[CAPACITY].0[lane]]
        });
        let (low_ah, high_ah) = self.plausible_ah;
        !self.cells[cell].has_filter
            || (bounds::TRUSTED_SOC.has(soc)
                && bounds::TRUSTED_LOG_RESISTANCE.has(log_resistance)
                && low_ah <= capacity_ah
                && capacity_ah <= high_ah)
    }

    /// Whether all cells are [plausible](Self::is_plausible).
    pub fn are_all_plausible(&self) -> bool {
        (0..self.cells.len()).all(|cell| self.is_plausible(cell))
    }

    /// Maximum of [`Self::mean_nis`] of all cells, at least 0; NaN counts as infinite.
    pub fn worst_nis(&self) -> f64 {
        let larger = |a: f64, b: f64| match () {
            () if b <= a => a,
            () if b > a => b,
            () => f64::INFINITY,
        };
        let worst = each_array!(&self.filters, x => x.blocks.iter().fold([0.0; WIDTH], |worst, block| {
            std::array::from_fn(|lane| larger(worst[lane], block.memory[MEAN_NIS].0[lane]))
        }));
        worst.into_iter().fold(0.0, larger)
    }

    /// Temperature that the filter uses (degrees C).
    #[inline]
    pub fn temperature_c(&self, cell: usize) -> Option<f64> {
        self.cells[cell].memory.temperature_c
    }

    /// Whether the SOC dates from before a downtime or sleep, because no voltage has been used since.
    pub fn is_carried_over(&self, cell: usize) -> bool {
        self.cells[cell].memory.is_carried_over()
    }

    /// A copy of a cell's estimator.
    pub fn cell(&self, cell: usize) -> CellEstimator {
        let CellSlot { memory, has_filter } = &self.cells[cell];
        let (filter, hot) = each_array!(&self.filters, x => x.lane(cell));
        CellEstimator { filter: has_filter.then_some(filter), memory: with_hot(memory, &hot) }
    }

    /// Replaces a cell's estimator.
    pub fn put(&mut self, cell: usize, estimator: &CellEstimator) {
        let CellEstimator { filter, memory } = estimator;
        let hot = hot(memory, &self.constants);
        self.cells[cell].has_filter = each_array!(&mut self.filters, x => x.set(cell, filter.as_ref(), hot));
        self.cells[cell].memory = *memory;
    }

    /// Calls `change` with a cell's estimator and stores the changed estimator.
    pub fn change<R>(&mut self, cell: usize, change: impl FnOnce(&mut CellEstimator) -> R) -> R {
        let mut estimator = self.cell(cell);
        let result = change(&mut estimator);
        self.put(cell, &estimator);
        result
    }

    /// Evidence about the current sensor's offset since the last correction: the sums of d^2 / R and of d e / R. e is
    /// an innovation, d is the effect of one standard deviation of the offset on e, and R is the variance of e without
    /// this effect. The sums are averaged over the cells, because the models of the cells have common errors.
    pub fn offset_evidence(&self) -> (f64, f64) {
        let cells = self.cells.len();
        let mean = |i: usize| {
            let sum: f64 =
                each_array!(&self.filters, x => x.blocks.iter().flat_map(|block| block.memory[i].0).take(cells).sum());
            sum / cells.max(1) as f64
        };
        (mean(OFFSET_INFORMATION), mean(OFFSET_SCORE))
    }

    /// Corrects all cells by `deviations` standard deviations of the current sensor's offset. Afterwards, the standard
    /// deviation of the offset is `offset_std_a`.
    pub fn absorb_current_offset(&mut self, deviations: f64, offset_std_a: f64) {
        let before_a = self.config.sensor.current_offset_a;
        let remains = if before_a > 0.0 { offset_std_a / before_a } else { 1.0 };
        self.change_all(|cell| cell.absorb_current_offset(deviations, remains));
        self.set_current_offset_std(offset_std_a);
    }

    /// Learns the slow ratio of every cell (how much more the resistance of its slowest branch has changed than the
    /// other resistances) from the evidence since the last correction.
    pub fn learn_slow_branches(&mut self) {
        let config = self.config;
        self.change_all(|cell| cell.learn_slow_branch(&config));
    }

    /// Sets the standard deviation of the current sensor's offset (A) per cell.
    pub fn set_current_offset_std(&mut self, offset_std_a: f64) {
        self.config.sensor.current_offset_a = offset_std_a;
        self.constants.sensor.current_offset_a = offset_std_a;
    }

    /// Changes every cell's estimator.
    pub fn change_all(&mut self, mut change: impl FnMut(&mut CellEstimator)) {
        (0..self.cells.len()).for_each(|cell| self.change(cell, &mut change));
    }

    /// Change of a cell's SOC (fraction) per standard deviation of the voltage's constant error.
    #[inline]
    fn soc_by_voltage(&self, cell: usize) -> f64 {
        let (block, lane) = (cell / WIDTH, cell % WIDTH);
        each_array!(&self.filters, x => x.blocks[block].by_constant[VOLTAGE_OFFSET][0].0[lane])
    }

    #[inline]
    fn marginal(&self, cell: usize, i: usize) -> ScalarGaussian {
        let (block, lane) = (cell / WIDTH, cell % WIDTH);
        each_array!(&self.filters, x => {
            let state = &x.blocks[block];
            let by_constant = state.by_constant.iter().map(|column| column[i].0[lane] * column[i].0[lane]);
            let variance = by_constant.fold(state.covariance[at(i, i)].0[lane], |sum, part| sum + part);
            ScalarGaussian { mean: state.mean[i].0[lane], variance }
        })
    }
}

fn plausible_ah(model: &CellModel, config: &EstimatorConfig) -> (f64, f64) {
    let (model_ah, initial_ah) = (model.capacity_ah, config.initial.capacity_ah);
    (bounds::TRUSTED_CAPACITY.low * model_ah.min(initial_ah), bounds::TRUSTED_CAPACITY.high * model_ah.max(initial_ah))
}

#[cfg(test)]
mod tests;
