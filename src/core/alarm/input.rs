//! Everything an alarm engine is told, as values: what one engine was told can be told to others.
//!
//! In: what the [`Monitor`](crate::monitor::Monitor) has for its rules. Out: the same as the engine's own methods. The
//! values of the rules do not depend on their thresholds, so engines with other thresholds that are told the same do
//! what a monitor with those thresholds would have done (`input_missing` aside: how long a silence is, is judged by its
//! strictest threshold before the engine sees it).

use super::{AlarmChange, AlarmEngine, Observation, Outcome, Rule, Selector};
use crate::quantity::{CellIndex, Timestamp};

/// One thing an engine is told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AlarmInput {
    /// [`AlarmEngine::observe`].
    Observe {
        /// Of which rule.
        rule: Rule,
        /// Of which cell; `None` = of the pack.
        cell: Option<CellIndex>,
        /// The value.
        observation: Observation,
    },
    /// [`AlarmEngine::set_inputs_valid`].
    InputsValid {
        /// Of which rule.
        rule: Rule,
        /// Of which cell; `None` = of the pack.
        cell: Option<CellIndex>,
        /// Whether they are.
        valid: bool,
    },
    /// [`AlarmEngine::poll`].
    Poll,
    /// [`AlarmEngine::handle_gap`].
    Gap,
    /// [`AlarmEngine::acknowledge`].
    Acknowledge(Selector),
    /// [`AlarmEngine::clear`].
    Clear(Selector),
    /// [`AlarmEngine::forget_learned`].
    ForgetLearned,
}

impl AlarmEngine {
    /// Takes one input at `now`; the outcome is that of a command.
    pub fn apply(&mut self, now: Timestamp, input: &AlarmInput, changes: &mut Vec<AlarmChange>) -> Outcome {
        match *input {
            AlarmInput::Observe { rule, cell, observation } => self.observe(now, rule, cell, &observation, changes),
            AlarmInput::InputsValid { rule, cell, valid } => self.set_inputs_valid(now, rule, cell, valid, changes),
            AlarmInput::Poll => self.poll(now, changes),
            AlarmInput::Gap => self.handle_gap(),
            AlarmInput::Acknowledge(which) => return self.acknowledge(&which, changes),
            AlarmInput::Clear(which) => return self.clear(&which, changes),
            AlarmInput::ForgetLearned => self.forget_learned(changes),
        }
        Outcome::default()
    }
}
