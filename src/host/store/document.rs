//! The stored state: the core's snapshot with its moment. JSON in the runtime folder, packed in the database.

use std::path::Path;
use std::{fs, io};

use serde::{Deserialize, Serialize};

use super::stamp::Stamp;
use crate::monitor::Snapshot;

/// A state and when it was taken.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct StateDocument {
    /// State folder it belongs to: two daemons may share a runtime folder.
    pub folder: String,
    /// When it was taken.
    pub stamp: Stamp,
    /// The core's state.
    pub snapshot: Box<Snapshot>,
}

impl StateDocument {
    /// Reads JSON.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn parse(json: &[u8]) -> Result<Self, String> {
        serde_json::from_slice(json).map_err(|error| format!("not a state: {error}"))
    }

    /// Writes it to a temporary name and renames it. Does not sync: the file lies in memory.
    pub(super) fn write(&self, path: &Path) -> io::Result<()> {
        let part = path.with_extension("json.part");
        fs::write(&part, serde_json::to_vec(self)?)?;
        fs::rename(&part, path)
    }
}
