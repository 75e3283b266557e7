//! Lists the available cell models: the model files in the usual folders, or in folders that the caller names.

use std::path::{Path, PathBuf};

use super::read::load_sourced;
use super::source::SourcedModel;
use crate::config::document::ConfigFaults;

/// Largest number of model files in a folder.
const MOST: usize = 1000;

/// A model file in a folder.
#[derive(Debug)]
pub struct LibraryEntry {
    /// The file.
    pub path: PathBuf,
    /// The model, or every fault.
    pub model: Result<SourcedModel, ConfigFaults>,
}

/// Returns the usual model folders that exist. `program` is the path of the program's executable.
pub fn usual_folders(program: Option<&Path>) -> Vec<PathBuf> {
    let shipped = program.and_then(Path::parent).map(|folder| folder.join("../share/packwatch/cells"));
    let shipped = shipped.and_then(|folder| folder.canonicalize().ok());
    ["config/cells", "cells", "/etc/packwatch/cells"]
        .iter()
        .map(PathBuf::from)
        .chain(shipped)
        .filter(|folder| folder.is_dir())
        .collect()
}

/// The models of a folder: its files `*.toml`, sorted by name.
///
/// # Errors
/// Fails if the folder cannot be listed or has too many files.
pub fn list(folder: &Path) -> Result<Vec<LibraryEntry>, String> {
    let named = |what: String| format!("{}: {what}", folder.display());
    let entries = std::fs::read_dir(folder).and_then(|entries| entries.collect::<std::io::Result<Vec<_>>>());
    let entries = entries.map_err(|error| named(format!("cannot be listed: {error}")))?;
    let mut paths: Vec<PathBuf> = entries.into_iter().map(|entry| entry.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "toml"));
    if paths.len() > MOST {
        return Err(named(format!("contains {} files *.toml, must be at most {MOST}", paths.len())));
    }
    paths.sort();
    Ok(paths.into_iter().map(|path| LibraryEntry { model: load_sourced(&path), path }).collect())
}
