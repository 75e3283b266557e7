//! What ticks drive: staleness, time-outs, and the cyclic frames.

use serde::{Deserialize, Serialize};

use super::{Event, EventKind, Monitor, MonitorConfig, Outputs, Transmit, Validity};
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
    /// Moves stored times onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        for due in [&mut self.housekeeping, &mut self.status, &mut self.health, &mut self.alarm] {
            *due = due.plus_nanos(by_nanos);
        }
    }

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

/// What the rules about inputs look at; `None` = not known.
#[derive(Debug, Clone, Copy, Default)]
struct InputState {
    silence_s: Option<f64>,
    bad_share: Option<f64>,
    /// Whether a reading has come since the last look.
    is_new: bool,
}

impl InputState {
    fn worst(self, other: Self) -> Self {
        let max = |a: Option<f64>, b: Option<f64>| a.map_or(b, |a| Some(b.map_or(a, |b| a.max(b))));
        Self {
            silence_s: max(self.silence_s, other.silence_s),
            bad_share: max(self.bad_share, other.bad_share),
            is_new: self.is_new || other.is_new,
        }
    }
}

impl MonitorConfig {
    /// Silence that the strictest rule calls missing, s.
    fn missing_after_s(&self) -> Option<f64> {
        let rules = self.rules.iter().filter(|rule| rule.rule == Rule::InputMissing);
        rules.map(|rule| rule.threshold).min_by(f64::total_cmp)
    }
}

impl Monitor {
    /// When a tick will next do something: a driver may leave out earlier ticks, the result is the same.
    pub fn next_due(&self) -> Option<Timestamp> {
        if !self.started {
            return None;
        }
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
        self.intake.poll(self.now, out);
        self.sampler.poll(self.now, &mut self.scratch.signal_changes);
        self.report_signals(out);
        self.observe_current(self.sampler.pack_current_a(self.now), out);
        if !self.sampler.voltages_fresh(self.now) {
            // A cell nobody measures any more may be the weakest.
            self.forget_pack();
        }
        self.watch_inputs(out);
        self.alarms.poll(self.now, &mut self.scratch.alarm_changes);
        self.report_alarms(out);
    }

    /// Silence and plausibility of every input, for the rules about them: a cell's own voltage under its number,
    /// what belongs to no cell under the pack.
    fn watch_inputs(&mut self, out: &mut Outputs) {
        let mut pack = InputState::default();
        for index in 0..self.sampler.channel_count() {
            let channel = self.sampler.channel(index);
            let state = self.input_state(channel);
            if let Channel::CellVoltage(cell) = channel {
                self.observe_input(Some(cell), state, out);
            } else {
                pack = pack.worst(state);
            }
        }
        self.observe_input(None, pack, out);
    }

    fn input_state(&self, channel: Channel) -> InputState {
        let silence_s = self.sampler.silence_s(channel, self.now);
        // Since waking nothing may have come yet: that is neither silence nor its end.
        let heard = self.sampler.heard_since_waking(channel);
        let beyond = |silence: &f64| heard || self.config.missing_after_s().is_some_and(|limit| *silence > limit);
        InputState {
            silence_s: silence_s.filter(beyond),
            bad_share: self.sampler.bad_share(channel),
            is_new: silence_s.is_some_and(|silence_s| heard && silence_s <= HOUSEKEEPING_S),
        }
    }

    fn observe_input(&mut self, cell: Option<CellIndex>, state: InputState, out: &mut Outputs) {
        self.observe_alarm(Rule::InputMissing, cell, state.silence_s, true, out);
        self.observe_alarm(Rule::InputImplausible, cell, state.bad_share, state.is_new, out);
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

    /// Health of the pack: its weakest cell's, once half-cycles have taught something about every cell.
    fn health_fields(&self) -> HealthFields {
        let recharge_period_s = self.recharge_period_s;
        if !self.learner.has_learned_all() {
            return HealthFields { recharge_period_s, ..HealthFields::default() };
        }
        let cells = 0..self.cells.len();
        let capacity = cells
            .map(|index| self.learner.capacity(&self.config.health.capacity, index))
            .min_by(|a, b| a.mean.total_cmp(&b.mean));
        let usable = self.cells.iter().filter_map(|slot| slot.usable).min_by(|a, b| a.mean.total_cmp(&b.mean));
        let log_resistance = self.cells.iter().map(|slot| slot.estimator.log_resistance().mean).max_by(f64::total_cmp);
        HealthFields {
            capacity_ah: capacity.map(|c| c.mean),
            capacity_std_ah: capacity.map(|c| c.std()),
            soh: capacity.map(|c| c.mean / self.config.model.rated_capacity_ah),
            recharge_period_s,
            normalized_recharge_period_s: self.normalised_recharge.map(|period| period.mean),
            usable_capacity_ah: usable.map(|u| u.mean),
            usable_capacity_std_ah: usable.map(|u| u.std()),
            resistance_ratio: log_resistance.map(libm::exp),
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
