//! Describes a vehicle of a fleet: its line in the manifest, and the file `vehicle.json` in its folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::cell::{Label, OwnModel};

pub(super) const VERSION: u32 = 2;
/// Name of the file with the result, in the vehicle's folder.
pub(super) const RECORD: &str = "vehicle.json";

/// A vehicle: a line of the manifest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vehicle {
    /// Name of the vehicle. Its folder has this name, and the first column of its tables contains it.
    pub vehicle: String,
    /// Size of the vehicle's logs (bytes).
    pub bytes: u64,
    /// Logs of the vehicle, in the order of recording.
    pub logs: Vec<PathBuf>,
    /// Configuration of the vehicle; `None` = the common configuration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub config: Option<PathBuf>,
}

/// Result of replaying a vehicle: the content of its `vehicle.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VehicleRecord {
    /// Version of the format.
    pub version: u32,
    /// Version of the program.
    pub packwatch: String,
    /// The line of the manifest.
    pub line: Vehicle,
    /// SHA-256 of all settings: configuration with its DBC files and cell model, and the options for reading logs.
    /// `None` = the configuration cannot be read.
    pub settings_sha256: Option<String>,
    /// Period of the estimates (s); `None` = no table of estimates.
    pub period_s: Option<f64>,
    /// Reason for missing tables; `None` = the tables exist.
    pub error: Option<String>,
    /// Number of rows of each table.
    pub rows: BTreeMap<String, u64>,
    /// Number of cells of the pack; 0 = the configuration cannot be read.
    pub cells: u32,
    /// Rated capacity of a cell (Ah); `None` = the configuration cannot be read.
    pub rated_ah: Option<f64>,
    /// Time from the first stamp to the last (days).
    pub days: f64,
    /// Notes on the logs.
    pub notes: Vec<String>,
    /// Cell model that was learned from the logs; `None` = no model was learned.
    pub model: Option<LearnedModel>,
}

/// A cell model learned from the logs of a vehicle, with the label from which learning started.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearnedModel {
    /// Label from which learning started.
    pub label: Label,
    /// The learned model.
    pub own: OwnModel,
    /// Whether learning started from the prior of a fleet (`pack.prior`).
    pub has_prior: bool,
}

impl VehicleRecord {
    /// Reads the result from a vehicle's folder; `None` = the replay is incomplete, or the file has another version.
    pub fn read(folder: &Path) -> Option<Self> {
        let text = std::fs::read(folder.join(RECORD)).ok()?;
        serde_json::from_slice(&text).ok().filter(|record: &Self| record.version == VERSION)
    }

    /// Whether `other` has the same inputs, which would give the same tables.
    pub(super) fn has_inputs_of(&self, other: &Self) -> bool {
        let key = |record: &Self| {
            let Self { packwatch, line, settings_sha256, period_s, .. } = record;
            (packwatch.clone(), line.clone(), settings_sha256.clone(), *period_s)
        };
        key(self) == key(other)
    }
}
