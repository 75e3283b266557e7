//! Learning stage: turns estimates and the pack current into half-cycles (charges and discharges), and half-cycles into
//! health values.
//!
//! In: the pack current, the cells' filters and samples. Out, passed to the [`Publisher`] as events and alarm values:
//! * changes of mode;
//! * per half-cycle and cell: capacity, usable capacity, resistance and remaining life;
//! * per charge: the recharge period;
//! * the pack's state.
//!
//! If the voltages of a half-cycle contain no information about the capacity, no capacity is measured.

use serde::{Deserialize, Serialize};

pub(crate) mod life;
pub(crate) mod moved;

use life::PackLife;
use moved::MovedCounter;

use super::estimation::resistance;
use super::publisher::{Publisher, learned};
use crate::alarm::{Observation, Rule};
use crate::can::encode::HealthFields;
use crate::cell::{CellEstimator, CellModel, EstimatorConfig, LossModes, PackBank};
use crate::filter::{ScalarGaussian, square};
use crate::health::recharge::normalised_period;
use crate::health::usable::usable_capacity;
use crate::health::{
    CapacityUpdate, CellShare, HalfCycle, HealthConfig, Learner, Lesson, ModeChange, PackState, RecentLoad,
    RechargeAlarm, RechargeConfig, RechargeTimer, TransitionDetector, UseCounter, pack,
};
use crate::monitor::config::MonitorConfig;
use crate::monitor::message::EventKind;
use crate::quantity::catalogue::{Quantity, RecordedValues};
use crate::quantity::{CellIndex, InvalidState, Mode, Timestamp, bounds};
use crate::sample::CellSample;

/// In the constant-voltage phase of a charge, the voltage is at most this far below the model's highest voltage (V).
const TAPER_BAND_V: f64 = 0.03;

#[derive(Debug)]
pub(crate) struct Learning {
    pub(crate) config: HealthConfig,
    pub(crate) state: LearningState,
    pub(crate) cells: Vec<CellHealth>,
    pub(crate) lives: PackLife,
    /// Buffer for the half-cycles that a change of mode completes; reused to avoid allocations.
    half_cycles: Vec<HalfCycle>,
}

/// Stored state of the stage, without the cells.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct LearningState {
    pub(crate) detector: TransitionDetector,
    pub(crate) learner: Learner,
    /// Time of the last half-cycle; `None` before the first half-cycle, or if the time is unknown.
    pub(crate) learned_at: Option<Timestamp>,
    /// Time of the last correction of the current offset.
    offset_at: Option<Timestamp>,
    pub(crate) recharge: RechargeTimer,
    pub(crate) recharge_period_s: Option<f64>,
    pub(crate) normalised_recharge: Option<ScalarGaussian>,
    #[serde(default)]
    pub(crate) load: RecentLoad,
    #[serde(default)]
    pub(crate) moved: MovedCounter,
    #[serde(default)]
    pub(crate) use_counter: UseCounter,
    pub(crate) pack: Option<PackState>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct CellHealth {
    /// SOC after the last full charge; 1 before the first full charge.
    pub(crate) full_soc: f64,
    /// Whether the charge in progress has tapered off at the highest voltage.
    tapered: bool,
    pub(crate) usable: Option<ScalarGaussian>,
    /// Resistance relative to a new cell, after the last discharge.
    pub(crate) discharge_resistance: Option<ScalarGaussian>,
    pub(crate) throughput: Throughput,
}

/// Sums over all half-cycles of a cell. A stored state contains the sums as an array in the order of the fields.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(from = "[f64; 3]", into = "[f64; 3]")]
pub struct Throughput {
    /// Charge moved in both directions (Ah).
    pub charge_ah: f64,
    /// Duration of the charges (s).
    pub charging_s: f64,
    /// Duration of the discharges (s).
    pub discharging_s: f64,
}

impl From<[f64; 3]> for Throughput {
    fn from([charge_ah, charging_s, discharging_s]: [f64; 3]) -> Self {
        Self { charge_ah, charging_s, discharging_s }
    }
}

impl From<Throughput> for [f64; 3] {
    fn from(sums: Throughput) -> Self {
        [sums.charge_ah, sums.charging_s, sums.discharging_s]
    }
}

impl Throughput {
    /// Adds a half-cycle. Limits the times to the range of a stored state, because the clock may jump.
    pub fn add(&mut self, mode: Mode, charge_ah: f64, duration_s: f64) {
        self.charge_ah += charge_ah.max(0.0);
        let time_s = if mode == Mode::Charge { &mut self.charging_s } else { &mut self.discharging_s };
        *time_s = (*time_s + duration_s.max(0.0)).min(bounds::TIME_S.high);
    }
}

impl Default for CellHealth {
    fn default() -> Self {
        Self {
            full_soc: 1.0,
            tapered: false,
            usable: None,
            discharge_resistance: None,
            throughput: Throughput::default(),
        }
    }
}

/// Whether the recharge period is plausible. While the capacity is unknown, the period may be implausible.
fn is_period(period: &ScalarGaussian) -> bool {
    bounds::TIME_S.has(period.mean) && bounds::TIME_S.has(period.std())
}

impl LearningState {
    fn new(config: &HealthConfig, bank: &PackBank) -> Self {
        let initial = (0..bank.cells()).map(|cell| CellEstimator::new(bank.config(cell)).capacity());
        Self { learner: Learner::new(&config.capacity, initial.collect()), ..Self::default() }
    }

    /// The learned values only, without anything in progress and without timestamps.
    pub(crate) fn learned_only(&self) -> Self {
        let mut use_counter = self.use_counter;
        use_counter.interrupt();
        Self {
            learner: self.learner.learned_only(),
            recharge_period_s: self.recharge_period_s,
            normalised_recharge: self.normalised_recharge,
            moved: self.moved.interrupted(),
            use_counter,
            ..Self::default()
        }
    }

    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.detector.rebase(by_nanos);
        self.learner.rebase(by_nanos);
        for stamp in [&mut self.learned_at, &mut self.offset_at].into_iter().flatten() {
            *stamp = stamp.plus_nanos(by_nanos);
        }
        self.recharge.rebase(by_nanos);
        self.load.rebase(by_nanos);
        self.moved.rebase(by_nanos);
        self.use_counter.rebase(by_nanos);
    }
}

impl LearningState {
    pub(crate) fn check(&self) -> Result<(), InvalidState> {
        self.learner.check()?;
        self.recharge.check()?;
        self.load.check()?;
        self.moved.check()?;
        self.use_counter.check()?;
        self.pack.iter().try_for_each(PackState::check)?;
        bounds::TIME_S.check_all("the recharge period", self.recharge_period_s)?;
        check_positive("the normalised recharge period", self.normalised_recharge)
    }
}

impl Learning {
    pub(crate) fn new(config: &MonitorConfig, bank: &PackBank) -> Self {
        Self {
            config: config.health,
            state: LearningState::new(&config.health, bank),
            cells: vec![CellHealth::default(); bank.cells()],
            lives: PackLife::new(bank, &config.health),
            half_cycles: Vec::new(),
        }
    }

    /// Forgets everything learned. `bank`: the estimators of the new cells.
    pub(crate) fn forget(&mut self, bank: &PackBank) {
        self.state = LearningState::new(&self.config, bank);
        self.cells.fill(CellHealth::default());
        self.lives = PackLife::new(bank, &self.config);
    }

    pub(crate) fn mode(&self) -> Mode {
        self.state.detector.mode()
    }

    /// Capacity of a cell (Ah): the learned value, or the initial value before the first learning.
    pub(crate) fn capacity(&self, index: usize) -> ScalarGaussian {
        self.state.learner.capacity(index)
    }

    /// Capacity of a cell (Ah), if it has been learned.
    pub(crate) fn learned_capacity(&self, index: usize) -> Option<ScalarGaussian> {
        self.state.learner.has_learned(index).then(|| self.capacity(index))
    }

    /// Ends a mode. If this completes a half-cycle, every cell learns from the half-cycle. `is_label`: whether the
    /// pack's cell model is still the model of the label (chemistry and rated capacity), so it was neither given as a
    /// file nor learned. Cells in modules with other cells have their own model. `is_doubtful`: for each cell, whether
    /// the current was doubtful or the cell's voltage is frozen. A doubtful cell learns no capacity.
    pub(crate) fn complete_mode(
        &mut self,
        change: ModeChange,
        bank: &mut PackBank,
        (is_label, is_doubtful): (bool, &[bool]),
        to: &mut Publisher<'_>,
    ) {
        let is_by_model = |cell| if bank.is_own(cell) { !is_label } else { bank.has_given_model(cell) };
        self.state.learner.prepare(|cell| match is_by_model(cell) {
            _ if is_doubtful[cell] => Lesson::Nothing,
            true => Lesson::ByModel,
            false => {
                let EstimatorConfig { initial, gate, .. } = bank.config(cell);
                Lesson::ByLabel { before: square(initial.capacity_std_ah), soc_error: gate.soc_error }
            }
        });
        to.event(EventKind::Mode { from: change.from, to: change.to });
        // If the current readings stop, keep the evidence for the offset and the slow RC branches until the next change
        // of mode.
        if change.to != Mode::Unknown {
            self.learn_offset(bank, to.now);
            bank.learn_slow_branches();
        }
        let mut half_cycles = std::mem::take(&mut self.half_cycles);
        let rated_ah = bank.own_model().rated_capacity_ah;
        self.state.learner.complete(&self.config.transition, rated_ah, change.from, &mut half_cycles);
        let was_life_known = self.lives.of_pack().is_some();
        let since_before_s = self.state.learned_at.map(|before| to.now.since(before));
        let mut is_measured = false;
        for (index, half_cycle) in half_cycles.iter().enumerate() {
            is_measured |= self.learn_cell(index, half_cycle, since_before_s, bank, to);
        }
        if change.from == Mode::Charge {
            self.finish_charge(!half_cycles.is_empty(), bank, to);
        }
        if !half_cycles.is_empty() {
            let cells = half_cycles.iter().enumerate().filter(|(cell, _)| !is_doubtful[*cell]);
            let cells = cells.map(|(cell, half_cycle)| (half_cycle, bank.model(cell).rated_capacity_ah));
            self.state.use_counter.count_half_cycle(cells);
            self.state.learner.finish();
            self.state.learned_at = Some(to.now);
            self.lives.publish(was_life_known, is_measured, to);
            half_cycles.clear();
        }
        self.half_cycles = half_cycles;
        if change.to == Mode::Charge {
            self.cells.iter_mut().for_each(|cell| cell.tapered = false);
        }
    }

    /// Learns the offset of the current sensor from the voltages since the last change of mode, and corrects the cells'
    /// estimates.
    fn learn_offset(&mut self, bank: &mut PackBank, now: Timestamp) {
        let configured_a = self.config.capacity.current_offset_std_a;
        let offset = self.state.learner.current_offset_mut();
        if configured_a > 0.0 {
            let deviations = offset.update(configured_a, bank.offset_evidence());
            bank.absorb_current_offset(deviations, offset.std_a(configured_a));
            offset.drift(self.state.offset_at.replace(now).map_or(0.0, |before| now.since(before)));
            bank.absorb_current_offset(0.0, offset.std_a(configured_a));
        }
    }

    /// Learns from a cell's half-cycle. `since_before_s`: time from the end of the previous half-cycle to the end of
    /// this one; `None` = unknown. Returns whether the half-cycle measured the cell's capacity.
    fn learn_cell(
        &mut self,
        index: usize,
        half_cycle: &HalfCycle,
        since_before_s: Option<f64>,
        bank: &mut PackBank,
        to: &mut Publisher<'_>,
    ) -> bool {
        let Self { config, state: LearningState { learner, .. }, cells, lives, .. } = self;
        let (health, life) = (&mut cells[index], &mut lives.cells[index]);
        if bank.soc(index).is_none() {
            life.learn(bank.model(index), config, half_cycle, since_before_s, None);
            return false;
        }
        let mut estimator = bank.cell(index);
        let update = learner.learn(bank.model(index), &config.capacity, index, &mut estimator, half_cycle);
        bank.put(index, &estimator);
        life.learn(bank.model(index), config, half_cycle, since_before_s, Some(&update));
        if half_cycle.mode == Mode::Charge && health.tapered {
            health.full_soc = half_cycle.end_soc.unwrap_or(health.full_soc);
        }
        // Discharges update the usable capacity. A charge only sets the first value, because a charge measures the
        // resistance to charging instead of discharging.
        let is_discharge = half_cycle.mode == Mode::Discharge;
        let is_restated = is_discharge || health.usable.is_none();
        if let Some(usable) = config.usable.as_ref().filter(|_| is_restated) {
            let (capacity, full_soc) = (update.capacity, health.full_soc);
            health.usable =
                Some(usable_capacity(bank.model(index), usable, (&estimator, bank.config(index)), capacity, full_soc));
        }
        health.throughput.add(half_cycle.mode, half_cycle.charge_ah, half_cycle.duration_s);
        let resistance = resistance(bank, index);
        if is_discharge {
            health.discharge_resistance = Some(resistance);
        }
        let (cell, usable) = (CellIndex(u16::try_from(index).unwrap_or(u16::MAX)), health.usable);
        to.event(half_cycle_event(cell, half_cycle));
        to.event(capacity_event(cell, health.recorded(update.capacity, resistance), &update));
        if self.state.learner.has_learned(index) {
            bank.model(index)
                .loss_modes(update.capacity)
                .iter()
                .for_each(|losses| to.event(losses_event(cell, losses)));
            let capacity = Observation { is_new: update.measurement.is_some(), ..learned(update.capacity) };
            to.observe(Rule::CapacityLow, Some(cell), capacity);
        }
        if let Some(usable) = usable.filter(|_| is_restated) {
            to.observe(Rule::UsableCapacityLow, Some(cell), learned(usable));
        }
        if is_discharge {
            to.observe(Rule::ResistanceHigh, Some(cell), learned(resistance));
        }
        update.measurement.is_some()
    }

    /// Handles a sample after its filter step: detects when a charge tapers off at the highest voltage.
    pub(crate) fn handle_sample(&mut self, sample: &CellSample, model: &CellModel) {
        let (Some(usable), Some(current_a)) = (&self.config.usable, sample.current_a) else { return };
        let is_tapering = current_a < 0.0 && -current_a <= usable.taper_current_a;
        if is_tapering && sample.voltage_v >= model.voltage_max_v - TAPER_BAND_V {
            self.cells[sample.cell.index()].tapered = true;
        }
    }

    /// Handles a reset of a cell's filter. The capacity becomes doubtful. The recharge timer restarts, because the
    /// reset changes the SOC without a flow of charge.
    pub(crate) fn handle_reset(&mut self, cell: CellIndex, bank: &mut PackBank) {
        self.state.recharge = RechargeTimer::default();
        let new_std_ah = bank.config(cell.index()).initial.capacity_std_ah;
        let mut estimator = bank.cell(cell.index());
        self.state.learner.doubt(&self.config.capacity, cell.index(), new_std_ah * new_std_ah, &mut estimator);
        bank.put(cell.index(), &estimator);
    }

    /// Combines the cells into the pack's values. If a charge has just passed the upper end of the recharge window (the
    /// SOC range `from_soc` to `to_soc`), records the raw, that is, measured recharge period. `all_fresh`: whether
    /// every cell's voltage is fresh.
    pub(crate) fn combine_pack(&mut self, all_fresh: bool, bank: &PackBank, to: &mut Publisher<'_>) {
        self.state.pack = if all_fresh { self.combined(bank) } else { None };
        let Some(pack) = self.state.pack else { return };
        let (config, mode) = (&self.config.recharge, self.mode());
        if let Some(seconds) = self.state.recharge.observe(config, to.now, mode, pack.soc) {
            self.state.recharge_period_s = Some(seconds);
            if config.alarm_on == RechargeAlarm::Raw {
                to.observe(Rule::RechargePeriodLow, None, Observation::new(Some(seconds)));
            }
        }
    }

    /// The pack's values from the latest estimates of its cells, at any age.
    fn combined(&self, bank: &PackBank) -> Option<PackState> {
        let cells = (0..u16::try_from(self.cells.len()).unwrap_or(u16::MAX)).map(CellIndex);
        pack::combine(cells.filter_map(|cell| {
            let (soc, capacity) = (bank.soc(cell.index())?, self.capacity(cell.index()));
            Some(CellShare { cell, soc, capacity })
        }))
    }

    /// Ends a charge and publishes its recharge periods: raw (as measured) and normalised (as with the reference
    /// charger). `has_learned`: whether the cells learned from the charge.
    fn finish_charge(&mut self, has_learned: bool, bank: &PackBank, to: &mut Publisher<'_>) {
        let config = &self.config.recharge;
        let charged = self.state.recharge.finish(config);
        let is_covered = charged.coverage >= config.min_coverage;
        let is_measured = is_covered && has_learned && self.state.learner.has_learned_all();
        let pack = if is_measured { self.combined(bank) } else { None };
        let normalised = pack.map(|pack| {
            let capacity = ScalarGaussian::from_std(pack.capacity_ah, pack.capacity_std_ah);
            normalised_period(config, capacity)
        });
        let normalised = normalised.filter(is_period);
        if charged.raw_s.is_none() && normalised.is_none() {
            return;
        }
        to.event(EventKind::RechargePeriod {
            seconds: charged.raw_s,
            normalised_s: normalised.map(|period| period.mean),
            normalised_std_s: normalised.as_ref().map(ScalarGaussian::std),
        });
        let Some(period) = normalised else { return };
        self.state.normalised_recharge = Some(period);
        if config.alarm_on == RechargeAlarm::Normalised {
            to.observe(Rule::RechargePeriodLow, None, learned(period));
        }
    }

    /// The last recharge period, raw or normalised as the rule requires.
    pub(crate) fn known_recharge_period(&self) -> Option<Observation> {
        match self.config.recharge.alarm_on {
            RechargeAlarm::Raw => self.state.recharge_period_s.map(|seconds| Observation::new(Some(seconds))),
            RechargeAlarm::Normalised => self.state.normalised_recharge.map(learned),
        }
    }

    /// Converts the recharge periods to another window or reference current. A period that cannot be converted exactly
    /// becomes unknown.
    pub(crate) fn restate_recharge(&mut self, old: &RechargeConfig) {
        let new = &self.config.recharge;
        if (old.from_soc, old.to_soc) != (new.from_soc, new.to_soc) {
            self.state.recharge.change_window();
            self.state.recharge_period_s = None;
        }
        // A normalised period is computed from the capacity, so it can be scaled to the new window and reference
        // current.
        let seconds_per_ah = |config: &RechargeConfig| (config.to_soc - config.from_soc) / config.reference_current_a;
        let ratio = seconds_per_ah(new) / seconds_per_ah(old);
        self.state.normalised_recharge = self
            .state
            .normalised_recharge
            .map(|period| ScalarGaussian { mean: ratio * period.mean, variance: ratio * ratio * period.variance })
            .filter(is_period);
    }

    /// The cell with the lowest capacity, and that capacity; `None` until every cell's capacity has been learned.
    pub(crate) fn weakest(&self) -> Option<(usize, ScalarGaussian)> {
        let capacities = (0..self.cells.len()).map(|index| (index, self.capacity(index)));
        capacities.min_by(|a, b| a.1.mean.total_cmp(&b.1.mean)).filter(|_| self.state.learner.has_learned_all())
    }

    /// Fields of the health frame: the worst value among the cells, and the losses of the weakest cell. Until every
    /// cell's capacity has been learned, only the raw recharge period is given.
    pub(crate) fn health_fields(&self, bank: &PackBank) -> HealthFields {
        let recharge_period_s = self.state.recharge_period_s;
        if !self.state.learner.has_learned_all() {
            return HealthFields { recharge_period_s, ..HealthFields::default() };
        }
        let weakest = self.weakest();
        let capacity = weakest.map(|(_, capacity)| capacity);
        let usable = self.cells.iter().filter_map(|cell| cell.usable).min_by(|a, b| a.mean.total_cmp(&b.mean));
        let log_resistance = (0..self.cells.len()).map(|cell| bank.log_resistance(cell).mean).max_by(f64::total_cmp);
        let life = self.lives.of_pack().map(|(_, life)| life);
        let cycles = life.and_then(|life| life.cycles);
        let losses = weakest.and_then(|(cell, capacity)| bank.model(cell).loss_modes(capacity));
        let part = |mode: fn(&LossModes) -> &ScalarGaussian| {
            let lost = losses.as_ref().map(mode);
            [lost.map(|lost| lost.mean), lost.map(ScalarGaussian::std)]
        };
        HealthFields {
            capacity_ah: capacity.map(|c| c.mean),
            capacity_std_ah: capacity.map(|c| c.std()),
            soh: weakest.map(|(cell, capacity)| capacity.mean / bank.model(cell).rated_capacity_ah),
            recharge_period_s,
            normalized_recharge_period_s: self.state.normalised_recharge.map(|period| period.mean),
            usable_capacity_ah: usable.map(|u| u.mean),
            usable_capacity_std_ah: usable.map(|u| u.std()),
            resistance_ratio: log_resistance.map(libm::exp),
            remaining_cycles: cycles.map(|cycles| cycles.median),
            remaining_cycles_low: cycles.map(|cycles| cycles.low),
            remaining_days: life.and_then(|life| life.days).map(|days| days.median),
            lli: part(|losses| &losses.lithium),
            lam_ne: part(|losses| &losses.negative),
            lam_pe: part(|losses| &losses.positive),
            ..HealthFields::default()
        }
    }
}

fn half_cycle_event(cell: CellIndex, half_cycle: &HalfCycle) -> EventKind {
    EventKind::HalfCycle {
        cell,
        mode: half_cycle.mode,
        charge_ah: half_cycle.charge_ah,
        swing: half_cycle.swing.map(|swing| swing.mean),
        swing_std: half_cycle.swing.as_ref().map(ScalarGaussian::std),
        duration_s: half_cycle.duration_s,
        mean_current_a: half_cycle.mean_current_a,
        mean_temperature_c: half_cycle.mean_temperature_c,
    }
}

fn losses_event(cell: CellIndex, losses: &LossModes) -> EventKind {
    EventKind::LossModes {
        cell,
        lli: losses.lithium.mean,
        lli_std: losses.lithium.std(),
        lam_ne: losses.negative.mean,
        lam_ne_std: losses.negative.std(),
        lam_pe: losses.positive.mean,
        lam_pe_std: losses.positive.std(),
    }
}

fn capacity_event(cell: CellIndex, values: RecordedValues, update: &CapacityUpdate) -> EventKind {
    EventKind::Capacity {
        cell,
        measured_ah: update.measurement.map(|z| z.value),
        measured_std_ah: update.measurement.map(|z| z.variance.sqrt()),
        values,
    }
}

impl CellHealth {
    /// The values that are recorded in the history and shown to readers.
    pub(crate) fn recorded(&self, capacity: ScalarGaussian, resistance: ScalarGaussian) -> RecordedValues {
        RecordedValues::default()
            .with(Quantity::Capacity, Some(capacity))
            .with(Quantity::UsableCapacity, self.usable)
            .with(Quantity::ResistanceRatio, Some(resistance))
    }
}

/// Checks that mean and variance are at least 0.
pub(crate) fn check_positive(what: &'static str, value: Option<ScalarGaussian>) -> Result<(), InvalidState> {
    let Some(ScalarGaussian { mean, variance }) = value else { return Ok(()) };
    InvalidState::unless_natural(what, mean)?;
    InvalidState::unless_natural(what, variance)
}
