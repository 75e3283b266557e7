//! The checked configuration.

use std::path::PathBuf;

use super::key_source::KeySource;
use super::vehicle::VehicleIdentity;
use crate::can::dbc::Database;
use crate::config::cell_model::ModelSource;
use crate::monitor::MonitorConfig;
use crate::quantity::BusIndex;

/// A configuration that cannot be wrong.
#[derive(Debug, Clone)]
pub struct Config {
    /// The configuration file.
    pub path: PathBuf,
    /// CAN interfaces; a `BusIndex` counts in this order.
    pub interfaces: Vec<InterfaceConfig>,
    /// Settings of the core.
    pub monitor: MonitorConfig,
    /// Where the cell model in them comes from.
    pub model_source: ModelSource,
    /// Layout of the sent frames, for receivers; `None` = nothing is sent.
    pub output_layout: Option<Database>,
    /// How state and history are kept.
    pub store: StoreConfig,
    /// What is allowed and unlikely, one line each, in the form of the faults.
    pub warnings: Vec<String>,
    /// Which vehicle and pack this is.
    pub vehicle: VehicleIdentity,
    /// Where the key of authenticated frames is; `None` = no frame is authenticated.
    pub key: Option<KeySource>,
}

impl Config {
    /// Name of an interface.
    pub fn interface_name(&self, bus: BusIndex) -> &str {
        self.interfaces.get(bus.index()).map_or("?", |interface| &interface.name)
    }

    /// Names of the interfaces, in the order in which they are numbered.
    pub fn interface_names(&self) -> Vec<String> {
        self.interfaces.iter().map(|interface| interface.name.clone()).collect()
    }
}

/// How state and history are kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StoreConfig {
    /// Least period of the state's checkpoints, s.
    pub checkpoint_s: f64,
    /// Rows of the history kept; beyond, the oldest segments are deleted.
    pub max_rows: u32,
    /// Rows older than this are deleted, years; `None` = whatever their age, they are kept.
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
