//! Sending stage: cyclic frames, alarm frames, replies to commands, tests, diagnostic requests, and the J1939 node.
//!
//! In: values from the other stages, alarms, ticks. Out: frames in [`Outputs`]. If the stage misses a period, it does
//! not send the frame later. Without `[output]`, only the J1939 node and the poller (diagnostic requests) send.

use serde::{Deserialize, Serialize};

pub(crate) mod alarm_queue;
mod digest;
pub(crate) mod j1939;
mod schedule;

use alarm_queue::AlarmKey;
use j1939::J1939;
pub use schedule::RESTART_FRESHNESS;
use schedule::{Schedule, take_due};

use crate::alarm::{Alarm, AlarmEngine, AlarmState, Rule};
use crate::can::Frame;
use crate::can::encode::{
    AlarmFields, HealthFields, LayoutMessage, OutputPlan, REPLY_DELAY_MS, ReplyFields, SendCounters, StatusFields,
};
use crate::can::j1939::Node;
use crate::can::poll::{PollOutputs, PollProgress, Poller};
use crate::monitor::config::{MonitorConfig, OutputConfig, SupplyConfig};
use crate::monitor::message::{Event, EventKind, Outputs, Secured, Transmit};
use crate::quantity::{BusIndex, Fault, Timestamp};

/// Period of the frames of a test (s). A receiver that reads once a second still gets several frames.
const TEST_PERIOD_S: f64 = 0.1;
/// Longest duration of a test (s), so that a forgotten test ends.
pub const MAX_TEST_S: f64 = 600.0;

/// Number of replies that may be sent at once after a pause. Further replies are at least [`REPLY_DELAY_MS`] apart, and
/// replies in between are dropped. A small number suffices, because a sender of commands waits for each reply.
const REPLY_BURST: i64 = 5;
const REPLY_DELAY_NS: i64 = REPLY_DELAY_MS as i64 * 1_000_000;

#[derive(Debug)]
pub(crate) struct Sending {
    config: Option<OutputConfig>,
    pub(crate) schedule: Schedule,
    /// The running test of an alarm frame; a test does not continue after a restart.
    test: Option<AlarmTest>,
    pub(crate) j1939: Option<J1939>,
    pub(crate) poller: Option<Poller>,
    supply: Option<SupplyConfig>,
    /// Whether an alarm change has changed the time at which work is next due.
    is_rescheduled: bool,
    /// Buffer for the poller's outputs; reused to avoid allocations.
    polled: PollOutputs,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SendingState {
    pub(crate) schedule: Schedule,
    test: Option<AlarmTest>,
    poller: Option<PollProgress>,
    node: Option<Node>,
}

impl SendingState {
    /// Drops everything that ends with the process: a test, diagnostic requests and the J1939 address. For the
    /// diagnostic requests, standby remains, and so does the silence after requests of another tester.
    pub(crate) fn restart(&mut self, now: Timestamp) {
        (self.test, self.node) = (None, None);
        self.poller.take_if(|poller| !poller.restart(now));
    }

    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.schedule.rebase(by_nanos);
        self.poller.iter_mut().for_each(|poller| poller.rebase(by_nanos));
    }
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct AlarmTest {
    rule: Rule,
    next: Timestamp,
    end: Timestamp,
}

/// Interfaces on which to send a frame: only `bus` if it is an output interface, otherwise all output interfaces.
fn buses_of(output: &OutputConfig, bus: Option<BusIndex>) -> impl Iterator<Item = BusIndex> + '_ {
    let only = bus.filter(|bus| output.buses.contains(bus));
    output.buses.iter().copied().filter(move |other| only.is_none_or(|bus| bus == *other))
}

impl Sending {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
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

    pub(crate) fn snapshot(&self) -> SendingState {
        SendingState {
            schedule: self.schedule.clone(),
            test: self.test,
            poller: self.poller.as_ref().map(|poller| poller.progress().clone()),
            node: self.j1939.as_ref().map(|j1939| j1939.node.clone()),
        }
    }

    /// Restores the standby of the diagnostic requests, and their silence after requests of another tester. `taken`:
    /// time of the stored state.
    pub(crate) fn restore_silence(&mut self, state: &SendingState, taken: Timestamp, now: Timestamp) {
        if let (Some(poller), Some(stored)) = (&mut self.poller, &state.poller) {
            poller.restore_silence(stored, taken, now);
        }
    }

    /// Resumes a test, diagnostic requests and the J1939 node from a stored state. The caller has already restored the
    /// schedule.
    pub(crate) fn resume(&mut self, state: &SendingState) {
        self.test = state.test;
        if let (Some(poller), Some(stored)) = (&mut self.poller, &state.poller) {
            poller.resume(stored);
        }
        if let (Some(j1939), Some(stored)) = (&mut self.j1939, &state.node) {
            j1939.node.resume(stored);
        }
    }

    /// Applies another `[output]` configuration. If the new configuration has no `[output]`, a running test ends, and
    /// the alarm queue is emptied.
    pub(crate) fn reconfigure(
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

    /// Applies another J1939 configuration. An unchanged node keeps its address; a new node claims an address.
    pub(crate) fn reconfigure_j1939(
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

    /// Makes housekeeping (the checks that depend only on time) due now. After a restart, all values are unknown, so
    /// they must be compared with the rules before a frame is sent.
    pub(crate) fn compare_first(&mut self, now: Timestamp) {
        self.schedule.housekeeping = self.schedule.housekeeping.min(now);
    }

    /// While the buses sleep, omits cyclic frames, unless the configuration requests them.
    pub(crate) fn set_asleep(&mut self, now: Timestamp, is_asleep: bool) {
        // If a poller is configured, the inputs of an awake bus are silent between two polls. The poller receives every
        // frame, so it decides whether the bus sleeps.
        let is_asleep = is_asleep && self.poller.as_ref().is_none_or(|poller| poller.is_bus_asleep(now));
        let is_omitted = self.config.as_ref().is_none_or(|config| !config.while_asleep);
        self.schedule.is_quiet = is_asleep && is_omitted && now >= self.schedule.quiet_from;
    }

    /// Ends the silence of a sleep that began at `since`.
    pub(crate) fn wake(&mut self, now: Timestamp, since: Timestamp) {
        self.restart(now);
        if let Some(j1939) = &mut self.j1939 {
            j1939.node.resume_cyclic(now, since);
        }
    }

    /// Whether the health frame contains energy, time or power.
    pub(crate) fn has_outlook(&self) -> bool {
        self.config.as_ref().is_some_and(|config| config.plan.has_outlook())
    }

    /// Makes all cyclic work due now. Called after a start, a sleep, and a gap.
    pub(crate) fn restart(&mut self, now: Timestamp) {
        self.is_rescheduled = true;
        self.schedule.restart(now);
    }

    /// Skips the counters of all frames that an earlier process sent after its state was stored, or would have sent by
    /// `now`. To receivers, the frames of the downtime then look lost, and no counter repeats.
    pub(crate) fn skip_counters(&mut self, stored: Timestamp, now: Timestamp, engine: &AlarmEngine) {
        let Some(config) = &self.config else { return };
        let Schedule { status, health, alarm, digest, alarms, counters, .. } = &mut self.schedule;
        let periods = |due: Timestamp, period_s: f64| {
            let periods = (now.since(due) / period_s).floor() + 1.0;
            // The cast saturates: a negative number of periods becomes 0.
            periods.max(0.0) as u64
        };
        let pages = |count: usize| u64::try_from(count).unwrap_or(0);
        // The queue still holds the alarms that the earlier process announced as unknown.
        let unknown = u64::from(alarms.has_unknown()) * periods(*alarm, config.alarm_period_s);
        alarms.limit(stored, now, config.alarm_period_s);
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
            // The state is not stored after a refused command, so the stored state may lack the counter of the reply to
            // that command.
            (LayoutMessage::Reply, 1),
        ] {
            config.plan.skip(message, frames, counters);
        }
    }

    /// Time at which a tick next has an effect.
    pub(crate) fn next_due(&self) -> Timestamp {
        let schedule = &self.schedule;
        let sending = self.config.as_ref().map(|config| {
            let digest = (config.plan.digest_pages() > 0).then_some(schedule.digest);
            let freshness = config.plan.authentication(LayoutMessage::Freshness).map(|_| schedule.freshness);
            let changing = digest.into_iter().chain(schedule.alarms.next_due()).chain(freshness);
            changing.fold(schedule.status.min(schedule.health).min(schedule.alarm), Timestamp::min)
        });
        let test = self.test.map(|test| test.next.min(test.end));
        let node = self.j1939.as_ref().and_then(J1939::next_due);
        let poller = self.poller.as_ref().and_then(Poller::next_due);
        [sending, test, node, poller].into_iter().flatten().fold(schedule.housekeeping, Timestamp::min)
    }

    pub(crate) fn take_housekeeping_due(&mut self, now: Timestamp, period_s: f64) -> bool {
        take_due(&mut self.schedule.housekeeping, now, period_s)
    }

    /// Whether the status, health and alarm frames and the digest are due; `None` without `[output]`.
    pub(crate) fn take_frames_due(&mut self, now: Timestamp) -> Option<[bool; 4]> {
        Some(self.schedule.take_frames_due(now, self.config.as_ref()?))
    }

    pub(crate) fn take_freshness_due(&mut self, now: Timestamp) -> bool {
        let is_sent = |config: &OutputConfig| config.plan.authentication(LayoutMessage::Freshness).is_some();
        self.config.as_ref().is_some_and(is_sent) && self.schedule.take_freshness_due(now)
    }

    /// Announces the freshness (the counter of authenticated frames, as in AUTOSAR SecOC) that commands may use next.
    /// `bus`: interface on which commands are received.
    pub(crate) fn send_freshness(&mut self, time: Timestamp, bus: Option<BusIndex>, freshness: u64, out: &mut Outputs) {
        let Some(output) = &self.config else { return };
        let secoc = output.plan.authentication(LayoutMessage::Freshness);
        let (Some(mut frame), Some(authentication)) = (output.plan.freshness(), secoc) else { return };
        authentication.write_freshness(frame.data_mut(), freshness);
        let secured = Some(Secured { authentication, freshness });
        let transmit = |bus| Transmit { time, bus, frame, announces: false, secured };
        out.frames.extend(buses_of(output, bus).map(transmit));
    }

    pub(crate) fn send_status(&mut self, now: Timestamp, fields: &StatusFields, out: &mut Outputs) {
        self.send(now, LayoutMessage::Status, out, |plan, counters| Some(plan.status(fields, counters)));
    }

    pub(crate) fn send_health(&mut self, now: Timestamp, fields: &HealthFields, out: &mut Outputs) {
        let pages = self.config.as_ref().map_or(0, |output| output.plan.health_pages());
        for page in 0..pages {
            self.send(now, LayoutMessage::Health, out, |plan, counters| Some(plan.health(page, fields, counters)));
        }
    }

    /// Sends the next alarm whose state is unknown, and queues the alarms whose state is known again.
    pub(crate) fn send_unknown_alarm(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let turn = self.schedule.alarm_turn;
        self.schedule.alarm_turn = turn.wrapping_add(1);
        self.schedule.alarms.note_known(now, engine);
        if let Some(alarm) = self.schedule.alarms.take_unknown(now, engine, turn) {
            self.send_alarm(now, &alarm, out);
        }
    }

    pub(crate) fn send_due_alarms(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let Some(period_s) = self.config.as_ref().map(|config| config.alarm_period_s) else { return };
        if self.schedule.is_quiet {
            self.schedule.alarms.skip_turns(now, engine, period_s);
        }
        // The loop ends when no alarm is due or the budget of alarm frames is used up.
        while let Some(key) = self.schedule.alarms.take(now, engine, period_s) {
            self.send_key(now, key, engine, out);
        }
    }

    /// Queues an alarm change. The caller then calls [`send_changed_alarms`](Self::send_changed_alarms).
    pub(crate) fn note_change(&mut self, now: Timestamp, key: AlarmKey) {
        if self.config.is_some() {
            self.schedule.alarms.note_change(now, key);
            self.is_rescheduled = true;
        }
    }

    /// Sends the present state of changed alarms, as far as the budget of alarm frames allows. The remaining alarms and
    /// the repetitions follow later.
    pub(crate) fn send_changed_alarms(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        while let Some(key) = self.schedule.alarms.take_changed(now) {
            self.send_key(now, key, engine, out);
        }
    }

    /// Whether an alarm change has changed the time of the next due work since the last call.
    #[inline]
    pub(crate) fn take_rescheduled(&mut self) -> bool {
        std::mem::take(&mut self.is_rescheduled)
    }

    /// Sends the present state of an alarm. If the alarm no longer has a threshold, sends its state as unknown.
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

    pub(crate) fn send_digest(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let Some(config) = &self.config else { return };
        let (pages, period_s) = (config.plan.digest_pages(), config.alarm_period_s);
        if pages == 0 {
            return;
        }
        let turn = self.schedule.threshold_turn;
        self.schedule.threshold_turn = turn.wrapping_add(1);
        let fields = digest::fields(engine, period_s, turn);
        for page in 0..pages {
            self.send(now, LayoutMessage::Digest, out, |plan, counters| plan.digest(page, &fields, counters));
        }
    }

    /// Sends the reply to a command that was received on `bus`. If `bus` is not an output interface, sends the reply on
    /// all output interfaces. If replies follow each other too fast ([`REPLY_BURST`]), drops the reply.
    pub(crate) fn send_reply(&mut self, now: Timestamp, bus: BusIndex, fields: &ReplyFields, out: &mut Outputs) {
        if self.schedule.reply > now || self.config.as_ref().is_none_or(|output| !output.plan.has_reply()) {
            return;
        }
        let earliest = now.plus_nanos(-(REPLY_BURST - 1) * REPLY_DELAY_NS);
        self.schedule.reply = self.schedule.reply.max(earliest).plus_nanos(REPLY_DELAY_NS);
        self.send_on(now, LayoutMessage::Reply, Some(bus), out, |plan, counters| plan.reply(fields, counters));
    }

    fn send_alarm_fields(&mut self, now: Timestamp, fields: &AlarmFields, out: &mut Outputs) {
        self.send(now, LayoutMessage::Alarm, out, |plan, counters| Some(plan.alarm(fields, counters)));
    }

    /// Sends the frame returned by `encode` on every output interface.
    fn send(
        &mut self,
        time: Timestamp,
        message: LayoutMessage,
        out: &mut Outputs,
        encode: impl FnOnce(&OutputPlan, &mut SendCounters) -> Option<Frame>,
    ) {
        self.send_on(time, message, None, out, encode);
    }

    /// Sends the frame that `encode` returns. `bus`: interface of the request that the frame answers; `None` if the
    /// frame is not an answer.
    fn send_on(
        &mut self,
        time: Timestamp,
        message: LayoutMessage,
        bus: Option<BusIndex>,
        out: &mut Outputs,
        encode: impl FnOnce(&OutputPlan, &mut SendCounters) -> Option<Frame>,
    ) {
        let Some(output) = &self.config else { return };
        let Some(mut frame) = encode(&output.plan, &mut self.schedule.counters) else { return };
        let secured = output.plan.authentication(message).map(|authentication| {
            let freshness = self.schedule.sent_freshness.saturating_add(1);
            self.schedule.sent_freshness = freshness;
            authentication.write_freshness(frame.data_mut(), freshness);
            Secured { authentication, freshness }
        });
        let announces = message != LayoutMessage::Status;
        let transmit = |bus| Transmit { time, bus, frame, announces, secured };
        out.frames.extend(buses_of(output, bus).map(transmit));
    }

    /// Ends a running test and starts to send a rule's alarm frame, marked as a test. If `seconds` is 0, only ends the
    /// running test. Returns `false` without `[output]`.
    pub(crate) fn start_test(
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

    /// Sends the test's frame when it is due, and ends the test on time.
    pub(crate) fn continue_test(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let Some(test) = &mut self.test else { return };
        if now >= test.end {
            self.end_test(now, engine, out);
        } else if take_due(&mut test.next, now, TEST_PERIOD_S) {
            let rule = test.rule;
            self.send_test(now, rule, AlarmState::Active, out);
        }
    }

    pub(crate) fn end_test(&mut self, now: Timestamp, engine: &AlarmEngine, out: &mut Outputs) {
        let Some(AlarmTest { rule, .. }) = self.test.take() else { return };
        self.send_test(now, rule, AlarmState::Inactive, out);
        out.events.push(Event { time: now, kind: EventKind::Test { rule, running: false } });
        self.update_trouble_codes(now, engine);
        self.poll_j1939(now, out);
    }

    /// Sends a test frame without value and threshold, so that receivers cannot mistake the frame for a measurement.
    fn send_test(&mut self, now: Timestamp, rule: Rule, state: AlarmState, out: &mut Outputs) {
        let (rule, state) = (rule as u8, Some(state.wire_code()));
        self.send_alarm_fields(now, &AlarmFields { rule, state, test: true, ..AlarmFields::default() }, out);
    }

    /// If there is a poller, runs `act` on it and adds its frames and events to the outputs.
    pub(crate) fn poll_with(
        &mut self,
        now: Timestamp,
        out: &mut Outputs,
        act: impl FnOnce(&mut Poller, &mut PollOutputs),
    ) {
        let Some(poller) = &mut self.poller else { return };
        act(poller, &mut self.polled);
        let transmit = |(bus, frame)| Transmit { time: now, bus, frame, announces: false, secured: None };
        out.frames.extend(self.polled.frames.drain(..).map(transmit));
        let event = |change| Event { time: now, kind: EventKind::Poll(change) };
        out.events.extend(self.polled.changes.drain(..).map(event));
    }

    pub(crate) fn handle_supply(&mut self, now: Timestamp, value: Result<f64, Fault>) {
        if let (Some(poller), Some(supply)) = (&mut self.poller, self.supply) {
            let is_good = value.is_ok_and(|volts| volts >= supply.minimum_v);
            poller.set_supply(is_good.then(|| now.plus_secs(supply.max_age_s)));
        }
    }

    /// Claims the J1939 address. Called at the start, after a sleep or gap, for a new node, and when the interface is
    /// up again.
    pub(crate) fn claim_address(&mut self, now: Timestamp, out: &mut Outputs) {
        if let Some(j1939) = &mut self.j1939 {
            j1939.claim_address(now, out);
        }
    }

    /// Passes a frame to the J1939 node. The node ignores frames of other interfaces.
    pub(crate) fn handle_j1939_frame(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame, out: &mut Outputs) {
        if let Some(j1939) = &mut self.j1939 {
            j1939.handle_frame(now, bus, frame, out);
        }
    }

    pub(crate) fn poll_j1939(&mut self, now: Timestamp, out: &mut Outputs) {
        if let Some(j1939) = &mut self.j1939 {
            if self.schedule.is_quiet {
                j1939.node.skip_cyclic(now);
            }
            j1939.poll(now, out);
        }
    }

    pub(crate) fn update_trouble_codes(&mut self, now: Timestamp, engine: &AlarmEngine) {
        if let Some(j1939) = &mut self.j1939 {
            j1939.update_trouble_codes(now, engine, self.test.is_some());
        }
    }
}
