//! What the doctor is told to expect: the configuration as far as it could be read.

use crate::can::CanId;
use crate::can::decode::Binding;
use crate::can::guard::GuardConfig;
use crate::can::signal::SignalLayout;
use crate::cell::CellModel;
use crate::quantity::BusIndex;

/// Everything expected. Where the configuration is broken parts of it are missing, and not judged.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// Configured interfaces in the order of their numbers; others may be heard besides.
    pub interfaces: Vec<InterfacePlan>,
    /// Configured signals that were found in a DBC.
    pub signals: Vec<SignalPlan>,
    /// Signals of the DBC that look like voltages of cells beyond `cells`, by number.
    pub more_cells: Vec<SignalPlan>,
    /// Cells in series.
    pub cells: u16,
    /// Only the total voltage is known.
    pub is_pack_total: bool,
    /// Parallel strings.
    pub strings: u16,
    /// The cell model; `None` = it cannot be read.
    pub model: Option<CellModel>,
    /// Capacity of a cell, Ah: the configured one, else the model's.
    pub capacity_ah: f64,
    /// Temperature of the surroundings, degrees C.
    pub ambient_c: f64,
    /// Current up to which the pack counts as resting, A.
    pub dead_band_a: f64,
    /// White noise of a voltage reading that the estimator is told of, V.
    pub voltage_noise_v: f64,
    /// Ages from which readings are stale.
    pub ages: Ages,
    /// Smallest and largest plausible current, cell voltage and temperature; infinite = any.
    pub limits: [(f64, f64); 3],
    /// Protected messages.
    pub guards: Vec<GuardConfig>,
    /// Frames that are sent.
    pub outputs: Vec<OutputPlan>,
    /// Messages that carry configured signals.
    pub messages: Vec<MessagePlan>,
    /// Values come from a CSV whose columns are in the program's own units: the bus's sign is not the one to change.
    pub is_csv: bool,
}

/// One interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InterfacePlan {
    /// Kernel name.
    pub name: String,
    /// FD frames are accepted.
    pub fd: bool,
}

/// Ages from which a reading is stale, s; infinite = never.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ages {
    /// Current.
    pub current_s: f64,
    /// Voltages.
    pub voltage_s: f64,
    /// Temperatures.
    pub temperature_s: f64,
}

impl Default for Ages {
    fn default() -> Self {
        Self { current_s: f64::INFINITY, voltage_s: f64::INFINITY, temperature_s: f64::INFINITY }
    }
}

/// One configured signal.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalPlan {
    /// Where it is, what it feeds, and its scale, offset and codes.
    pub binding: Binding,
    /// Its layout as the DBC writes it.
    pub layout: SignalLayout,
    /// Table of the configuration, `input.temperature[3]`.
    pub table: String,
    /// Message in the DBC.
    pub message: String,
    /// `Message.Signal`.
    pub name: String,
    /// Unit in the DBC.
    pub unit: String,
    /// The configuration's `scale`, for the line to change.
    pub scale: f64,
    /// The configuration's `offset`.
    pub offset: f64,
}

/// One message with configured signals.
#[derive(Debug, Clone, PartialEq)]
pub struct MessagePlan {
    /// Interface.
    pub bus: BusIndex,
    /// Identifier.
    pub id: CanId,
    /// Name in the DBC.
    pub name: String,
    /// `GenMsgCycleTime`, s.
    pub cycle_time_s: Option<f64>,
    /// Multiplexer pages with configured signals.
    pub pages: usize,
}

/// One frame that is sent.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputPlan {
    /// Interfaces.
    pub buses: Vec<BusIndex>,
    /// Identifier.
    pub id: CanId,
    /// `status`, `health`, `alarm`.
    pub name: &'static str,
    /// Its table and key in the configuration.
    pub table: String,
}
