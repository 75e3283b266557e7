//! Reads the location of the key for authenticated frames from `[authentication]`.

use std::path::{Path, PathBuf};

use crate::config::document::beside;
use crate::config::schema::RawTables;

/// Location of the key for authenticated frames.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum KeySource {
    /// Name of a credential passed by the service manager.
    Credential(String),
    /// A file.
    File(PathBuf),
}

impl std::fmt::Display for KeySource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Credential(name) => write!(f, "credential {name}"),
            Self::File(path) => write!(f, "file {}", path.display()),
        }
    }
}

/// Location of the key for authenticated frames; `None` = no frame is authenticated, or a fault is reported.
pub(crate) fn key_source(raw: &RawTables, config: &Path, has_authenticated: bool) -> Option<KeySource> {
    let keys = raw.authentication.as_ref()?;
    match (&keys.credential, &keys.key_file) {
        (Some(_), Some(_)) => {
            keys.place.fault("key_file", "must not be given together with credential");
            None
        }
        (Some(name), None) if !is_file_name(name) => {
            keys.place.fault("credential", "must be a name without /");
            None
        }
        (Some(name), None) => has_authenticated.then(|| KeySource::Credential(name.clone())),
        (None, Some(file)) => has_authenticated.then(|| KeySource::File(beside(config, file))),
        (None, None) => {
            if has_authenticated {
                keys.place.fault(
                    "credential",
                    "must be the name of a systemd credential, unless key_file names a file: secoc requires a key",
                );
            }
            None
        }
    }
}

fn is_file_name(name: &str) -> bool {
    !name.contains('/') && name != "." && name != ".."
}
