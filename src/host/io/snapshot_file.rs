//! The core's state as a file: JSON, written whole or not at all.

use std::io::{self, Write};
use std::path::Path;

use crate::io::result_file::ResultFile;
use crate::monitor::Snapshot;

/// Stores a state so that after a power cut there is the old one or the new one, whole.
///
/// # Errors
/// Disk full and the like; the message names the file.
pub fn write(path: &Path, snapshot: &Snapshot) -> io::Result<()> {
    let mut file = ResultFile::create(path)?;
    file.write_all(&serde_json::to_vec(snapshot)?)?;
    file.write_all(b"\n")?;
    file.finish()
}

/// Reads a stored state.
///
/// # Errors
/// When the file cannot be read or is no snapshot: file, line and why.
pub fn read(path: &Path) -> Result<Snapshot, String> {
    let bytes = std::fs::read(path).map_err(|error| format!("{}: cannot be read: {error}", path.display()))?;
    serde_json::from_slice(&bytes)
        .map_err(|error| format!("{}:{}: not a snapshot: {error}", path.display(), error.line()))
}
