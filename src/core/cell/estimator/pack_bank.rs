//! The estimators of a pack whose modules may have different cells: one [`EstimatorBank`] for the pack's own cells, and
//! one per replaced module. The cells of a bank are called a kind.
//!
//! In: one [`CellStep`] per cell and batch, by the cell's index in the pack. Out: results and estimates per cell. All
//! kinds share the current sensor, so its offset is learned for the whole pack.

use super::bank::EstimatorBank;
use super::cell_estimator::CellEstimator;
use super::step::{CellStep, StepResult};
use crate::cell::{CellModel, EstimatorConfig, MAX_BRANCHES};
use crate::filter::ScalarGaussian;
use crate::quantity::CellIndex;

/// A replaced module, whose cells differ from the pack's own cells.
#[derive(Debug, Clone, PartialEq)]
pub struct CellModule {
    /// The cells, ascending; no cell is in two modules.
    pub cells: Vec<CellIndex>,
    /// Model of the cells.
    pub model: CellModel,
    /// The pack's estimator settings with the initial capacity of this model.
    pub estimator: EstimatorConfig,
    /// Whether the model comes from a file; otherwise, it is built from the label (chemistry and rated capacity).
    pub is_given: bool,
}

#[derive(Debug, Clone, Copy)]
struct Place {
    bank: usize,
    cell: usize,
}

/// The estimators of a pack's cells.
#[derive(Debug, Clone)]
pub struct PackBank {
    /// The bank of the pack's own cells, then one bank per module.
    banks: Vec<EstimatorBank>,
    places: Vec<Place>,
    /// The pack's own cells, ascending.
    own: Vec<usize>,
    is_given: Vec<bool>,
}

impl PackBank {
    /// Estimators of `cells` cells before their first measurement. Cells outside the modules use `model`.
    ///
    /// # Panics
    /// If a module has a cell that the pack does not have.
    pub fn new(model: &CellModel, config: &EstimatorConfig, cells: usize, modules: &[CellModule]) -> Self {
        let mut places: Vec<Option<Place>> = vec![None; cells];
        for (bank, module) in (1..).zip(modules) {
            for (cell, index) in module.cells.iter().enumerate() {
                places[index.index()] = Some(Place { bank, cell });
            }
        }
        let own: Vec<usize> = (0..cells).filter(|&cell| places[cell].is_none()).collect();
        for (cell, &index) in own.iter().enumerate() {
            places[index] = Some(Place { bank: 0, cell });
        }
        let of_module = |module: &CellModule| EstimatorBank::new(&module.model, &module.estimator, module.cells.len());
        let banks = std::iter::once(EstimatorBank::new(model, config, own.len())).chain(modules.iter().map(of_module));
        Self {
            banks: banks.collect(),
            places: places.into_iter().flatten().collect(),
            own,
            is_given: modules.iter().map(|module| module.is_given).collect(),
        }
    }

    /// Replaces settings and tables for the same cells and modules. No model may change its number of branches.
    pub fn reconfigure(&mut self, model: &CellModel, config: &EstimatorConfig, modules: &[CellModule]) {
        self.banks[0].reconfigure(model, config);
        for (bank, module) in self.banks[1..].iter_mut().zip(modules) {
            bank.reconfigure(&module.model, &module.estimator);
        }
    }

    #[inline]
    fn at(&self, cell: usize) -> (&EstimatorBank, usize) {
        let Place { bank, cell } = self.places[cell];
        (&self.banks[bank], cell)
    }

    #[inline]
    fn at_mut(&mut self, cell: usize) -> (&mut EstimatorBank, usize) {
        let Place { bank, cell } = self.places[cell];
        (&mut self.banks[bank], cell)
    }

    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.places.len()
    }

    /// The cells outside the modules, ascending.
    pub fn own_cells(&self) -> &[usize] {
        &self.own
    }

    /// Whether a cell is outside the modules.
    #[inline]
    pub fn is_own(&self, cell: usize) -> bool {
        self.places[cell].bank == 0
    }

    /// Model and settings of each kind of cell, starting with the pack's own cells.
    pub fn kinds(&self) -> impl Iterator<Item = (&CellModel, &EstimatorConfig)> {
        self.banks.iter().map(|bank| (bank.model(), bank.config()))
    }

    /// Index of a cell's [kind](Self::kinds).
    pub fn kind(&self, cell: usize) -> usize {
        self.places[cell].bank
    }

    /// Whether a cell is in a module whose model is from a file.
    pub fn has_given_model(&self, cell: usize) -> bool {
        let of_module = self.kind(cell).checked_sub(1).and_then(|module| self.is_given.get(module));
        of_module.copied().unwrap_or(false)
    }

    /// The model of the pack's own cells.
    pub fn own_model(&self) -> &CellModel {
        self.banks[0].model()
    }

    /// The settings of the pack's own cells.
    pub fn own_config(&self) -> &EstimatorConfig {
        self.banks[0].config()
    }

    /// A cell's model.
    pub fn model(&self, cell: usize) -> &CellModel {
        self.at(cell).0.model()
    }

    /// A cell's settings.
    pub fn config(&self, cell: usize) -> &EstimatorConfig {
        self.at(cell).0.config()
    }

    /// Adds a step, see [`EstimatorBank::add`].
    ///
    /// # Panics
    /// If there is no such cell.
    #[inline]
    pub fn add(&mut self, cell: usize, step: &CellStep) {
        let (bank, cell) = self.at_mut(cell);
        bank.add(cell, step);
    }

    /// Makes the steps, see [`EstimatorBank::step`].
    pub fn step(&mut self) {
        self.banks.iter_mut().for_each(EstimatorBank::step);
    }

    /// See [`EstimatorBank::result`].
    #[inline]
    pub fn result(&self, cell: usize) -> &StepResult {
        let (bank, cell) = self.at(cell);
        bank.result(cell)
    }

    /// See [`EstimatorBank::is_started`].
    pub fn is_started(&self, cell: usize) -> bool {
        let (bank, cell) = self.at(cell);
        bank.is_started(cell)
    }

    /// See [`EstimatorBank::filtered_soc`].
    pub fn filtered_soc(&self, cell: usize) -> Option<ScalarGaussian> {
        let (bank, cell) = self.at(cell);
        bank.filtered_soc(cell)
    }

    /// See [`EstimatorBank::soc`].
    pub fn soc(&self, cell: usize) -> Option<ScalarGaussian> {
        let (bank, cell) = self.at(cell);
        bank.soc(cell)
    }

    /// Like [`EstimatorBank::extremes`], for all cells of the pack.
    pub fn extremes(&self) -> Option<(ScalarGaussian, ScalarGaussian)> {
        let mut of_banks = self.banks.iter().filter(|bank| bank.cells() > 0).map(EstimatorBank::extremes);
        let first = of_banks.next()??;
        of_banks.try_fold(first, |(lowest, highest), of_bank| {
            let (low, high) = of_bank?;
            Some((
                if low.mean < lowest.mean { low } else { lowest },
                if high.mean > highest.mean { high } else { highest },
            ))
        })
    }

    /// See [`EstimatorBank::log_resistance`].
    pub fn log_resistance(&self, cell: usize) -> ScalarGaussian {
        let (bank, cell) = self.at(cell);
        bank.log_resistance(cell)
    }

    /// See [`EstimatorBank::branch_v`].
    pub fn branch_v(&self, cell: usize) -> [f64; MAX_BRANCHES] {
        let (bank, cell) = self.at(cell);
        bank.branch_v(cell)
    }

    /// See [`EstimatorBank::mean_nis`].
    pub fn mean_nis(&self, cell: usize) -> f64 {
        let (bank, cell) = self.at(cell);
        bank.mean_nis(cell)
    }

    /// See [`EstimatorBank::is_plausible`].
    pub fn is_plausible(&self, cell: usize) -> bool {
        let (bank, cell) = self.at(cell);
        bank.is_plausible(cell)
    }

    /// See [`EstimatorBank::are_all_plausible`].
    pub fn are_all_plausible(&self) -> bool {
        self.banks.iter().all(EstimatorBank::are_all_plausible)
    }

    /// See [`EstimatorBank::worst_nis`].
    pub fn worst_nis(&self) -> f64 {
        self.banks.iter().map(EstimatorBank::worst_nis).fold(0.0, f64::max)
    }

    /// See [`EstimatorBank::temperature_c`].
    pub fn temperature_c(&self, cell: usize) -> Option<f64> {
        let (bank, cell) = self.at(cell);
        bank.temperature_c(cell)
    }

    /// See [`EstimatorBank::is_carried_over`].
    pub fn is_carried_over(&self, cell: usize) -> bool {
        let (bank, cell) = self.at(cell);
        bank.is_carried_over(cell)
    }

    /// A copy of a cell's estimator.
    pub fn cell(&self, cell: usize) -> CellEstimator {
        let (bank, cell) = self.at(cell);
        bank.cell(cell)
    }

    /// Replaces a cell's estimator.
    pub fn put(&mut self, cell: usize, estimator: &CellEstimator) {
        let (bank, cell) = self.at_mut(cell);
        bank.put(cell, estimator);
    }

    /// Changes a cell's estimator.
    pub fn change<R>(&mut self, cell: usize, change: impl FnOnce(&mut CellEstimator) -> R) -> R {
        let (bank, cell) = self.at_mut(cell);
        bank.change(cell, change)
    }

    /// Like [`EstimatorBank::offset_evidence`], averaged over all cells of the pack.
    pub fn offset_evidence(&self) -> (f64, f64) {
        let of_bank = |bank: &EstimatorBank| {
            let (share, (information, score)) = (bank.cells() as f64 / self.cells() as f64, bank.offset_evidence());
            (share * information, share * score)
        };
        self.banks.iter().map(of_bank).fold((0.0, 0.0), |sum, of_bank| (sum.0 + of_bank.0, sum.1 + of_bank.1))
    }

    /// See [`EstimatorBank::absorb_current_offset`].
    pub fn absorb_current_offset(&mut self, deviations: f64, offset_std_a: f64) {
        self.banks.iter_mut().for_each(|bank| bank.absorb_current_offset(deviations, offset_std_a));
    }

    /// See [`EstimatorBank::learn_slow_branches`].
    pub fn learn_slow_branches(&mut self) {
        self.banks.iter_mut().for_each(EstimatorBank::learn_slow_branches);
    }

    /// See [`EstimatorBank::set_current_offset_std`].
    pub fn set_current_offset_std(&mut self, offset_std_a: f64) {
        self.banks.iter_mut().for_each(|bank| bank.set_current_offset_std(offset_std_a));
    }

    /// Changes every cell's estimator.
    pub fn change_all(&mut self, mut change: impl FnMut(&EstimatorConfig, &mut CellEstimator)) {
        for bank in &mut self.banks {
            let config = *bank.config();
            bank.change_all(|cell| change(&config, cell));
        }
    }
}
