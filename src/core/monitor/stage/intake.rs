//! Intake stage: turns frames into checked readings and commands.
//!
//! In: frames with their time, events of the interfaces. Out: the readings or the command of an admitted frame, counts,
//! and events, for example when a flood of frames starts or ends. If a frame fails its end-to-end check, its readings
//! are bad, not missing. If a message arrives more often than its limit allows (a flood), the excess frames are dropped
//! and counted.

use serde::{Deserialize, Serialize};

pub(crate) mod buses;
pub(crate) mod command_gate;

use buses::Buses;
use command_gate::CommandGate;

use crate::alarm::{Observation, Rule, Selector, Severity};
use crate::can::decode::GroupSenders;
use crate::can::e2e::Status;
use crate::can::encode::{self, CommandFields, CommandRefusal};
use crate::can::flood::{FloodCount, FloodGate, FloodProgress};
use crate::can::guard::{GuardCounts, GuardProgress, Guards};
use crate::can::own_frames::{OwnFrames, OwnFramesState};
use crate::can::rate::{MessageRate, SecondSenders};
use crate::can::uds::{self, Controller, ControllerCounts, LinkProgress, Listener};
use crate::can::{CanId, Frame};
use crate::monitor::config::{CommandConfig, MonitorConfig};
use crate::monitor::message::{BusEvent, Command, Event, EventKind, Outputs};
use crate::quantity::{BusIndex, Fault, Timestamp};
use crate::sample::Moment;

/// Shortest time between two reports of rejected command frames (s).
const BAD_COMMAND_S: f64 = 1.0;

#[derive(Debug)]
pub(crate) struct Intake {
    gate: FloodGate,
    guards: Guards,
    pub(crate) senders: SecondSenders,
    /// Senders of J1939 parameter groups. Not part of the stored state.
    pub(crate) group_senders: GroupSenders,
    pub(crate) own: OwnFrames,
    buses: Buses,
    pub(crate) command_gate: CommandGate,
    /// Controllers, in the listener's order.
    pub(crate) controllers: Vec<Controller>,
    pub(crate) listener: Listener,
    /// Per controller: start of the answer that is being received.
    pub(crate) moments: Vec<Option<Moment>>,
    pub(crate) bad_command_at: Option<Timestamp>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct ReceivedFrame<'a> {
    pub(crate) bus: BusIndex,
    pub(crate) frame: &'a Frame,
    /// The freshness for which the frame's authenticator is correct. `None` if no value fits, or if the authenticator
    /// was not checked.
    pub(crate) freshness: Option<u64>,
}

/// Result of an admitted frame's end-to-end check; `None` if its message is not protected.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Admission(Option<Status>);

impl Admission {
    /// Returns `Ok` if the frame's readings may be used.
    #[inline]
    pub(crate) fn readings(self) -> Result<(), Fault> {
        if self.0.is_none_or(Status::is_usable) { Ok(()) } else { Err(Fault::EndToEnd) }
    }
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct IntakeState {
    protected: Vec<GuardCounts>,
    dropped: Vec<FloodCount>,
    controllers: Vec<ControllerCount>,
    pub(crate) commands: CommandGate,
    senders: Vec<MessageRate>,
    pub(crate) buses: Buses,
    /// State that is valid only while frames are received without a break. `None` in a state for a restart, because
    /// frames are missed during the restart.
    progress: Option<Box<IntakeProgress>>,
}

impl IntakeState {
    pub(crate) fn restart(&mut self) {
        self.progress = None;
    }
}

/// State that is valid only while frames are received without a break.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct IntakeProgress {
    protected: Vec<GuardProgress>,
    floods: Vec<FloodProgress>,
    answers: Vec<LinkProgress>,
    moments: Vec<Option<Moment>>,
    bad_command_at: Option<Timestamp>,
    own: OwnFramesState,
}

/// Counts of a controller that answers diagnostic requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ControllerCount {
    #[serde(flatten)]
    pub controller: Controller,
    #[serde(flatten)]
    pub counts: ControllerCounts,
}

impl Intake {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
        let commands = config.commands.iter().map(|commands| (commands.bus, commands.plan.id(), 1));
        let answers = uds::wanted(&config.answers).into_iter().map(|(bus, id)| (bus, id, 1));
        let listener = Listener::new(&config.answers);
        Self {
            gate: FloodGate::new(&config.flood, config.input.messages().chain(commands).chain(answers)),
            guards: Guards::new(config.guards.clone()),
            senders: SecondSenders::new(config.unprotected()),
            group_senders: GroupSenders::default(),
            own: OwnFrames::new(config.own_ids()),
            buses: Buses::default(),
            command_gate: CommandGate::default(),
            moments: vec![None; listener.counts().count()],
            controllers: listener.counts().map(|(controller, _)| controller).collect(),
            listener,
            bad_command_at: None,
        }
    }

    /// Applies the limits and checks of a new configuration that has the same messages. Keeps the counts and the state
    /// of floods in progress.
    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig) {
        let new = Self::new(config);
        self.gate = new.gate.inheriting(&self.gate);
        self.guards = new.guards.inheriting(&self.guards);
        let (rates, own) = (self.senders.snapshot(), self.own.state().clone());
        (self.senders, self.own) = (new.senders, new.own);
        self.senders.restore(&rates);
        self.own.resume(&own);
        // Diagnostic definitions cannot change here, so the listener keeps partially received messages.
    }

    /// Checks a frame. Returns `None` if the frame is dropped, otherwise the result of the frame's end-to-end check.
    #[inline]
    pub(crate) fn admit(
        &mut self,
        now: Timestamp,
        bus: BusIndex,
        frame: &Frame,
        out: &mut Outputs,
    ) -> Option<Admission> {
        self.buses.handle_frame(bus);
        self.own.handle(now, bus, frame);
        self.senders.handle(now, bus, frame.id());
        let admitted = self.gate.admit(now, bus, frame.id());
        let status = if admitted { self.guards.check(now, bus, frame) } else { None };
        self.report(now, out);
        admitted.then_some(Admission(status))
    }

    /// Decodes a command frame. Returns the decoded fields, if there are any, and the command. Rejections are reported
    /// at most once a second.
    ///
    /// # Errors
    /// The reason why the command is not executed.
    pub(crate) fn command(
        &mut self,
        now: Timestamp,
        config: &CommandConfig,
        received: &ReceivedFrame<'_>,
        admission: Admission,
        out: &mut Outputs,
    ) -> (Option<CommandFields>, Result<Command, CommandRefusal>) {
        let frame = received.frame;
        let refusal = match config.plan.authentication() {
            Some(secoc) => self.command_gate.judge(now, secoc, frame.data(), received.freshness).err(),
            None => admission.0.and_then(CommandRefusal::of),
        };
        let is_intact = refusal.is_none_or(CommandRefusal::is_intact);
        let fields = config.plan.decode(frame).ok().filter(|_| is_intact);
        let command = fields.as_ref().and_then(command_of).ok_or(CommandRefusal::NoMeaning);
        let result = refusal.map_or(command, Err);
        if let Err(reason) = result
            && self.bad_command_at.is_none_or(|before| now.since(before) >= BAD_COMMAND_S)
        {
            self.bad_command_at = Some(now);
            let kind = EventKind::BadCommand { bus: config.bus, intact: is_intact, reason };
            out.events.push(Event { time: now, kind });
        }
        (fields, result)
    }

    /// Counter that the next command must have; `None` if any counter is accepted.
    pub(crate) fn next_command_counter(&self, config: &CommandConfig) -> Option<u8> {
        self.guards.next_counter(config.bus, config.plan.id())
    }

    pub(crate) fn handle_bus_event(&mut self, now: Timestamp, bus: BusIndex, event: BusEvent, out: &mut Outputs) {
        self.buses.handle_event(now, bus, event);
        out.events.push(Event { time: now, kind: EventKind::Bus { bus, what: event } });
    }

    /// Value for the rule about interface faults (s): duration of the longest present fault. Another node that uses
    /// identifiers of the daemon's frames also counts as a fault.
    pub(crate) fn bus_fault(&self, now: Timestamp, interfaces: usize) -> Observation {
        let (fault_s, is_whole) = self.buses.worst_s(now, interfaces);
        let foreign_s = Some(self.own.longest_s(now)).filter(|seconds| *seconds > 0.0);
        let longest_s = fault_s.into_iter().chain(foreign_s).reduce(f64::max);
        Observation::new(longest_s).of_part(!is_whole)
    }

    /// Detects periods without a frame, and the end of floods.
    pub(crate) fn poll(&mut self, now: Timestamp, out: &mut Outputs) {
        self.guards.poll(now);
        self.gate.poll(now);
        self.senders.poll(now);
        self.own.poll(now);
        self.listener.poll(now);
        self.report(now, out);
    }

    /// Restarts the checks after a sleep or a step of the clock.
    pub(crate) fn restart(&mut self, now: Timestamp, out: &mut Outputs) {
        self.guards.restart();
        self.gate.restart();
        self.senders.restart();
        self.own.restart();
        self.listener.restart();
        self.command_gate.restart(now);
        self.moments.fill(None);
        self.report(now, out);
    }

    pub(crate) fn protected(&self) -> impl Iterator<Item = GuardCounts> + '_ {
        self.guards.counts()
    }

    pub(crate) fn dropped(&self) -> impl Iterator<Item = FloodCount> + '_ {
        self.gate.counts()
    }

    pub(crate) fn controllers(&self) -> impl Iterator<Item = ControllerCount> + '_ {
        self.listener.counts().map(|(controller, counts)| ControllerCount { controller, counts })
    }

    pub(crate) fn snapshot(&self) -> IntakeState {
        IntakeState {
            protected: self.guards.counts().collect(),
            dropped: self.gate.counts().collect(),
            controllers: self.controllers().collect(),
            commands: self.command_gate.clone(),
            senders: self.senders.snapshot(),
            buses: self.buses.clone(),
            progress: Some(Box::new(self.progress())),
        }
    }

    fn progress(&self) -> IntakeProgress {
        IntakeProgress {
            protected: self.guards.progress(),
            floods: self.gate.progress(),
            answers: self.listener.progress(),
            moments: self.moments.clone(),
            bad_command_at: self.bad_command_at,
            own: self.own.state().clone(),
        }
    }

    pub(crate) fn second_senders(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.senders.doubtful()
    }

    /// Interfaces on which another node uses identifiers of the daemon's frames, with the latest such identifier.
    pub(crate) fn own_id_uses(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.own.uses()
    }

    fn resume(&mut self, stored: &IntakeProgress) {
        self.guards.resume(&stored.protected);
        self.gate.resume(&stored.floods);
        self.listener.resume(&stored.answers);
        if stored.moments.len() == self.moments.len() {
            self.moments.clone_from(&stored.moments);
        }
        self.bad_command_at = stored.bad_command_at;
        self.own.resume(&stored.own);
    }

    pub(crate) fn restore(&mut self, state: IntakeState) {
        self.guards.restore(&state.protected);
        self.gate.restore(&state.dropped);
        self.listener.restore(state.controllers.iter().map(|of| (of.controller, of.counts)));
        self.command_gate = state.commands;
        self.senders.restore(&state.senders);
        self.buses = state.buses;
        match state.progress {
            Some(progress) => self.resume(&progress),
            None => self.senders.restart(),
        }
    }

    #[inline]
    pub(crate) fn report(&mut self, time: Timestamp, out: &mut Outputs) {
        let is_quiet = self.guards.changes.is_empty()
            && self.gate.changes.is_empty()
            && self.listener.losses.is_empty()
            && self.senders.changes.is_empty()
            && self.own.changes.is_empty();
        if !is_quiet {
            self.report_changes(time, out);
        }
    }

    fn report_changes(&mut self, time: Timestamp, out: &mut Outputs) {
        let protection = self.guards.changes.drain(..).map(EventKind::Protection);
        let floods = self.gate.changes.drain(..).map(EventKind::Flood);
        let losses = self.listener.losses.drain(..).map(EventKind::MessageLoss);
        let senders = self.senders.changes.drain(..).map(EventKind::SecondSender);
        let own = self.own.changes.drain(..).map(EventKind::OwnIdentifier);
        let kinds = protection.chain(floods).chain(losses).chain(senders).chain(own);
        out.events.extend(kinds.map(|kind| Event { time, kind }));
    }
}

/// The command of a frame; `None` if the frame names a rule or severity that does not exist.
fn command_of(fields: &CommandFields) -> Option<Command> {
    let severity = |code: u8| Severity::ALL.into_iter().find(|severity| *severity as u8 == code);
    let which = Selector {
        rule: fields.rule.map(|number| Rule::from_number(number).ok_or(())).transpose().ok()?,
        severity: fields.severity.map(|code| severity(code).ok_or(())).transpose().ok()?,
        cell: fields.cell,
    };
    Some(match fields.command {
        encode::Command::Acknowledge => Command::Acknowledge(which),
        encode::Command::Clear => Command::Clear(which),
        encode::Command::PackReplaced => Command::PackReplaced,
    })
}
