//! Estimation stage: computes the estimate of every cell from cell samples.
//!
//! In: batches of samples, and the values learned from half-cycles ([`Learner`]). Out: one filter step per sample, and
//! two judgements per cell: whether the innovations agree with their covariance, and whether the model fits the cell
//! ([`ModelCheck`]). If a filter fails at a sample, only that filter is reset.

use serde::{Deserialize, Serialize};

pub(crate) mod batch;
pub(crate) mod current_check;

use batch::CellBatch;
use current_check::{CurrentCheck, MAX_CELLS};

use super::modelling::{Adoption, Modelling};
use crate::cell::model_check::model_id;
use crate::cell::{
    AdoptedState, CellModel, CellModule, CellStep, EstimatorConfig, ModelCheck, ModelEvidence, PackBank,
};
use crate::filter::ScalarGaussian;
use crate::health::{CapacityConfig, Learner};
use crate::monitor::config::MonitorConfig;
use crate::monitor::message::{Estimate, MeasuredValues};
use crate::quantity::{CellIndex, Timestamp};
use crate::sample::CellSample;

/// Contradiction score of an estimate that is known to be wrong, in multiples of the consistency limit. It is high
/// enough to trip an alarm whose threshold is the limit.
const DOUBT: f64 = 2.0;

/// If a cell is not trusted, its contradiction must fall to this part of the consistency limit before the cell is
/// trusted again. With the default limit, a correct filter has this contradiction on average.
const RETURN: f64 = 0.25;

/// Value of `Consumed::path_v` that marks a frozen voltage (V). It is far outside the range of [`CurrentCheck::path_v`]
/// (sum of all voltage changes that the cells have in common).
const FROZEN_PATH_V: f64 = 1e9;

#[derive(Debug)]
pub(crate) struct Estimation {
    pub(crate) bank: PackBank,
    /// Modules with cells of another kind.
    modules: Vec<CellModule>,
    pub(crate) batch: CellBatch,
    progress: Vec<CellProgress>,
    /// Per cell: whether its estimate is trusted ([`Self::judge_trust`]).
    trusted: Vec<bool>,
    pub(crate) all_trusted: bool,
    checks: Vec<ModelCheck>,
    any_check_open: bool,
    pub(crate) any_mismatched: bool,
    pub(crate) current_check: CurrentCheck,
    /// Whether the current's reading is frozen or contradicts the voltages, or an input message has a second sender.
    pub(crate) is_current_doubtful: bool,
    /// Whether the current was doubtful at any time since the last change of mode.
    pub(crate) was_current_doubtful: bool,
    ambient_c: f64,
    /// Cells whose next half-cycle may have started in the gap before their latest sample.
    after_gap: Vec<usize>,
}

/// Stored state of the stage, without the cells.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct EstimationState {
    pub(crate) waiting: Vec<CellSample>,
    pub(crate) is_current_doubtful: bool,
    pub(crate) was_current_doubtful: bool,
    pub(crate) current_check: CurrentCheck,
}

/// The sampler's data that a cell's filter has already used. Stored apart from the filters for cache locality, because
/// every sample updates this data.
#[derive(Debug, Clone, Copy, Default)]
struct CellProgress {
    /// Sampler totals at the last step; `None` before the first step.
    consumed: Option<Consumed>,
    /// The sample of the latest estimate.
    sample: Option<CellSample>,
}

/// Totals of the sampler at a cell's latest step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Consumed {
    pub(crate) time: Timestamp,
    pub(crate) charge_as: f64,
    offset_s: f64,
    pub(crate) unmeasured_s: f64,
    voltage_v: f64,
    /// Value of [`CurrentCheck::path_v`] when this voltage last changed (V).
    path_v: f64,
}

impl Estimation {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
        let cells = usize::from(config.sample.cells);
        let bank = PackBank::new(&config.model, &config.estimator, cells, &config.modules);
        Self {
            checks: ids_of_models(&bank).into_iter().map(ModelCheck::new).collect(),
            bank,
            modules: config.modules.clone(),
            batch: CellBatch::new(cells),
            progress: vec![CellProgress::default(); cells],
            trusted: vec![true; cells],
            all_trusted: true,
            any_check_open: true,
            any_mismatched: false,
            current_check: CurrentCheck::default(),
            is_current_doubtful: false,
            was_current_doubtful: false,
            ambient_c: config.sample.ambient_c,
            after_gap: Vec::new(),
        }
    }

    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig, modelling: &Modelling, learner: &Learner) {
        self.modules.clone_from(&config.modules);
        self.use_model(modelling, learner);
        let ids = ids_of_models(&self.bank);
        self.checks.iter_mut().zip(ids).for_each(|(check, id)| *check = check.or_new(id));
        self.note_checks();
        self.ambient_c = config.sample.ambient_c;
    }

    /// Applies the present model to the existing cells.
    pub(crate) fn use_model(&mut self, modelling: &Modelling, learner: &Learner) {
        let (model, estimator) = modelling.in_force();
        self.reconfigure_bank(&model, &estimator, learner);
    }

    fn reconfigure_bank(&mut self, model: &CellModel, estimator: &EstimatorConfig, learner: &Learner) {
        let learned = |config: &EstimatorConfig| {
            let mut config = *config;
            config.sensor.current_offset_a = learner.current_offset().std_a(config.sensor.current_offset_a);
            config
        };
        let modules: Vec<CellModule> = self
            .modules
            .iter()
            .map(|module| CellModule { estimator: learned(&module.estimator), ..module.clone() })
            .collect();
        self.bank.reconfigure(model, &learned(estimator), &modules);
    }

    /// Forgets all cells, because another pack is connected.
    pub(crate) fn forget(&mut self, modelling: &Modelling) {
        let (cells, (model, estimator)) = (self.cells(), modelling.in_force());
        self.bank = PackBank::new(&model, &estimator, cells, &self.modules);
        self.progress.fill(CellProgress::default());
        self.trusted.fill(true);
        self.all_trusted = true;
        self.current_check.interrupt();
        self.begin_checks();
    }

    fn begin_checks(&mut self) {
        self.checks = ids_of_models(&self.bank).into_iter().map(ModelCheck::new).collect();
        self.note_checks();
    }

    /// Whether the current is doubtful, or a jump of the SOC is unconfirmed ([`CurrentCheck::is_unconfirmed`]).
    pub(crate) fn is_doubtful(&self) -> bool {
        self.is_current_doubtful || self.current_check.is_unconfirmed()
    }

    /// Whether the current was doubtful at any time since the last call.
    pub(crate) fn take_doubt(&mut self) -> bool {
        std::mem::replace(&mut self.was_current_doubtful, self.is_current_doubtful)
    }

    /// Temperature that replaces a missing measurement (degrees C).
    pub(crate) fn ambient_c(&self) -> f64 {
        self.ambient_c
    }

    pub(crate) fn cells(&self) -> usize {
        self.progress.len()
    }

    pub(crate) fn cell_indices(&self) -> impl ExactSizeIterator<Item = CellIndex> + use<> {
        (0..u16::try_from(self.cells()).unwrap_or(u16::MAX)).map(CellIndex)
    }

    /// Runs the filters on all waiting samples. Returns the samples, which the caller later passes to
    /// [`finish`](Self::finish).
    pub(crate) fn step(&mut self, learner: &mut Learner, modelling: &mut Modelling) -> Vec<CellSample> {
        let samples = std::mem::take(&mut self.batch.waiting);
        self.check_current(&samples);
        self.is_current_doubtful |= self.current_check.is_doubtful();
        self.was_current_doubtful |= self.is_current_doubtful;
        for sample in &samples {
            let (cell, step) = (sample.cell.index(), self.next_step(sample, learner));
            if self.bank.is_own(cell) {
                modelling.note(&step);
            }
            self.bank.add(cell, &step);
        }
        self.bank.step();
        // A wrong current makes the SOC of most cells jump. Jumps at rest do not count: if the measured current is
        // small but not exactly zero, the sensor works and the pack rests.
        let rest_a = self.bank.own_config().gap.rest_current_a;
        let is_rest = |sample: &CellSample| sample.current_a.is_some_and(|a| a != 0.0 && a.abs() <= rest_a);
        let has_jumped = |sample: &&CellSample| self.bank.result(sample.cell.index()).jumped && !is_rest(sample);
        self.current_check.note_jumps(samples.iter().filter(has_jumped).count(), self.progress.len());
        self.check_models(&samples);
        if modelling.has_row() {
            modelling.close_row(self.mean_soc());
        }
        samples
    }

    fn check_current(&mut self, samples: &[CellSample]) {
        let Self { bank, current_check, .. } = self;
        let own = bank.own_cells();
        let own_compared = &own[..own.len().min(MAX_CELLS)];
        // The cells are in ascending order.
        let last = own_compared[own_compared.len() - 1];
        let is_near = |sample: &&CellSample| sample.cell.index() <= last;
        let place = |sample: &CellSample| own_compared.iter().position(|&cell| cell == sample.cell.index());
        let compared = samples.iter().filter(is_near).filter_map(|sample| Some((place(sample)?, sample)));
        let soc = bank.filtered_soc(own[0]).map_or(0.5, |soc| soc.mean.clamp(0.0, 1.0));
        let temperature_c = bank.temperature_c(own[0]).unwrap_or(self.ambient_c);
        let ohm = bank.own_model().r0_ohm(&bank.own_model().grid_position(soc, temperature_c));
        let config = bank.own_config();
        current_check.handle(compared, config.voltage.noise_v, ohm, config.gap.rest_current_a);
    }

    /// Mean SOC of the cells outside modules, fraction; 0.5 if no such cell has an estimate.
    fn mean_soc(&self) -> f64 {
        self.mean_estimate().map_or(0.5, |soc| soc.mean)
    }

    /// Adopts another model. Each cell keeps its differences from the mean cell in SOC, resistance and capacity.
    pub(crate) fn adopt(&mut self, adoption: &Adoption, learner: &mut Learner, config: &CapacityConfig) {
        let Adoption { model, config: estimator, mean, with_capacity, is_learned } = adoption;
        let (own, bank) = (self.bank.own_cells().to_vec(), &self.bank);
        let soc = differences(own.iter().map(|&cell| bank.filtered_soc(cell).map(|soc| soc.mean)));
        let log_resistance = differences(own.iter().map(|&cell| Some(bank.log_resistance(cell).mean)));
        let log_capacity = differences(own.iter().map(|&cell| Some(libm::log(learner.capacity(cell).mean))));
        self.reconfigure_bank(model, estimator, learner);
        let (estimator, bank) = (*self.bank.own_config(), &mut self.bank);
        for (at, cell) in own.into_iter().enumerate() {
            let ratio = libm::exp(log_capacity[at]);
            let fitted =
                ScalarGaussian { mean: mean.capacity.mean * ratio, variance: mean.capacity.variance * ratio * ratio };
            let capacity = with_capacity.then_some(fitted);
            let state = AdoptedState {
                soc: mean.soc.map(|mean| ScalarGaussian { mean: mean.mean + soc[at], ..mean }),
                capacity: capacity.unwrap_or(learner.capacity(cell)),
                log_resistance: log_resistance[at],
                ..*mean
            };
            bank.change(cell, |cell| cell.adopt(model, &estimator, &state));
            learner.adopt(config, cell, capacity.map(|capacity| (capacity, *is_learned)), state.soc, &bank.cell(cell));
        }
        let ids = ids_of_models(&self.bank);
        for &cell in self.bank.own_cells() {
            self.checks[cell] = ModelCheck::new(ids[cell]);
        }
        self.note_checks();
    }

    /// SOC of a cell at a mark (a possible start of a half-cycle): the filter's SOC, and the [SOC by
    /// voltage](Self::soc_by_voltage). `is_label`: whether the model of the cells outside modules comes from a label.
    pub(crate) fn soc_at_mark(&self, cell: usize, is_label: bool) -> (Option<ScalarGaussian>, Option<f64>) {
        let uses_label = if self.bank.is_own(cell) { is_label } else { !self.bank.has_given_model(cell) };
        let by_voltage = if uses_label { self.soc_by_voltage(cell) } else { None };
        (self.bank.filtered_soc(cell), by_voltage)
    }

    /// SOC at which the open-circuit voltage equals a cell's latest voltage plus the voltage drop in the cell. Unlike
    /// the filter's SOC, this SOC does not contain the counted charge. `None` if the current is unknown or doubtful, if
    /// the voltage is frozen, or if the SOC is outside the curve.
    fn soc_by_voltage(&self, index: usize) -> Option<f64> {
        let sample = self.progress[index].sample?;
        let current_a = sample.current_a.filter(|_| !self.is_current_doubtful && !self.is_voltage_frozen(index))?;
        let (cell, model) = (self.bank.cell(index), self.bank.model(index));
        let temperature = model.temperature_position(self.bank.temperature_c(index).unwrap_or(self.ambient_c));
        let position = model.grid_position_at(&temperature, self.bank.filtered_soc(index)?.mean);
        let ratio = libm::exp(self.bank.log_resistance(index).mean);
        let branches_v: f64 = cell.branch_v().into_iter().filter(|branch_v| branch_v.is_finite()).sum();
        let ocv_v = sample.voltage_v + current_a * model.r0_ohm(&position) * ratio + branches_v;
        let soc = model.soc_of_aged_ocv(&temperature, cell.curve().mean, ocv_v);
        // An SOC slightly outside 0 to 1 is accepted, because the curve is extrapolated a little beyond its ends.
        (-0.05..=1.05).contains(&soc).then_some(soc)
    }

    /// Completes the work on samples that the filters have used, and reuses their buffer.
    pub(crate) fn finish(&mut self, mut samples: Vec<CellSample>, is_label: bool, learner: &mut Learner) {
        samples.clear();
        self.batch.waiting = samples;
        for cell in std::mem::take(&mut self.after_gap) {
            learner.move_mark(cell, self.soc_at_mark(cell, is_label));
        }
    }

    /// The filter step from the previous sample to this one.
    fn next_step(&mut self, sample: &CellSample, learner: &mut Learner) -> CellStep {
        let index = sample.cell.index();
        let (charge, unmeasured) = (sample.charge_as, sample.unmeasured_s);
        let path_v = match self.progress[index].consumed {
            // A frozen voltage counts as frozen until it changes, even if the voltages of the other cells return to
            // their earlier values.
            Some(before) if before.voltage_v == sample.voltage_v && self.is_voltage_frozen(index) => FROZEN_PATH_V,
            Some(before) if before.voltage_v == sample.voltage_v => before.path_v,
            _ => self.current_check.path_v(),
        };
        let now = Consumed {
            time: sample.time,
            charge_as: charge,
            offset_s: sample.offset_s,
            unmeasured_s: unmeasured,
            voltage_v: sample.voltage_v,
            path_v,
        };
        let (mut measured_s, mut charge_as, mut offset_s, mut unmeasured_s) = (0.0, 0.0, 0.0, 0.0);
        // Before the first reading, and after a gap of unknown length, the unmeasured time is infinite.
        let mut gap_s = f64::INFINITY;
        if let Some(before) = self.progress[index].consumed.replace(now) {
            charge_as = charge - before.charge_as;
            offset_s = sample.offset_s - before.offset_s;
            unmeasured_s = unmeasured - before.unmeasured_s;
            measured_s = (sample.time.since(before.time) - unmeasured_s).max(0.0);
            gap_s = unmeasured_s;
        }
        if self.any_check_open {
            self.checks[index].add_step(measured_s, charge_as, unmeasured_s);
        }
        if learner.observe(index, sample.time, sample.temperature_c, measured_s, gap_s) {
            self.after_gap.push(index);
        }
        let (mut current_a, is_voltage_frozen) = (sample.current_a, self.is_voltage_frozen(index));
        if self.is_current_doubtful {
            (measured_s, charge_as, offset_s, unmeasured_s) = (0.0, 0.0, 0.0, measured_s + unmeasured_s);
            current_a = None;
        } else if is_voltage_frozen {
            current_a = None;
        }
        // Corrects the current for the sensor's offset. A reading of exactly zero counts as free of offset.
        let offset_a = learner.current_offset().mean_a();
        let corrected = |current_a: f64| if current_a == 0.0 { 0.0 } else { current_a - offset_a };
        CellStep {
            measured_s,
            charge_as: charge_as - offset_a * offset_s,
            offset_s,
            unmeasured_s,
            current_a: current_a.map(corrected),
            temperature_c: sample.temperature_c,
            ambient_c: self.ambient_c,
            voltage_v: sample.voltage_v,
            is_voltage_frozen,
        }
    }

    /// Whether a cell's voltage has stayed exactly the same while the other cells' voltages have changed.
    pub(crate) fn is_voltage_frozen(&self, index: usize) -> bool {
        self.progress[index].consumed.is_some_and(|consumed| self.current_check.is_frozen_since(consumed.path_v))
    }

    /// Records the sample of a cell's latest step. Returns whether that step reset the cell's filter.
    #[inline]
    pub(crate) fn record(&mut self, sample: &CellSample) -> bool {
        self.progress[sample.cell.index()].sample = Some(*sample);
        self.bank.result(sample.cell.index()).reset
    }

    pub(crate) fn is_trusted(&self, index: usize) -> bool {
        self.trusted[index]
    }

    fn check_models(&mut self, samples: &[CellSample]) {
        if !self.any_check_open {
            return;
        }
        let mut has_judged = false;
        let Self { bank, checks, .. } = self;
        for index in samples.iter().map(|sample| sample.cell.index()) {
            if !checks[index].is_due() {
                continue;
            }
            let update = bank.result(index).update.filter(|_| !bank.result(index).reset);
            let evidence = update.zip(bank.filtered_soc(index)).map(|(update, soc)| ModelEvidence {
                update,
                soc: soc.mean,
                log_resistance: bank.log_resistance(index).mean,
                log_resistance_std: bank.config(index).initial.log_resistance_std,
            });
            checks[index].judge(evidence, bank.model(index).rated_capacity_ah);
            has_judged = true;
        }
        if has_judged {
            self.note_checks();
        }
    }

    fn note_checks(&mut self) {
        self.any_check_open = self.checks.iter().any(ModelCheck::is_open);
        self.any_mismatched = self.checks.iter().any(ModelCheck::is_mismatched);
    }

    /// Whether a cell belongs to a module and its stored `check` was made with a different cell model.
    pub(crate) fn is_other_cell(&self, index: usize, check: &ModelCheck) -> bool {
        !self.bank.is_own(index) && self.is_of_other_model(index, check)
    }

    /// Whether the stored `check` of a cell was made with a different cell model.
    pub(crate) fn is_of_other_model(&self, index: usize, check: &ModelCheck) -> bool {
        check.is_of_other(model_id(self.bank.model(index), self.bank.config(index).initial.log_resistance_std))
    }

    /// Mean SOC and mean SOC variance of the cells outside modules; `None` if no such cell has an estimate.
    pub(crate) fn mean_estimate(&self) -> Option<ScalarGaussian> {
        let socs = self.bank.own_cells().iter().filter_map(|&cell| self.bank.filtered_soc(cell));
        let (count, mean, variance) = socs.fold((0.0, 0.0, 0.0), |(count, mean, variance), soc| {
            (count + 1.0, mean + soc.mean, variance + soc.variance)
        });
        (count > 0.0).then(|| ScalarGaussian { mean: mean / count, variance: variance / count })
    }

    pub(crate) fn model_check(&self, index: usize) -> ModelCheck {
        self.checks[index]
    }

    /// How much a cell contradicts its estimate: the mean normalised innovation squared. If the model does not fit the
    /// cell, the result is at least the mismatch times the consistency limit. If the estimate is impossible or the
    /// current is doubtful, the result is at least [`DOUBT`] times the limit.
    pub(crate) fn contradiction(&self, index: usize) -> f64 {
        let (mean_nis, check) = (self.bank.mean_nis(index), &self.checks[index]);
        let limit = self.bank.own_config().consistency.limit;
        let mismatch = if check.is_mismatched() { check.mismatch() } else { 0.0 };
        let is_doubtful = self.is_doubtful() || self.is_voltage_frozen(index) || !self.bank.is_plausible(index);
        let doubt = if is_doubtful { DOUBT } else { 0.0 };
        if mismatch.max(doubt) > 0.0 { mean_nis.max(mismatch.max(doubt) * limit) } else { mean_nis }
    }

    /// Judges whether a cell's estimate is trusted: its contradiction is at most the consistency limit. Returns the
    /// result if it has changed.
    pub(crate) fn judge_trust(&mut self, cell: CellIndex) -> Option<bool> {
        let relative = self.contradiction(cell.index()) / self.bank.own_config().consistency.limit;
        let is_trusted = is_trusted(relative, self.trusted[cell.index()]);
        if is_trusted == self.trusted[cell.index()] {
            return None;
        }
        self.trusted[cell.index()] = is_trusted;
        self.all_trusted = self.trusted.iter().all(|&trusted| trusted);
        Some(is_trusted)
    }

    /// Handles a gap of unknown length. Charge is not counted across the gap.
    pub(crate) fn handle_unknown_gap(&mut self) {
        self.current_check.interrupt();
        self.bank.change_all(|_, cell| cell.handle_unknown_gap());
        self.progress.iter_mut().for_each(|cell| cell.consumed = None);
    }

    /// A cell's estimate after its latest step; `None` before its first step.
    pub(crate) fn estimate(&self, index: usize, capacity: ScalarGaussian) -> Option<Estimate> {
        let sample = self.progress[index].sample.as_ref()?;
        let soc = self.bank.soc(index)?;
        let update = self.bank.result(index).update;
        let resistance = self.resistance(index);
        Some(Estimate {
            time: sample.time,
            cell: sample.cell,
            soc: soc.mean,
            soc_std: soc.std(),
            branch_v: self.bank.branch_v(index),
            capacity_ah: capacity.mean,
            capacity_std_ah: capacity.std(),
            resistance_ratio: resistance.mean,
            resistance_ratio_std: resistance.std(),
            innovation_v: update.map_or(f64::NAN, |u| u.innovation),
            innovation_std_v: update.map_or(f64::NAN, |u| u.innovation_variance.sqrt()),
            accepted: update.is_some_and(|u| u.accepted),
            measured: MeasuredValues {
                voltage_v: sample.voltage_v,
                current_a: sample.current_a.unwrap_or(f64::NAN),
                temperature_c: self.bank.temperature_c(index).unwrap_or(f64::NAN),
            },
        })
    }

    pub(crate) fn resistance(&self, index: usize) -> ScalarGaussian {
        resistance(&self.bank, index)
    }

    pub(crate) fn consumed(&self, cell: usize) -> Option<Consumed> {
        self.progress[cell].consumed
    }

    pub(crate) fn snapshot(&self) -> EstimationState {
        EstimationState {
            waiting: self.batch.waiting.clone(),
            is_current_doubtful: self.is_current_doubtful,
            was_current_doubtful: self.was_current_doubtful,
            current_check: self.current_check.clone(),
        }
    }

    /// Restores stored cells (totals at the latest step, trust, model checks) and the batch.
    pub(crate) fn restore(
        &mut self,
        cells: impl Iterator<Item = (Option<Consumed>, bool, ModelCheck)>,
        batch: CellBatch,
    ) {
        let ids = ids_of_models(&self.bank);
        for (index, (consumed, trusted, check)) in cells.enumerate() {
            self.progress[index].consumed = consumed;
            self.trusted[index] = trusted;
            self.checks[index] = check.or_new(ids[index]);
        }
        self.note_checks();
        self.all_trusted = self.trusted.iter().all(|&trusted| trusted);
        self.batch = batch;
    }
}

/// Difference of each value from the mean of the known values; 0 for an unknown value.
fn differences(values: impl Iterator<Item = Option<f64>> + Clone) -> Vec<f64> {
    let known = values.clone().flatten();
    let mean = known.clone().sum::<f64>() / known.count().max(1) as f64;
    values.map(|value| value.map_or(0.0, |value| value - mean)).collect()
}

/// Per cell, an identifier of its model and of the expected spread of its resistance.
fn ids_of_models(bank: &PackBank) -> Vec<u64> {
    let of_kinds: Vec<u64> =
        bank.kinds().map(|(model, config)| model_id(model, config.initial.log_resistance_std)).collect();
    (0..bank.cells()).map(|cell| of_kinds[bank.kind(cell)]).collect()
}

/// Resistance of a cell relative to a new cell.
pub(crate) fn resistance(bank: &PackBank, index: usize) -> ScalarGaussian {
    let log_resistance = bank.log_resistance(index);
    let ratio = libm::exp(log_resistance.mean);
    ScalarGaussian::from_std(ratio, ratio * log_resistance.std())
}

/// Whether a cell is trusted. `relative`: its contradiction as a multiple of the consistency limit. `was_trusted`:
/// whether the cell was trusted before.
fn is_trusted(relative: f64, was_trusted: bool) -> bool {
    relative <= if was_trusted { 1.0 } else { RETURN }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trust_is_lost_above_limit_and_returns_far_below() {
        assert!(is_trusted(1.0, true) && !is_trusted(1.01, true));
        assert!(is_trusted(0.25, false) && !is_trusted(0.9, false));
        assert!(!is_trusted(f64::NAN, true), "an unknown contradiction is not trusted");
    }
}
