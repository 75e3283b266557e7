//! What ticks drive: staleness, time-outs, and the cyclic frames.

use serde::{Deserialize, Serialize};

use super::alarms::HOUSEKEEPING_S;
use super::{Event, EventKind, Monitor, Outputs, Transmit, Validity};
use crate::alarm::{Alarm, Rule, Severity, State};
use crate::can::Frame;
use crate::can::encode::{AlarmFields, HealthFields, SendCounters, StatusFields};
use crate::quantity::{CellIndex, Timestamp};

/// Period of a test's frames, s: a consumer that looks once a second sees several.
const TEST_PERIOD_S: f64 = 0.1;
/// Longest test, s: one that is forgotten ends by itself.
pub const MAX_TEST_S: f64 = 600.0;

/// A test of an alarm frame that is running.
#[derive(Debug, Clone, Copy)]
pub(super) struct Test {
    rule: Rule,
    next: Timestamp,
    end: Timestamp,
}

/// When each cyclic piece of work is due next.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(super) struct Schedule {
    housekeeping: Timestamp,
    status: Timestamp,
    health: Timestamp,
    alarm: Timestamp,
    /// Which of the raised alarms is next in the cycle.
    alarm_turn: usize,
    /// Counters of the frames' end-to-end protection.
    #[serde(default)]
    counters: SendCounters,
}

impl Schedule {
    /// Moves stored times onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        for due in [&mut self.housekeeping, &mut self.status, &mut self.health, &mut self.alarm] {
            *due = due.plus_nanos(by_nanos);
        }
    }

    /// Other periods, from here on: status, health, alarm.
    pub(super) fn take_over(&mut self, now: Timestamp, before_s: [f64; 3], after_s: [f64; 3]) {
        let dues = [&mut self.status, &mut self.health, &mut self.alarm];
        for (due, (before_s, after_s)) in dues.into_iter().zip(before_s.into_iter().zip(after_s)) {
            if before_s != after_s {
                *due = (*due).min(now.plus_secs(after_s));
            }
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

impl Monitor {
    /// When a tick will next do something: a driver may leave out earlier ticks, the result is the same.
    #[inline]
    pub fn next_due(&self) -> Option<Timestamp> {
        self.due
    }

    pub(super) fn find_due(&self) -> Option<Timestamp> {
        if !self.started {
            return None;
        }
        let schedule = &self.schedule;
        let sending = self.config.output.as_ref().map(|_| schedule.status.min(schedule.health).min(schedule.alarm));
        let test = self.test.map(|test| test.next.min(test.end));
        let node = self.j1939.as_ref().and_then(super::j1939::J1939::next_due);
        [sending, test, node].into_iter().flatten().chain([schedule.housekeeping]).min()
    }

    pub(super) fn handle_tick(&mut self, out: &mut Outputs) {
        if take_due(&mut self.schedule.housekeeping, self.now, HOUSEKEEPING_S) {
            self.keep_house(out);
        }
        self.poll_j1939(out);
        let Some(output) = &self.config.output else { return };
        let (status_s, health_s, alarm_s) = (output.status_period_s, output.health_period_s, output.alarm_period_s);
        if take_due(&mut self.schedule.status, self.now, status_s) {
            let frame = self.status_frame();
            self.send(frame, false, out);
        }
        if take_due(&mut self.schedule.health, self.now, health_s) {
            self.send_health(out);
        }
        if take_due(&mut self.schedule.alarm, self.now, alarm_s) {
            self.send_next_alarm(out);
        }
        self.continue_test(out);
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
        self.watch(out);
    }

    fn send(&self, frame: Option<Frame>, announces: bool, out: &mut Outputs) {
        let (Some(frame), Some(output)) = (frame, &self.config.output) else { return };
        out.frames.extend(output.buses.iter().map(|&bus| Transmit { time: self.now, bus, frame, announces }));
    }

    pub(super) fn validity(&self) -> Validity {
        if self.pack.is_none() {
            Validity::Unavailable
        } else if !self.all_trusted {
            Validity::Untrusted
        } else if self.sampler.any_bad() {
            Validity::Degraded
        } else {
            Validity::Valid
        }
    }

    fn status_frame(&mut self) -> Option<Frame> {
        let output = self.config.output.as_ref()?;
        let pack = self.pack.as_ref();
        let fields = StatusFields {
            soc: pack.map(|pack| pack.soc),
            soc_std: pack.map(|pack| pack.soc_std),
            mode: Some(self.detector.mode()),
            validity: self.validity() as u8,
            // Before there is an estimate, "no alarm" would be a claim nobody can make.
            highest_severity: self.alarms.highest_severity().map(|severity| severity as u8).or(pack.map(|_| 0)),
            active_alarms: Some(u16::try_from(self.alarms.count()).unwrap_or(u16::MAX)),
            limiting_cell: pack.map(|pack| pack.limiting_cell),
            unknown_rules: Some(match self.alarms.unknown() {
                (_, 0) => 0,
                (all, unknown) if unknown < all => 1,
                (_, _) => 2,
            }),
        };
        Some(output.plan.status(&fields, &mut self.schedule.counters))
    }

    /// Health of the pack: its weakest cell's, once half-cycles have taught something about every cell.
    pub(super) fn health_fields(&self) -> HealthFields {
        let recharge_period_s = self.recharge_period_s;
        if !self.learner.has_learned_all() {
            return HealthFields { recharge_period_s, ..HealthFields::default() };
        }
        let capacity = self.weakest_capacity();
        let usable = self.cells.iter().filter_map(|slot| slot.usable).min_by(|a, b| a.mean.total_cmp(&b.mean));
        let log_resistance =
            (0..self.cells.len()).map(|cell| self.estimators.log_resistance(cell).mean).max_by(f64::total_cmp);
        let life = self.pack_remaining_life().map(|(_, life)| life);
        let cycles = life.and_then(|life| life.cycles);
        HealthFields {
            capacity_ah: capacity.map(|c| c.mean),
            capacity_std_ah: capacity.map(|c| c.std()),
            soh: capacity.map(|c| c.mean / self.config.model.rated_capacity_ah),
            recharge_period_s,
            normalized_recharge_period_s: self.normalised_recharge.map(|period| period.mean),
            usable_capacity_ah: usable.map(|u| u.mean),
            usable_capacity_std_ah: usable.map(|u| u.std()),
            resistance_ratio: log_resistance.map(libm::exp),
            remaining_cycles: cycles.map(|cycles| cycles.median),
            remaining_cycles_low: cycles.map(|cycles| cycles.low),
            remaining_days: life.and_then(|life| life.days).map(|days| days.median),
        }
    }

    fn send_health(&mut self, out: &mut Outputs) {
        let fields = self.health_fields();
        let pages = self.config.output.as_ref().map_or(0, |output| output.plan.health_pages());
        for page in 0..pages {
            let plan = self.config.output.as_ref().map(|output| &output.plan);
            let frame = plan.map(|plan| plan.health(page, &fields, &mut self.schedule.counters));
            self.send(frame, true, out);
        }
    }

    /// One of the raised alarms in turn, and one of those whose value is not known: the first are not slowed by the
    /// second.
    fn send_next_alarm(&mut self, out: &mut Outputs) {
        let turn = self.schedule.alarm_turn;
        self.schedule.alarm_turn = turn.wrapping_add(1);
        let raised = turn.checked_rem(self.alarms.count()).and_then(|turn| self.alarms.raised().nth(turn));
        let unknown = self.alarms.unknown_alarm(turn);
        for alarm in raised.into_iter().chain(unknown) {
            self.send_alarm(&alarm, out);
        }
    }

    /// Sends an alarm as it stands.
    pub(super) fn send_alarm(&mut self, alarm: &Alarm, out: &mut Outputs) {
        self.send_alarm_fields(alarm_fields(alarm), out);
    }

    /// Sends that nothing watches an alarm any more: its state is not known.
    pub(super) fn send_alarm_end(
        &mut self,
        rule: Rule,
        severity: Severity,
        cell: Option<CellIndex>,
        out: &mut Outputs,
    ) {
        let (rule, state, severity) = (rule as u8, Some(State::Unknown.wire_code()), Some(severity as u8));
        self.send_alarm_fields(AlarmFields { rule, state, severity, cell, ..AlarmFields::default() }, out);
    }

    fn send_alarm_fields(&mut self, fields: AlarmFields, out: &mut Outputs) {
        let counters = &mut self.schedule.counters;
        let frame = self.config.output.as_ref().map(|output| output.plan.alarm(&fields, counters));
        self.send(frame, true, out);
    }

    /// Begins to send a rule's alarm frame marked as a test, in place of one that runs; of 0 s, only ends that one.
    /// `false` = there is no output to send it on.
    pub(super) fn start_test(&mut self, rule: Rule, seconds: f64, out: &mut Outputs) -> bool {
        if self.config.output.is_none() {
            return false;
        }
        self.end_test(out);
        if seconds.is_nan() || seconds <= 0.0 {
            return true;
        }
        let seconds = seconds.min(MAX_TEST_S);
        self.test = Some(Test { rule, next: self.now, end: self.now.plus_secs(seconds) });
        out.events.push(Event { time: self.now, kind: EventKind::Test { rule, running: true } });
        self.tell_j1939();
        self.poll_j1939(out);
        self.continue_test(out);
        true
    }

    /// The test's frame when it is due, and its end.
    fn continue_test(&mut self, out: &mut Outputs) {
        let Some(mut test) = self.test else { return };
        if self.now >= test.end {
            self.end_test(out);
        } else if take_due(&mut test.next, self.now, TEST_PERIOD_S) {
            self.test = Some(test);
            self.send_alarm_fields(test_fields(test.rule, State::Active), out);
        }
    }

    pub(super) fn end_test(&mut self, out: &mut Outputs) {
        let Some(test) = self.test.take() else { return };
        self.send_alarm_fields(test_fields(test.rule, State::Inactive), out);
        out.events.push(Event { time: self.now, kind: EventKind::Test { rule: test.rule, running: false } });
        self.tell_j1939();
        self.poll_j1939(out);
    }
}

fn alarm_fields(alarm: &Alarm) -> AlarmFields {
    AlarmFields {
        rule: alarm.rule as u8,
        state: Some(alarm.state.wire_code()),
        severity: Some(alarm.severity as u8),
        test: false,
        acknowledged: alarm.is_acknowledged,
        cell: alarm.cell,
        value: alarm.value,
        threshold: Some(alarm.threshold),
    }
}

/// No value and no threshold: nothing of it can be taken for a measurement.
fn test_fields(rule: Rule, state: State) -> AlarmFields {
    let (rule, state) = (rule as u8, Some(state.wire_code()));
    AlarmFields { rule, state, test: true, ..AlarmFields::default() }
}
