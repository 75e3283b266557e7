//! The state as it is kept: the core's snapshot with the moment it was taken. JSON in the runtime folder, packed in the
//! database.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::stamp::Stamp;
use crate::monitor::Snapshot;

/// A state and when it was taken.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Document {
    /// State folder it belongs to: two daemons may share a runtime folder.
    pub folder: String,
    /// When it was taken.
    pub stamp: Stamp,
    /// The core's state.
    pub snapshot: Box<Snapshot>,
}

impl Document {
    /// As compact JSON.
    pub(super) fn to_json(&self) -> io::Result<Vec<u8>> {
        Ok(serde_json::to_vec(self)?)
    }

    /// From JSON; what is wrong with it otherwise.
    pub(super) fn parse(json: &[u8]) -> Result<Self, String> {
        serde_json::from_slice(json).map_err(|error| format!("not a state: {error}"))
    }

    /// Writes it beside its place and renames it. Not made last on a disk: it lives in memory.
    pub(super) fn write(&self, path: &Path) -> io::Result<()> {
        let part = path.with_extension("json.part");
        let mut file = BufWriter::new(File::create(&part)?);
        serde_json::to_writer(&mut file, self)?;
        file.flush()?;
        drop(file);
        fs::rename(&part, path)
    }
}
