//! Finds the signals of the traction battery in a log: pack current and voltage, cell voltages, temperatures, and the battery
//! controller's own SOC and SOH.
//!
//! Input: frames with times; optionally DBC files and definitions of diagnostic answers. Output: ranked candidates for each
//! quantity, each with its reasons in plain words. Answers to diagnostic requests are read, whichever device sent the request. Answers
//! without a definition are searched for rows of cell voltages and other fields. Memory is bounded, and any frames are accepted.
//!
//! The result is a proposal for the owner to confirm: names mislead, and a car at rest shows little. The scale of a field without a
//! definition is a guess from plausible values.

mod capture;
mod configuration;
mod fields;
pub(crate) mod groups;
mod judge;
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

/// Meaning of a positive current.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PositiveDirection {
    /// Charge.
    Charge,
    /// Discharge.
    Discharge,
}

/// A signal, or a numbered group of signals, that may carry a quantity.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Candidate {
    /// The quantity.
    pub quantity: PackQuantity,
    /// Rank among the candidates of the quantity; 1 = best.
    pub rank: usize,
    /// Interface that carries it.
    pub interface: String,
    /// `Message.Signal`; with `{n}` for a group.
    pub signal: String,
    /// Number of signals of the group; 1 = no group.
    pub signals: usize,
    /// Smallest value in the log, in V, A, degrees Celsius or %.
    pub low: f64,
    /// Largest value.
    pub high: f64,
    /// Weight of the evidence; only the order of candidates matters.
    pub points: f64,
    /// For a current: the direction that the voltage shows.
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
    /// Number of frames ignored because there were too many identifiers.
    pub ignored_frames: u64,
    /// Number of kinds of diagnostic answers in the log.
    pub answers: usize,
    /// Length of the log, s.
    pub seconds: f64,
    /// Number of signals with values in the log.
    pub signals: usize,
    /// Remarks on described voltages and currents of the battery that never have a valid value in the log.
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
    /// Name in a configuration.
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

    /// Adds the answers of an OBDb signal set.
    ///
    /// # Errors
    /// As [`obdb::import`].
    pub fn add_obdb(&mut self, text: &str, settings: &ObdbSettings) -> Result<(), LabError> {
        self.descriptions.tables.extend(obdb::tables(text, settings)?);
        Ok(())
    }

    /// Receives a frame.
    pub fn handle(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        self.capture.handle(time, bus, frame);
    }

    /// Number of frames so far.
    pub fn frames(&self) -> u64 {
        self.capture.frames
    }

    /// Length of the log so far, s.
    pub fn seconds(&self) -> f64 {
        self.capture.seconds()
    }

    /// Ranks the candidates; `interfaces` are the names of the interfaces by number.
    pub fn finish(&self, interfaces: &[String]) -> Discovery {
        let (signals, remarks) = signals::signals(&self.capture, &self.descriptions);
        Discovery {
            candidates: judge::candidates(&signals, interfaces),
            frames: self.capture.frames,
            ignored_frames: self.capture.ignored,
            answers: self.capture.answers.len(),
            seconds: self.capture.seconds(),
            signals: signals.len(),
            remarks,
            log_signals: signals,
        }
    }

    /// A configuration from the best candidates of [`finish`](Self::finish).
    ///
    /// # Errors
    /// Questions that neither the log nor the settings answer, one per line.
    pub fn configuration(&self, discovery: &Discovery, settings: &PackSettings) -> Result<PackConfiguration, LabError> {
        let Self { capture, descriptions } = self;
        let writer = Writer { discovery, capture, descriptions, settings };
        writer.write().map_err(|questions| LabError::Data(questions.join("\n")))
    }
}
