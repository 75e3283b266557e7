//! Everything that touches the computer: configuration, log files, sockets, the state store, the service and its status,
//! control and metrics sockets, and the loops that drive the core from recorded logs.

pub use packwatch_core::{alarm, can, cell, doctor, filter, findings, health, monitor, quantity, sample, sim};

pub mod config;
pub mod control;
pub mod diagnosis;
pub mod exporter;
pub mod failure;
pub mod io;
pub mod logging;
pub mod replay;
pub mod service;
pub mod status;
pub mod store;
mod token_bucket;
