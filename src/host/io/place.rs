//! Places of the daemon's files that the command line or systemd names.

use std::path::{Path, PathBuf};

/// Place of a socket or of the state of the daemon.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PlaceSetting {
    /// The folder that systemd made, else the standard one; where that cannot be used, the daemon runs without.
    Standard,
    /// There is none.
    Off,
    /// There; a socket that cannot be made there keeps the daemon from its start.
    At(PathBuf),
}

impl PlaceSetting {
    /// Reads the value of the command line: a path, or `none`.
    pub fn from_path(path: Option<PathBuf>) -> Self {
        match path {
            None => Self::Standard,
            Some(path) if path.as_os_str() == "none" => Self::Off,
            Some(path) => Self::At(path),
        }
    }

    /// The path and whether it is required; `None` = there is none.
    pub fn resolve(&self, standard: impl FnOnce() -> (PathBuf, bool)) -> Option<(PathBuf, bool)> {
        match self {
            Self::Off => None,
            Self::At(path) => Some((path.clone(), true)),
            Self::Standard => Some(standard()),
        }
    }
}

/// The first folder of a variable of systemd, which separates several by colons: the unit's own.
pub fn first_folder(variable: &str) -> Option<PathBuf> {
    let folders = std::env::var_os(variable).filter(|folders| !folders.is_empty())?;
    std::env::split_paths(&folders).next()
}

/// A path with a suffix appended to its name.
pub fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}
