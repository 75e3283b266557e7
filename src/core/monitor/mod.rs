//! The core's one face: inputs in, outputs out. Never reads a clock, a file or a socket, and never logs.
//!
//! Inputs come in the order in which they happened; the same inputs give the same outputs, byte for byte.
//! Frames become readings, readings become samples, each voltage sample steps its cell's estimator; a
//! charge/discharge transition runs the capacity filters; values go to the alarm rules; ticks send the cyclic
//! frames. Bad input is an event and a count, never a panic.

mod alarms;
mod buses;
mod cyclic;
mod heard;
mod identity;
mod intake;
mod j1939;
mod learning;
mod life;
mod output;
mod reconfigure;
mod snapshot;
mod statistics;
mod steps;
mod types;
mod view;

pub use cyclic::MAX_TEST_S;
pub use j1939::{AlarmCode, J1939Config};
pub use output::{CommandConfig, OutputConfig};
pub use reconfigure::{ReconfigureError, Reconfigured};
pub use snapshot::{RestoreError, Snapshot};
pub use statistics::{AlarmCounts, BusStatistics, Statistics};
pub use types::*;
pub use view::{CellView, PackView};

use alarms::{HOUSEKEEPING_S, StoreState};
use buses::Buses;
use cyclic::{Schedule, Test};
use intake::Intake;
use life::CellLife;
use snapshot::{PendingRestore, Taken};
use steps::{CellBatch, end_state};

use crate::alarm::{AlarmChange, AlarmEngine, AlarmInput, RuleConfig};
use crate::can::decode::InputMap;
use crate::can::flood::{FloodConfig, FloodCount};
use crate::can::guard::{GuardConfig, GuardCounts};
use crate::can::j1939::Node;
use crate::can::{CanId, Frame};
use crate::cell::{CellEstimator, CellModel, EstimatorBank, EstimatorConfig};
use crate::filter::ScalarGaussian;
use crate::health::{HalfCycle, HealthConfig, Learner, PackState, RechargeTimer, TransitionDetector};
use crate::quantity::{BusIndex, CellIndex, Channel, Mode, Reading, Timestamp};
use crate::sample::{CellSample, SampleConfig, Sampler, SignalChange};

/// Without any input, not even a tick, for this long, the computer was asleep, s: 500 ticks.
const ASLEEP_S: f64 = 5.0;
const ASLEEP_NS: i64 = (ASLEEP_S * 1e9) as i64;

/// Everything the core must know, already checked.
#[derive(Debug, Clone)]
pub struct MonitorConfig {
    /// How many interfaces there are.
    pub interfaces: usize,
    /// What input frames mean.
    pub input: InputMap,
    /// Input messages with end-to-end protection.
    pub guards: Vec<GuardConfig>,
    /// Readings in a row that must say another pack identity, where such a signal is among `input`.
    pub identity_readings: u32,
    /// How many frames of one identifier are taken in.
    pub flood: FloodConfig,
    /// Sample stage.
    pub sample: SampleConfig,
    /// Cell model.
    pub model: CellModel,
    /// Estimator.
    pub estimator: EstimatorConfig,
    /// Learning at transitions.
    pub health: HealthConfig,
    /// Alarm rules.
    pub rules: Vec<RuleConfig>,
    /// What is sent, when and where; `None` = the daemon only listens.
    pub output: Option<OutputConfig>,
    /// Commands taken from the bus; `None` = none.
    pub commands: Option<CommandConfig>,
    /// The J1939 node; `None` = there is none.
    pub j1939: Option<J1939Config>,
}

/// How far a cell's samples have been taken in. Every sample touches this, so it lies apart from all else that is known of
/// a cell.
#[derive(Debug, Clone, Copy, Default)]
struct Progress {
    /// Sampler totals at the last step; `None` before the first.
    consumed: Option<Consumed>,
    /// The sample of the latest estimate.
    sample: Option<CellSample>,
}

/// What is known of a cell beside its estimator and its samples.
#[derive(Debug, Clone)]
struct CellSlot {
    trusted: bool,
    /// SOC the last full charge left; 1 until one was seen.
    full_soc: f64,
    /// Whether the present charge has tapered off at the highest voltage.
    tapered: bool,
    usable: Option<ScalarGaussian>,
    /// Resistance relative to new as the last discharge left it.
    discharge_resistance: Option<ScalarGaussian>,
    life: CellLife,
}

impl CellSlot {
    /// A cell of which nothing is known.
    fn new(config: &MonitorConfig) -> Self {
        Self {
            trusted: true,
            full_soc: 1.0,
            tapered: false,
            usable: None,
            discharge_resistance: None,
            life: CellLife::new(config),
        }
    }
}

/// Totals of the sampler a cell has already taken in.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
struct Consumed {
    time: Timestamp,
    charge_as: f64,
    unmeasured_s: f64,
}

/// The pure core.
#[derive(Debug)]
pub struct Monitor {
    config: MonitorConfig,
    /// Whether an input has come.
    started: bool,
    /// Whether a usable reading has come since then.
    heard: bool,
    /// Time of the latest input that did something.
    now: Timestamp,
    /// Inputs that came with a time before `now`.
    time_backwards: u64,
    intake: Intake,
    identity: identity::Identity,
    sampler: Sampler,
    estimators: EstimatorBank,
    cells: Vec<CellSlot>,
    /// One for each cell.
    progress: Vec<Progress>,
    round: CellBatch,
    detector: TransitionDetector,
    learner: Learner,
    /// When the last half-cycle taught something; `None` = never, or nobody knows how long ago.
    learned_at: Option<Timestamp>,
    recharge: RechargeTimer,
    recharge_period_s: Option<f64>,
    normalised_recharge: Option<ScalarGaussian>,
    pack: Option<PackState>,
    alarms: AlarmEngine,
    /// When values of inputs that change no alarm were last shown, and when innovations that do not.
    inputs_shown_at: Timestamp,
    nis_shown_at: Timestamp,
    /// Whether every cell's innovations agree with their covariance.
    all_trusted: bool,
    /// When a tick will next do something; `None` = not started.
    due: Option<Timestamp>,
    /// The rules have been told that every learned value stands on valid inputs.
    all_valid_told: bool,
    buses: Buses,
    store: StoreState,
    /// When a command frame that was not obeyed was last told.
    bad_command_told: Option<Timestamp>,
    /// A test of an alarm frame that is running; it ends with the process.
    test: Option<Test>,
    schedule: Schedule,
    j1939: Option<j1939::J1939>,
    pending: Option<PendingRestore>,
    statistics: Statistics,
    scratch: Scratch,
}

/// Lists that live only within one input, kept for their memory.
#[derive(Debug, Default)]
struct Scratch {
    readings: Vec<Reading>,
    signal_changes: Vec<SignalChange>,
    alarm_changes: Vec<AlarmChange>,
    half_cycles: Vec<HalfCycle>,
    /// Cells for which the next half-cycle may have begun in the gap before their latest sample.
    after_gap: Vec<usize>,
}

impl MonitorConfig {
    /// Identifiers to be received on an interface, ascending.
    pub fn wanted_ids(&self, bus: BusIndex) -> Vec<CanId> {
        let mut ids = self.input.ids(bus);
        ids.extend(self.commands.iter().filter(|commands| commands.bus == bus).map(|commands| commands.plan.id()));
        ids.sort_unstable();
        ids
    }

    /// Extended identifiers to be received besides, as identifier and mask.
    pub fn wanted_patterns(&self, bus: BusIndex) -> Vec<(u32, u32)> {
        let node = self.j1939.iter().filter(|j1939| j1939.bus == bus);
        node.flat_map(|j1939| Node::new(&j1939.node).wanted()).collect()
    }
}

impl Monitor {
    /// A monitor that knows nothing yet.
    pub fn new(config: MonitorConfig) -> Self {
        let cells = usize::from(config.sample.cells);
        let slot = CellSlot::new(&config);
        let estimators = EstimatorBank::new(&config.model, &config.estimator, cells);
        Self {
            intake: Intake::new(&config),
            identity: identity::Identity::default(),
            sampler: Sampler::new(config.sample.clone()),
            learner: Learner::new(&config.health.capacity, cells, CellEstimator::new(&config.estimator).capacity()),
            alarms: AlarmEngine::new(config.rules.clone(), config.sample.cells),
            estimators,
            cells: vec![slot; cells],
            progress: vec![Progress::default(); cells],
            round: CellBatch::new(cells),
            started: false,
            heard: false,
            now: Timestamp::ZERO,
            time_backwards: 0,
            detector: TransitionDetector::default(),
            learned_at: None,
            recharge: RechargeTimer::default(),
            recharge_period_s: None,
            normalised_recharge: None,
            pack: None,
            inputs_shown_at: Timestamp::from_nanos(i64::MIN),
            nis_shown_at: Timestamp::from_nanos(i64::MIN),
            all_trusted: true,
            due: None,
            all_valid_told: false,
            buses: Buses::default(),
            store: StoreState::default(),
            bad_command_told: None,
            test: None,
            schedule: Schedule::default(),
            j1939: config.j1939.clone().map(j1939::J1939::new),
            pending: None,
            statistics: Statistics::default(),
            scratch: Scratch::default(),
            config,
        }
    }

    /// Takes one input; appends what comes of it to `out`. A tick before [`Monitor::next_due`] does nothing at all,
    /// so a driver may leave it out.
    pub fn handle(&mut self, input: Input<'_>, out: &mut Outputs) {
        let told = out.events.len();
        self.take(input, out);
        self.statistics.note(&input, &out.events[told..]);
    }

    fn take(&mut self, input: Input<'_>, out: &mut Outputs) {
        let time = input.time();
        if !self.started {
            self.start(time, out);
        }
        if let Input::Frame { bus, frame, .. } = input {
            self.advance(time, out);
            self.handle_frame(bus, frame, out);
            if self.j1939.is_some() {
                self.handle_j1939_frame(bus, frame, out);
                self.due = self.find_due();
            }
            return;
        }
        if matches!(input, Input::Tick { .. }) && self.due.is_some_and(|due| time < due) {
            return;
        }
        self.make_steps(out);
        match input {
            Input::Frame { .. } => {}
            Input::UnknownGap { .. } => self.handle_unknown_gap(time, out),
            Input::Tick { .. } => {
                self.advance(time, out);
                self.handle_tick(out);
            }
            Input::Command { command, .. } => {
                self.advance(time, out);
                self.handle_command(Source::Local, command, out);
            }
            Input::Store { works, .. } => {
                self.advance(time, out);
                if self.store.note(self.now, works) {
                    out.events.push(Event { time: self.now, kind: EventKind::Store { works } });
                }
            }
            Input::Bus { bus, event, .. } => {
                self.advance(time, out);
                self.buses.handle_event(self.now, bus, event);
                out.events.push(Event { time: self.now, kind: EventKind::Bus { bus, what: event } });
                if event == BusEvent::Up && self.config.j1939.as_ref().is_some_and(|j1939| j1939.bus == bus) {
                    self.start_j1939(self.now, out);
                }
            }
        }
        self.due = self.find_due();
    }

    /// The latest estimate of every cell, for live tables; `None` before its first. What came since the last
    /// [`settle`](Self::settle) is not in it.
    pub fn latest(&self) -> impl Iterator<Item = Option<Estimate>> {
        (0..self.cells.len()).map(|index| self.estimate(index))
    }

    /// The pack as its limiting cells make it; `None` before every cell has an estimate.
    pub fn pack(&self) -> Option<&PackState> {
        self.pack.as_ref()
    }

    /// Charge, rest or discharge.
    pub fn mode(&self) -> Mode {
        self.detector.mode()
    }

    /// The last recorded recharge period, s.
    pub fn recharge_period_s(&self) -> Option<f64> {
        self.recharge_period_s
    }

    /// What the reference charger would need for the window, s, after the last charge that covered enough of it.
    pub fn normalised_recharge_period(&self) -> Option<ScalarGaussian> {
        self.normalised_recharge
    }

    /// Usable capacity of a cell after its last half-cycle.
    pub fn usable_capacity(&self, cell: CellIndex) -> Option<ScalarGaussian> {
        self.cells.get(cell.index())?.usable
    }

    /// Published capacity of a cell.
    pub fn capacity(&self, cell: CellIndex) -> ScalarGaussian {
        self.learner.capacity(&self.config.health.capacity, cell.index())
    }

    /// Inputs whose time was before that of an earlier one.
    pub fn time_backwards(&self) -> u64 {
        self.time_backwards
    }

    /// Per protected input message: how often each status of its check was given.
    pub fn protected(&self) -> impl Iterator<Item = GuardCounts> + '_ {
        self.intake.protected()
    }

    /// Input messages of which frames were dropped, because more came than are taken in.
    pub fn dropped(&self) -> impl Iterator<Item = FloodCount> + '_ {
        self.intake.dropped()
    }

    /// Alarms that are raised now.
    pub fn alarms(&self) -> &AlarmEngine {
        &self.alarms
    }

    /// The first input: its time is now; a stored state that waits is taken up and says when it was "now".
    fn start(&mut self, time: Timestamp, out: &mut Outputs) {
        (self.started, self.now) = (true, time);
        self.schedule.restart(time);
        let taken = self.apply_pending(time, out);
        let was_away_briefly = taken != Taken::Ageless && time.since(self.now) <= ASLEEP_S;
        if taken == Taken::Aged {
            let away_s = time.since(self.now);
            if away_s > HOUSEKEEPING_S {
                // What was measured before the time away belongs before it, and says nothing of the present.
                self.step_waiting(was_away_briefly, out);
            }
            let config = self.config.estimator;
            self.estimators.change_all(|estimator| estimator.note_downtime(&config, away_s));
        }
        if taken != Taken::Nothing {
            self.restate_known(was_away_briefly, out);
        }
        if taken == Taken::Ageless {
            // Claims the address, too.
            self.handle_unknown_gap(time, out);
        }
        // After a longer time `advance` finds the gap and claims the address.
        if was_away_briefly {
            self.start_j1939(time, out);
        }
        self.due = self.find_due();
    }

    /// Nothing is known of the cells any more; what comes in is judged as before.
    fn forget_learned(&mut self) {
        let (config, cells) = (&self.config, self.cells.len());
        self.estimators = EstimatorBank::new(&config.model, &config.estimator, cells);
        self.learner = Learner::new(&config.health.capacity, cells, CellEstimator::new(&config.estimator).capacity());
        self.cells.fill(CellSlot::new(config));
        self.progress.fill(Progress::default());
        (self.learned_at, self.all_valid_told, self.all_trusted) = (None, false, true);
        self.detector = TransitionDetector::default();
        self.recharge = RechargeTimer::default();
        (self.recharge_period_s, self.normalised_recharge) = (None, None);
        self.forget_pack();
    }

    /// Moves the clock to an input's time: never back, and with an eye on time asleep (or away, after a restart).
    #[inline]
    fn advance(&mut self, time: Timestamp, out: &mut Outputs) {
        if (0..=ASLEEP_NS).contains(&time.nanos().saturating_sub(self.now.nanos())) {
            self.now = time;
        } else {
            self.advance_far(time, out);
        }
    }

    #[cold]
    fn advance_far(&mut self, time: Timestamp, out: &mut Outputs) {
        let elapsed_s = time.since(self.now);
        if elapsed_s < 0.0 {
            self.time_backwards += 1;
            if time < self.now.plus_nanos(-MERGE_TOLERANCE_NS) {
                self.make_steps(out);
                out.events.push(Event { time, kind: EventKind::TimeBackwards { seconds: -elapsed_s } });
                self.handle_unknown_gap(time, out);
                self.due = self.find_due();
            }
            return;
        }
        if elapsed_s > ASLEEP_S {
            self.fall_asleep(out);
            out.events.push(Event { time, kind: EventKind::Gap { seconds: Some(elapsed_s) } });
            self.sampler.wake(time);
            self.schedule.restart(time);
            self.start_j1939(time, out);
            self.due = self.find_due();
        }
        self.now = time;
    }

    /// Nobody listened after `now`: the mode is unknown from there, nothing is timed over it, and the pack's values
    /// wait for a new reading of every cell.
    fn fall_asleep(&mut self, out: &mut Outputs) {
        self.make_steps(out);
        self.intake.restart(self.now, out);
        self.observe_current(None, out);
        self.tell_alarms(AlarmInput::Gap, out);
        self.recharge.interrupt();
        self.estimators.change_all(CellEstimator::note_sleep);
        self.forget_pack();
    }

    /// The pack's values are not known until every cell has a new estimate.
    fn forget_pack(&mut self) {
        self.pack = None;
        self.round.begin();
    }

    /// The record goes on at `time`, but how far that is from before nobody knows.
    fn handle_unknown_gap(&mut self, time: Timestamp, out: &mut Outputs) {
        self.fall_asleep(out);
        self.end_test(out);
        self.bad_command_told = None;
        if let Some(change) = self.detector.settle() {
            self.complete_mode(change, out);
        }
        self.learned_at = None;
        self.now = time;
        out.events.push(Event { time, kind: EventKind::Gap { seconds: None } });
        self.sampler.handle_gap(time);
        self.schedule.restart(time);
        self.start_j1939(self.now, out);
        self.estimators.change_all(CellEstimator::handle_unknown_gap);
        self.progress.iter_mut().for_each(|cell| cell.consumed = None);
    }

    fn handle_frame(&mut self, bus: BusIndex, frame: &Frame, out: &mut Outputs) {
        self.buses.handle_frame(bus);
        let Some(intact) = self.intake.judge(self.now, bus, frame, out) else { return };
        if self.config.commands.as_ref().is_some_and(|commands| commands.bus == bus && commands.plan.id() == frame.id())
        {
            return self.handle_command_frame(bus, frame, intact.is_ok(), out);
        }
        let mut readings = std::mem::take(&mut self.scratch.readings);
        let Self { config, now, sampler, round, heard, .. } = self;
        config.input.decode(bus, frame, |Reading { channel, value }| {
            let value = intact.and(value);
            // Nearly all readings are ordinary voltages. They overtake none that is not.
            if readings.is_empty()
                && let (Channel::CellVoltage(cell), Ok(voltage_v)) = (channel, value)
                && round.awaits(cell)
                && let Some(sample) = sampler.take_ordinary_voltage(*now, cell, voltage_v)
            {
                round.add(sample);
                *heard = true;
            } else {
                readings.push(Reading { channel, value });
            }
        });
        if self.round.is_complete() {
            self.close_round(out);
        }
        for reading in readings.drain(..) {
            if reading.channel == Channel::PackIdentity {
                self.observe_identity(bus, reading.value, out);
                continue;
            }
            if let (Channel::CellVoltage(cell), Ok(voltage_v)) = (reading.channel, reading.value)
                && let Some(sample) = self.sampler.take_ordinary_voltage(self.now, cell, voltage_v)
            {
                self.heard = true;
                self.note_sample(sample, out);
                continue;
            }
            let sample = self.sampler.handle_reading(self.now, reading, &mut self.scratch.signal_changes);
            self.note_heard(&reading);
            self.report_signals(out);
            if reading.channel == Channel::Current {
                self.observe_current(self.sampler.pack_current_a(self.now), out);
            }
            if let Some(sample) = sample {
                self.note_sample(sample, out);
            }
        }
        self.scratch.readings = readings;
    }

    fn report_signals(&mut self, out: &mut Outputs) {
        if self.scratch.signal_changes.is_empty() {
            return;
        }
        for change in self.scratch.signal_changes.drain(..) {
            let channel = change.channel;
            let kind = match change.state {
                Err(fault) => EventKind::SignalBad { channel, fault },
                Ok(bad_readings) => EventKind::SignalGood { channel, bad_readings },
            };
            out.events.push(Event { time: self.now, kind });
        }
    }

    /// A cell's estimate after its latest step; `None` before the first.
    fn estimate(&self, index: usize) -> Option<Estimate> {
        let sample = self.progress[index].sample.as_ref()?;
        let (soc, capacity) = (self.estimators.soc(index)?, self.capacity(sample.cell));
        let update = self.estimators.result(index).update;
        let resistance = self.resistance(index);
        Some(Estimate {
            time: sample.time,
            cell: sample.cell,
            soc: soc.mean,
            soc_std: soc.std(),
            branch_v: self.estimators.branch_v(index),
            capacity_ah: capacity.mean,
            capacity_std_ah: capacity.std(),
            resistance_ratio: resistance.mean,
            resistance_ratio_std: resistance.std(),
            innovation_v: update.map_or(f64::NAN, |u| u.innovation),
            innovation_std_v: update.map_or(f64::NAN, |u| u.innovation_variance.sqrt()),
            accepted: update.is_some_and(|u| u.accepted),
            voltage_v: sample.voltage_v,
            current_a: sample.current_a.unwrap_or(f64::NAN),
            temperature_c: self.estimators.temperature_c(index).unwrap_or(f64::NAN),
        })
    }

    /// Resistance of a cell relative to new.
    fn resistance(&self, index: usize) -> ScalarGaussian {
        let log_resistance = self.estimators.log_resistance(index);
        let ratio = libm::exp(log_resistance.mean);
        ScalarGaussian::from_std(ratio, ratio * log_resistance.std())
    }
}
