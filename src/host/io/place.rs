//! Locations of the daemon's files, as given by the command line or systemd.

use std::path::{Path, PathBuf};

/// Location of a socket, or of the daemon's state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PlaceSetting {
    /// The folder created by systemd, else the standard one; if it cannot be used, the daemon runs without.
    Standard,
    /// None.
    Off,
    /// This path; if a socket cannot be created there, the daemon does not start.
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

    /// The path and whether it is required; `None` = none.
    pub fn resolve(&self, standard: impl FnOnce() -> (PathBuf, bool)) -> Option<(PathBuf, bool)> {
        match self {
            Self::Off => None,
            Self::At(path) => Some((path.clone(), true)),
            Self::Standard => Some(standard()),
        }
    }
}

/// The first folder in a systemd variable, which may list several separated by colons; the first is the unit's own.
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
