//! Arguments, log reading and output shared by several commands.

pub(crate) mod alarms;
#[cfg(feature = "lab")]
pub(crate) mod cell_model;
pub(crate) mod control;
#[cfg(feature = "lab")]
pub(crate) mod files;
pub(crate) mod label;
pub(crate) mod logs;
#[cfg(feature = "lab")]
pub(crate) mod many_logs;
#[cfg_attr(not(feature = "lab"), expect(dead_code, reason = "used by the offline commands"))]
pub(crate) mod numbers;
#[cfg_attr(not(feature = "lab"), expect(dead_code, reason = "used by the offline commands"))]
pub(crate) mod output;
pub(crate) mod progress;
#[cfg(feature = "lab")]
pub(crate) mod replaying;
