//! Compares the values of rules with thresholds and raises alarms, with debounce, hysteresis, severity and
//! acknowledgement. The module does not depend on the estimators.
//!
//! In: commands, and the values of each rule per cell or per pack, in the rule's unit (`None` = unknown). Out: changes
//! of alarms. An unknown value neither raises nor clears an alarm, but the alarm's state shows that the value is
//! unknown. For each threshold, the engine stores at most one alarm for the pack and one alarm per cell. States and
//! transitions follow ISA-18.2 (unacknowledged, latched, suppressed).
//! * [`rule`] specifies what each rule compares;
//! * [`limit`] compares a value with a threshold;
//! * [`machine`] is the state machine of one alarm;
//! * [`engine`] holds one machine per threshold and cell;
//! * [`input`] represents every input of an engine as a value, so that another engine can replay the inputs;
//! * [`selector`] selects the alarms that a command changes.

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
