//! The J1939 node, which sends alarms as trouble codes in addition to the frames of `[output]`.
//!
//! In: frames of the node's interface, alarms, ticks. Out: the node's frames and events. If several raised thresholds
//! of a rule share a suspect parameter number (SPN), the node sends only the code of the most severe threshold. If
//! several raised rules share an SPN, the node sends only the rule with the highest number. The occurrence count of a
//! code is the largest count among the threshold's alarms.

use crate::alarm::AlarmEngine;
use crate::can::Frame;
use crate::can::j1939::{ActiveCode, Lamp, Node, NodeOutputs, TroubleCode};
use crate::monitor::config::{AlarmCode, J1939Config};
use crate::monitor::message::{Event, EventKind, Outputs, Transmit};
use crate::quantity::{BusIndex, Timestamp};

#[derive(Debug)]
pub(crate) struct J1939 {
    config: J1939Config,
    pub(crate) node: Node,
    out: NodeOutputs,
    active: Vec<ActiveCode>,
    previously_active: Vec<TroubleCode>,
}

impl J1939 {
    pub(crate) fn new(config: J1939Config) -> Self {
        Self {
            node: Node::new(&config.node),
            config,
            out: NodeOutputs::default(),
            active: Vec::new(),
            previously_active: Vec::new(),
        }
    }

    /// Applies a configuration with other trouble codes. If its interface or its node settings differ, changes nothing
    /// and returns `false`.
    pub(crate) fn reconfigure(&mut self, config: &J1939Config) -> bool {
        let is_same = (self.config.bus, self.config.node) == (config.bus, config.node);
        if is_same {
            self.config.clone_from(config);
        }
        is_same
    }

    pub(crate) fn next_due(&self) -> Option<Timestamp> {
        self.node.next_due()
    }

    pub(crate) fn claim_address(&mut self, now: Timestamp, out: &mut Outputs) {
        self.node.start(now, &mut self.out);
        self.dispatch_outputs(now, out);
    }

    pub(crate) fn handle_frame(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame, out: &mut Outputs) {
        if bus == self.config.bus {
            self.node.handle_frame(now, frame, &mut self.out);
            self.dispatch_outputs(now, out);
        }
    }

    pub(crate) fn poll(&mut self, now: Timestamp, out: &mut Outputs) {
        self.node.poll(now, &mut self.out);
        self.dispatch_outputs(now, out);
    }

    /// Sets the node's active and previously active codes from the present alarms.
    pub(crate) fn update_trouble_codes(&mut self, now: Timestamp, engine: &AlarmEngine, is_test_running: bool) {
        self.active.clear();
        self.previously_active.clear();
        // Within a rule, the thresholds are ordered by increasing severity.
        for threshold in engine.thresholds().rev() {
            let same = |code: &&AlarmCode| (code.rule, code.severity) == (threshold.rule, threshold.severity);
            let Some(own) = self.config.alarms.iter().find(same) else { continue };
            let code = own.code.with_occurrences(threshold.occurrences);
            if threshold.is_raised {
                if self.active.iter().all(|graver| graver.code.spn() != code.spn()) {
                    self.active.push(ActiveCode { code, lamp: own.lamp });
                }
            } else if threshold.occurrences > 0 {
                self.previously_active.push(code);
            }
        }
        // Restores the order by rule and severity. The order matters, because a list that is too long loses its end.
        self.previously_active.reverse();
        if is_test_running {
            self.active.push(ActiveCode { code: self.config.test_code, lamp: Lamp::None });
        }
        let (_, unknown) = engine.unknown();
        self.node.set_codes(now, &self.active, &self.previously_active, unknown == 0);
    }

    fn dispatch_outputs(&mut self, now: Timestamp, out: &mut Outputs) {
        let bus = self.config.bus;
        let transmit = |frame| Transmit { time: now, bus, frame, announces: true, secured: None };
        out.frames.extend(self.out.frames.drain(..).map(transmit));
        let event = |what| Event { time: now, kind: EventKind::J1939 { what } };
        out.events.extend(self.out.events.drain(..).map(event));
    }
}
