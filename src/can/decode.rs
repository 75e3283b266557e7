//! The plan that turns input frames into readings.

use serde::{Deserialize, Serialize};

use crate::quantity::{CellIndex, Fault};

/// Which temperature sensor, in the order of the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SensorIndex(pub u16);

/// What a configured signal feeds. The order is the order in which the readings of one frame are
/// handed on: a voltage triggers the estimator, so current and temperature of the same frame come first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Channel {
    /// Pack current, A, positive = discharge after the configured sign.
    Current,
    /// A temperature sensor, degrees C.
    Temperature(SensorIndex),
    /// Total pack voltage, V.
    PackVoltage,
    /// One cell's voltage, V.
    CellVoltage(CellIndex),
}

/// One value taken from a frame, in the program's units and sign, or why there is none.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// What it feeds.
    pub channel: Channel,
    /// The value, or the fault that makes it unusable.
    pub value: Result<f64, Fault>,
}
