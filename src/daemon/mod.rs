//! The loops round the core: the live service and the replay of records.

pub(crate) mod alarm_test;
mod background_file;
pub mod control;
mod event_log;
mod j1939_carrier;
pub mod logging;
pub mod replay;
pub mod service;
pub mod snapshot_file;
pub mod store;
