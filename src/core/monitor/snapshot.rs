//! The Monitor's state as a versioned document, and how it is taken up again.

use serde::{Deserialize, Serialize};

use super::buses::Buses;
use super::cyclic::Schedule;
use super::identity::Identity;
use super::intake::IntakeState;
use super::life::CellLife;
use super::steps::CellBatch;
use super::{
    CellSlot, Consumed, Downtime, Event, EventKind, MERGE_TOLERANCE_NS, Monitor, MonitorConfig, Outputs, Statistics,
};
use crate::alarm::{AlarmState, StoredAlarm};
use crate::cell::{CellEstimator, CellState};
use crate::filter::ScalarGaussian;
use crate::health::{Axis, Forecast, Learner, PackState, RechargeTimer, TransitionDetector};
use crate::quantity::{InvalidState, Timestamp};
use crate::sample::{CellSample, SamplerState};

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
    cells: Vec<CellDocument>,
    /// Samples whose step was not made yet.
    #[serde(default)]
    waiting: Vec<CellSample>,
    sampler: SamplerState,
    detector: TransitionDetector,
    learner: Learner,
    #[serde(default)]
    learned_at: Option<Timestamp>,
    recharge: RechargeTimer,
    recharge_period_s: Option<f64>,
    #[serde(default)]
    normalised_recharge: Option<ScalarGaussian>,
    pack: Option<PackState>,
    /// For programs before this one; here the cells that have reported are counted.
    updated_cells: usize,
    time_backwards: u64,
    alarms: AlarmState,
    schedule: Schedule,
    #[serde(default)]
    intake: IntakeState,
    #[serde(default)]
    buses: Buses,
    #[serde(default)]
    identity: Identity,
    #[serde(default)]
    statistics: Statistics,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CellDocument {
    estimator: CellState,
    consumed: Option<Consumed>,
    trusted: bool,
    full_soc: f64,
    tapered: bool,
    usable: Option<ScalarGaussian>,
    #[serde(default)]
    discharge_resistance: Option<ScalarGaussian>,
    /// A state of before there were forecasts has none: it begins with the next reading.
    #[serde(default)]
    forecast: Option<Forecast>,
    updated_in_round: bool,
}

/// Why a snapshot cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RestoreError {
    /// Written by another version.
    #[error("snapshot version {found}, this program reads {allowed}")]
    Version {
        /// In the file.
        found: u32,
        /// Readable here.
        allowed: u32,
    },
    /// Taken with another configuration.
    #[error("snapshot is of {found}, the configuration has {allowed}")]
    Shape {
        /// In the file.
        found: String,
        /// Configured.
        allowed: String,
    },
    /// A number in it cannot be: it is damaged.
    #[error("snapshot is damaged: {what}{} = {found:?}, must be {allowed}", .cell.map(|cell| format!(" (cell {cell})")).unwrap_or_default())]
    Number {
        /// Which number.
        what: &'static str,
        /// Of which cell, counted from 0, where it is of one.
        cell: Option<usize>,
        /// What it is.
        found: f64,
        /// What it may be.
        allowed: &'static str,
    },
}

impl From<InvalidState> for RestoreError {
    fn from(InvalidState { what, found, allowed }: InvalidState) -> Self {
        Self::Number { what, cell: None, found, allowed }
    }
}

/// What became of a restore that waited.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Taken {
    /// There was none.
    Nothing,
    /// The state is taken up, and was taken at `Monitor::now`.
    Aged,
    /// The state is taken up, but nobody knows when it was taken.
    Ageless,
}

/// A restore that waits for the first input, whose time is "now".
#[derive(Debug)]
pub(super) struct PendingRestore {
    snapshot: Box<Snapshot>,
    away: Downtime,
}

impl Monitor {
    /// The state, to be stored.
    pub fn snapshot(&self) -> Snapshot {
        if let Some(PendingRestore { snapshot, .. }) = &self.pending {
            return (**snapshot).clone();
        }
        Snapshot {
            version: SNAPSHOT_VERSION,
            time: self.now,
            cells: (0..self.cells.len()).map(|cell| self.document(cell)).collect(),
            waiting: self.round.waiting.clone(),
            sampler: self.sampler.snapshot(),
            detector: self.detector.clone(),
            learner: self.learner.clone(),
            learned_at: self.learned_at,
            recharge: self.recharge.clone(),
            recharge_period_s: self.recharge_period_s,
            normalised_recharge: self.normalised_recharge,
            pack: self.pack,
            updated_cells: self.round.reported(),
            time_backwards: self.time_backwards,
            alarms: self.alarms.snapshot(),
            schedule: self.schedule.clone(),
            intake: self.intake.snapshot(),
            buses: self.buses.clone(),
            identity: self.identity,
            statistics: self.statistics.clone(),
        }
    }

    /// Takes up a stored state in a monitor that has had no input yet. The first input's time is "now": the
    /// snapshot was taken `away` before it, its stamps are moved onto the present clock, and the time away is a gap like
    /// any other.
    ///
    /// # Errors
    /// When the snapshot's version or shape does not fit, or a number in it cannot be. Then none of it is used: where one
    /// number is damaged nobody knows which others are.
    pub fn restore(&mut self, snapshot: Snapshot, away: Downtime) -> Result<(), RestoreError> {
        if snapshot.version != SNAPSHOT_VERSION {
            return Err(RestoreError::Version { found: snapshot.version, allowed: SNAPSHOT_VERSION });
        }
        let branches = self.config.model.branches.len();
        let fits = snapshot.cells.len() == self.cells.len()
            && snapshot.learner.fits(self.cells.len())
            && self.sampler.fits(&snapshot.sampler)
            && snapshot.waiting_fits()
            && snapshot.cells.iter().all(|cell| CellEstimator::restore(&cell.estimator, branches).is_some());
        if !fits {
            return Err(RestoreError::Shape {
                found: format!("{} cells, another number of branches, or samples of no cell", snapshot.cells.len()),
                allowed: format!("{} cells of {branches} branches", self.cells.len()),
            });
        }
        snapshot.check()?;
        self.pending = Some(PendingRestore { snapshot: Box::new(snapshot), away });
        Ok(())
    }

    /// Takes the waiting snapshot up, if there is one; `self.now` becomes when it was taken, on the present clock.
    pub(super) fn apply_pending(&mut self, now: Timestamp, out: &mut Outputs) -> Taken {
        let Some(PendingRestore { mut snapshot, away }) = self.pending.take() else { return Taken::Nothing };
        let taken = match away {
            Downtime::AsStamped if snapshot.time <= now.plus_nanos(MERGE_TOLERANCE_NS) => Some(snapshot.time.min(now)),
            Downtime::Seconds(away_s) => Some(now.plus_secs(-away_s)),
            Downtime::AsStamped | Downtime::Unknown => None,
        };
        let outcome = if taken.is_some() { Taken::Aged } else { Taken::Ageless };
        let taken = taken.unwrap_or(now);
        let by_nanos = taken.nanos().saturating_sub(snapshot.time.nanos());
        snapshot.rebase(by_nanos);
        let branches = self.config.model.branches.len();
        for (cell, document) in snapshot.cells.iter().enumerate() {
            self.cells[cell].take_up(document, &self.config);
            self.progress[cell].consumed = document.consumed;
            if let Some(estimator) = CellEstimator::restore(&document.estimator, branches) {
                self.estimators.put(cell, &estimator);
            }
        }
        let has_reported = snapshot.cells.iter().map(|cell| cell.updated_in_round).collect();
        self.round = CellBatch::resume(has_reported, snapshot.waiting);
        self.all_trusted = self.cells.iter().all(|cell| cell.trusted);
        // Checked in `restore`.
        let _ = self.sampler.restore(&snapshot.sampler);
        self.detector = snapshot.detector;
        self.learner = snapshot.learner;
        self.learned_at = snapshot.learned_at;
        self.recharge = snapshot.recharge;
        self.recharge_period_s = snapshot.recharge_period_s;
        self.normalised_recharge = snapshot.normalised_recharge;
        self.pack = snapshot.pack;
        self.time_backwards = snapshot.time_backwards;
        self.schedule = snapshot.schedule;
        self.restore_alarms(now, &snapshot.alarms, out);
        self.intake.restore(&snapshot.intake);
        self.identity = snapshot.identity;
        self.buses = snapshot.buses.taken_up(snapshot.time, now);
        self.statistics = snapshot.statistics;
        self.statistics.restores += 1;
        // From here the time away is a gap like any other.
        self.now = snapshot.time;
        outcome
    }
}

impl Monitor {
    /// Takes the stored alarms up. Those that nothing watches any more end, here and for whoever saw them on the bus.
    fn restore_alarms(&mut self, time: Timestamp, state: &AlarmState, out: &mut Outputs) {
        self.all_valid_told = false;
        for orphan in self.alarms.restore(state) {
            let StoredAlarm { rule, severity, cell, .. } = orphan;
            let (active, occurrences) = (orphan.is_raised(), orphan.occurrences());
            out.events
                .push(Event { time, kind: EventKind::AlarmDropped { rule, severity, cell, active, occurrences } });
            self.send_alarm_end(rule, severity, cell, out);
        }
    }
}

impl Snapshot {
    /// Whether the samples that wait are of its cells, each of another, and known to have come.
    fn waiting_fits(&self) -> bool {
        let mut has_come: Vec<bool> = self.cells.iter().map(|cell| cell.updated_in_round).collect();
        let mut is_first = |cell: usize| has_come.get_mut(cell).is_some_and(std::mem::take);
        self.waiting.iter().all(|sample| is_first(sample.cell.index()))
    }

    /// Whether its numbers can be gone on with.
    fn check(&self) -> Result<(), RestoreError> {
        for (cell, document) in self.cells.iter().enumerate() {
            let at_cell =
                |InvalidState { what, found, allowed }| RestoreError::Number { what, cell: Some(cell), found, allowed };
            document.check().map_err(at_cell)?;
        }
        self.waiting.iter().try_for_each(CellSample::check)?;
        self.sampler.check()?;
        self.learner.check()?;
        self.recharge.check()?;
        self.pack.iter().try_for_each(PackState::check)?;
        InvalidState::unless_natural("the recharge period", self.recharge_period_s.unwrap_or(0.0))?;
        Ok(check_belief("the normalised recharge period", self.normalised_recharge)?)
    }

    /// Moves every stamp by `by_nanos`.
    fn rebase(&mut self, by_nanos: i64) {
        self.time = self.time.plus_nanos(by_nanos);
        for consumed in self.cells.iter_mut().filter_map(|cell| cell.consumed.as_mut()) {
            consumed.time = consumed.time.plus_nanos(by_nanos);
        }
        self.waiting.iter_mut().for_each(|sample| sample.time = sample.time.plus_nanos(by_nanos));
        self.sampler.rebase(by_nanos);
        self.detector.rebase(by_nanos);
        self.learner.rebase(by_nanos);
        self.learned_at = self.learned_at.map(|at| at.plus_nanos(by_nanos));
        self.recharge.rebase(by_nanos);
        self.alarms.rebase(by_nanos);
        self.schedule.rebase(by_nanos);
        self.buses.rebase(by_nanos);
    }
}

impl CellDocument {
    fn check(&self) -> Result<(), InvalidState> {
        self.estimator.check()?;
        InvalidState::unless_number("the SOC of a full cell", self.full_soc)?;
        check_belief("the usable capacity", self.usable)?;
        check_belief("the resistance of discharge", self.discharge_resistance)?;
        self.forecast.iter().try_for_each(|forecast| forecast.check(Axis::Cycles))?;
        let Some(Consumed { charge_as, unmeasured_s, .. }) = self.consumed else { return Ok(()) };
        InvalidState::unless_number("the charge taken in", charge_as)?;
        InvalidState::unless_number("the unmeasured time taken in", unmeasured_s)
    }
}

/// A mean that is not below 0, and its variance.
fn check_belief(what: &'static str, belief: Option<ScalarGaussian>) -> Result<(), InvalidState> {
    let Some(ScalarGaussian { mean, variance }) = belief else { return Ok(()) };
    InvalidState::unless_natural(what, mean)?;
    InvalidState::unless_natural(what, variance)
}

impl Monitor {
    fn document(&self, cell: usize) -> CellDocument {
        let slot = &self.cells[cell];
        CellDocument {
            estimator: self.estimators.cell(cell).snapshot(),
            consumed: self.progress[cell].consumed,
            trusted: slot.trusted,
            full_soc: slot.full_soc,
            tapered: slot.tapered,
            usable: slot.usable,
            discharge_resistance: slot.discharge_resistance,
            forecast: Some(slot.life.forecast.clone()),
            updated_in_round: self.round.has_reported(cell),
        }
    }
}

impl CellSlot {
    fn take_up(&mut self, document: &CellDocument, config: &MonitorConfig) {
        self.trusted = document.trusted;
        self.full_soc = document.full_soc;
        self.tapered = document.tapered;
        self.usable = document.usable;
        self.discharge_resistance = document.discharge_resistance;
        let forecast = document.forecast.clone();
        self.life = forecast.map_or_else(|| CellLife::new(config), |forecast| CellLife::of(forecast, config));
    }
}
