//! What ticks drive: staleness, time-outs, and the cyclic frames.

use serde::{Deserialize, Serialize};

use super::{Event, EventKind, Monitor, Outputs, Transmit, Validity};
use crate::alarm::{ActiveAlarm, AlarmChange, Rule};
use crate::can::Frame;
use crate::can::encode::{AlarmFields, HealthFields, StatusFields};
use crate::quantity::{CellIndex, Channel, Timestamp};

/// Period of the work that only watches the clock (staleness, debounce), s.
const HOUSEKEEPING_S: f64 = 0.1;

/// When each cyclic piece of work is due next.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(super) struct Schedule {
    housekeeping: Timestamp,
    status: Timestamp,
    health: Timestamp,
    alarm: Timestamp,
    /// Which of the raised alarms is next in the cycle.
    alarm_turn: usize,
}

impl Schedule {
    /// Everything is due now: after a start and after time asleep.
    pub(super) fn restart(&mut self, now: Timestamp) {
        (self.housekeeping, self.status, self.health, self.alarm) = (now, now, now, now);
    }
}

/// Whether work is due; when it is, its next time is set, with missed periods skipped.
fn take_due(due: &mut Timestamp, now: Timestamp, period_s: f64) -> bool {
    if now < *due {
        return false;
    }
    let next = due.plus_secs(period_s);
    *due = if next > now { next } else { now.plus_secs(period_s) };
    true
}

impl Monitor {
    /// When a tick will next do something: a driver may leave out earlier ticks, the result is the same.
    pub fn next_due(&self) -> Option<Timestamp> {
        self.started?;
        let schedule = &self.schedule;
        let sending = self.config.output.as_ref().map(|_| schedule.status.min(schedule.health).min(schedule.alarm));
        Some(sending.map_or(schedule.housekeeping, |due| due.min(schedule.housekeeping)))
    }

    pub(super) fn handle_tick(&mut self, out: &mut Outputs) {
        if take_due(&mut self.schedule.housekeeping, self.now, HOUSEKEEPING_S) {
            self.keep_house(out);
        }
        let Some(output) = &self.config.output else { return };
        let (status_s, health_s, alarm_s) = (output.status_period_s, output.health_period_s, output.alarm_period_s);
        if take_due(&mut self.schedule.status, self.now, status_s) {
            let frame = self.status_frame();
            self.send(frame, out);
        }
        if take_due(&mut self.schedule.health, self.now, health_s) {
            self.send_health(out);
        }
        if take_due(&mut self.schedule.alarm, self.now, alarm_s) {
            self.send_next_alarm(out);
        }
    }

    /// Staleness of the inputs, the mode's minimum duration, the alarms' debounce.
    fn keep_house(&mut self, out: &mut Outputs) {
        self.sampler.poll(self.now, &mut self.scratch.signal_changes);
        self.report_signals(out);
        self.observe_current(self.sampler.pack_current_a(self.now), out);
        self.watch_inputs(out);
        self.alarms.poll(self.now, &mut self.scratch.alarm_changes);
        self.report_alarms(out);
    }

    /// Silence and plausibility of every input, for the rules about them: a cell's own voltage under its number,
    /// what belongs to no cell under the pack.
    fn watch_inputs(&mut self, out: &mut Outputs) {
        let mut pack = (0.0_f64, 0.0_f64);
        for index in 0..self.sampler.channel_count() {
            let channel = self.sampler.channel(index);
            let silence_s = self.sampler.silence_s(channel, self.now).unwrap_or(0.0);
            let bad_share = self.sampler.bad_share(channel).unwrap_or(0.0);
            if let Channel::CellVoltage(cell) = channel {
                self.observe_alarm(Rule::InputMissing, Some(cell), Some(silence_s), true, out);
                self.observe_alarm(Rule::InputImplausible, Some(cell), Some(bad_share), true, out);
            } else {
                pack = (pack.0.max(silence_s), pack.1.max(bad_share));
            }
        }
        self.observe_alarm(Rule::InputMissing, None, Some(pack.0), true, out);
        self.observe_alarm(Rule::InputImplausible, None, Some(pack.1), true, out);
    }

    /// Takes a value into the rules; what changes goes out at once.
    pub(super) fn observe_alarm(
        &mut self,
        rule: Rule,
        cell: Option<CellIndex>,
        value: Option<f64>,
        new_value: bool,
        out: &mut Outputs,
    ) {
        self.alarms.observe(self.now, rule, cell, value, new_value, &mut self.scratch.alarm_changes);
        self.report_alarms(out);
    }

    fn report_alarms(&mut self, out: &mut Outputs) {
        let mut changes = std::mem::take(&mut self.scratch.alarm_changes);
        for change in changes.drain(..) {
            let kind = EventKind::Alarm {
                rule: change.rule,
                cell: change.cell,
                active: change.active,
                severity: change.severity,
                value: change.value,
                threshold: change.threshold,
            };
            out.events.push(Event { time: self.now, kind });
            self.send(self.alarm_frame(&change), out);
        }
        self.scratch.alarm_changes = changes;
    }

    fn send(&self, frame: Option<Frame>, out: &mut Outputs) {
        let (Some(frame), Some(output)) = (frame, &self.config.output) else { return };
        out.frames.extend(output.buses.iter().map(|&bus| Transmit { time: self.now, bus, frame }));
    }

    fn validity(&self) -> Validity {
        if self.pack.is_none() {
            Validity::Unavailable
        } else if self.cells.iter().any(|cell| !cell.trusted) {
            Validity::Untrusted
        } else if self.sampler.any_bad() {
            Validity::Degraded
        } else {
            Validity::Valid
        }
    }

    fn status_frame(&self) -> Option<Frame> {
        let output = self.config.output.as_ref()?;
        let pack = self.pack.as_ref();
        Some(output.plan.status(&StatusFields {
            soc: pack.map(|pack| pack.soc),
            soc_std: pack.map(|pack| pack.soc_std),
            mode: Some(self.detector.mode()),
            validity: self.validity() as u8,
            // Before there is an estimate, "no alarm" would be a claim nobody can make.
            highest_severity: self.alarms.highest_severity().map(|severity| severity as u8).or(pack.map(|_| 0)),
            active_alarms: Some(u16::try_from(self.alarms.count()).unwrap_or(u16::MAX)),
            limiting_cell: pack.map(|pack| pack.limiting_cell),
        }))
    }

    /// Health of the pack: its weakest cell's capacity, as an estimate only once a half-cycle has taught something.
    fn health_fields(&self) -> HealthFields {
        let rated_ah = self.config.model.rated_capacity_ah;
        let learned = self.cells.iter().enumerate().filter(|(_, slot)| slot.latest.is_some());
        let capacity = learned
            .map(|(index, _)| self.learner.capacity(&self.config.health.capacity, index))
            .min_by(|a, b| a.mean.total_cmp(&b.mean))
            .filter(|_| self.pack.is_some());
        let usable = self.cells.iter().filter_map(|slot| slot.usable).min_by(|a, b| a.mean.total_cmp(&b.mean));
        let resistance = self
            .cells
            .iter()
            .filter_map(|slot| slot.latest.as_ref().map(|estimate| estimate.resistance_ratio))
            .max_by(f64::total_cmp);
        HealthFields {
            capacity_ah: capacity.map(|c| c.mean),
            capacity_std_ah: capacity.map(|c| c.std()),
            soh: capacity.map(|c| c.mean / rated_ah),
            recharge_period_s: self.recharge_period_s,
            normalized_recharge_period_s: None,
            usable_capacity_ah: usable.map(|u| u.mean),
            usable_capacity_std_ah: usable.map(|u| u.std()),
            resistance_ratio: resistance,
        }
    }

    fn send_health(&self, out: &mut Outputs) {
        let Some(output) = &self.config.output else { return };
        let fields = self.health_fields();
        for page in 0..output.plan.health_pages() {
            self.send(Some(output.plan.health(page, &fields)), out);
        }
    }

    fn send_next_alarm(&mut self, out: &mut Outputs) {
        let count = self.alarms.count();
        if count == 0 {
            return;
        }
        let turn = self.schedule.alarm_turn % count;
        self.schedule.alarm_turn = turn + 1;
        let alarm = self.alarms.active().nth(turn);
        let frame = alarm.and_then(|alarm| self.alarm_frame(&raised(&alarm)));
        self.send(frame, out);
    }

    fn alarm_frame(&self, alarm: &AlarmChange) -> Option<Frame> {
        let output = self.config.output.as_ref()?;
        Some(output.plan.alarm(&AlarmFields {
            rule: alarm.rule as u8,
            state: Some(if alarm.active { 1 } else { 2 }),
            severity: Some(alarm.severity as u8),
            test: false,
            cell: alarm.cell,
            value: alarm.value,
            threshold: Some(alarm.threshold),
        }))
    }
}

fn raised(alarm: &ActiveAlarm) -> AlarmChange {
    AlarmChange {
        rule: alarm.rule,
        cell: alarm.cell,
        active: true,
        severity: alarm.severity,
        value: alarm.value,
        threshold: alarm.threshold,
    }
}
