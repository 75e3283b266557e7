//! What comes first when a frame arrives: is it one too many, and is its message protected and intact?
//!
//! In: frames with their time. Out: whether the frame is taken in and its readings may be used; counts, and events on
//! change. A frame that fails its check keeps its place in the stream: its readings are bad, not missing.

use serde::{Deserialize, Serialize};

use super::{Event, EventKind, MonitorConfig, Outputs};
use crate::can::Frame;
use crate::can::flood::{FloodCount, FloodGate};
use crate::can::guard::{GuardCounts, Guards};
use crate::quantity::{BusIndex, Fault, Timestamp};

/// The checks a frame passes before it is decoded.
#[derive(Debug)]
pub(super) struct Intake {
    gate: FloodGate,
    guards: Guards,
}

/// What is kept over a restart.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct IntakeState {
    protected: Vec<GuardCounts>,
    dropped: Vec<FloodCount>,
}

impl Intake {
    pub(super) fn new(config: &MonitorConfig) -> Self {
        let commands = config.commands.iter().map(|commands| (commands.bus, commands.plan.id(), 1));
        let gate = FloodGate::new(&config.flood, config.input.messages().chain(commands));
        Self { gate, guards: Guards::new(config.guards.clone()) }
    }

    /// Other bounds and checks for the same messages: what is counted and under way goes on.
    pub(super) fn reconfigure(&mut self, config: &MonitorConfig) {
        let new = Self::new(config);
        self.gate = new.gate.inheriting(&self.gate);
        self.guards = new.guards.inheriting(&self.guards);
    }

    /// `None` = the frame is dropped; otherwise whether its readings may be used.
    #[inline]
    pub(super) fn judge(
        &mut self,
        now: Timestamp,
        bus: BusIndex,
        frame: &Frame,
        out: &mut Outputs,
    ) -> Option<Result<(), Fault>> {
        let admitted = self.gate.admit(now, bus, frame.id());
        let status = if admitted { self.guards.check(now, bus, frame) } else { None };
        self.report(now, out);
        let usable = status.is_none_or(crate::can::e2e::Status::is_usable);
        admitted.then_some(if usable { Ok(()) } else { Err(Fault::EndToEnd) })
    }

    /// Periods without a frame, floods that are over.
    pub(super) fn poll(&mut self, now: Timestamp, out: &mut Outputs) {
        self.guards.poll(now);
        self.gate.poll(now);
        self.report(now, out);
    }

    /// Nobody listened, or the clock was set.
    pub(super) fn restart(&mut self, now: Timestamp, out: &mut Outputs) {
        self.guards.restart();
        self.gate.restart();
        self.report(now, out);
    }

    /// Per protected message: how often each status was given.
    pub(super) fn protected(&self) -> impl Iterator<Item = GuardCounts> + '_ {
        self.guards.counts()
    }

    /// Messages of which frames were dropped.
    pub(super) fn dropped(&self) -> impl Iterator<Item = FloodCount> + '_ {
        self.gate.counts()
    }

    pub(super) fn snapshot(&self) -> IntakeState {
        IntakeState { protected: self.guards.snapshot(), dropped: self.gate.counts().collect() }
    }

    pub(super) fn restore(&mut self, state: &IntakeState) {
        self.guards.restore(&state.protected);
        self.gate.restore(&state.dropped);
    }

    #[inline]
    fn report(&mut self, time: Timestamp, out: &mut Outputs) {
        if self.guards.has_changes() || self.gate.has_changes() {
            self.report_changes(time, out);
        }
    }

    fn report_changes(&mut self, time: Timestamp, out: &mut Outputs) {
        let turned = self.guards.take_changes().map(|c| EventKind::Protection {
            bus: c.bus,
            id: c.id,
            status: c.status,
            usable: c.usable,
            count: c.count,
        });
        out.events.extend(turned.map(|kind| Event { time, kind }));
        let floods = self.gate.take_changes().map(|c| EventKind::Flood {
            bus: c.bus,
            id: c.id,
            active: c.active,
            dropped: c.dropped,
        });
        out.events.extend(floods.map(|kind| Event { time, kind }));
    }
}
