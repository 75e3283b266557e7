//! The monitor's state as a versioned document: assembled from the stages' parts, checked, and restored.
//!
//! In: a [`Snapshot`], from a store or a file. Out: the monitor that continues from it at its first input, or the number
//! that is damaged. The JSON form of a snapshot is stored in the field: its names and their order do not change.

use serde::{Deserialize, Serialize};

use super::alarm_queue::AlarmKey;
use super::batch::CellBatch;
use super::buses::Buses;
use super::continuation::Continuation;
use super::estimation::Consumed;
use super::intake::IntakeState;
use super::learning::{CellHealth, LearningState, Throughput};
use super::life::CellLife;
use super::modelling::{ModelView, ModellingState};
use super::pack_memory::{PackMemory, StoredPack};
use super::sampling::Identity;
use super::sender::Schedule;
use super::stages::Stages;
use super::{Downtime, Event, EventKind, MERGE_TOLERANCE_NS, Monitor, Outputs, Statistics};
use crate::alarm::{AlarmSnapshot, StoredAlarm};
use crate::cell::{CellEstimator, CellModel, CellState, Label, ModelCheck, PackBank};
use crate::cell_faults::{CellFaultDetector, Imbalance, UnknownImbalance};
use crate::filter::ScalarGaussian;
use crate::health::{Axis, Forecast, HealthConfig, PackState};
use crate::quantity::{InvalidState, Timestamp, bounds};
use crate::sample::{CellSample, SampleConfig, SamplerState};

/// Charge of a stored state that no current moved.
const CHARGE: &str = "the charge since a cell's latest voltage or half-cycle";
/// Room for limits of the current that were wider when the charge was counted, and for a clock that was set.
const CHARGE_TOLERANCE: f64 = 2.0;
const CHARGE_TOLERANCE_S: f64 = 1000.0;

/// A longer time without an input, s, is a break of the program, whatever its stamps: a running one ticks.
const BREAK_S: f64 = 30.0;

/// Layout version of [`Snapshot`].
const SNAPSHOT_VERSION: u32 = 2;

/// State of a [`Monitor`] at one moment.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Snapshot {
    /// Layout version.
    pub version: u32,
    /// When it was taken, on the clock of the inputs.
    pub time: Timestamp,
    cells: Vec<StoredCell>,
    /// Samples without their step.
    #[serde(default)]
    waiting: Vec<CellSample>,
    sampler: SamplerState,
    #[serde(flatten)]
    learning: LearningState,
    /// For earlier programs; this one counts the cells that have reported.
    updated_cells: usize,
    time_backwards: u64,
    alarms: AlarmSnapshot,
    schedule: Schedule,
    #[serde(default)]
    intake: IntakeState,
    #[serde(default)]
    buses: Buses,
    #[serde(default)]
    identity: Identity,
    #[serde(default)]
    statistics: Statistics,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    modelling: Option<ModellingState>,
    /// `None` in states of earlier programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    diagnosis: Option<CellFaultDetector>,
    /// Since when the buses sleep.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    asleep_since: Option<Timestamp>,
    /// Packs that were connected before.
    #[serde(default, skip_serializing_if = "PackMemory::is_empty")]
    packs: PackMemory,
    /// `None` in states of earlier programs, and in those for a restart.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    continuation: Option<Box<Continuation>>,
}

/// One cell of a snapshot.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StoredCell {
    estimator: CellState,
    consumed: Option<Consumed>,
    trusted: bool,
    /// Ended in states of programs without one: an aged cell is not judged as a new one.
    #[serde(default = "ModelCheck::ended")]
    model_check: ModelCheck,
    #[serde(flatten)]
    pub(super) health: CellHealth,
    /// `None` in states of programs without forecasts: it begins with the next reading.
    #[serde(default)]
    forecast: Option<Forecast>,
    updated_in_round: bool,
}

/// Why a snapshot cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RestoreError {
    /// Written by another version, or taken with another configuration.
    #[error("{0}")]
    Unfit(String),
    /// A number in it is impossible: it is damaged.
    #[error("snapshot is damaged: {what}{} = {found:?}, must be {allowed}", .cell.map(|cell| format!(" (cell {cell})")).unwrap_or_default())]
    Number {
        /// Which number.
        what: &'static str,
        /// Of which cell, counted from 0, where it is of one.
        cell: Option<usize>,
        /// Its value.
        found: f64,
        /// Allowed values.
        allowed: &'static str,
    },
}

impl From<InvalidState> for RestoreError {
    fn from(InvalidState { what, found, allowed }: InvalidState) -> Self {
        Self::Number { what, cell: None, found, allowed }
    }
}

/// How a monitor began at its first input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Beginning {
    /// Without a stored state.
    New,
    /// With a state on the same clock: as if the program had not stopped.
    Continued,
    /// With a state that was taken at the clock's present time.
    Restored,
    /// With a state of unknown age.
    RestoredAgeless,
}

/// A restore that waits for the first input, which gives the present time.
#[derive(Debug)]
pub(super) struct PendingRestore {
    snapshot: Box<Snapshot>,
    downtime: Downtime,
}

impl Monitor {
    /// The state, to be stored.
    pub fn snapshot(&self) -> Snapshot {
        if let Some(PendingRestore { snapshot, .. }) = &self.pending {
            return (**snapshot).clone();
        }
        let Stages {
            sampling,
            estimation,
            modelling,
            learning,
            diagnosing,
            alarming,
            sender,
            statistics,
            sleep,
            packs,
        } = &self.stages;
        let (intake, buses) = self.intake.snapshot();
        Snapshot {
            version: SNAPSHOT_VERSION,
            time: self.clock.now,
            cells: (0..estimation.cells()).map(|cell| self.stages.stored_cell(cell)).collect(),
            waiting: estimation.batch.waiting.clone(),
            sampler: sampling.sampler.snapshot(),
            learning: learning.state.clone(),
            updated_cells: estimation.batch.reported,
            time_backwards: self.clock.time_backwards,
            alarms: alarming.engine.snapshot(),
            schedule: sender.schedule.clone(),
            intake,
            buses,
            identity: sampling.identity,
            statistics: statistics.clone(),
            modelling: modelling.stored(),
            diagnosis: diagnosing.stored(),
            asleep_since: sleep.since,
            packs: packs.clone(),
            continuation: Some(Box::new(self.continuation())),
        }
    }

    /// Restores a stored state in a monitor without any input yet. The first input gives the present time: the snapshot
    /// was taken `downtime` before it, its stamps are moved onto the present clock, and the downtime is a gap like any
    /// other. [`Downtime::AsStamped`] says that the same clock continues: then frames, events and estimates are, byte for byte,
    /// those of a monitor that had not stopped, unless half a minute is without an input or the state was stored
    /// [for a restart](Snapshot::for_restart).
    ///
    /// # Errors
    /// When the snapshot's version or shape does not fit, or a number in it is impossible. Then none of it is used: one
    /// damaged number leaves the others in doubt.
    pub fn restore(&mut self, snapshot: Snapshot, downtime: Downtime) -> Result<(), RestoreError> {
        if snapshot.version != SNAPSHOT_VERSION {
            let found = snapshot.version;
            return Err(RestoreError::Unfit(format!(
                "snapshot version {found}, this program reads {SNAPSHOT_VERSION}"
            )));
        }
        let Stages { sampling, estimation, .. } = &self.stages;
        let (bank, cells) = (&estimation.bank, estimation.cells());
        let fits = snapshot.cells.len() == cells
            && snapshot.learning.learner.fits(cells)
            && sampling.sampler.fits(&snapshot.sampler)
            && snapshot.waiting_fits()
            && snapshot.cells.iter().enumerate().all(|(index, cell)| cell.fits(bank, index));
        if !fits {
            let (found, branches) = (snapshot.cells.len(), bank.own_model().branches.len());
            return Err(RestoreError::Unfit(format!(
                "snapshot is of {found} cells, another number of branches, or samples of no cell, the configuration has \
                 {cells} cells of {branches} branches"
            )));
        }
        snapshot.check()?;
        let config = sampling.sampler.config();
        snapshot.check_charges(config)?;
        self.pending = Some(PendingRestore { snapshot: Box::new(snapshot), downtime });
        Ok(())
    }

    /// Continues from the waiting snapshot, if there is one; the clock then shows when it was taken. The downtime is left
    /// to the caller.
    pub(super) fn apply_pending(&mut self, now: Timestamp, out: &mut Outputs) -> Beginning {
        let Some(PendingRestore { mut snapshot, downtime }) = self.pending.take() else { return Beginning::New };
        let continuation = snapshot.continuation.take().filter(|_| now.since(snapshot.time).abs() <= BREAK_S);
        if let (Downtime::AsStamped, Some(continuation)) = (downtime, continuation) {
            (self.clock.now, self.clock.time_backwards) = (snapshot.time, snapshot.time_backwards);
            self.intake.restore(&snapshot.intake, std::mem::take(&mut snapshot.buses));
            self.stages.restore(*snapshot, now, true, out);
            self.resume(&continuation);
            return Beginning::Continued;
        }
        let taken = match downtime {
            Downtime::AsStamped if snapshot.time <= now.plus_nanos(MERGE_TOLERANCE_NS) => Some(snapshot.time.min(now)),
            Downtime::Seconds(seconds) => Some(now.plus_secs(-seconds)),
            Downtime::AsStamped | Downtime::Unknown => None,
        };
        snapshot.rebase(taken.unwrap_or(now).nanos().saturating_sub(snapshot.time.nanos()));
        (self.clock.now, self.clock.time_backwards) = (snapshot.time, snapshot.time_backwards);
        self.intake.restore(&snapshot.intake, std::mem::take(&mut snapshot.buses).restored(snapshot.time, now));
        self.intake.senders.restart();
        self.stages.restore(*snapshot, now, false, out);
        if taken.is_some() { Beginning::Restored } else { Beginning::RestoredAgeless }
    }
}

impl Stages {
    fn stored_cell(&self, cell: usize) -> StoredCell {
        let Self { estimation, learning, .. } = self;
        StoredCell {
            estimator: estimation.bank.cell(cell).snapshot(),
            consumed: estimation.consumed(cell),
            trusted: estimation.is_trusted(cell),
            model_check: estimation.model_check(cell),
            health: learning.cells[cell],
            forecast: Some(learning.lives.cells[cell].forecast.clone()),
            updated_in_round: estimation.batch.has_reported(cell),
        }
    }

    /// Continues from a checked and rebased snapshot. `is_continued`: without a break, so that no frame was missed.
    fn restore(&mut self, snapshot: Snapshot, now: Timestamp, is_continued: bool, out: &mut Outputs) {
        let has_reported = snapshot.cells.iter().map(|cell| cell.updated_in_round).collect();
        let batch = CellBatch::restore(has_reported, snapshot.waiting);
        self.restore_learned(&snapshot.cells, snapshot.modelling, snapshot.learning, batch);
        self.diagnosing.restore(snapshot.diagnosis, (!is_continued).then_some((snapshot.time, now)));
        self.note_faulty_channels();
        // Its shape is checked in `Monitor::restore`.
        self.sampling.sampler.restore(snapshot.sampler);
        self.sampling.identity = snapshot.identity;
        self.packs = snapshot.packs;
        let bank = &self.estimation.bank;
        self.packs.retain(|pack| pack.fits(bank));
        self.sender.schedule = snapshot.schedule;
        if !is_continued {
            self.sender.begin_freshness(now);
        }
        self.sleep.since = snapshot.asleep_since;
        self.restore_alarms(now, &snapshot.alarms, is_continued, out);
        self.statistics = snapshot.statistics;
        self.statistics.restores = self.statistics.restores.saturating_add(1);
    }

    /// Restores the cells' model, filters and learned values of all cells.
    fn restore_learned(
        &mut self,
        cells: &[StoredCell],
        model: Option<ModellingState>,
        state: LearningState,
        batch: CellBatch,
    ) {
        let Self { estimation, modelling, learning, .. } = self;
        if let Some(stored) = model {
            modelling.restore(stored);
            estimation.use_model(modelling, &state.learner);
        }
        learning.state = state;
        for (index, cell) in cells.iter().enumerate() {
            if estimation.is_other_cell(index, &cell.model_check) {
                // A module that was replaced while the program did not run: what is stored was of the cells before.
                learning.state.learner.begin(&learning.config.capacity, index, estimation.bank.cell(index).capacity());
                continue;
            }
            learning.cells[index] = cell.health;
            let model = estimation.bank.model(index);
            learning.lives.cells[index] = cell.life(model, &learning.config);
            if let Some(estimator) = CellEstimator::restore(&cell.estimator, model.branches.len()) {
                estimation.bank.put(index, &estimator);
            }
        }
        estimation.restore(cells.iter().map(|cell| (cell.consumed, cell.trusted, cell.model_check)), batch);
        // Earlier programs combined cells beyond empty and full.
        learning.state.pack = learning.state.pack.filter(|pack| (0.0..=1.0).contains(&pack.soc));
        let configured_a = learning.config.capacity.current_offset_std_a;
        estimation.bank.set_current_offset_std(learning.state.learner.current_offset().std_a(configured_a));
    }

    /// What is learned of the connected pack, under its number.
    pub(super) fn stored_pack(&self) -> StoredPack {
        let cells = 0..self.estimation.cells();
        let cells = cells.map(|cell| StoredCell { consumed: None, updated_in_round: false, ..self.stored_cell(cell) });
        StoredPack {
            number: self.sampling.identity.known.unwrap_or(0.0),
            cells: cells.collect(),
            modelling: self.modelling.stored(),
            diagnosis: self.diagnosing.stored(),
            learning: self.learning.state.learned_only(),
        }
    }

    /// Continues with a pack that was connected before, after a time of unknown length.
    pub(super) fn restore_pack(&mut self, now: Timestamp, pack: StoredPack, out: &mut Outputs) {
        let batch = CellBatch::new(pack.cells.len());
        self.restore_learned(&pack.cells, pack.modelling, pack.learning, batch);
        self.modelling.end_stretch();
        self.estimation.handle_unknown_gap();
        // Of the time since, no balancing is counted: the charge is forgotten.
        self.diagnosing.restore(pack.diagnosis, Some((now, now)));
        self.diagnosing.diagnosis.forget_charge();
        self.note_faulty_channels();
        let capacity = self.learning.weakest().map(|(_, capacity)| capacity);
        let kind = EventKind::PackReturned {
            identity: pack.number,
            capacity_ah: capacity.map(|capacity| capacity.mean),
            capacity_std_ah: capacity.as_ref().map(ScalarGaussian::std),
        };
        out.events.push(Event { time: now, kind });
        // The alarms of the pack that was here ended: these values are new to the rules.
        self.restate_known(now, false, true, out);
        self.publisher(now, out).publish_alarms();
    }

    /// Restores the stored alarms. Those without a configured threshold end, here and for their receivers on the bus.
    fn restore_alarms(&mut self, time: Timestamp, state: &AlarmSnapshot, is_continued: bool, out: &mut Outputs) {
        self.alarming.knows_all_valid = false;
        let orphans = self.alarming.engine.restore(state);
        if !is_continued {
            self.sender.compare_first(time);
            self.sender.skip_counters(time, &self.alarming.engine);
        }
        let has_changed = !is_continued || !orphans.is_empty();
        for orphan in orphans {
            let StoredAlarm { rule, severity, cell, .. } = orphan;
            let (active, occurrences) = (orphan.is_raised(), orphan.occurrences());
            let kind = EventKind::AlarmDropped { rule, severity, cell, active, occurrences };
            out.events.push(Event { time, kind });
            self.sender.note_change(time, AlarmKey::new(rule, severity, cell));
        }
        if has_changed {
            self.sender.send_changed_alarms(time, &self.alarming.engine, out);
        }
    }
}

impl StoredPack {
    /// Whether it is a pack of so many cells, each of so many branches.
    fn fits(&self, bank: &PackBank) -> bool {
        self.cells.len() == bank.cells()
            && self.learning.learner.fits(bank.cells())
            && self.cells.iter().enumerate().all(|(index, cell)| cell.fits(bank, index))
    }
}

impl Snapshot {
    /// The state without what holds only where the same clock continues: smaller, for a program that will be restarted.
    #[must_use]
    pub fn for_restart(self) -> Self {
        let mut diagnosis = self.diagnosis;
        diagnosis.iter_mut().for_each(CellFaultDetector::interrupt);
        Self { continuation: None, diagnosis, ..self }
    }

    /// What is known of single cells; `None` = the pack is too small for a comparison, or the state is of an earlier program.
    pub fn diagnosis(&self) -> Option<&CellFaultDetector> {
        self.diagnosis.as_ref()
    }

    /// What the differences between the cells cost the pack; `None` = without a diagnosis.
    pub fn imbalance(&self) -> Option<Result<Imbalance, UnknownImbalance>> {
        let mut capacities: Vec<ScalarGaussian> =
            (0..self.cells.len()).map(|cell| self.learning.learner.capacity(cell)).collect();
        capacities.sort_by(|a, b| a.mean.total_cmp(&b.mean));
        let middle = *capacities.get(capacities.len() / 2)?;
        Some(self.diagnosis.as_ref()?.imbalance(middle))
    }

    /// Half-cycles of all cells and packs since the first start.
    pub fn half_cycles(&self) -> u64 {
        self.statistics.learning.half_cycles
    }

    /// What each cell of the connected pack has moved; `None` = the state is of an earlier program.
    pub fn throughputs(&self) -> Option<Vec<Throughput>> {
        self.cells.iter().map(|cell| cell.health.throughput).collect()
    }

    /// Rated capacity of a cell in the configuration with which its record began, Ah; `None` = the state is of an earlier program.
    pub fn rated_capacity_ah(&self) -> Option<f64> {
        self.cells.first()?.forecast.as_ref().map(Forecast::reference_ah)
    }

    /// Number of cells that are estimated.
    pub fn cells(&self) -> usize {
        self.cells.len()
    }

    /// Parallel strings, and cells in series, of its configuration; `None` = the state is of an earlier program.
    pub fn wiring(&self) -> Option<(u16, u16)> {
        self.sampler.wiring()
    }

    /// What is known of the cells' model; `label` is that of the configuration, for a state without a fit. `None` = the state is of a
    /// model file, or the label is not known.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn model(&self, label: Option<Label>) -> Result<Option<ModelView<'_>>, RestoreError> {
        let Some(stored) = &self.modelling else { return Ok(None) };
        stored.check()?;
        Ok(stored.stored_view(label))
    }

    /// Whether the waiting samples are of its cells, each of another, and known to have come.
    fn waiting_fits(&self) -> bool {
        let mut has_come: Vec<bool> = self.cells.iter().map(|cell| cell.updated_in_round).collect();
        let mut is_first = |cell: usize| has_come.get_mut(cell).is_some_and(std::mem::take);
        self.waiting.iter().all(|sample| is_first(sample.cell.index()))
    }

    /// Checks that every number is possible.
    fn check(&self) -> Result<(), RestoreError> {
        for (cell, stored) in self.cells.iter().enumerate() {
            stored.check().map_err(|invalid| at_cell(cell, invalid))?;
        }
        self.waiting.iter().try_for_each(CellSample::check)?;
        self.modelling.iter().try_for_each(ModellingState::check)?;
        self.diagnosis.iter().try_for_each(|diagnosis| diagnosis.check(self.cells.len()))?;
        self.sampler.check()?;
        self.intake.commands.check_state()?;
        self.packs.check()?;
        // Stamps differ by what the clock's range holds.
        bounds::STAMP_NS.check("the time of the state, ns", self.time.nanos() as f64)?;
        Ok(self.learning.check()?)
    }

    /// Checks that the charge between a moment of the past and the state is one that the largest plausible current moves.
    /// Only its differences mean anything, so that each of both numbers alone may be what it likes.
    fn check_charges(&self, config: &SampleConfig) -> Result<(), RestoreError> {
        let (strings, limits) = (f64::from(config.strings.max(1)), &config.current);
        let most_a = limits.min.abs().max(limits.max.abs()) / strings;
        // A cell's latest voltage has taken in the current that was held until then.
        let charge_as = self.sampler.charge_as(self.time, limits.max_age_s) / strings;
        let check = |time: Timestamp, before_as: f64| {
            // The next reading replaces a current that was held for so long.
            let passed_s = self.time.since(time).abs() + limits.max_age_s + CHARGE_TOLERANCE_S;
            let moved_as = charge_as - before_as;
            let is_possible = moved_as.abs() <= CHARGE_TOLERANCE * most_a * passed_s;
            InvalidState::unless(is_possible, CHARGE, moved_as / 3600.0, "Ah that the largest plausible current moves")
        };
        for (cell, consumed) in self.cells.iter().enumerate().filter_map(|(i, cell)| Some((i, cell.consumed?))) {
            check(consumed.time, consumed.charge_as).map_err(|invalid| at_cell(cell, invalid))?;
        }
        Ok(self.learning.learner.marks().try_for_each(|(time, charge_as)| check(time, charge_as))?)
    }

    /// Moves every stamp by `by_nanos`.
    fn rebase(&mut self, by_nanos: i64) {
        self.time = self.time.plus_nanos(by_nanos);
        for consumed in self.cells.iter_mut().filter_map(|cell| cell.consumed.as_mut()) {
            consumed.time = consumed.time.plus_nanos(by_nanos);
        }
        self.waiting.iter_mut().for_each(|sample| sample.time = sample.time.plus_nanos(by_nanos));
        self.sampler.rebase(by_nanos);
        self.learning.rebase(by_nanos);
        self.diagnosis.iter_mut().for_each(|diagnosis| diagnosis.rebase(by_nanos));
        self.alarms.rebase(by_nanos);
        self.schedule.rebase(by_nanos);
        self.buses.rebase(by_nanos);
        self.intake.commands.rebase(by_nanos);
        self.asleep_since = self.asleep_since.map(|since| since.plus_nanos(by_nanos));
    }
}

impl LearningState {
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        self.learner.check()?;
        self.recharge.check()?;
        self.pack.iter().try_for_each(PackState::check)?;
        bounds::TIME_S.check_all("the recharge period", self.recharge_period_s)?;
        check_positive("the normalised recharge period", self.normalised_recharge)
    }
}

impl StoredCell {
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        self.estimator.check()?;
        self.model_check.check()?;
        bounds::STORED_SOC.check("the SOC of a full cell", self.health.full_soc)?;
        check_positive("the usable capacity", self.health.usable)?;
        check_positive("the resistance of discharge", self.health.discharge_resistance)?;
        if let Some(Throughput { charge_ah, charging_s, discharging_s }) = self.health.throughput {
            InvalidState::unless_natural("the charge moved", charge_ah)?;
            bounds::TIME_S.check_all("the time of charges and discharges", [charging_s, discharging_s])?;
        }
        self.forecast.iter().try_for_each(|forecast| forecast.check(Axis::Cycles))?;
        let Some(Consumed { charge_as, unmeasured_s, .. }) = self.consumed else { return Ok(()) };
        bounds::CHARGE_AS.check("the charge taken in", charge_as)?;
        bounds::TIME_S.check("the unmeasured time taken in", unmeasured_s)
    }

    /// Whether the filter has the branches of this cell of the bank; a module's may have been replaced.
    fn fits(&self, bank: &PackBank, index: usize) -> bool {
        !bank.is_own(index) || CellEstimator::restore(&self.estimator, bank.model(index).branches.len()).is_some()
    }

    fn life(&self, model: &CellModel, config: &HealthConfig) -> CellLife {
        let forecast = self.forecast.clone();
        forecast.map_or_else(|| CellLife::new(model, config), |forecast| CellLife::restore(forecast, config))
    }
}

fn at_cell(cell: usize, InvalidState { what, found, allowed }: InvalidState) -> RestoreError {
    RestoreError::Number { what, cell: Some(cell), found, allowed }
}

/// Checks that mean and variance are 0 or more.
fn check_positive(what: &'static str, value: Option<ScalarGaussian>) -> Result<(), InvalidState> {
    let Some(ScalarGaussian { mean, variance }) = value else { return Ok(()) };
    InvalidState::unless_natural(what, mean)?;
    InvalidState::unless_natural(what, variance)
}
