//! The core's one face: inputs in, outputs out. Never reads a clock, a file or a socket, and never logs.
mod types;
pub use types::*;

use serde::{Deserialize, Serialize};

use crate::quantity::Timestamp;

/// Everything the core must know, already checked.
#[derive(Debug, Clone)]
pub struct MonitorConfig {
    /// Sample stage.
    pub sample: crate::sample::SampleConfig,
    /// Cell model.
    pub model: crate::cell::CellModel,
    /// Estimator.
    pub estimator: crate::cell::EstimatorConfig,
    /// Learning at transitions.
    pub health: crate::health::HealthConfig,
    /// Alarm rules.
    pub rules: Vec<crate::alarm::RuleConfig>,
}

/// State of a [`Monitor`] at one moment, as a versioned serde document.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Snapshot {
    /// Layout version.
    pub version: u32,
    /// When it was taken, on the clock of the inputs.
    pub time: Timestamp,
}

/// Why a snapshot cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RestoreError {
    /// Written by another version.
    #[error("snapshot version {found}, this program reads {allowed}")]
    Version {
        /// In the file.
        found: u32,
        /// Readable here.
        allowed: u32,
    },
    /// Taken with another number of cells or branches.
    #[error("snapshot is for {found}, the configuration has {allowed}")]
    Shape {
        /// In the file.
        found: String,
        /// Configured.
        allowed: String,
    },
}

/// The pure core.
#[derive(Debug)]
pub struct Monitor {}

impl Monitor {
    /// A monitor that knows nothing yet.
    pub fn new(config: MonitorConfig) -> Self {
        let _ = config;
        Self {}
    }

    /// Takes one input; appends what comes of it to `out`.
    pub fn handle(&mut self, input: Input<'_>, out: &mut Outputs) {
        let _ = (input, out);
    }

    /// The state, to be stored.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot { version: 1, time: Timestamp::ZERO }
    }

    /// Takes up a stored state at time `now`, `away_s` seconds after it was taken: its time stamps are
    /// moved onto the present clock, and the time away is a gap like any other.
    ///
    /// # Errors
    /// When the snapshot's version or shape does not fit.
    pub fn restore(&mut self, snapshot: &Snapshot, now: Timestamp, away_s: f64) -> Result<(), RestoreError> {
        let _ = (snapshot, now, away_s);
        Ok(())
    }

    /// The latest estimate of every cell, for live tables; `None` before its first.
    pub fn latest(&self) -> &[Option<Estimate>] {
        &[]
    }
}
