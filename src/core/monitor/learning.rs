//! Transitions and what follows from them: half-cycles, capacities, usable capacities, recharge periods, and the
//! pack's values.

use super::alarms::learned;
use super::{Event, EventKind, Monitor, Outputs, end_state};
use crate::alarm::{Observation, Rule};
use crate::filter::ScalarGaussian;
use crate::health::recharge::normalised_period;
use crate::health::usable::usable_capacity;
use crate::health::{CapacityUpdate, CellShare, HalfCycle, ModeChange, PackState, RechargeAlarm, pack};
use crate::quantity::{CellIndex, Mode};
use crate::sample::CellSample;

/// Below the model's highest voltage by this, a charge is in its constant-voltage part, V.
const TAPER_BAND_V: f64 = 0.03;

impl Monitor {
    /// Takes the pack current into the mode detector; `None` = stale.
    pub(super) fn observe_current(&mut self, current_a: Option<f64>, out: &mut Outputs) {
        let observed = self.detector.observe(&self.config.health.transition, self.now, current_a);
        if observed.change.is_some() || observed.candidate_begins {
            self.make_steps(out);
        }
        if let Some(change) = observed.change {
            self.complete_mode(change, out);
        }
        if observed.candidate_begins {
            let (charge_as, _) = self.sampler.counted(self.now);
            let estimators = &self.estimators;
            self.learner.mark_candidate(self.now, charge_as, |cell| end_state(estimators, cell));
        }
    }

    /// A mode is over: its half-cycle, if it was one, teaches every cell.
    pub(super) fn complete_mode(&mut self, change: ModeChange, out: &mut Outputs) {
        out.events.push(Event { time: self.now, kind: EventKind::Mode { from: change.from, to: change.to } });
        let mut half_cycles = std::mem::take(&mut self.scratch.half_cycles);
        let rated_ah = self.config.model.rated_capacity_ah;
        self.learner.complete(&self.config.health.transition, rated_ah, change.from, &mut half_cycles);
        let life_before = self.pack_remaining_life();
        let since_before_s = self.learned_at.map(|before| self.now.since(before));
        let mut is_new = false;
        for (index, half_cycle) in half_cycles.iter().enumerate() {
            is_new |= self.learn_cell(index, half_cycle, since_before_s, out);
        }
        if change.from == Mode::Charge {
            self.finish_charge(!half_cycles.is_empty(), out);
        }
        if !half_cycles.is_empty() {
            self.learner.finish();
            self.learned_at = Some(self.now);
            self.tell_life(life_before.is_some(), is_new, out);
            half_cycles.clear();
        }
        self.scratch.half_cycles = half_cycles;
        if change.to == Mode::Charge {
            self.cells.iter_mut().for_each(|cell| cell.tapered = false);
        }
    }

    /// What a half-cycle teaches a cell, so long after the one before (`None` = not known); whether its capacity was measured.
    fn learn_cell(
        &mut self,
        index: usize,
        half_cycle: &HalfCycle,
        since_before_s: Option<f64>,
        out: &mut Outputs,
    ) -> bool {
        let cell = CellIndex(u16::try_from(index).unwrap_or(u16::MAX));
        let slot = &mut self.cells[index];
        if self.estimators.soc(index).is_none() {
            slot.life.learn(&self.config, half_cycle, since_before_s, None);
            return false;
        }
        let (model, config, learner) = (&self.config.model, &self.config.health.capacity, &mut self.learner);
        let mut estimator = self.estimators.cell(index);
        let update = learner.learn(model, config, index, &mut estimator, half_cycle);
        self.estimators.put(index, &estimator);
        slot.life.learn(&self.config, half_cycle, since_before_s, Some(&update));
        if half_cycle.mode == Mode::Charge && slot.tapered {
            slot.full_soc = half_cycle.end_soc.unwrap_or(slot.full_soc);
        }
        // What a discharge will deliver is restated by discharges: a charge leaves the resistance of charging.
        let restate = half_cycle.mode == Mode::Discharge || slot.usable.is_none();
        if let Some(config) = self.config.health.usable.as_ref().filter(|_| restate) {
            let capacity = update.capacity;
            slot.usable = Some(usable_capacity(&self.config.model, config, &estimator, capacity, slot.full_soc));
        }
        let resistance = self.resistance(index);
        let slot = &mut self.cells[index];
        if half_cycle.mode == Mode::Discharge {
            slot.discharge_resistance = Some(resistance);
        }
        let (usable, discharge_resistance) = (slot.usable, slot.discharge_resistance);
        out.events.push(Event { time: self.now, kind: half_cycle_event(cell, half_cycle) });
        out.events.push(Event { time: self.now, kind: capacity_event(cell, usable, resistance, &update) });
        if self.learner.has_learned(index) {
            let capacity = Observation { is_new: update.measurement.is_some(), ..learned(update.capacity) };
            self.observe_alarm(Rule::CapacityLow, Some(cell), capacity, out);
        }
        if let Some(usable) = usable.filter(|_| restate) {
            self.observe_alarm(Rule::UsableCapacityLow, Some(cell), learned(usable), out);
        }
        if let Some(resistance) = discharge_resistance.filter(|_| half_cycle.mode == Mode::Discharge) {
            self.observe_alarm(Rule::ResistanceHigh, Some(cell), learned(resistance), out);
        }
        update.measurement.is_some()
    }

    /// Notes that a charge has tapered off at the highest voltage: what it leaves is "full".
    pub(super) fn note_taper(&mut self, sample: &CellSample) {
        let (Some(usable), Some(current_a)) = (&self.config.health.usable, sample.current_a) else { return };
        let charging = current_a < 0.0 && -current_a <= usable.taper_current_a;
        if charging && sample.voltage_v >= self.config.model.voltage_max_v - TAPER_BAND_V {
            self.cells[sample.cell.index()].tapered = true;
        }
    }

    /// The pack's values from its cells', and the raw recharge period they make.
    pub(super) fn combine_pack(&mut self, out: &mut Outputs) {
        let known = self.sampler.voltages_fresh(self.now);
        self.pack = if known { self.combined() } else { None };
        let Some(pack) = self.pack else { return };
        let config = &self.config.health.recharge;
        if let Some(seconds) = self.recharge.observe(config, self.now, self.detector.mode(), pack.soc) {
            self.recharge_period_s = Some(seconds);
            if config.alarm_on == RechargeAlarm::Raw {
                self.observe_alarm(Rule::RechargePeriodLow, None, Observation::new(Some(seconds)), out);
            }
        }
    }

    /// The pack as the latest estimates of its cells make it, however old they are.
    fn combined(&self) -> Option<PackState> {
        let config = &self.config.health;
        let shares = (0..self.config.sample.cells).filter_map(|index| {
            let soc = self.estimators.soc(usize::from(index))?;
            let capacity = self.learner.capacity(&config.capacity, usize::from(index));
            Some(CellShare { cell: CellIndex(index), soc, capacity })
        });
        pack::combine(shares)
    }

    /// A charge is over, and its cells have `learned` from it or not: its recharge period, raw and normalised.
    fn finish_charge(&mut self, has_learned: bool, out: &mut Outputs) {
        let config = &self.config.health.recharge;
        let charged = self.recharge.finish(config);
        let told = charged.coverage >= config.min_coverage && has_learned && self.learner.has_learned_all();
        let pack = if told { self.combined() } else { None };
        let normalised = pack.map(|pack| {
            let capacity = ScalarGaussian::from_std(pack.capacity_ah, pack.capacity_std_ah);
            normalised_period(config, capacity)
        });
        if charged.raw_s.is_none() && normalised.is_none() {
            return;
        }
        let kind = EventKind::RechargePeriod {
            seconds: charged.raw_s,
            normalised_s: normalised.map(|period| period.mean),
            normalised_std_s: normalised.as_ref().map(ScalarGaussian::std),
        };
        out.events.push(Event { time: self.now, kind });
        let Some(period) = normalised else { return };
        self.normalised_recharge = Some(period);
        if self.config.health.recharge.alarm_on == RechargeAlarm::Normalised {
            self.observe_alarm(Rule::RechargePeriodLow, None, learned(period), out);
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

fn capacity_event(
    cell: CellIndex,
    usable: Option<ScalarGaussian>,
    resistance: ScalarGaussian,
    update: &CapacityUpdate,
) -> EventKind {
    EventKind::Capacity {
        cell,
        measured_ah: update.measurement.map(|z| z.value),
        measured_std_ah: update.measurement.map(|z| z.variance.sqrt()),
        capacity_ah: update.capacity.mean,
        capacity_std_ah: update.capacity.std(),
        usable_capacity_ah: usable.map(|usable| usable.mean),
        usable_capacity_std_ah: usable.as_ref().map(ScalarGaussian::std),
        resistance_ratio: resistance.mean,
        resistance_ratio_std: resistance.std(),
    }
}
