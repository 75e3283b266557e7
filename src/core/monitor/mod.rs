//! The core: handles records and produces outputs. The core never reads a clock, a file or a socket, and never logs.
//!
//! Records arrive in the order in which they happened. The same records give the same outputs, byte for byte. A bad
//! record is counted and causes an event, never a panic. The data path has one file per stage:
//!
//! ```text
//! frame ─▶ intake ─▶ sampling ─▶ estimation ─▶ learning ─▶ alarming ─▶ sending
//!          readings  samples     estimates     health      alarms      frames
//! ```
//!
//! * `message`: inputs and outputs, independent of the stages;
//! * `stage`: the stages; each stage depends only on the stages before it;
//! * `stages`: connects the stages after the intake, passes their values to the alarm rules, and remembers exchanged
//!   packs;
//! * `snapshot`: the stored state;
//! * `lifecycle`: restores a stored state, relearns from a history, and applies a new configuration;
//! * `clock`, `config`, `view`: time, configuration and present values of the whole monitor.

mod clock;
mod config;
mod lifecycle;
mod message;
mod snapshot;
mod stage;
mod stages;
mod view;

use clock::{ASLEEP_S, Clock, HOUSEKEEPING_S, TimeJump};
use snapshot::{Beginning, PendingRestore};
use stage::intake::{Intake, ReceivedFrame};
use stage::sleep::Silence;
use stages::Stages;

use crate::alarm::CommandOutcome;
use crate::can::Frame;
use crate::can::decode::GroupFrame;
use crate::can::encode::ReplyFields;
use crate::can::poll::Poller;
use crate::can::secoc::MacCheck;
use crate::can::uds::FrameOutcome;
use crate::cell::own_model::task::{FitFindings, FitTask};
use crate::quantity::{BusIndex, Channel, Reading, Timestamp, bounds};

pub use config::{
    AlarmCode, CommandConfig, J1939Config, MonitorConfig, OutputConfig, ReconfigureError, Reconfigured, SupplyConfig,
};
pub use message::{
    BusEvent, CellView, Command, Downtime, DowntimeParseError, Estimate, Event, EventKind, LearnedCell,
    MERGE_TOLERANCE_NS, MeasuredValues, ModelState, Outputs, PackView, Record, RecordKind, Secured, Source,
    TICK_PERIOD_MS, Transmit, Validity,
};
pub use snapshot::{RestoreError, Snapshot};
pub use stage::intake::ControllerCount;
pub use stage::intake::command_gate::CommandCounts;
pub use stage::learning::Throughput;
pub use stage::learning::moved::MovedSums;
pub use stage::modelling::{ModelChange, ModelView};
pub use stage::sending::{MAX_TEST_S, RESTART_FRESHNESS};
pub use stage::statistics::{AlarmCounts, BusStatistics, LearningCounts, Statistics, VoltageCounts};

/// The pure core of packwatch: takes records and returns outputs.
#[derive(Debug)]
pub struct Monitor {
    pub(crate) config: MonitorConfig,
    pub(crate) clock: Clock,
    pub(crate) intake: Intake,
    pub(crate) stages: Stages,
    /// A stored state that is applied at the first input.
    pub(crate) pending: Option<PendingRestore>,
}

/// Range of timestamps that the monitor handles.
const EARLIEST: Timestamp = Timestamp::from_nanos(-LATEST.nanos());
const LATEST: Timestamp = Timestamp::from_nanos(bounds::STAMP_NS.high as i64);

impl Monitor {
    /// Creates a monitor that has not learned anything yet.
    pub fn new(config: MonitorConfig) -> Self {
        let (intake, stages) = (Intake::new(&config), Stages::new(&config));
        Self { config, clock: Clock::default(), intake, stages, pending: None }
    }

    /// Handles one record and appends its outputs to `out`. A tick before [`Monitor::next_due`] has no effect, so a
    /// driver may omit it.
    pub fn handle(&mut self, record: &Record, out: &mut Outputs) {
        if matches!(record.kind, RecordKind::Reload | RecordKind::Restore { .. }) {
            return;
        }
        let (first_event, first_frame) = (out.events.len(), out.frames.len());
        self.dispatch(record, out);
        for sent in &out.frames[first_frame..] {
            self.intake.own.note_sent(sent.time, sent.bus, &sent.frame);
        }
        if self.stages.sending.poller.is_some() {
            // The bus does not echo the daemon's requests, but the listener needs them to recognise the answers.
            for sent in &out.frames[first_frame..] {
                self.intake.listener.handle(sent.time, sent.bus, &sent.frame);
            }
        }
        self.stages.statistics.note(&record.kind, &out.events[first_event..]);
    }

    fn dispatch(&mut self, record: &Record, out: &mut Outputs) {
        // A timestamp beyond the range is wrong, and differences between timestamps would overflow.
        let time = record.time.clamp(EARLIEST, LATEST);
        if !self.clock.has_started {
            self.start(time, out);
        }
        match &record.kind {
            RecordKind::Frame { bus, frame } => self.handle_frame_at(time, *bus, frame, None, out),
            RecordKind::SecuredFrame { bus, frame, freshness } => {
                self.handle_frame_at(time, *bus, frame, *freshness, out);
            }
            RecordKind::Tick if self.clock.is_before_due(time) => {}
            RecordKind::UnknownGap => {
                self.stages.step_waiting(self.clock.now, true, out);
                self.handle_unknown_gap(time, out);
                self.find_due();
            }
            kind => {
                self.stages.step_waiting(self.clock.now, true, out);
                self.advance(time, out);
                self.handle_occasional(kind, out);
                self.find_due();
            }
        }
    }

    #[inline]
    fn handle_frame_at(
        &mut self,
        time: Timestamp,
        bus: BusIndex,
        frame: &Frame,
        freshness: Option<u64>,
        out: &mut Outputs,
    ) {
        self.advance(time, out);
        self.handle_frame(ReceivedFrame { bus, frame, freshness }, out);
        if self.stages.sending.take_rescheduled() {
            self.find_due();
        }
        if self.stages.sending.poller.is_some() {
            self.stages.poll_after_frame(self.clock.now, bus, frame, out);
            self.find_due();
        }
        if self.stages.sending.j1939.is_some() {
            self.stages.sending.handle_j1939_frame(self.clock.now, bus, frame, out);
            self.find_due();
        }
    }

    /// Passes the readings of a frame to the stages, or executes the command in the frame.
    fn handle_frame(&mut self, received: ReceivedFrame<'_>, out: &mut Outputs) {
        let Self { config, clock, intake, stages, .. } = self;
        let found =
            config.input.groups().configured(clock.now, received.bus, received.frame, &mut intake.group_senders);
        let received = match &found {
            GroupFrame::Other => received,
            GroupFrame::Configured(frame) => ReceivedFrame { frame, ..received },
            GroupFrame::OfAnotherSender => return,
        };
        let ReceivedFrame { bus, frame, .. } = received;
        let now = clock.now;
        let Some(admission) = intake.admit(now, bus, frame, out) else { return };
        let is_command = |commands: &&CommandConfig| commands.bus == bus && commands.plan.id() == frame.id();
        if let Some(commands) = config.commands.as_ref().filter(is_command) {
            let (command, result) = intake.command(now, commands, &received, admission, out);
            let outcome = result.map(|command| {
                let CommandOutcome { changed, refused } = stages.handle_command(now, Source::Bus(bus), command, out);
                (changed, refused)
            });
            let bad_commands = &mut stages.statistics.bad_commands;
            *bad_commands = bad_commands.saturating_add(u64::from(outcome.is_err()));
            let counter_expected = intake.next_command_counter(commands);
            stages.sending.send_reply(now, bus, &ReplyFields { outcome, command, counter_expected }, out);
            return;
        }
        let intact = admission.readings();
        if stages.sleep.since.is_some() {
            let mut wakes = false;
            config.input.decode(bus, frame, |reading| wakes |= Stages::wakes(reading.channel));
            if wakes {
                stages.end_bus_sleep(now, out);
            }
        }
        let step_a = stages.sampling.sampler.flow_a();
        config.input.decode(bus, frame, |Reading { channel, value }| {
            if let (Channel::Current, Ok(current_a)) = (channel, value) {
                intake.senders.note_current(bus, frame.id(), current_a, step_a);
            }
            stages.handle_reading(now, bus, Reading { channel, value: intact.and(value) }, out);
        });
        if !intake.listener.is_empty() {
            self.handle_diagnostic(bus, frame, out);
        }
    }

    /// Handles a frame of diagnostic requests and answers. The values of an answer count as measured at the time of its
    /// first frame, because the controller has assembled the answer by then. The times of the remaining frames depend
    /// only on the tester's flow control.
    fn handle_diagnostic(&mut self, bus: BusIndex, frame: &Frame, out: &mut Outputs) {
        let Self { clock, intake, stages, .. } = self;
        let (now, Intake { listener, moments, controllers, .. }) = (clock.now, &mut *intake);
        match listener.handle(now, bus, frame) {
            FrameOutcome::Nothing => {}
            FrameOutcome::Begun { controller } => {
                moments[controller] = Some(stages.sampling.sampler.moment(now));
                let begun = |poller: &mut Poller, out: &mut _| poller.handle_begun(now, &controllers[controller], out);
                stages.sending.poll_with(now, out, begun);
            }
            FrameOutcome::Continued { controller } => {
                stages.sending.poll_with(now, out, |poller, _| poller.handle_continued(now, &controllers[controller]));
            }
            FrameOutcome::Refused { controller, refusal } => {
                stages.sending.poll_with(now, out, |poller, out| {
                    poller.handle_refusal(now, &controllers[controller], refusal, out);
                });
            }
            FrameOutcome::Whole { controller, answer, data, is_single } => {
                stages.end_bus_sleep(now, out);
                let began = moments[controller].take();
                // If an answer contains the current, all its values count as measured at the end of the answer.
                let is_now = is_single || answer.has(|channel| channel == Channel::Current);
                let moment = began.filter(|_| !is_now);
                for reading in answer.readings(data) {
                    stages.handle_answer_reading(now, bus, moment.as_ref(), reading, out);
                }
                stages.sending.poll_with(now, out, |poller, out| poller.handle_answer(now, &answer.question, out));
            }
        }
        intake.report(now, out);
    }

    /// Handles ticks, commands, and reports about files and interfaces.
    fn handle_occasional(&mut self, kind: &RecordKind, out: &mut Outputs) {
        let Self { config, intake, stages, .. } = self;
        let now = self.clock.now;
        match *kind {
            RecordKind::Tick => {
                if stages.sending.take_housekeeping_due(now, HOUSEKEEPING_S) {
                    intake.poll(now, out);
                    let silence = stages.silence(now);
                    if silence == Silence::Begins {
                        intake.restart(now, out);
                        stages.begin_bus_sleep(now, out);
                    }
                    stages.sampling.has_second_sender = intake.second_senders().next().is_some();
                    stages.run_housekeeping(now, intake.bus_fault(now, config.interfaces), silence, out);
                }
                stages.sending.set_asleep(now, stages.sleep.is_asleep());
                if stages.sending.take_freshness_due(now) {
                    let freshness = intake.command_gate.announce(now);
                    stages.sending.send_freshness(now, config.commands.as_ref().map(|of| of.bus), freshness, out);
                }
                stages.send_due(now, out);
            }
            RecordKind::Command { command } => {
                stages.handle_command(now, Source::Local, command, out);
            }
            RecordKind::Store { works } => {
                if stages.alarming.state.store.handle_report(now, works) {
                    out.events.push(Event { time: now, kind: EventKind::Store { works } });
                }
            }
            RecordKind::Bus { bus, event } => {
                intake.handle_bus_event(now, bus, event, out);
                if event == BusEvent::Up && config.j1939.as_ref().is_some_and(|j1939| j1939.bus == bus) {
                    stages.sending.claim_address(now, out);
                }
            }
            // The caller handles frames and gaps; the other records are for the driver.
            RecordKind::Frame { .. }
            | RecordKind::SecuredFrame { .. }
            | RecordKind::UnknownGap
            | RecordKind::Reload
            | RecordKind::Restore { .. } => {}
        }
    }

    /// Freshness value of the last authenticated frame that was sent. The driver must store the state before this value
    /// has risen by [`RESTART_FRESHNESS`] since the last stored state. Otherwise, a restart could use a value twice.
    pub fn sent_freshness(&self) -> u64 {
        self.stages.sending.schedule.sent_freshness
    }

    /// How to check the authenticator of a frame; `None` if the frame does not belong to an authenticated message. The
    /// driver has the key, so the driver checks such a frame and passes it as [`RecordKind::SecuredFrame`]. If the
    /// driver passes the frame as [`RecordKind::Frame`], the frame counts as forged.
    #[inline]
    pub fn mac_check(&self, bus: BusIndex, frame: &Frame) -> Option<MacCheck> {
        let commands = self.config.commands.as_ref()?;
        let secoc = commands.plan.authentication()?;
        let is_command = commands.bus == bus && commands.plan.id() == frame.id();
        is_command.then(|| self.intake.command_gate.mac_check(secoc, frame.data()))
    }

    /// The model fit that has just started; returned once. A fit takes too long for one tick. A live driver therefore
    /// runs the fit on another thread and passes the findings to [`Self::give_model_fit`]. If no driver takes the fit,
    /// the monitor runs the fit when it is due, with the same result.
    pub fn take_model_fit(&mut self) -> Option<FitTask> {
        self.stages.modelling.take_task()
    }

    /// Receives the findings of a fit that the driver ran.
    pub fn give_model_fit(&mut self, task: FitTask, findings: FitFindings) {
        self.stages.modelling.give(task, findings);
    }

    /// Runs the filters on samples that wait for the samples of other cells. The core itself does this before it uses
    /// estimates. A driver calls this function after the last input.
    pub fn settle(&mut self, out: &mut Outputs) {
        let first_event = out.events.len();
        self.stages.step_waiting(self.clock.now, true, out);
        self.stages.statistics.note_events(&out.events[first_event..]);
        self.find_due();
    }

    /// Time at which a tick next has an effect. A driver may omit earlier ticks without changing the result.
    #[inline]
    pub fn next_due(&self) -> Option<Timestamp> {
        self.clock.due
    }

    fn find_due(&mut self) {
        self.clock.due = self.clock.has_started.then(|| self.stages.sending.next_due());
    }

    /// Starts at the time of the first input. If a stored state is pending, continues from that state.
    fn start(&mut self, time: Timestamp, out: &mut Outputs) {
        (self.clock.has_started, self.clock.now) = (true, time);
        self.stages.sending.restart(time);
        let beginning = self.apply_pending(time, out);
        if beginning == Beginning::Continued {
            // Another run may have continued from the same state. This run must reject the commands that the other run
            // accepted.
            if !self.config.authentications().is_empty() {
                self.begin_freshness(time);
            }
            self.find_due();
            return;
        }
        let (taken, stages) = (self.clock.now, &mut self.stages);
        let away_s = time.since(taken);
        let was_brief = beginning != Beginning::RestoredAgeless && away_s <= ASLEEP_S;
        if beginning == Beginning::Restored {
            if away_s > HOUSEKEEPING_S {
                // Samples that were waiting when the downtime started belong to the time before the downtime.
                stages.step_waiting(taken, was_brief, out);
            }
            stages.estimation.bank.change_all(|config, estimator| estimator.note_downtime(config, away_s));
        }
        self.intake.command_gate.begin(time);
        if beginning == Beginning::New {
            stages.sending.schedule.begin_freshness(time);
        } else {
            stages.restate_known(taken, was_brief, false, out);
        }
        if beginning == Beginning::RestoredAgeless {
            // Also claims the J1939 address.
            self.handle_unknown_gap(time, out);
        }
        // After a longer downtime, `advance` detects the gap and claims the address.
        if was_brief {
            self.stages.sending.claim_address(time, out);
        }
        self.find_due();
    }

    /// Starts the freshness of commands and sent frames above the values of all earlier runs.
    fn begin_freshness(&mut self, now: Timestamp) {
        self.intake.command_gate.begin(now);
        self.stages.sending.schedule.begin_freshness(now);
    }

    #[inline]
    fn advance(&mut self, time: Timestamp, out: &mut Outputs) {
        if let Some(jump) = self.clock.advance(time) {
            self.handle_jump(jump, time, out);
        }
    }

    #[cold]
    fn handle_jump(&mut self, jump: TimeJump, time: Timestamp, out: &mut Outputs) {
        match jump {
            TimeJump::Backwards { seconds } => {
                self.stages.step_waiting(self.clock.now, true, out);
                out.events.push(Event { time, kind: EventKind::TimeBackwards { seconds } });
                self.stages.sending.schedule.step_back(seconds);
                self.handle_unknown_gap(time, out);
            }
            TimeJump::Asleep { seconds } => {
                self.fall_asleep(out);
                out.events.push(Event { time, kind: EventKind::Gap { seconds: Some(seconds) } });
                self.stages.wake(time, out);
                self.clock.now = time;
            }
        }
        self.find_due();
    }

    /// Ends everything in progress at the clock's time, because a gap follows.
    fn fall_asleep(&mut self, out: &mut Outputs) {
        let now = self.clock.now;
        self.stages.step_waiting(now, true, out);
        self.intake.restart(now, out);
        self.stages.fall_asleep(now, out);
    }

    fn handle_unknown_gap(&mut self, time: Timestamp, out: &mut Outputs) {
        self.fall_asleep(out);
        // The age of the last rejected command is now unknown.
        self.intake.bad_command_at = None;
        self.stages.begin_unknown_gap(self.clock.now, out);
        self.clock.now = time;
        out.events.push(Event { time, kind: EventKind::Gap { seconds: None } });
        self.stages.end_unknown_gap(time, out);
    }
}
