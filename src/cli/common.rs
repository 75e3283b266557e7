//! What several commands share: their arguments, the logs they read, and what they print. No command is named here.

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
#[cfg_attr(not(feature = "lab"), expect(dead_code, reason = "the offline commands use more of it"))]
pub(crate) mod numbers;
#[cfg_attr(not(feature = "lab"), expect(dead_code, reason = "the offline commands use more of it"))]
pub(crate) mod output;
pub(crate) mod progress;
#[cfg(feature = "lab")]
pub(crate) mod replaying;
