//! End of the data path: publishes events, alarm values and the resulting frames at the time of one input.
//!
//! Each stage of the data path publishes its events and its values for the alarm rules here. If a value changes an
//! alarm, the publisher immediately adds an event, the alarm's frame and the J1939 trouble codes.

use super::alarming::Alarming;
use super::sending::Sending;
use super::sending::alarm_queue::AlarmKey;
use crate::alarm::{Alarm, AlarmChange, AlarmInput, CommandOutcome, Observation, Rule};
use crate::filter::ScalarGaussian;
use crate::monitor::message::{Event, EventKind, Outputs};
use crate::quantity::{CellIndex, Timestamp};

/// Access to alarms, frames and outputs at the time of one input.
pub(crate) struct Publisher<'a> {
    pub(crate) now: Timestamp,
    pub(crate) alarming: &'a mut Alarming,
    pub(crate) sending: &'a mut Sending,
    pub(crate) out: &'a mut Outputs,
}

impl Publisher<'_> {
    pub(crate) fn event(&mut self, kind: EventKind) {
        self.out.events.push(Event { time: self.now, kind });
    }

    /// Passes a value to its rule and publishes the resulting changes. Ignores values from a faulty channel.
    pub(crate) fn observe(&mut self, rule: Rule, cell: Option<CellIndex>, observation: Observation) {
        if !self.alarming.depends_on_faulty_channel(rule, cell) {
            self.restate(rule, cell, observation);
        }
    }

    /// Passes a previously learned value to its rule again, even if the channel is now faulty.
    pub(crate) fn restate(&mut self, rule: Rule, cell: Option<CellIndex>, observation: Observation) {
        self.apply(AlarmInput::Observe { rule, cell, observation });
        self.publish_alarms();
    }

    /// Passes an input to the alarm engine; changes wait for [`publish_alarms`](Self::publish_alarms).
    pub(crate) fn apply(&mut self, input: AlarmInput) -> CommandOutcome {
        if self.out.want_alarm_inputs {
            self.out.alarm_inputs.push((self.now, input));
        }
        self.alarming.engine.apply(self.now, &input, &mut self.alarming.changes)
    }

    /// Publishes waiting alarm changes, and sends the present state of each changed alarm.
    pub(crate) fn publish_alarms(&mut self) {
        if self.alarming.changes.is_empty() {
            return;
        }
        let mut changes = std::mem::take(&mut self.alarming.changes);
        for change in changes.drain(..) {
            self.event(alarm_event(&change));
            let Alarm { rule, severity, cell, .. } = change.alarm;
            self.sending.note_change(self.now, AlarmKey::new(rule, severity, cell));
        }
        self.alarming.changes = changes;
        self.sending.send_changed_alarms(self.now, &self.alarming.engine, self.out);
        self.update_trouble_codes();
        self.sending.poll_j1939(self.now, self.out);
    }

    pub(crate) fn update_trouble_codes(&mut self) {
        self.sending.update_trouble_codes(self.now, &self.alarming.engine);
    }
}

/// The observation for a rule from a newly learned value.
pub(crate) fn learned(value: ScalarGaussian) -> Observation {
    Observation::new(Some(value.mean)).with_std(value.std())
}

fn alarm_event(change: &AlarmChange) -> EventKind {
    let Alarm { rule, cell, state, severity, value, probability, threshold, occurrences, is_acknowledged, .. } =
        change.alarm;
    EventKind::Alarm {
        rule,
        cell,
        change: change.change,
        state,
        active: state.is_raised(),
        severity,
        value,
        probability,
        threshold,
        occurrences,
        acknowledged: is_acknowledged,
    }
}
