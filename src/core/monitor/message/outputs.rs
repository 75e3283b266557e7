//! Outputs of the [`Monitor`](crate::monitor::Monitor): frames, events, estimates, and the inputs of its alarm engine.

use serde::{Deserialize, Serialize};

use super::event::Event;
use crate::alarm::AlarmInput;
use crate::can::Frame;
use crate::can::secoc::{Authentication, Mac};
use crate::quantity::{BusIndex, CellIndex, Timestamp};

/// A frame to send.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transmit {
    /// Time of the input that caused the frame.
    pub time: Timestamp,
    pub bus: BusIndex,
    pub frame: Frame,
    /// Whether frames of this kind can announce a new result (a learned value or an alarm change), so that they wait
    /// until the result is stored. True for all frames except status frames, freshness frames and diagnostic requests.
    /// All frames of one identifier and all parts of one transfer therefore have the same flag.
    pub announces: bool,
    /// How to authenticate the frame; `None` = the frame is not authenticated. The frame already contains its
    /// freshness, and zeros in place of the authenticator.
    pub secured: Option<Secured>,
}

/// Inputs for the authenticator of a sent frame, in addition to the frame's data and the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Secured {
    /// Lengths of the fields, and the data identifier.
    pub authentication: Authentication,
    /// The complete freshness value.
    pub freshness: u64,
}

impl Secured {
    /// Returns a copy of the frame that contains the authenticator. `mac` computes AES-128-CMAC.
    pub fn seal(&self, frame: &Frame, mac: impl FnOnce(&[u8]) -> Mac) -> Frame {
        let mut sealed = *frame;
        if let Some(input) = self.authentication.mac_input(frame.data(), self.freshness) {
            self.authentication.write_mac(sealed.data_mut(), mac(input.bytes()));
        }
        sealed
    }
}

/// Validity of the published estimates. CAN frames contain the number of the variant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Validity {
    /// The estimate is missing: not every cell has an estimate yet, or a cell's voltage is overdue.
    Unavailable = 0,
    /// Inputs are fresh and the filter is consistent.
    Valid = 1,
    /// Current or temperature is stale or implausible: the estimate is extrapolated and its standard deviation grows.
    Degraded = 2,
    /// A cell's innovations contradict the covariance of the cell's filter, a cell's model does not fit, or the current
    /// is doubtful.
    Untrusted = 3,
}

/// One cell's estimate after one voltage update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Time of the voltage reading.
    pub time: Timestamp,
    pub cell: CellIndex,
    /// State of charge, fraction.
    pub soc: f64,
    /// Standard deviation of the SOC.
    pub soc_std: f64,
    /// Voltages of the model's RC branches (V); NaN in unused elements.
    pub branch_v: [f64; crate::cell::MAX_BRANCHES],
    /// Learned capacity (Ah).
    pub capacity_ah: f64,
    /// Standard deviation of the capacity (Ah).
    pub capacity_std_ah: f64,
    /// Resistance relative to the resistance of a new cell.
    pub resistance_ratio: f64,
    /// Standard deviation of the resistance ratio.
    pub resistance_ratio_std: f64,
    /// Measured minus predicted voltage (V).
    pub innovation_v: f64,
    /// Predicted standard deviation of the innovation (V).
    pub innovation_std_v: f64,
    /// Whether the reading passed the innovation gate and changed the estimate.
    pub accepted: bool,
    /// The readings used.
    pub measured: MeasuredValues,
}

/// Readings used for one estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredValues {
    pub voltage_v: f64,
    /// Cell current (A), positive = discharge.
    pub current_a: f64,
    pub temperature_c: f64,
}

/// Outputs of the monitor. The caller empties and reuses one value, so that normal operation does not allocate memory.
#[derive(Debug, Default)]
pub struct Outputs {
    pub frames: Vec<Transmit>,
    pub events: Vec<Event>,
    /// Estimates; empty unless `want_estimates` is set.
    pub estimates: Vec<Estimate>,
    /// Whether the caller wants `estimates`.
    pub want_estimates: bool,
    /// Inputs of the alarm engine; empty unless `want_alarm_inputs` is set. Not included: restored alarms and changed
    /// rules.
    pub alarm_inputs: Vec<(Timestamp, AlarmInput)>,
    /// Whether the caller wants `alarm_inputs`.
    pub want_alarm_inputs: bool,
}

impl Outputs {
    /// Whether all lists are empty.
    pub fn is_empty(&self) -> bool {
        self.events.is_empty() && self.frames.is_empty() && self.estimates.is_empty() && self.alarm_inputs.is_empty()
    }

    /// Empties the lists and keeps their allocations.
    pub fn clear(&mut self) {
        self.frames.clear();
        self.events.clear();
        self.estimates.clear();
        self.alarm_inputs.clear();
    }
}
