//! Writes and reads the core's state as a JSON file, which is written completely or not at all.

use std::io::{self, Write};
use std::path::Path;

use crate::bounded_file;
use crate::io::json::json_fault;
use crate::io::result_file::ResultFile;
use crate::monitor::Snapshot;

/// Stores a state. After a power cut the file contains either the complete old state or the complete new state.
///
/// # Errors
/// Fails if the file cannot be written; the message names it.
pub fn write(path: &Path, snapshot: &Snapshot) -> io::Result<()> {
    let mut file = ResultFile::create(path)?;
    file.write_all(&serde_json::to_vec(snapshot)?)?;
    file.write_all(b"\n")?;
    file.finish()
}

/// Reads a stored state.
///
/// # Errors
/// Fails if the file cannot be read or is not a snapshot. The message names the file and the reason, and the line if
/// the content is invalid.
pub fn read(path: &Path) -> Result<Snapshot, String> {
    let bytes = bounded_file::read(path).map_err(|error| format!("{}: cannot be read: {error}", path.display()))?;
    serde_json::from_slice(&bytes).map_err(|error| {
        let (path, line, fault) = (path.display(), error.line(), json_fault(&error));
        format!("{path}:{line}: not a snapshot, must be a file written with --snapshot: {fault}")
    })
}
