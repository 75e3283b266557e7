//! Everything that interacts with the computer: configuration, log files, sockets, the state store, and the service
//! with its status, control and metrics sockets. The loops that run the core on recorded logs are also here.

pub use packwatch_core::{alarm, can, cell, cell_faults, filter, health, monitor, quantity, sample, sim, wiring};

pub mod bounded_file;
pub mod config;
pub mod control;
pub mod exporter;
pub mod failure;
pub mod http;
pub mod io;
pub mod logging;
pub mod replay;
pub mod service;
pub mod status;
pub mod store;
mod token_bucket;
pub mod wiring_check;
