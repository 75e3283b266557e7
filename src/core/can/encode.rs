//! The daemon's frames, laid out by a DBC ([`layout`], [`OutputPlan`]); its command frame ([`CommandPlan`]); and input frames
//! made from values, for CSV replay and the simulator ([`InputEncoder`]).
//!
//! In: values in the program's units (fractions, Ah, s, A positive for discharge). Out: frames. An unknown value is sent as
//! the signal's "not available" code, never as a number.

mod command;
mod input;
mod layout;
mod message;
mod output;
mod protector;

pub use command::{Command, CommandFault, CommandFields, CommandPlan};
pub use input::InputEncoder;
pub use layout::{
    E2eSetting, LayoutBase, LayoutMessage, LayoutSettings, MessageSettings, SettingFault, default_database, layout,
};
pub use output::{AlarmFields, HealthFields, OutputPlan, PlanFaults, SendCounters, StatusFields};
pub use protector::InputProtector;
