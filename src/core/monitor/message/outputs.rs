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
    /// Time of the input that caused it.
    pub time: Timestamp,
    /// Interface to send on.
    pub bus: BusIndex,
    /// The frame.
    pub frame: Frame,
    /// It announces a learned value or a change of an alarm: true for all health, alarm and J1939 frames, so that frames of
    /// one identifier, and the parts of one transfer, are all of one kind.
    pub announces: bool,
    /// Authentication: the frame carries its freshness, and zeros in place of the authenticator. `None` = there is none.
    pub secured: Option<Secured>,
}

/// What the authenticator of a sent frame is made from, besides its data and the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Secured {
    /// Lengths and data id.
    pub authentication: Authentication,
    /// The whole freshness.
    pub freshness: u64,
}

impl Secured {
    /// The frame with its authenticator; `mac` is AES-128-CMAC.
    pub fn seal(&self, frame: &Frame, mac: impl FnOnce(&[u8]) -> Mac) -> Frame {
        let mut sealed = *frame;
        if let Some(input) = self.authentication.mac_input(frame.data(), self.freshness) {
            self.authentication.write_mac(sealed.data_mut(), mac(input.bytes()));
        }
        sealed
    }
}

/// Validity of the published estimates, as on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Validity {
    /// No estimate yet, or none any more: a cell's voltage has not come for too long.
    Unavailable = 0,
    /// Inputs fresh, filter consistent.
    Valid = 1,
    /// Current or temperature is stale or implausible: the estimate is coasting and its deviation grows.
    Degraded = 2,
    /// The filter's innovations contradict its covariance.
    Untrusted = 3,
}

/// One cell's estimate after one voltage update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Time of the voltage reading.
    pub time: Timestamp,
    /// Which cell.
    pub cell: CellIndex,
    /// State of charge, fraction.
    pub soc: f64,
    /// Its standard deviation.
    pub soc_std: f64,
    /// Branch voltages, V; NaN beyond the model's branches.
    pub branch_v: [f64; crate::cell::MAX_BRANCHES],
    /// Learned capacity, Ah.
    pub capacity_ah: f64,
    /// Its standard deviation, Ah.
    pub capacity_std_ah: f64,
    /// Resistance relative to new.
    pub resistance_ratio: f64,
    /// Its standard deviation.
    pub resistance_ratio_std: f64,
    /// Measured minus predicted voltage, V.
    pub innovation_v: f64,
    /// Its predicted standard deviation, V.
    pub innovation_std_v: f64,
    /// Whether the reading passed the gate and moved the estimate.
    pub accepted: bool,
    /// The readings it came from.
    pub measured: MeasuredValues,
}

/// The readings that one estimate was made from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredValues {
    /// Voltage, V.
    pub voltage_v: f64,
    /// Cell current, A, positive = discharge.
    pub current_a: f64,
    /// Temperature, degrees C.
    pub temperature_c: f64,
}

/// Outputs of the monitor; the caller empties it. Reused from input to input, so that the
/// steady state allocates nothing.
#[derive(Debug, Default)]
pub struct Outputs {
    /// Frames to send.
    pub frames: Vec<Transmit>,
    /// Events to log.
    pub events: Vec<Event>,
    /// Estimates, only when `want_estimates`.
    pub estimates: Vec<Estimate>,
    /// Whether the caller wants `estimates`.
    pub want_estimates: bool,
    /// Inputs of the alarm engine, only when `want_alarm_inputs`; without changes by a restore or another configuration.
    pub alarm_inputs: Vec<(Timestamp, AlarmInput)>,
    /// Whether the caller wants `alarm_inputs`.
    pub want_alarm_inputs: bool,
}

impl Outputs {
    /// Whether there is no output.
    pub fn is_empty(&self) -> bool {
        self.events.is_empty() && self.frames.is_empty() && self.estimates.is_empty() && self.alarm_inputs.is_empty()
    }

    /// Empties the lists, keeps their memory.
    pub fn clear(&mut self) {
        self.frames.clear();
        self.events.clear();
        self.estimates.clear();
        self.alarm_inputs.clear();
    }
}
