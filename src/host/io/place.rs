//! Determines the locations of the daemon's files from the command line and from systemd.

use std::path::{Path, PathBuf};

/// Location of a socket, or of the daemon's state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PlaceSetting {
    /// The folder created by systemd, else the standard folder. If the folder cannot be used, the daemon runs without
    /// the socket or the stored state.
    Standard,
    /// The socket or the stored state is switched off.
    Off,
    /// The given path. If a socket cannot be created there, the daemon does not start.
    At(PathBuf),
}

impl PlaceSetting {
    /// Converts the command line's value: a path, or `none`.
    pub fn from_path(path: Option<PathBuf>) -> Self {
        match path {
            None => Self::Standard,
            Some(path) if path.as_os_str() == "none" => Self::Off,
            Some(path) => Self::At(path),
        }
    }

    /// Returns the path, and whether it is required; `None` = the socket or the stored state is switched off.
    pub fn resolve(&self, standard: impl FnOnce() -> (PathBuf, bool)) -> Option<(PathBuf, bool)> {
        match self {
            Self::Off => None,
            Self::At(path) => Some((path.clone(), true)),
            Self::Standard => Some(standard()),
        }
    }
}

/// The first folder in a systemd variable. The variable may list several folders separated by colons; the first one
/// belongs to the unit itself.
pub fn first_folder(variable: &str) -> Option<PathBuf> {
    let folders = std::env::var_os(variable).filter(|folders| !folders.is_empty())?;
    std::env::split_paths(&folders).next()
}

/// Returns a path with a suffix appended to its file name.
pub fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}
