//! Finds the signals of the traction battery in a log: pack current and voltage, cell voltages, temperatures, and the
//! battery controller's own SOC and SOH.
//!
//! Input: frames with times; optionally DBC files and definitions of diagnostic answers. Output: for each quantity,
//! ranked candidates with reasons in words. Answers to diagnostic requests are read regardless of the requesting
//! device. Bits that no definition describes are searched for consecutive cell voltages and other fields.
//!
//! The owner must confirm the result, because names can mislead and a parked car shows little. The scale of a field
//! without a definition is guessed from plausible values.

mod capture;
mod configuration;
mod fields;
pub(crate) mod groups;
mod judge;
mod label;
mod log_signal;
mod raw;
mod signals;
#[cfg(test)]
mod tests;

use serde::Serialize;

use crate::can::Frame;
use crate::can::dbc::Database;
use crate::error::LabError;
use crate::import::obdb::{self, ObdbSettings};
use crate::quantity::{BusIndex, Timestamp};
use crate::wiring::evidence::PackQuantity;
use capture::Capture;
use configuration::Writer;
use log_signal::LogSignal;
use signals::Descriptions;

pub use configuration::{PackConfiguration, PackSettings};
pub use label::PackLabel;

/// Direction of a positive current.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PositiveDirection {
    /// A positive current charges the pack.
    Charge,
    /// A positive current discharges the pack.
    Discharge,
}

/// A signal, or a numbered group of signals, that may carry a quantity.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Candidate {
    /// The quantity.
    pub quantity: PackQuantity,
    /// Rank among the candidates of the quantity; 1 = best.
    pub rank: usize,
    /// Interface on which the signal was received.
    pub interface: String,
    /// `Message.Signal`. The name of a group contains `{n}` in place of the number.
    pub signal: String,
    /// Number of signals of the group; 1 = a single signal.
    pub signals: usize,
    /// Smallest value in the log, in V, A, degrees Celsius or %.
    pub low: f64,
    /// Largest value.
    pub high: f64,
    /// Weight of the evidence. Only the order of candidates matters.
    pub points: f64,
    /// Direction of a positive current, found from the response of the voltage; `None` = unknown, or not a current.
    pub positive: Option<PositiveDirection>,
    /// Reasons, in plain words.
    pub reasons: Vec<String>,
    #[serde(skip)]
    members: Vec<usize>,
}

/// Result of a search.
#[derive(Debug, Serialize)]
pub struct Discovery {
    /// Candidates by quantity, best first.
    pub candidates: Vec<Candidate>,
    /// Number of frames in the log.
    pub frames: u64,
    /// Number of frames that were ignored because the log has too many identifiers.
    pub ignored_frames: u64,
    /// Number of different diagnostic answers (sender, service and identifier).
    pub answers: usize,
    /// Length of the log (s).
    pub seconds: f64,
    /// Number of signals with values in the log.
    pub signals: usize,
    /// Remarks on battery voltages and currents that a definition describes but that never have a valid value.
    pub remarks: Vec<String>,
    #[serde(skip)]
    log_signals: Vec<LogSignal>,
}

/// Receives a log frame by frame.
#[derive(Debug, Default)]
pub struct Discoverer {
    capture: Capture,
    descriptions: Descriptions,
}

impl PositiveDirection {
    /// Returns the name of this direction in a configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Charge => "charge",
            Self::Discharge => "discharge",
        }
    }
}

impl Discoverer {
    /// Adds the messages of a DBC file.
    pub fn add_database(&mut self, database: Database) {
        self.descriptions.databases.push(database);
    }

    /// Adds the diagnostic answers of an OBDb signal set.
    ///
    /// # Errors
    /// The errors of [`obdb::import`].
    pub fn add_obdb(&mut self, text: &str, settings: &ObdbSettings) -> Result<(), LabError> {
        self.descriptions.tables.extend(obdb::tables(text, settings)?);
        Ok(())
    }

    /// Sets the data on the pack's label. If the values fit several scales, the label decides.
    pub fn set_label(&mut self, label: PackLabel) {
        self.descriptions.label = label;
    }

    /// Receives a frame.
    pub fn handle(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        self.capture.handle(time, bus, frame);
    }

    /// Returns the number of frames received so far.
    pub fn frames(&self) -> u64 {
        self.capture.frames
    }

    /// Returns the length of the log so far (s).
    pub fn seconds(&self) -> f64 {
        self.capture.seconds()
    }

    /// Ranks the candidates. `interfaces` are the names of the interfaces in the order of their numbers.
    pub fn finish(&self, interfaces: &[String]) -> Discovery {
        let (signals, remarks) = signals::signals(&self.capture, &self.descriptions);
        Discovery {
            candidates: judge::candidates(&signals, interfaces, &self.descriptions.label),
            frames: self.capture.frames,
            ignored_frames: self.capture.ignored,
            answers: self.capture.answers.len(),
            seconds: self.capture.seconds(),
            signals: signals.len(),
            remarks,
            log_signals: signals,
        }
    }

    /// Writes a configuration that uses the best candidates of [`finish`](Self::finish).
    ///
    /// # Errors
    /// Neither the log nor the settings answer some questions. The error lists them, one per line.
    pub fn configuration(&self, discovery: &Discovery, settings: &PackSettings) -> Result<PackConfiguration, LabError> {
        let Self { capture, descriptions } = self;
        let writer = Writer { discovery, capture, descriptions, settings };
        writer.write().map_err(|questions| LabError::Data(questions.join("\n")))
    }
}
