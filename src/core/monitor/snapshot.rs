//! The stored state of the monitor: contents and checks.
//!
//! In: a [`Snapshot`] from a store or a file. Out: a monitor that continues from the snapshot at its first input, or
//! the reason why the snapshot cannot be used. Vehicles store snapshots as JSON, so names and order of the fields must
//! not change.

use serde::{Deserialize, Serialize};

use crate::alarm::AlarmChange;
use crate::cell::Label;
use crate::cell_faults::thermal_event::ThermalWatch;
use crate::cell_faults::{CellFaultDetector, Imbalance, UnknownImbalance};
use crate::filter::ScalarGaussian;
use crate::health::UseRecord;
use crate::monitor::message::Downtime;
use crate::monitor::stage::alarming::StoredAlarming;
use crate::monitor::stage::estimation::EstimationState;
use crate::monitor::stage::intake::IntakeState;
use crate::monitor::stage::learning::{LearningState, Throughput};
use crate::monitor::stage::modelling::{ModelView, ModellingState};
use crate::monitor::stage::sampling::SamplingState;
use crate::monitor::stage::sending::SendingState;
use crate::monitor::stage::statistics::Statistics;
use crate::monitor::stages::pack_memory::{PackMemory, StoredCell};
use crate::quantity::{InvalidState, Timestamp, bounds};
use crate::sample::{CellSample, SampleConfig};

/// Name of the charge that [`Snapshot::check_charges`] checks, for error messages.
const CHARGE: &str = "the charge since a cell's latest voltage or half-cycle";
/// Factor by which a charge may exceed the largest plausible charge, because the configured limits of the current may
/// have been wider when the charge was counted.
const CHARGE_TOLERANCE: f64 = 2.0;
/// Tolerance of the time during which a charge has moved (s), because the clock may have been set in this time.
const CHARGE_TOLERANCE_S: f64 = 1000.0;

pub(crate) const SNAPSHOT_VERSION: u32 = 1;

/// State of a [`Monitor`](crate::monitor::Monitor) at one moment: the states of its stages.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Snapshot {
    /// Layout version.
    pub version: u32,
    /// Time of the snapshot, on the clock of the inputs.
    pub time: Timestamp,
    /// Whether a monitor may continue from this state on the same clock, as if the program had not stopped. `false` if
    /// the snapshot was made [for a restart](Self::for_restart).
    pub(crate) may_continue: bool,
    pub(crate) time_backwards: u64,
    pub(crate) intake: IntakeState,
    pub(crate) sampling: SamplingState,
    pub(crate) estimation: EstimationState,
    pub(crate) cells: Vec<StoredCell>,
    /// State of the modelling stage; `None` if the cell model comes from a model file.
    pub(crate) modelling: Option<ModellingState>,
    pub(crate) learning: LearningState,
    /// State of the cell-fault detector; `None` if the pack is too small for a comparison.
    pub(crate) diagnosis: Option<CellFaultDetector>,
    /// State of the thermal-event detector; `None` if its alarm rule is not configured, and in a state for a restart.
    pub(crate) thermal: Option<ThermalWatch>,
    pub(crate) alarming: StoredAlarming,
    pub(crate) sending: SendingState,
    pub(crate) statistics: Statistics,
    /// Start of the present bus sleep; `None` if the buses are awake.
    pub(crate) asleep_since: Option<Timestamp>,
    pub(crate) packs: PackMemory,
}

/// Reason why a snapshot cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RestoreError {
    /// The snapshot was written by another version or with another configuration.
    #[error("{0}")]
    Unfit(String),
    /// A number in the snapshot is impossible, so the snapshot is damaged.
    #[error("snapshot is damaged: {what}{} = {found:?}, must be {allowed}", .cell.map(|cell| format!(" (cell {cell})")).unwrap_or_default())]
    Number {
        what: &'static str,
        /// Cell, counted from 0; `None` if the number does not belong to a single cell.
        cell: Option<usize>,
        found: f64,
        allowed: &'static str,
    },
}

impl From<InvalidState> for RestoreError {
    fn from(InvalidState { what, found, allowed }: InvalidState) -> Self {
        Self::Number { what, cell: None, found, allowed }
    }
}

/// How a monitor started at its first input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Beginning {
    /// The monitor had no stored state.
    New,
    /// The monitor continued from a state on the same clock, as if the program had not stopped.
    Continued,
    /// The monitor restored a state of known age.
    Restored,
    /// The monitor restored a state of unknown age.
    RestoredAgeless,
}

/// A restore that waits for the first input, which gives the present time.
#[derive(Debug)]
pub(crate) struct PendingRestore {
    pub(crate) snapshot: Box<Snapshot>,
    pub(crate) downtime: Downtime,
}

impl Snapshot {
    /// Drops everything that is valid only if the same clock continues. A program stores this smaller snapshot before
    /// it restarts.
    #[must_use]
    pub fn for_restart(self) -> Self {
        let mut restarted = Self { may_continue: false, ..self };
        restarted.intake.restart();
        restarted.sampling.restart();
        restarted.estimation.is_current_doubtful = false;
        restarted.learning.load.interrupt();
        restarted.learning.moved = restarted.learning.moved.interrupted();
        restarted.estimation.current_check.interrupt();
        restarted.modelling.iter_mut().for_each(ModellingState::restart);
        restarted.diagnosis.iter_mut().for_each(CellFaultDetector::interrupt);
        restarted.thermal = None;
        restarted.alarming.restart();
        restarted.sending.restart(restarted.time);
        restarted.packs.drop_aside();
        restarted
    }

    /// Applies the alarm changes that were recorded after the snapshot was taken.
    pub fn repeat_alarms(&mut self, changes: &[(Timestamp, AlarmChange)]) {
        changes.iter().for_each(|(time, change)| self.alarming.alarms.repeat(*time, change));
    }

    /// State of the cell-fault detector; `None` if the pack is too small for a comparison.
    pub fn diagnosis(&self) -> Option<&CellFaultDetector> {
        self.diagnosis.as_ref()
    }

    /// Capacity that the pack loses because its cells differ; `None` without a cell-fault detector.
    pub fn imbalance(&self) -> Option<Result<Imbalance, UnknownImbalance>> {
        let mut capacities: Vec<ScalarGaussian> =
            (0..self.cells.len()).map(|cell| self.learning.learner.capacity(cell)).collect();
        capacities.sort_by(|a, b| a.mean.total_cmp(&b.mean));
        let middle = *capacities.get(capacities.len() / 2)?;
        Some(self.diagnosis.as_ref()?.imbalance(middle))
    }

    /// Number of half-cycles since the first start, summed over all cells and packs.
    pub fn half_cycles(&self) -> u64 {
        self.statistics.learning.half_cycles
    }

    /// Throughput of each cell of the connected pack.
    pub fn throughputs(&self) -> Vec<Throughput> {
        self.cells.iter().map(|cell| cell.health.throughput).collect()
    }

    /// How the connected pack was used.
    pub fn use_record(&self) -> &UseRecord {
        self.learning.use_counter.record()
    }

    /// Rated capacity (Ah) that was configured when the life forecast of the first cell started; `None` without cells.
    pub fn rated_capacity_ah(&self) -> Option<f64> {
        self.cells.first().map(|cell| cell.forecast.reference_ah())
    }

    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.cells.len()
    }

    /// Number of parallel strings, and number of cells in series.
    pub fn wiring(&self) -> (u16, u16) {
        self.sampling.sampler.wiring()
    }

    /// State of the cell model. If the stored state contains no fitted model, the configured `label` is used. Returns
    /// `None` if the model comes from a model file, or if the label is unknown.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn model(&self, label: Option<Label>) -> Result<Option<ModelView<'_>>, RestoreError> {
        let Some(stored) = &self.modelling else { return Ok(None) };
        stored.check()?;
        Ok(stored.stored_view(label))
    }

    /// Whether the samples of the unfinished batch (waiting samples) fit the snapshot: each cell has at most one
    /// waiting sample, and every cell with a waiting sample exists and is marked as updated in this batch.
    pub(crate) fn waiting_fits(&self) -> bool {
        let mut has_come: Vec<bool> = self.cells.iter().map(|cell| cell.updated_in_round).collect();
        let mut is_first = |cell: usize| has_come.get_mut(cell).is_some_and(std::mem::take);
        self.estimation.waiting.iter().all(|sample| is_first(sample.cell.index()))
    }

    pub(crate) fn check(&self) -> Result<(), RestoreError> {
        for (cell, stored) in self.cells.iter().enumerate() {
            stored.check().map_err(|invalid| at_cell(cell, invalid))?;
        }
        self.estimation.waiting.iter().try_for_each(CellSample::check)?;
        self.estimation.current_check.check()?;
        self.modelling.iter().try_for_each(ModellingState::check)?;
        self.diagnosis.iter().try_for_each(|diagnosis| diagnosis.check(self.cells.len()))?;
        self.thermal.iter().try_for_each(ThermalWatch::check)?;
        self.sampling.sampler.check()?;
        self.intake.commands.check_state()?;
        self.packs.check()?;
        // The limit on the time prevents an overflow when two times are subtracted.
        bounds::STAMP_NS.check("the time of the state, ns", self.time.nanos() as f64)?;
        Ok(self.learning.check()?)
    }

    /// Checks the charge that moved between each mark (a cell's latest voltage or half-cycle) and the time of the
    /// state. The largest plausible current must be able to move this charge. Only differences are checked, because the
    /// absolute charges are arbitrary.
    pub(crate) fn check_charges(&self, config: &SampleConfig) -> Result<(), RestoreError> {
        let (strings, limits) = (f64::from(config.strings.max(1)), &config.current);
        let most_a = limits.min.abs().max(limits.max.abs()) / strings;
        // The charge that is stored with a cell's latest voltage was counted as if the latest current had flowed until
        // that voltage. Count in the same way up to the time of the state.
        let charge_as = self.sampling.sampler.charge_as(self.time, limits.max_age_s) / strings;
        let check = |time: Timestamp, before_as: f64| {
            // The sampler may have held a current for `max_age_s` before the next reading replaced it.
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

    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.time = self.time.plus_nanos(by_nanos);
        for consumed in self.cells.iter_mut().filter_map(|cell| cell.consumed.as_mut()) {
            consumed.time = consumed.time.plus_nanos(by_nanos);
        }
        self.estimation.current_check.rebase(by_nanos);
        self.estimation.waiting.iter_mut().for_each(|sample| sample.time = sample.time.plus_nanos(by_nanos));
        self.sampling.sampler.rebase(by_nanos);
        self.learning.rebase(by_nanos);
        self.diagnosis.iter_mut().for_each(|diagnosis| diagnosis.rebase(by_nanos));
        self.alarming.alarms.rebase(by_nanos);
        self.sending.rebase(by_nanos);
        self.intake.buses.rebase(by_nanos);
        self.intake.commands.rebase(by_nanos);
        self.asleep_since = self.asleep_since.map(|since| since.plus_nanos(by_nanos));
    }
}

fn at_cell(cell: usize, InvalidState { what, found, allowed }: InvalidState) -> RestoreError {
    RestoreError::Number { what, cell: Some(cell), found, allowed }
}
