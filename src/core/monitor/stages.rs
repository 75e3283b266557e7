//! Connects the stages after the intake: readings → samples → estimates → health → alarms → frames.
//!
//! Each stage owns its configuration and state. Only this file depends on the order of the stages. In all functions,
//! `now` is the time of the input that is being handled.

mod outlook;
pub(crate) mod pack_memory;
mod use_record;
pub(crate) mod watch;

use pack_memory::PackMemory;

use super::config::MonitorConfig;
use super::message::{Command, Estimate, Event, EventKind, Outputs, Source, Validity};
use super::stage::alarming::Alarming;
use super::stage::estimation::Estimation;
use super::stage::findings::Findings;
use super::stage::learning::Learning;
use super::stage::modelling::Modelling;
use super::stage::publisher::{Publisher, learned};
use super::stage::sampling::Sampling;
use super::stage::sending::Sending;
use super::stage::sleep::{BusSleep, QUIET_S, Silence};
use super::stage::statistics::Statistics;
use crate::alarm::{AlarmInput, CommandOutcome, Observation, Rule};
use crate::can::Frame;
use crate::can::encode::{HealthFields, StatusFields};
use crate::can::poll::CarState;
use crate::filter::ScalarGaussian;
use crate::health::ModeChange;
use crate::quantity::catalogue::PackValues;
use crate::quantity::{BusIndex, CellIndex, Channel, Mode, Reading, Timestamp};
use crate::sample::{CellSample, Moment};

#[derive(Debug)]
pub(crate) struct Stages {
    pub(crate) sampling: Sampling,
    pub(crate) estimation: Estimation,
    pub(crate) modelling: Modelling,
    pub(crate) learning: Learning,
    pub(crate) findings: Findings,
    pub(crate) alarming: Alarming,
    pub(crate) sending: Sending,
    pub(crate) statistics: Statistics,
    pub(crate) sleep: BusSleep,
    pub(crate) packs: PackMemory,
}

impl Stages {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
        let estimation = Estimation::new(config);
        Self {
            sampling: Sampling::new(config),
            modelling: Modelling::new(config),
            learning: Learning::new(config, &estimation.bank),
            findings: Findings::new(config, estimation.bank.own_cells()),
            estimation,
            alarming: Alarming::new(config),
            sending: Sending::new(config),
            statistics: Statistics::default(),
            sleep: BusSleep::new(config),
            packs: PackMemory::default(),
        }
    }

    pub(crate) fn publisher<'a>(&'a mut self, now: Timestamp, out: &'a mut Outputs) -> Publisher<'a> {
        self.learning_and_publisher(now, out).1
    }

    pub(crate) fn learning_and_publisher<'a>(
        &'a mut self,
        now: Timestamp,
        out: &'a mut Outputs,
    ) -> (&'a mut Learning, Publisher<'a>) {
        let publisher = Publisher { now, alarming: &mut self.alarming, sending: &mut self.sending, out };
        (&mut self.learning, publisher)
    }

    #[inline]
    pub(crate) fn handle_reading(&mut self, now: Timestamp, bus: BusIndex, reading: Reading, out: &mut Outputs) {
        match reading.channel {
            Channel::PackIdentity => return self.handle_identity(now, bus, reading, out),
            Channel::Balancing(cell) => return self.findings.handle_balancing(now, cell, reading.value),
            Channel::SupplyVoltage => return self.sending.handle_supply(now, reading.value),
            _ => {}
        }
        self.watch_reading(now, &reading, out);
        let sample = self.sampling.handle_reading(now, reading, out);
        if matches!(reading.channel, Channel::Current | Channel::Contactor) {
            self.observe_current(now, self.sampling.sampler.pack_current_a(now), out);
        }
        if let Some(sample) = sample {
            self.handle_sample(now, sample, out);
        }
    }

    /// Passes a received frame and the state of the car to the poller, which sends the diagnostic requests.
    pub(crate) fn poll_after_frame(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame, out: &mut Outputs) {
        let state = self.car_state();
        self.sending.poll_with(now, out, |poller, out| {
            poller.set_state(now, state);
            poller.handle_frame(now, bus, frame, out);
        });
    }

    fn car_state(&self) -> CarState {
        match self.learning.mode() {
            Mode::Discharge => CarState::Drive,
            Mode::Charge => CarState::Charge,
            Mode::Rest | Mode::Unknown => CarState::Parked,
        }
    }

    /// Handles a reading of a diagnostic answer. If `moment` is given, a voltage counts as measured at that earlier
    /// time.
    pub(crate) fn handle_answer_reading(
        &mut self,
        now: Timestamp,
        bus: BusIndex,
        moment: Option<&Moment>,
        reading: Reading,
        out: &mut Outputs,
    ) {
        match (reading.channel, moment) {
            (Channel::CellVoltage(_) | Channel::PackVoltage, Some(moment)) => {
                self.watch_reading(now, &reading, out);
                if let Some(sample) = self.sampling.handle_reading(now, reading, out) {
                    self.handle_sample(now, sample.measured_at(moment), out);
                }
            }
            _ => self.handle_reading(now, bus, reading, out),
        }
    }

    fn handle_identity(&mut self, now: Timestamp, bus: BusIndex, reading: Reading, out: &mut Outputs) {
        match self.sampling.identity.is_other(reading.value) {
            Some(true) if !self.packs.has_aside() => {
                self.step_waiting(now, true, out);
                let pack = self.stored_pack();
                self.packs.put_aside(pack);
            }
            Some(false) => self.packs.drop_aside(),
            _ => {}
        }
        let Some((identity, is_replacement)) = self.sampling.handle_identity(reading.value) else { return };
        if is_replacement {
            let before = self.packs.exchange(identity);
            self.handle_command(now, Source::Bus(bus), Command::PackReplaced, out);
            if let Some(pack) = before {
                self.restore_pack(now, pack, out);
            }
        }
        out.events.push(Event { time: now, kind: EventKind::PackIdentity { identity } });
    }

    /// Adds a sample to the batch, which holds one sample per cell. If the cell already has a sample in the batch, runs
    /// the filters on the old batch first. If every cell now has a sample, runs the filters.
    #[inline]
    fn handle_sample(&mut self, now: Timestamp, sample: CellSample, out: &mut Outputs) {
        if !self.estimation.batch.awaits(sample.cell) {
            self.complete_batch(now, out);
        }
        self.estimation.batch.add(sample);
        if self.estimation.batch.is_complete() {
            self.complete_batch(now, out);
        }
    }

    #[inline(never)]
    fn complete_batch(&mut self, now: Timestamp, out: &mut Outputs) {
        self.step_waiting(now, true, out);
        self.estimation.current_check.forget_jumps();
        self.estimation.batch.begin();
        let all_fresh = self.sampling.sampler.voltages_fresh(now);
        let Self { estimation, learning, alarming, sending, .. } = self;
        learning.combine_pack(all_fresh, &estimation.bank, &mut Publisher { now, alarming, sending, out });
    }

    /// Runs the filters on the waiting samples, without waiting for the other cells. Callers do this before they use
    /// estimates. If the samples are not recent (`is_current` is false), the alarm rule that judges the innovations
    /// (measured minus predicted voltages) ignores them.
    pub(crate) fn step_waiting(&mut self, now: Timestamp, is_current: bool, out: &mut Outputs) {
        if self.estimation.batch.waiting.is_empty() {
            return;
        }
        let samples = self.estimation.step(&mut self.learning.state.learner, &mut self.modelling);
        let bank = &self.estimation.bank;
        self.statistics.note_voltages(samples.iter().map(|sample| bank.result(sample.cell.index())));
        let is_quiet = self.are_innovations_quiet(out);
        for sample in &samples {
            self.handle_step(now, sample, out);
            if !is_quiet {
                self.judge_trust(now, sample.cell, is_current, out);
            }
        }
        if is_quiet && is_current {
            self.show_innovations(now, &samples);
        }
        let is_prior = self.modelling.is_label();
        let has_row_ended = self.findings.observe(now, &samples, (&self.estimation, is_prior), &self.learning, out);
        self.estimation.finish(samples, is_prior, &mut self.learning.state.learner);
        if has_row_ended {
            self.publish_diagnosis(now, true, out);
        }
    }

    fn handle_step(&mut self, now: Timestamp, sample: &CellSample, out: &mut Outputs) {
        if self.estimation.record(sample) {
            out.events.push(Event { time: now, kind: EventKind::FilterReset { cell: sample.cell } });
            self.learning.handle_reset(sample.cell, &mut self.estimation.bank);
        }
        self.learning.handle_sample(sample, self.estimation.bank.model(sample.cell.index()));
        if out.want_estimates {
            out.estimates.extend(self.estimate(sample.cell.index()));
        }
    }

    /// A cell's estimate after its latest sample; `None` before its first sample.
    pub(crate) fn estimate(&self, index: usize) -> Option<Estimate> {
        self.estimation.estimate(index, self.learning.capacity(index))
    }

    /// Passes the pack current (`None` if stale) to the mode detector (charge, discharge or rest). When the mode
    /// changes, the learning stage evaluates the period that has ended.
    fn observe_current(&mut self, now: Timestamp, current_a: Option<f64>, out: &mut Outputs) {
        let Learning { config, state, .. } = &mut self.learning;
        let observed = state.detector.observe(&config.transition, now, current_a);
        let strings = self.sampling.sampler.strings();
        let rest_a = config.transition.dead_band_a / strings;
        let mode = state.detector.mode();
        state.load.observe(now, mode, current_a.map(|pack_a| pack_a / strings), rest_a);
        state.moved.observe(now, current_a, || self.sampling.pack_voltage_v(self.estimation.cell_indices(), now));
        if observed.change.is_none() && !observed.candidate_begins {
            return;
        }
        self.step_waiting(now, true, out);
        if let Some(change) = observed.change {
            self.complete_mode(now, change, out);
        }
        if observed.candidate_begins {
            let (charge_as, _) = self.sampling.sampler.counted(now);
            let (estimation, is_label) = (&self.estimation, self.modelling.is_label());
            let soc = |cell: usize| estimation.soc_at_mark(cell, is_label);
            self.learning.state.learner.mark_candidate(now, charge_as, soc);
        }
    }

    fn complete_mode(&mut self, now: Timestamp, change: ModeChange, out: &mut Outputs) {
        let Self { estimation, modelling, learning, alarming, sending, .. } = self;
        let mut publisher = Publisher { now, alarming, sending, out };
        let is_label = modelling.is_label();
        let is_doubtful = estimation.take_doubt();
        if is_doubtful {
            learning.state.learner.interrupt_span();
        }
        let is_doubtful = |cell: usize| is_doubtful || estimation.is_voltage_frozen(cell);
        let doubtful: Vec<bool> = (0..estimation.cells()).map(is_doubtful).collect();
        let first = publisher.out.events.len();
        learning.complete_mode(change, &mut estimation.bank, (is_label, &doubtful), &mut publisher);
        if out.events[first..].iter().any(|event| matches!(event.kind, EventKind::HalfCycle { .. })) {
            out.events.extend(self.recorded_outlook().map(|kind| Event { time: now, kind }));
        }
    }

    /// Fits the cell model to the collected data. If the fit changes the model, the estimators adopt the new model.
    fn learn_model(&mut self, now: Timestamp, out: &mut Outputs) {
        self.step_waiting(now, true, out);
        let Self { estimation, modelling, learning, .. } = self;
        let before = modelling.view().state;
        let adoption = modelling.refit();
        if let Some(adoption) = &adoption {
            estimation.adopt(adoption, &mut learning.state.learner, &learning.config.capacity);
        } else if modelling.has_returned() {
            estimation.use_model(modelling, &learning.state.learner);
        }
        out.events.extend(self.modelling.note_change(now, before));
        if adoption.is_some_and(|it| it.with_capacity) {
            self.restate_capacities(now, out);
        }
    }

    /// Passes the capacities of the cells to the capacity rules. Called when a new model has changed the capacities.
    /// Cells in modules with other cells have their own model and are skipped.
    fn restate_capacities(&mut self, now: Timestamp, out: &mut Outputs) {
        for index in self.estimation.bank.own_cells().to_vec() {
            let capacity = self.learning.learned_capacity(index);
            let cell = Some(CellIndex(u16::try_from(index).unwrap_or(u16::MAX)));
            let mut publisher = self.publisher(now, out);
            match capacity {
                Some(capacity) => publisher.observe(Rule::CapacityLow, cell, learned(capacity)),
                None => {
                    for rule in [Rule::CapacityLow, Rule::UsableCapacityLow] {
                        publisher.restate(rule, cell, Observation::new(None));
                    }
                    self.learning.cells[index].usable = None;
                }
            }
        }
    }

    pub(crate) fn handle_command(
        &mut self,
        now: Timestamp,
        source: Source,
        command: Command,
        out: &mut Outputs,
    ) -> CommandOutcome {
        self.step_waiting(now, true, out);
        if command == Command::PackReplaced {
            // Learned values that were put aside when a reading showed another pack number belong to the old pack. Drop
            // them, whatever the pack number is now.
            self.packs.drop_aside();
        }
        let CommandOutcome { changed, refused } = match command {
            Command::Acknowledge(which) => self.publisher(now, out).apply(AlarmInput::Acknowledge(which)),
            Command::Clear(which) => self.publisher(now, out).apply(AlarmInput::Clear(which)),
            Command::PackReplaced => {
                self.replace_pack(now, out);
                let changed = u32::try_from(self.alarming.changes.len()).unwrap_or(u32::MAX);
                CommandOutcome { changed, refused: 0 }
            }
            Command::Poll { standby } => {
                let is_there = self.sending.poller.is_some();
                self.sending.poll_with(now, out, |poller, out| {
                    poller.set_standby(standby);
                    poller.poll(now, out);
                });
                CommandOutcome { changed: u32::from(is_there), refused: u32::from(!is_there) }
            }
            Command::Test { rule, seconds } => {
                let has_output = self.sending.start_test(now, rule, seconds, &self.alarming.engine, out);
                CommandOutcome { changed: 0, refused: u32::from(!has_output) }
            }
        };
        let mut publisher = self.publisher(now, out);
        publisher.event(EventKind::Command { source, command, changed, refused });
        publisher.publish_alarms();
        CommandOutcome { changed, refused }
    }

    /// Publishes the learned capacity of the old pack as an event, and forgets all its learned values.
    fn replace_pack(&mut self, now: Timestamp, out: &mut Outputs) {
        let capacity = self.learning.weakest().map(|(_, capacity)| capacity);
        let kind = EventKind::PackReplaced {
            capacity_ah: capacity.map(|capacity| capacity.mean),
            capacity_std_ah: capacity.as_ref().map(ScalarGaussian::std),
        };
        out.events.push(Event { time: now, kind });
        self.modelling.forget();
        self.estimation.forget(&self.modelling);
        self.estimation.bank.set_current_offset_std(self.learning.config.capacity.current_offset_std_a);
        self.learning.forget(&self.estimation.bank);
        self.findings.forget();
        self.forget_pack_state();
        self.alarming.state.knows_all_valid = false;
        self.alarming.faulty_channels.clear();
        for cell in self.estimation.cell_indices() {
            self.publisher(now, out).observe(Rule::ChannelFaulty, Some(cell), Observation::default());
        }
        self.publisher(now, out).apply(AlarmInput::ForgetLearned);
    }

    /// Marks the pack's values as unknown until every cell has a new estimate.
    fn forget_pack_state(&mut self) {
        self.learning.state.pack = None;
        self.estimation.batch.begin();
    }

    /// Ends everything in progress, because no reading follows for a while. `now` is the time of the last input. The
    /// mode becomes unknown, and recharge periods are not timed across the gap. The pack's values become unknown until
    /// every cell has a new reading.
    pub(crate) fn fall_asleep(&mut self, now: Timestamp, out: &mut Outputs) {
        self.observe_current(now, None, out);
        if self.modelling.is_due() {
            self.learn_model(now, out);
        }
        self.modelling.end_stretch();
        self.sending.poll_with(now, out, |poller, _| poller.restart());
        self.publisher(now, out).apply(AlarmInput::Gap);
        self.learning.state.recharge.interrupt();
        self.learning.state.load.interrupt();
        self.estimation.bank.change_all(|_, cell| cell.note_sleep());
        self.forget_pack_state();
        self.findings.interrupt_thermal();
    }

    pub(crate) fn wake(&mut self, time: Timestamp, out: &mut Outputs) {
        self.sampling.sampler.wake(time);
        self.sending.restart(time);
        self.sending.claim_address(time, out);
    }

    /// Ends everything that cannot continue across a gap of unknown length. The gap starts at `now`.
    pub(crate) fn begin_unknown_gap(&mut self, now: Timestamp, out: &mut Outputs) {
        self.sending.end_test(now, &self.alarming.engine, out);
        if let Some(change) = self.learning.state.detector.settle() {
            self.complete_mode(now, change, out);
        }
        self.learning.state.learned_at = None;
        self.learning.state.use_counter.interrupt();
    }

    pub(crate) fn end_unknown_gap(&mut self, time: Timestamp, out: &mut Outputs) {
        self.sampling.sampler.handle_gap(time);
        self.sending.restart(time);
        self.sending.claim_address(time, out);
        self.estimation.handle_unknown_gap();
        self.findings.diagnosis.forget_charge();
        self.findings.interrupt_thermal();
    }

    /// Runs the checks that depend only on time: ages of the inputs, minimum duration of the mode, and alarms.
    pub(crate) fn run_housekeeping(
        &mut self,
        now: Timestamp,
        bus_fault: Observation,
        silence: Silence,
        out: &mut Outputs,
    ) {
        let is_judged = silence == Silence::None;
        if is_judged {
            self.sampling.poll(now, out);
        }
        if silence != Silence::Lasts {
            self.observe_current(now, self.sampling.sampler.pack_current_a(now), out);
            if self.modelling.observe_mode(now, self.learning.mode()) {
                self.learn_model(now, out);
            }
        }
        if !self.sampling.sampler.voltages_fresh(now) {
            // The pack's values are unknown, because a cell without a fresh voltage may be the cell that limits the
            // pack.
            self.forget_pack_state();
        }
        let is_current_frozen = self.sampling.sampler.is_current_frozen();
        let is_contradicted = self.estimation.current_check.is_doubtful();
        self.estimation.is_current_doubtful = self.sampling.has_second_sender || is_current_frozen || is_contradicted;
        self.findings.watch_current(now, is_current_frozen, out);
        if is_judged {
            self.count_use(now);
            self.watch(now, out);
        }
        self.watch_computer(now, bus_fault, out);
    }

    pub(crate) fn send_due(&mut self, now: Timestamp, out: &mut Outputs) {
        self.sending.poll_j1939(now, out);
        let state = self.car_state();
        self.sending.poll_with(now, out, |poller, out| {
            poller.set_state(now, state);
            poller.poll(now, out);
        });
        let Some([is_status_due, is_health_due, is_alarm_due, is_digest_due]) = self.sending.take_frames_due(now)
        else {
            return;
        };
        if is_status_due {
            let fields = self.status_fields();
            self.sending.send_status(now, &fields, out);
        }
        if is_health_due {
            let mut outlook = PackValues::default();
            if self.sending.has_outlook() {
                let _ = self.set_outlook(&mut outlook);
            }
            let fields = HealthFields {
                model_state: Some(self.modelling.view().state.code()),
                outlook,
                ..self.learning.health_fields(&self.estimation.bank)
            };
            self.sending.send_health(now, &fields, out);
        }
        if is_alarm_due {
            self.sending.send_unknown_alarm(now, &self.alarming.engine, out);
        }
        self.sending.send_due_alarms(now, &self.alarming.engine, out);
        if is_digest_due {
            self.sending.send_digest(now, &self.alarming.engine, out);
        }
        self.sending.continue_test(now, &self.alarming.engine, out);
    }

    pub(crate) fn validity(&self) -> Validity {
        if self.learning.state.pack.is_none() {
            Validity::Unavailable
        } else if !self.estimation.all_trusted {
            Validity::Untrusted
        } else if self.sampling.sampler.any_bad() {
            Validity::Degraded
        } else {
            Validity::Valid
        }
    }

    fn status_fields(&self) -> StatusFields {
        let (pack, engine) = (self.learning.state.pack.as_ref(), &self.alarming.engine);
        StatusFields {
            soc: pack.map(|pack| pack.soc),
            soc_std: pack.map(|pack| pack.soc_std),
            mode: Some(self.learning.mode()),
            validity: self.validity() as u8,
            // Without an estimate, 0 (no alarm) would be unfounded, so the field is unknown.
            highest_severity: engine.highest_severity().map(|severity| severity as u8).or(pack.map(|_| 0)),
            active_alarms: Some(u16::try_from(engine.count()).unwrap_or(u16::MAX)),
            limiting_cell: pack.map(|pack| pack.limiting_cell),
            unknown_rules: Some(match engine.unknown() {
                (_, 0) => 0,
                (all, unknown) if unknown < all => 1,
                (_, _) => 2,
            }),
        }
    }

    /// Judges whether the silence of all inputs means that the vehicle sleeps.
    pub(crate) fn silence(&self, now: Timestamp) -> Silence {
        let Some(after_s) = self.sleep.after_s else { return Silence::None };
        if self.sleep.since.is_some() {
            return Silence::Lasts;
        }
        let sampler = &self.sampling.sampler;
        let transition = &self.learning.config.transition;
        let rest_a = transition.dead_band_a + transition.hysteresis_a;
        // Before the first reading, silence does not count as sleep, because the wiring may be wrong.
        let Some(silent_s) = sampler.all_silent_s(now, QUIET_S) else { return Silence::None };
        if sampler.latest_current_a(now).is_none_or(|current_a| current_a.abs() > rest_a) {
            return Silence::None;
        }
        if silent_s > after_s { Silence::Begins } else { Silence::Quiet }
    }

    pub(crate) fn begin_bus_sleep(&mut self, now: Timestamp, out: &mut Outputs) {
        self.sleep.since = Some(now);
        self.fall_asleep(now, out);
        out.events.push(Event { time: now, kind: EventKind::BusAsleep { asleep: true, seconds: None } });
    }

    /// Ends the bus sleep. Called at the first reading after the sleep.
    #[cold]
    pub(crate) fn end_bus_sleep(&mut self, now: Timestamp, out: &mut Outputs) {
        let Some(since) = self.sleep.since.take() else { return };
        let seconds = Some(now.since(since));
        out.events.push(Event { time: now, kind: EventKind::BusAsleep { asleep: false, seconds } });
        self.sampling.sampler.wake(now);
        self.sending.wake(now, since);
    }

    /// Whether a reading of this channel ends a bus sleep. A reading of the supply voltage does not, because the
    /// computer itself may measure this voltage. A balancing bit does not, because a BMS may balance while the vehicle
    /// is parked.
    pub(crate) fn wakes(channel: Channel) -> bool {
        !matches!(channel, Channel::SupplyVoltage | Channel::Balancing(_))
    }
}
