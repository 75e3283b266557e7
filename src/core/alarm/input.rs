//! Every input of an alarm engine as a value, so that another engine can replay the same inputs.
//!
//! In: values that the [`Monitor`](crate::monitor::Monitor) passes to its rules. Out: the same as the engine's own
//! methods. The values do not depend on thresholds, so an engine with other thresholds and the same inputs does what a
//! monitor with those thresholds would have done. Exception: for `input_missing`, the strictest threshold decides
//! whether the monitor reports a silence to the engine at all.

use super::engine::{AlarmChange, AlarmEngine};
use super::limit::Observation;
use super::machine::Machine;
use super::rule::Rule;
use super::selector::{CommandOutcome, Selector};
use crate::quantity::{CellIndex, Timestamp};

/// One input of an engine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AlarmInput {
    /// [`AlarmEngine::observe`].
    Observe {
        rule: Rule,
        /// The cell; `None` = the pack.
        cell: Option<CellIndex>,
        observation: Observation,
    },
    /// Whether the inputs of a learned value are valid now. While they are not, the value cannot be renewed and changes
    /// no alarm. Ignored for rules that are not learned.
    InputsValid {
        rule: Rule,
        /// The cell; `None` = the pack.
        cell: Option<CellIndex>,
        valid: bool,
    },
    /// [`AlarmEngine::poll`].
    Poll,
    /// [`AlarmEngine::handle_gap`].
    Gap,
    Acknowledge(Selector),
    /// Clears alarms: latched alarms end (unless they are beyond their threshold again), the history of past alarms is
    /// forgotten. Alarms that are active, or whose value has not been healthy since, stay and count as refused. Learned
    /// values do not change.
    Clear(Selector),
    /// [`AlarmEngine::forget_learned`].
    ForgetLearned,
}

impl AlarmEngine {
    /// Handles one input at `now`; returns the outcome of a command.
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
