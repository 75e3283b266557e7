//! Rules over named values: debounce, hysteresis, severity, acknowledgement. Sees values with age and validity, no estimator.
//!
//! In: a rule's value per cell or per pack, in the rule's unit, or `None` when it is not known; commands of people.
//! Out: what became of the alarms. Promise: an unknown value neither raises nor clears, and shows; memory is bounded by
//! rules x cells.
//! * [`rule`] says what each rule compares;
//! * [`judge`] compares a value with a threshold;
//! * [`machine`] holds the life of one alarm as a transition table;
//! * [`engine`] holds one such machine per rule and cell;
//! * [`input`] makes values of what an engine is told, so that others can be told the same;
//! * [`selector`] says which alarms a command of people means.

pub mod engine;
pub mod input;
pub mod judge;
pub mod machine;
pub mod rule;
pub mod selector;

pub use engine::{Alarm, AlarmChange, AlarmEngine, AlarmState, StoredAlarm, ThresholdState};
pub use input::AlarmInput;
pub use judge::{Observation, RuleConfig, When};
pub use machine::{Change, Refusal, State};
pub use rule::{Direction, Rule, Scope, Severity, Unit};
pub use selector::{Outcome, Selector};
