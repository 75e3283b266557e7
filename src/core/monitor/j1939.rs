//! The J1939 node beside the frames of `[output]`: alarms as trouble codes.
//!
//! In: frames of the node's interface, alarms, ticks. Out: the node's frames and events. Of the thresholds
//! of a rule that share a parameter number and are raised for any cell, the gravest is told. The occurrence count is
//! that of the one of its alarms that was raised most often.

use super::{Event, EventKind, Monitor, Outputs, Transmit};
use crate::alarm::{Rule, Severity};
use crate::can::Frame;
use crate::can::j1939::{ActiveCode, Lamp, Node, NodeConfig, NodeOutputs, TroubleCode};
use crate::quantity::{BusIndex, Timestamp};

/// J1939 as configured.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct J1939Config {
    /// Interface the node is on.
    pub bus: BusIndex,
    /// Who it is.
    pub node: NodeConfig,
    /// How each threshold of each rule shows.
    pub alarms: Vec<AlarmCode>,
    /// What is told while a test runs.
    pub test_code: TroubleCode,
}

/// How the alarms of one threshold show on J1939.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AlarmCode {
    /// The rule.
    pub rule: Rule,
    /// The threshold's severity.
    pub severity: Severity,
    /// Its code, with no occurrence counted.
    pub code: TroubleCode,
    /// The lamp it lights.
    pub lamp: Lamp,
}

/// The node and what it tells.
#[derive(Debug)]
pub(super) struct J1939 {
    config: J1939Config,
    node: Node,
    out: NodeOutputs,
    active: Vec<ActiveCode>,
    previously_active: Vec<TroubleCode>,
}

impl J1939 {
    pub(super) fn new(config: J1939Config) -> Self {
        Self {
            node: Node::new(&config.node),
            config,
            out: NodeOutputs::default(),
            active: Vec::new(),
            previously_active: Vec::new(),
        }
    }

    /// Other codes for the same node; `false` = it is another node.
    pub(super) fn take_over(&mut self, config: &J1939Config) -> bool {
        let is_same = (self.config.bus, self.config.node) == (config.bus, config.node);
        if is_same {
            self.config.clone_from(config);
        }
        is_same
    }

    pub(super) fn next_due(&self) -> Option<Timestamp> {
        self.node.next_due()
    }

    fn dispatch_outputs(&mut self, now: Timestamp, out: &mut Outputs) {
        let bus = self.config.bus;
        let transmit = |frame| Transmit { time: now, bus, frame, announces: true };
        out.frames.extend(self.out.frames.drain(..).map(transmit));
        let event = |what| Event { time: now, kind: EventKind::J1939 { what } };
        out.events.extend(self.out.events.drain(..).map(event));
    }
}

impl Monitor {
    /// Claims the address: at the start, after time asleep, when the interface comes back.
    pub(super) fn start_j1939(&mut self, now: Timestamp, out: &mut Outputs) {
        let Some(j1939) = &mut self.j1939 else { return };
        j1939.node.handle_gap(now, &mut j1939.out);
        j1939.dispatch_outputs(now, out);
    }

    pub(super) fn handle_j1939_frame(&mut self, bus: BusIndex, frame: &Frame, out: &mut Outputs) {
        let Some(j1939) = self.j1939.as_mut().filter(|j1939| j1939.config.bus == bus) else { return };
        j1939.node.handle_frame(self.now, frame, &mut j1939.out);
        j1939.dispatch_outputs(self.now, out);
    }

    pub(super) fn poll_j1939(&mut self, out: &mut Outputs) {
        let Some(j1939) = &mut self.j1939 else { return };
        j1939.node.poll(self.now, &mut j1939.out);
        j1939.dispatch_outputs(self.now, out);
    }

    /// Hands the node what is raised and what has been.
    pub(super) fn tell_j1939(&mut self) {
        let Some(j1939) = &mut self.j1939 else { return };
        j1939.active.clear();
        j1939.previously_active.clear();
        // Within a rule the gravest threshold comes last.
        for threshold in self.alarms.thresholds().rev() {
            let same = |code: &&AlarmCode| (code.rule, code.severity) == (threshold.rule, threshold.severity);
            let Some(own) = j1939.config.alarms.iter().find(same) else { continue };
            let code = own.code.with_occurrences(threshold.occurrences);
            if threshold.is_raised {
                if j1939.active.iter().all(|graver| graver.code.spn() != code.spn()) {
                    j1939.active.push(ActiveCode { code, lamp: own.lamp });
                }
            } else if threshold.occurrences > 0 {
                j1939.previously_active.push(code);
            }
        }
        // The gravest rule that was active first: what does not fit is cut off at the end.
        j1939.previously_active.reverse();
        let test = self.test.map(|_| ActiveCode { code: j1939.config.test_code, lamp: Lamp::None });
        j1939.active.extend(test);
        let (_, unknown) = self.alarms.unknown();
        j1939.node.set_codes(self.now, &j1939.active, &j1939.previously_active, unknown == 0);
    }
}
