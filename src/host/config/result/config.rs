//! The checked configuration, as the daemon and the other commands use it.

use std::path::PathBuf;

use super::key_source::KeySource;
use super::vehicle::VehicleIdentity;
use crate::can::dbc::Database;
use crate::config::cell_model::ModelSource;
use crate::monitor::MonitorConfig;
use crate::quantity::BusIndex;

/// A checked configuration.
#[derive(Debug, Clone)]
pub struct Config {
    /// The configuration file.
    pub path: PathBuf,
    /// CAN interfaces. A `BusIndex` is an index into this list.
    pub interfaces: Vec<InterfaceConfig>,
    /// Settings of the core.
    pub monitor: MonitorConfig,
    /// The origin of the cell model in `monitor`.
    pub model_source: ModelSource,
    /// Layout of the sent frames, for receivers; `None` = nothing is sent.
    pub output_layout: Option<Database>,
    /// How state and history are kept.
    pub store: StoreConfig,
    /// Values that are allowed but unlikely, one line each, formatted like faults.
    pub warnings: Vec<String>,
    /// The vehicle and pack.
    pub vehicle: VehicleIdentity,
    /// Location of the key for authenticated frames; `None` = no frame is authenticated.
    pub key: Option<KeySource>,
}

impl Config {
    /// Name of an interface.
    pub fn interface_name(&self, bus: BusIndex) -> &str {
        self.interfaces.get(bus.index()).map_or("?", |interface| &interface.name)
    }

    /// Names of the interfaces in the order of their numbers.
    pub fn interface_names(&self) -> Vec<String> {
        self.interfaces.iter().map(|interface| interface.name.clone()).collect()
    }
}

/// How state and history are kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StoreConfig {
    /// Shortest time between checkpoints of the state (s).
    pub checkpoint_s: f64,
    /// Maximum number of rows kept in the history; above this number the oldest segments are deleted.
    pub max_rows: u32,
    /// Longest age of rows, years; `None` = unlimited.
    pub keep_years: Option<f64>,
}

/// One CAN interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InterfaceConfig {
    /// Kernel name, `can0`.
    pub name: String,
    /// Whether FD frames are accepted and may be sent.
    pub fd: bool,
}
