//! Represents every input of an alarm engine as a value, so that another engine can replay the same inputs.
//!
//! In: the inputs that the [`Monitor`](crate::monitor::Monitor) passes to its engine. Out: changes of alarms. The
//! inputs do not depend on the thresholds. If an engine with other thresholds replays the inputs, it therefore reports
//! the same changes as a monitor with those thresholds. The rule `input_missing` is an exception. Until a CAN signal
//! gives its first reading after a start or a sleep, the monitor passes the signal's silence to this rule only if the
//! silence exceeds the lowest threshold.

use super::engine::{AlarmChange, AlarmEngine};
use super::limit::Observation;
use super::machine::Machine;
use super::rule::Rule;
use super::selector::{CommandOutcome, Selector};
use crate::quantity::{CellIndex, Timestamp};

/// One input of an engine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AlarmInput {
    /// A value: input of [`AlarmEngine::observe`].
    Observe {
        rule: Rule,
        /// The cell; `None` = the pack.
        cell: Option<CellIndex>,
        observation: Observation,
    },
    /// Whether the inputs of a learned value are valid now. While they are invalid, the value cannot be renewed, so the
    /// latest value counts as unknown. Ignored for rules whose value is not learned.
    InputsValid {
        rule: Rule,
        /// The cell; `None` = the pack.
        cell: Option<CellIndex>,
        valid: bool,
    },
    /// Time has passed: input of [`AlarmEngine::poll`].
    Poll,
    /// A period without values: input of [`AlarmEngine::handle_gap`].
    Gap,
    Acknowledge(Selector),
    /// Clears alarms. A latched alarm (one that stays raised although its value is normal again) ends, and the history
    /// of a past alarm is forgotten. A raised alarm that is not latched stays and counts as refused. A latched alarm
    /// also stays and counts as refused if its value is beyond its threshold again. Learned values do not change.
    Clear(Selector),
    /// Another pack is connected: input of [`AlarmEngine::forget_learned`].
    ForgetLearned,
}

impl AlarmEngine {
    /// Handles one input at `now`. Returns the outcome of a command. For an input that is not a command, both numbers
    /// of the outcome are 0.
    pub fn apply(&mut self, now: Timestamp, input: &AlarmInput, changes: &mut Vec<AlarmChange>) -> CommandOutcome {
        match *input {
            AlarmInput::Observe { rule, cell, observation } => self.observe(now, rule, cell, &observation, changes),
            AlarmInput::InputsValid { rule, cell, valid: true } if rule.spec().is_learned => {
                self.each_threshold(rule, cell, changes, |machine, config| machine.resume(now, config));
            }
            AlarmInput::InputsValid { rule, cell, valid: false } if rule.spec().is_learned => {
                self.each_threshold(rule, cell, changes, |machine, config| machine.suspend(now, config));
            }
            AlarmInput::InputsValid { .. } => {}
            AlarmInput::Poll => self.poll(now, changes),
            AlarmInput::Gap => self.handle_gap(),
            AlarmInput::Acknowledge(which) => return self.command(&which, changes, Machine::acknowledge),
            AlarmInput::Clear(which) => return self.command(&which, changes, Machine::clear),
            AlarmInput::ForgetLearned => self.forget_learned(changes),
        }
        CommandOutcome::default()
    }
}
