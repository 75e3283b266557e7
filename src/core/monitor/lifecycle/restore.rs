//! Creates and restores snapshots of a monitor.

use crate::alarm::{AlarmSnapshot, StoredAlarm};
use crate::cell::CellEstimator;
use crate::filter::ScalarGaussian;
use crate::monitor::Monitor;
use crate::monitor::message::{Downtime, Event, EventKind, MERGE_TOLERANCE_NS, Outputs};
use crate::monitor::snapshot::{Beginning, PendingRestore, RestoreError, SNAPSHOT_VERSION, Snapshot};
use crate::monitor::stage::estimation::batch::CellBatch;
use crate::monitor::stage::learning::LearningState;
use crate::monitor::stage::learning::life::CellLife;
use crate::monitor::stage::modelling::ModellingState;
use crate::monitor::stage::sending::alarm_queue::AlarmKey;
use crate::monitor::stages::Stages;
use crate::monitor::stages::pack_memory::{StoredCell, StoredPack};
use crate::quantity::Timestamp;

/// Longest time without an input while a program runs and sends ticks (s). A longer gap is a restart, even if the
/// timestamps are on the same clock.
const BREAK_S: f64 = 30.0;

impl Monitor {
    /// The state to be stored.
    pub fn snapshot(&self) -> Snapshot {
        if let Some(PendingRestore { snapshot, .. }) = &self.pending {
            return (**snapshot).clone();
        }
        let Stages { sampling, estimation, modelling, learning, findings, alarming, sending, statistics, sleep, packs } =
            &self.stages;
        Snapshot {
            version: SNAPSHOT_VERSION,
            time: self.clock.now,
            may_continue: true,
            time_backwards: self.clock.time_backwards,
            intake: self.intake.snapshot(),
            sampling: sampling.snapshot(),
            estimation: estimation.snapshot(),
            cells: (0..estimation.cells()).map(|cell| self.stages.stored_cell(cell)).collect(),
            modelling: modelling.stored(),
            learning: learning.state.clone(),
            diagnosis: findings.stored(),
            thermal: findings.stored_thermal(),
            alarming: alarming.snapshot(),
            sending: sending.snapshot(),
            statistics: statistics.clone(),
            asleep_since: sleep.since,
            packs: packs.clone(),
        }
    }

    /// Restores a stored state in a monitor that has not received an input. The first input gives the present time; the
    /// snapshot was taken `downtime` before that time. The snapshot's timestamps are shifted to the clock of the
    /// present run, and the downtime counts as a gap.
    ///
    /// With [`Downtime::AsStamped`], the same clock continues. Frames, events and estimates are then equal, byte for
    /// byte, to the outputs of a monitor that had not stopped. They differ if the downtime exceeds half a minute, or if
    /// the state was stored [for a restart](Snapshot::for_restart).
    ///
    /// # Errors
    /// The snapshot's version, cells or branches do not fit, or a number in the snapshot is impossible. The monitor
    /// then uses nothing of the snapshot, because one damaged number casts doubt on the others.
    pub fn restore(&mut self, snapshot: Snapshot, downtime: Downtime) -> Result<(), RestoreError> {
        if snapshot.version != SNAPSHOT_VERSION {
            let found = snapshot.version;
            return Err(RestoreError::Unfit(format!(
                "snapshot has version {found}, this program reads version {SNAPSHOT_VERSION}"
            )));
        }
        let Stages { sampling, estimation, .. } = &self.stages;
        let (bank, cells) = (&estimation.bank, estimation.cells());
        let fits = snapshot.cells.len() == cells
            && snapshot.learning.learner.fits(cells)
            && sampling.sampler.fits(&snapshot.sampling.sampler)
            && snapshot.waiting_fits()
            && snapshot.cells.iter().enumerate().all(|(index, cell)| cell.fits(bank, index));
        if !fits {
            let (found, branches) = (snapshot.cells.len(), bank.own_model().branches.len());
            return Err(RestoreError::Unfit(format!(
                "snapshot does not fit: {found} cells (must be {cells}), another number of branches (must be \
                 {branches}), or samples of unknown cells"
            )));
        }
        snapshot.check()?;
        let config = sampling.sampler.config();
        snapshot.check_charges(config)?;
        self.pending = Some(PendingRestore { snapshot: Box::new(snapshot), downtime });
        Ok(())
    }

    /// If a snapshot is pending, continues from it and sets the clock to the time of the snapshot. The caller handles
    /// the downtime.
    pub(crate) fn apply_pending(&mut self, now: Timestamp, out: &mut Outputs) -> Beginning {
        let Some(PendingRestore { mut snapshot, downtime }) = self.pending.take() else { return Beginning::New };
        let is_brief = now.since(snapshot.time).abs() <= BREAK_S;
        if downtime == Downtime::AsStamped && snapshot.may_continue && is_brief {
            self.continue_from(*snapshot, now, out);
            return Beginning::Continued;
        }
        let taken = match downtime {
            Downtime::AsStamped if snapshot.time <= now.plus_nanos(MERGE_TOLERANCE_NS) => Some(snapshot.time.min(now)),
            Downtime::Seconds(seconds) => Some(now.plus_secs(-seconds)),
            Downtime::AsStamped | Downtime::Unknown => None,
        };
        snapshot.rebase(taken.unwrap_or(now).nanos().saturating_sub(snapshot.time.nanos()));
        let (buses, taken_at) = (std::mem::take(&mut snapshot.intake.buses), snapshot.time);
        snapshot.intake.buses = buses.restored(taken_at, now);
        if taken.is_none() {
            snapshot.sending.schedule.alarms.use_up(now);
        }
        self.continue_from(snapshot.for_restart(), now, out);
        if taken.is_some() { Beginning::Restored } else { Beginning::RestoredAgeless }
    }

    fn continue_from(&mut self, snapshot: Snapshot, now: Timestamp, out: &mut Outputs) {
        (self.clock.now, self.clock.time_backwards) = (snapshot.time, snapshot.time_backwards);
        self.intake.restore(snapshot.intake.clone());
        self.stages.restore(snapshot, now, out);
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
            forecast: learning.lives.cells[cell].forecast.clone(),
            updated_in_round: estimation.batch.has_reported(cell),
        }
    }

    fn restore(&mut self, snapshot: Snapshot, now: Timestamp, out: &mut Outputs) {
        let is_continued = snapshot.may_continue;
        let has_reported = snapshot.cells.iter().map(|cell| cell.updated_in_round).collect();
        let batch = CellBatch::restore(has_reported, snapshot.estimation.waiting);
        self.estimation.is_current_doubtful = snapshot.estimation.is_current_doubtful;
        self.estimation.was_current_doubtful = snapshot.estimation.was_current_doubtful;
        self.estimation.current_check = snapshot.estimation.current_check;
        self.restore_learned(&snapshot.cells, snapshot.modelling, snapshot.learning, batch);
        self.findings.restore(snapshot.diagnosis, (!is_continued).then_some((snapshot.time, now)));
        self.findings.restore_thermal(snapshot.thermal);
        self.note_faulty_channels();
        self.sampling.restore(snapshot.sampling);
        self.packs = snapshot.packs;
        let bank = &self.estimation.bank;
        self.packs.retain(|pack| pack.fits(bank));
        self.sending.schedule = snapshot.sending.schedule.clone();
        if !is_continued {
            self.sending.schedule.begin_freshness(now);
            self.sending.restore_silence(&snapshot.sending, snapshot.time, now);
            let was_asleep = snapshot.asleep_since.is_some();
            let after_s = self.sleep.after_s.filter(|_| !was_asleep).unwrap_or(0.0);
            self.sending.schedule.set_quiet_from(now.plus_secs(after_s));
        }
        self.sleep.since = snapshot.asleep_since;
        let stored = (!is_continued).then_some(snapshot.time);
        self.restore_alarms(now, &snapshot.alarming.alarms, stored, out);
        if is_continued {
            self.alarming.resume(&snapshot.alarming);
            self.sending.resume(&snapshot.sending);
        }
        self.statistics = snapshot.statistics;
        self.statistics.restores = self.statistics.restores.saturating_add(1);
    }

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
                // The module was replaced while the program did not run, so the stored values belong to the previous
                // cells.
                learning.state.learner.begin(&learning.config.capacity, index, estimation.bank.cell(index).capacity());
                continue;
            }
            learning.cells[index] = cell.health;
            learning.lives.cells[index] = CellLife::restore(cell.forecast.clone(), &learning.config);
            let branches = estimation.bank.model(index).branches.len();
            if let Some(estimator) = CellEstimator::restore(&cell.estimator, branches) {
                estimation.bank.put(index, &estimator);
            }
        }
        let is_of_other = |&own: &usize| estimation.is_of_other_model(own, &cells[own].model_check);
        let is_changed = modelling.is_label() && estimation.bank.own_cells().iter().any(is_of_other);
        let stored = cells.iter().map(|cell| (cell.consumed, cell.trusted, cell.model_check));
        estimation.restore(stored, batch);
        if is_changed {
            // A resistance is stored relative to its model. If the model now comes from another label or prior, the
            // stored resistance has no meaning.
            let capacity = learning.state.learner.capacity(estimation.bank.own_cells()[0]);
            let adoption = modelling.other_model_adoption(estimation.mean_estimate(), capacity);
            estimation.adopt(&adoption, &mut learning.state.learner, &learning.config.capacity);
        }
        let configured_a = learning.config.capacity.current_offset_std_a;
        estimation.bank.set_current_offset_std(learning.state.learner.current_offset().std_a(configured_a));
    }

    /// Learned values of the connected pack, with the pack's number.
    pub(crate) fn stored_pack(&self) -> StoredPack {
        let cells = 0..self.estimation.cells();
        let cells = cells.map(|cell| StoredCell { consumed: None, updated_in_round: false, ..self.stored_cell(cell) });
        let mut modelling = self.modelling.stored();
        modelling.iter_mut().for_each(ModellingState::restart);
        StoredPack {
            number: self.sampling.identity.known.unwrap_or(0.0),
            cells: cells.collect(),
            modelling,
            diagnosis: self.findings.stored(),
            learning: self.learning.state.learned_only(),
        }
    }

    /// Restores a previously connected pack after a time of unknown length.
    pub(crate) fn restore_pack(&mut self, now: Timestamp, pack: StoredPack, out: &mut Outputs) {
        let batch = CellBatch::new(pack.cells.len());
        self.restore_learned(&pack.cells, pack.modelling, pack.learning, batch);
        self.modelling.end_stretch();
        self.estimation.handle_unknown_gap();
        // Balancing while the pack was absent was not counted, so the differences between the cells' charges are
        // unknown.
        self.findings.restore(pack.diagnosis, Some((now, now)));
        self.findings.diagnosis.forget_charge();
        self.note_faulty_channels();
        let capacity = self.learning.weakest().map(|(_, capacity)| capacity);
        let kind = EventKind::PackReturned {
            identity: pack.number,
            capacity_ah: capacity.map(|capacity| capacity.mean),
            capacity_std_ah: capacity.as_ref().map(ScalarGaussian::std),
        };
        out.events.push(Event { time: now, kind });
        // The alarms of the previous pack have ended, so these values are new to the rules.
        self.restate_known(now, false, true, out);
        self.publisher(now, out).publish_alarms();
    }

    /// Restores the alarms that were stored at `stored`; `None` = the same run continues. Alarms without a configured
    /// threshold end, and receivers on the bus are notified.
    fn restore_alarms(&mut self, time: Timestamp, state: &AlarmSnapshot, stored: Option<Timestamp>, out: &mut Outputs) {
        self.alarming.state.knows_all_valid = false;
        let orphans = self.alarming.engine.restore(time, state);
        if let Some(stored) = stored {
            self.sending.compare_first(time);
            self.sending.skip_counters(stored, time, &self.alarming.engine);
        }
        let has_changed = stored.is_some() || !orphans.is_empty();
        for orphan in orphans {
            let StoredAlarm { rule, severity, cell, .. } = orphan;
            let (active, occurrences) = (orphan.is_raised(), orphan.occurrences());
            let kind = EventKind::AlarmDropped { rule, severity, cell, active, occurrences };
            out.events.push(Event { time, kind });
            self.sending.note_change(time, AlarmKey::new(rule, severity, cell));
        }
        if has_changed {
            self.sending.send_changed_alarms(time, &self.alarming.engine, out);
        }
    }
}
