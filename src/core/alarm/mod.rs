//! Rules over named values: debounce, hysteresis, severity, acknowledgement. Sees values with age and validity, no estimator.
//!
//! In: a rule's value per cell or per pack, in the rule's unit, or `None` when it is not known; commands.
//! Out: changes of alarms. Promise: an unknown value neither raises nor clears, and is visible; memory is bounded by
//! rules x cells. States and transitions follow ISA-18.2 (unacknowledged, latched, suppressed).
//! * [`rule`] says what each rule compares;
//! * [`limit`] compares a value with a threshold;
//! * [`machine`] holds the life of one alarm as a transition table;
//! * [`engine`] holds one such machine per threshold and cell;
//! * [`input`] holds every input of an engine as a value, so that another engine can take the same;
//! * [`selector`] selects the alarms of a command.

pub mod engine;
pub mod input;
pub mod limit;
pub mod machine;
pub mod rule;
pub mod selector;

pub use engine::summary::RuleSummary;
pub use engine::{Alarm, AlarmChange, AlarmEngine, AlarmSnapshot, RunningAlarm, StoredAlarm, ThresholdState};
pub use input::AlarmInput;
pub use limit::{Comparison, Observation, RuleConfig};
pub use machine::{AlarmState, Change, Refusal};
pub use rule::{Direction, Rule, Scope, Severity, Unit};
pub use selector::{CommandOutcome, Selector};
