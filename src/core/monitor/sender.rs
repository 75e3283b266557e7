//! Sending stage: cyclic frames, alarm frames, replies to commands, tests, and the J1939 node.
//!
//! In: fields of the frames from the other stages, alarms, ticks. Out: frames in [`Outputs`]. Missed periods are skipped,
//! not made up for. Without `[output]` nothing but the J1939 node sends.

use serde::{Deserialize, Serialize};

use super::alarm_queue::{AlarmKey, AlarmQueue};
use super::digest;
use super::j1939::J1939;
use super::{Event, EventKind, MonitorConfig, Outputs, SupplyConfig, Transmit};
use crate::alarm::{Alarm, AlarmEngine, AlarmState, Rule};
use crate::can::Frame;
use crate::can::encode::{
    AlarmFields, HealthFields, LayoutMessage, OutputPlan, REPLY_DELAY_MS, ReplyFields, SendCounters, StatusFields,
};
use crate::can::poll::{PollOutputs, Poller};
use crate::quantity::{BusIndex, Fault, Timestamp};

/// Period of a test's frames, s: a consumer that reads once a second receives several.
const TEST_PERIOD_S: f64 = 0.1;
/// Longest test, s: a forgotten test ends by itself.
pub const MAX_TEST_S: f64 = 600.0;

/// Replies at once after a pause; then one each [`REPLY_DELAY_MS`]. A sender of commands waits for each reply.
const REPLY_BURST: i64 = 5;
const REPLY_DELAY_NS: i64 = REPLY_DELAY_MS as i64 * 1_000_000;

/// The daemon's sent frames.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputConfig {
    /// Layouts and identifiers.
    pub plan: OutputPlan,
    /// Interfaces they are sent on.
    pub buses: Vec<BusIndex>,
    /// Period of the status frame, s.
    pub status_period_s: f64,
    /// Period of the health frame (all its pages), s.
    pub health_period_s: f64,
    /// Period of the alarm frame, s: each raised alarm once in it, as far as the budget of frames allows.
    pub alarm_period_s: f64,
    /// Period of the digest (all its pages), s.
    pub digest_period_s: f64,
}

/// The sending stage.
#[derive(Debug)]
pub(super) struct Sender {
    config: Option<OutputConfig>,
    pub(super) schedule: Schedule,
    /// A running test of an alarm frame; it ends with the process.
    pub(super) test: Option<AlarmTest>,
    pub(super) j1939: Option<J1939>,
    pub(super) poller: Option<Poller>,
    supply: Option<SupplyConfig>,
    /// A change of an alarm gave the next tick something to do.
    is_rescheduled: bool,
    /// Outputs of the poller, kept for their memory.
    polled: PollOutputs,
}

/// A running test of an alarm frame.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct AlarmTest {
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
    /// Which of the alarms that cannot be judged is next in the cycle.
    alarm_turn: usize,
    #[serde(default)]
    digest: Timestamp,
    /// Which threshold is next in the digest.
    #[serde(default)]
    threshold_turn: usize,
    /// From when on another reply may be sent.
    #[serde(default)]
    reply: Timestamp,
    #[serde(default)]
    pub(super) alarms: AlarmQueue,
    /// Counters of the frames' end-to-end protection.
    #[serde(default)]
    counters: SendCounters,
}

impl Schedule {
    /// Moves stored times onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        for due in self.dues() {
            *due = due.plus_nanos(by_nanos);
        }
        self.reply = self.reply.plus_nanos(by_nanos);
        self.alarms.rebase(by_nanos);
    }

    /// When each piece of work is due.
    fn dues(&mut self) -> [&mut Timestamp; 5] {
        [&mut self.housekeeping, &mut self.status, &mut self.health, &mut self.alarm, &mut self.digest]
    }

    /// Other periods; a shorter one begins now, not when the longer one is over.
    fn reconfigure(&mut self, now: Timestamp, before: &OutputConfig, after: &OutputConfig) {
        let periods_s =
            |of: &OutputConfig| [of.status_period_s, of.health_period_s, of.alarm_period_s, of.digest_period_s];
        let dues = [&mut self.status, &mut self.health, &mut self.alarm, &mut self.digest];
        for (due, (before_s, after_s)) in dues.into_iter().zip(periods_s(before).into_iter().zip(periods_s(after))) {
            if before_s != after_s {
                *due = (*due).min(now.plus_secs(after_s));
            }
        }
    }
}

/// Whether work is due; if so, its next time is set, with missed periods skipped.
fn take_due(due: &mut Timestamp, now: Timestamp, period_s: f64) -> bool {
    if now < *due {
        return false;
    }
    let next = due.plus_secs(period_s);
    *due = if next > now { next } else { now.plus_secs(period_s) };
    true
}

impl Sender {
    pub(super) fn new(config: &MonitorConfig) -> Self {
        Self {
            config: config.output.clone(),
            schedule: Schedule::default(),
            test: None,
            j1939: config.j1939.clone().map(J1939::new),
            poller: config.poll.as_ref().map(Poller::new),
            supply: config.supply,
            is_rescheduled: false,
            polled: PollOutputs::default(),
        }
    }

    /// Other cyclic frames. Without any, a running test ends.
    pub(super) fn reconfigure(
        &mut self,
        now: Timestamp,
        config: Option<&OutputConfig>,
        engine: &AlarmEngine,
        out: &mut Outputs,
    ) {
        let before = std::mem::replace(&mut self.config, config.cloned());
        match (before, config) {
            (_, None) => {
                self.end_test(now, engine, out);
                self.schedule.alarms.clear();
            }
            (Some(before), Some(after)) => self.schedule.reconfigure(now, &before, after),
            (None, Some(_)) => {}
        }
    }

    /// Another J1939 configuration: the same node keeps its address, another one claims it.
    pub(super) fn reconfigure_j1939(
        &mut self,
        now: Timestamp,
        config: &MonitorConfig,
        has_started: bool,
        out: &mut Outputs,
    ) {
        let Some(config) = &config.j1939 else {
            self.j1939 = None;
            return;
        };
        if !self.j1939.as_mut().is_some_and(|running| running.reconfigure(config)) {
            self.j1939 = Some(J1939::new(config.clone()));
            if has_started {
                self.claim_address(now, out);
            }
        }
    }

    /// Values are compared before anything is sent: after a restart none is known.
    pub(super) fn compare_first(&mut self, now: Timestamp) {
        self.schedule.housekeeping = self.schedule.housekeeping.min(now);
    }

    /// Makes everything due now: after a start and after time asleep.
    pub(super) fn restart(&mut self, now: Timestamp) {
        self.schedule.dues().into_iter().for_each(|due| *due = now);
        self.schedule.reply = self.schedule.reply.min(now);
        self.schedule.alarms.restart(now);
    }

    /// Skips the counters of the frames that an earlier process has sent since its state was stored, or would have sent by
    /// `now`: for a receiver the frames of the downtime are lost ones, and no counter comes twice.
    pub(super) fn skip_counters(&mut self, now: Timestamp, engine: &AlarmEngine) {
        let Some(config) = &self.config else { return };
        let Schedule { status, health, alarm, digest, alarms, counters, .. } = &mut self.schedule;
        let periods = |due: Timestamp, period_s: f64| {
            let periods = (now.since(due) / period_s).floor() + 1.0;
            // Of a saturating cast: a negative number of periods is none.
            periods.max(0.0) as u64
        };
        let pages = |count: usize| u64::try_from(count).unwrap_or(0);
        let unknown = u64::from(engine.unknown().1 > 0) * periods(*alarm, config.alarm_period_s);
        alarms.limit(now, config.alarm_period_s);
        for (message, frames) in [
            (LayoutMessage::Status, periods(*status, config.status_period_s)),
            (
                LayoutMessage::Health,
                periods(*health, config.health_period_s).saturating_mul(pages(config.plan.health_pages())),
            ),
            (
                LayoutMessage::Digest,
                periods(*digest, config.digest_period_s).saturating_mul(pages(config.plan.digest_pages())),
            ),
            (LayoutMessage::Alarm, alarms.frames_until(now, engine, config.alarm_period_s).saturating_add(unknown)),
        ] {
            config.plan.skip(message, frames, counters);
        }
    }

    /// When a tick next does something.
    pub(super) fn next_due(&self) -> Timestamp {
        let schedule = &self.schedule;
        let sending = self.config.as_ref().map(|config| {
            let digest = (config.plan.digest_pages() > 0).then_some(schedule.digest);
            let changing = digest.into_iter().chain(schedule.alarms.next_due());
            changing.fold(schedule.status.min(schedule.health).min(schedule.alarm), Timestamp::min)
        });
        let test = self.test.map(|test| test.next.min(test.end));
        let node = self.j1939.as_ref().and_then(J1939::next_due);
        let poller = self.poller.as_ref().and_then(Poller::next_due);
        [sending, test, node, poller].into_iter().flatten().fold(schedule.housekeeping, Timestamp::min)
    }

    /// Whether housekeeping is due.
    pub(super) fn take_housekeeping_due(&mut self, now: Timestamp, period_s: f64) -> bool {
        take_due(&mut self.schedule.housekeeping, now, period_s)
    }

    /// Whether status, health and alarm frames and the digest are due; `None` = none is configured.
    pub(super) fn take_frames_due(&mut self, now: Timestamp) -> Option<[bool; 4]> {
        let (config, schedule) = (self.config.as_ref()?, &mut self.schedule);
        Some([
            take_due(&mut schedule.status, now, config.status_period_s),
            take_due(&mut schedule.health, now, config.health_period_s),
            take_due(&mut schedule.alarm, now, config.alarm_period_s),
            take_due(&mut schedule.digest, now, config.digest_period_s),
        ])
    }

    /// Sends the status frame.
    pub(super) fn send_status(&mut self, now: Timestamp, fields: &StatusFields, out: &mut Outputs) {
        self.send(now, false, out, |plan, counters| plan.status(fields, counters));
    }

    /// Sends all pages of the health frame.
    pub(super) fn send_health(&mut self, now: Timestamp, fields: &HealthFields, out: &mut Outputs) {
        let pages = self.config.as_ref().map_or(0, |output| output.plan.health_pages());
        for page in 0..pages {
            self.send(now, true, out, |plan, counters| plan.health(page, fields, counters));
        }
    }

    /// Sends one of the alarms that cannot be judged in turn, and notes those that can be judged again.
    pub(super) fn send_unknown_alarm(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let turn = self.schedule.alarm_turn;
        self.schedule.alarm_turn = turn.wrapping_add(1);
        self.schedule.alarms.note_known(now, engine);
        if let Some(alarm) = self.schedule.alarms.take_unknown(now, engine, turn) {
            self.send_alarm(now, &alarm, out);
        }
    }

    /// Sends the alarms that are due within the budget.
    pub(super) fn send_due_alarms(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let Some(period_s) = self.config.as_ref().map(|config| config.alarm_period_s) else { return };
        // Ends with the budget.
        while let Some(key) = self.schedule.alarms.take(now, engine, period_s) {
            self.send_key(now, key, engine, out);
        }
    }

    /// Notes that an alarm changed; the caller then calls [`send_changed_alarms`](Self::send_changed_alarms).
    pub(super) fn note_change(&mut self, now: Timestamp, key: AlarmKey) {
        if self.config.is_some() {
            self.schedule.alarms.note_change(now, key);
            self.is_rescheduled = true;
        }
    }

    /// Sends changed alarms as they are now, within the budget; the rest and the repetitions follow.
    pub(super) fn send_changed_alarms(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        while let Some(key) = self.schedule.alarms.take_changed(now) {
            self.send_key(now, key, engine, out);
        }
    }

    /// Whether something is due at another time than before.
    #[inline]
    pub(super) fn take_rescheduled(&mut self) -> bool {
        std::mem::take(&mut self.is_rescheduled)
    }

    /// Sends an alarm as it is now; the state of one that no threshold watches any more is unknown.
    fn send_key(&mut self, now: Timestamp, key: AlarmKey, engine: &AlarmEngine, out: &mut Outputs) {
        let (rule, severity, cell) = key.parts();
        if let Some(alarm) = engine.find(rule, severity, cell) {
            return self.send_alarm(now, &alarm, out);
        }
        let (rule, state, severity) = (rule as u8, Some(AlarmState::Unknown.wire_code()), Some(severity as u8));
        self.send_alarm_fields(now, &AlarmFields { rule, state, severity, cell, ..AlarmFields::default() }, out);
    }

    fn send_alarm(&mut self, now: Timestamp, alarm: &Alarm, out: &mut Outputs) {
        let fields = AlarmFields {
            rule: alarm.rule as u8,
            state: Some(alarm.state.wire_code()),
            severity: Some(alarm.severity as u8),
            test: false,
            acknowledged: alarm.is_acknowledged,
            cell: alarm.cell,
            value: alarm.value,
            threshold: Some(alarm.threshold),
        };
        self.send_alarm_fields(now, &fields, out);
    }

    /// Sends all pages of the digest.
    pub(super) fn send_digest(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let Some(config) = &self.config else { return };
        let (pages, period_s) = (config.plan.digest_pages(), config.alarm_period_s);
        if pages == 0 {
            return;
        }
        let turn = self.schedule.threshold_turn;
        self.schedule.threshold_turn = turn.wrapping_add(1);
        let fields = digest::fields(engine, period_s, turn);
        for page in 0..pages {
            self.send_if(now, out, |plan, counters| plan.digest(page, &fields, counters));
        }
    }

    /// Sends the reply to a command that came on `bus`, on that interface or, where nothing else is sent on it, on all.
    pub(super) fn send_reply(&mut self, now: Timestamp, bus: BusIndex, fields: &ReplyFields, out: &mut Outputs) {
        let Some(output) = &self.config else { return };
        if self.schedule.reply > now {
            return;
        }
        let Some(frame) = output.plan.reply(fields, &mut self.schedule.counters) else { return };
        let earliest = now.plus_nanos(-(REPLY_BURST - 1) * REPLY_DELAY_NS);
        self.schedule.reply = self.schedule.reply.max(earliest).plus_nanos(REPLY_DELAY_NS);
        let has_bus = output.buses.contains(&bus);
        let buses = output.buses.iter().filter(|other| !has_bus || **other == bus);
        out.frames.extend(buses.map(|&bus| Transmit { time: now, bus, frame, announces: true }));
    }

    fn send_alarm_fields(&mut self, now: Timestamp, fields: &AlarmFields, out: &mut Outputs) {
        self.send(now, true, out, |plan, counters| plan.alarm(fields, counters));
    }

    /// Sends an announcing frame, if there is one, on every interface.
    fn send_if(
        &mut self,
        time: Timestamp,
        out: &mut Outputs,
        encode: impl FnOnce(&OutputPlan, &mut SendCounters) -> Option<Frame>,
    ) {
        let Some(output) = &self.config else { return };
        let Some(frame) = encode(&output.plan, &mut self.schedule.counters) else { return };
        out.frames.extend(output.buses.iter().map(|&bus| Transmit { time, bus, frame, announces: true }));
    }

    /// Sends a frame on every interface.
    fn send(
        &mut self,
        time: Timestamp,
        announces: bool,
        out: &mut Outputs,
        encode: impl FnOnce(&OutputPlan, &mut SendCounters) -> Frame,
    ) {
        let Some(output) = &self.config else { return };
        let frame = encode(&output.plan, &mut self.schedule.counters);
        out.frames.extend(output.buses.iter().map(|&bus| Transmit { time, bus, frame, announces }));
    }

    /// Begins to send a rule's alarm frame marked as a test, in place of a running one; of 0 s, only ends that one.
    /// `false` = there is no output to send it on.
    pub(super) fn start_test(
        &mut self,
        now: Timestamp,
        rule: Rule,
        seconds: f64,
        engine: &AlarmEngine,
        out: &mut Outputs,
    ) -> bool {
        if self.config.is_none() {
            return false;
        }
        self.end_test(now, engine, out);
        if seconds.is_nan() || seconds <= 0.0 {
            return true;
        }
        self.test = Some(AlarmTest { rule, next: now, end: now.plus_secs(seconds.min(MAX_TEST_S)) });
        out.events.push(Event { time: now, kind: EventKind::Test { rule, running: true } });
        self.update_trouble_codes(now, engine);
        self.poll_j1939(now, out);
        self.continue_test(now, engine, out);
        true
    }

    /// Sends the test's frame when it is due, and ends the test in time.
    pub(super) fn continue_test(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let Some(test) = &mut self.test else { return };
        if now >= test.end {
            self.end_test(now, engine, out);
        } else if take_due(&mut test.next, now, TEST_PERIOD_S) {
            let rule = test.rule;
            self.send_test(now, rule, AlarmState::Active, out);
        }
    }

    /// Ends a running test.
    pub(super) fn end_test(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let Some(AlarmTest { rule, .. }) = self.test.take() else { return };
        self.send_test(now, rule, AlarmState::Inactive, out);
        out.events.push(Event { time: now, kind: EventKind::Test { rule, running: false } });
        self.update_trouble_codes(now, engine);
        self.poll_j1939(now, out);
    }

    /// Sends no value and no threshold, so that no part of a test can be taken for a measurement.
    fn send_test(&mut self, now: Timestamp, rule: Rule, state: AlarmState, out: &mut Outputs) {
        let (rule, state) = (rule as u8, Some(state.wire_code()));
        self.send_alarm_fields(now, &AlarmFields { rule, state, test: true, ..AlarmFields::default() }, out);
    }

    /// Does something with the poller, if there is one, and sends what it wants to.
    pub(super) fn poll_with(
        &mut self,
        now: Timestamp,
        out: &mut Outputs,
        act: impl FnOnce(&mut Poller, &mut PollOutputs),
    ) {
        let Some(poller) = &mut self.poller else { return };
        act(poller, &mut self.polled);
        let transmit = |(bus, frame)| Transmit { time: now, bus, frame, announces: false };
        out.frames.extend(self.polled.frames.drain(..).map(transmit));
        let event = |change| Event { time: now, kind: EventKind::Poll(change) };
        out.events.extend(self.polled.changes.drain(..).map(event));
    }

    /// Takes a reading of the vehicle's supply voltage.
    pub(super) fn handle_supply(&mut self, now: Timestamp, value: Result<f64, Fault>) {
        if let (Some(poller), Some(supply)) = (&mut self.poller, self.supply) {
            let is_good = value.is_ok_and(|volts| volts >= supply.minimum_v);
            poller.set_supply(is_good.then(|| now.plus_secs(supply.max_age_s)));
        }
    }

    /// Claims the J1939 address: at the start, after time asleep, when the interface is up again.
    pub(super) fn claim_address(&mut self, now: Timestamp, out: &mut Outputs) {
        if let Some(j1939) = &mut self.j1939 {
            j1939.claim_address(now, out);
        }
    }

    /// Passes a frame to the J1939 node, if it came on the node's interface.
    pub(super) fn handle_j1939_frame(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame, out: &mut Outputs) {
        if let Some(j1939) = &mut self.j1939 {
            j1939.handle_frame(now, bus, frame, out);
        }
    }

    /// Sends what is due from the J1939 node.
    pub(super) fn poll_j1939(&mut self, now: Timestamp, out: &mut Outputs) {
        if let Some(j1939) = &mut self.j1939 {
            j1939.poll(now, out);
        }
    }

    /// Passes the present alarms to the J1939 node.
    pub(super) fn update_trouble_codes(&mut self, now: Timestamp, engine: &AlarmEngine) {
        if let Some(j1939) = &mut self.j1939 {
            j1939.update_trouble_codes(now, engine, self.test.is_some());
        }
    }
}
