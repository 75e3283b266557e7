//! Finds the signals of the traction battery in a log: pack current and voltage, cell voltages, temperatures, the battery
//! controller's own SOC and SOH.
//!
//! In: frames with times; DBC files and definitions of diagnostic answers, if there are any. Out: ranked candidates of each
//! quantity, each with its reasons in plain words. Answers to diagnostic requests are read, whatever device asked; those that no
//! definition describes are searched for rows of cell voltages and other fields. Memory is bounded, any frames are accepted.
//!
//! It proposes, the owner decides: names mislead, and a car at rest shows little. The scale of a field without a definition is
//! a guess from plausible values.

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

/// What a positive current means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PositiveDirection {
    /// It charges.
    Charge,
    /// It discharges.
    Discharge,
}

/// A signal, or a numbered group, that may be a quantity.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Candidate {
    /// The quantity.
    pub quantity: PackQuantity,
    /// 1 = best of its quantity.
    pub rank: usize,
    /// Interface that carries it.
    pub interface: String,
    /// `Message.Signal`, for a group with `{n}`.
    pub signal: String,
    /// Signals of the group; 1 = no group.
    pub signals: usize,
    /// Smallest value in the log, in V, A, degrees Celsius or %.
    pub low: f64,
    /// Largest value.
    pub high: f64,
    /// Weight of the evidence; only the order matters.
    pub points: f64,
    /// For a current: what the voltage says about its sign.
    pub positive: Option<PositiveDirection>,
    /// Why, in plain words.
    pub reasons: Vec<String>,
    #[serde(skip)]
    members: Vec<usize>,
}

/// What was found.
#[derive(Debug, Serialize)]
pub struct Discovery {
    /// Candidates by quantity, best first.
    pub candidates: Vec<Candidate>,
    /// Frames of the log.
    pub frames: u64,
    /// Frames ignored because there are too many identifiers.
    pub ignored_frames: u64,
    /// Kinds of diagnostic answers in the log.
    pub answers: usize,
    /// Length of the log, s.
    pub seconds: f64,
    /// Signals that have values in the log.
    pub signals: usize,
    /// Voltages and currents of the battery that are in the log and never have a value.
    pub remarks: Vec<String>,
    #[serde(skip)]
    log_signals: Vec<LogSignal>,
}

/// Takes a log frame by frame.
#[derive(Debug, Default)]
pub struct Discoverer {
    capture: Capture,
    descriptions: Descriptions,
}

impl PositiveDirection {
    /// As in a configuration.
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

    /// Takes a frame.
    pub fn handle(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        self.capture.handle(time, bus, frame);
    }

    /// Frames so far.
    pub fn frames(&self) -> u64 {
        self.capture.frames
    }

    /// Length of the log so far, s.
    pub fn seconds(&self) -> f64 {
        self.capture.seconds()
    }

    /// Judges what was taken; `interfaces` are the names of the interfaces by number.
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

    /// A configuration of the best candidates of what [`finish`](Self::finish) found.
    ///
    /// # Errors
    /// The questions that the log leaves open and the settings do not answer, one a line.
    pub fn configuration(&self, discovery: &Discovery, settings: &PackSettings) -> Result<PackConfiguration, LabError> {
        let Self { capture, descriptions } = self;
        let writer = Writer { discovery, capture, descriptions, settings };
        writer.write().map_err(|questions| LabError::Data(questions.join("\n")))
    }
}
