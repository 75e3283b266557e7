//! Encodes the frames that the daemon sends, with a layout from a DBC ([`layout`], [`OutputPlan`]), and decodes the
//! command frame that it receives ([`CommandPlan`]). Also encodes input frames for CSV replay and the simulator
//! ([`InputEncoder`]).
//!
//! In: values in the program's units (fractions, Ah, s, A positive for discharge). Out: frames. An unknown value is
//! sent as the signal's "not available" code, never as a number.

mod command;
mod digest;
mod input;
mod layout;
mod message;
mod output;
mod protector;
mod reply;

pub use command::{Command, CommandFault, CommandFields, CommandPlan};
pub use digest::{DigestFields, RuleState, TableChecksum, ThresholdFields};
pub use input::InputEncoder;
pub use layout::{
    ALARM_DELAY_MS, CHANGE_REPETITION_MS, CHANGE_REPETITIONS, DEFAULT_PERIOD_MS, E2eSetting, FRESHNESS_PERIOD_MS,
    LayoutBase, LayoutMessage, LayoutSettings, MessageSettings, REPLY_DELAY_MS, SettingFault, default_database, layout,
};
pub use message::PlanFaults;
pub use output::{AlarmFields, HealthFields, OutputPlan, SendCounters, SentMessage, StatusFields};
pub use protector::InputProtector;
pub use reply::{CommandRefusal, ReplyFields};
