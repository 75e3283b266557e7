//! The loops round the core: the live service and the replay of records.

pub(crate) mod alarm_test;
mod background_file;
pub mod control;
pub mod doctor;
mod event_log;
pub(crate) mod exporter;
mod j1939_carrier;
pub mod logging;
pub mod replay;
pub mod service;
pub mod snapshot_file;
pub mod status;
pub mod store;
mod unix_socket;
