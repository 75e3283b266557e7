//! The uplink's settings: one TOML file, apart from the daemon's configuration, so that another broker changes neither the
//! daemon nor the digest of its configuration.
//!
//! In: the file of `-c`. Out: checked settings. A fault names file, line, key and what is allowed.

use std::path::{Path, PathBuf};

use packwatch_host::status::standard_path;
use serde::Deserialize;

use crate::kuksa::settings::KuksaSettings;

/// Longest file, bytes: a hundred times what a person writes.
const MAX_BYTES: u64 = 1 << 20;

/// What the file may hold.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Where the daemon's status comes from.
    pub status: StatusSettings,
    /// The KUKSA databroker.
    pub kuksa: KuksaSettings,
}

/// The daemon's status.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StatusSettings {
    /// The daemon's status socket; the stream socket is next to it.
    pub socket: PathBuf,
}

impl Default for StatusSettings {
    fn default() -> Self {
        Self { socket: standard_path() }
    }
}

impl Settings {
    /// Reads the file at `path`.
    ///
    /// # Errors
    /// When it cannot be read, or with file, line and reason what is wrong in it.
    pub fn read(path: &Path) -> Result<Self, String> {
        let at = path.display();
        let size = std::fs::metadata(path).map_err(|error| format!("{at}: {error}"))?.len();
        if size > MAX_BYTES {
            return Err(format!("{at}: {size} bytes, must be at most {MAX_BYTES}"));
        }
        let text = std::fs::read_to_string(path).map_err(|error| format!("{at}: {error}"))?;
        let settings = Self::parse(&text).map_err(|fault| format!("{at}:{fault}"))?;
        settings.kuksa.check().map_err(|fault| format!("{at}: {fault}"))?;
        Ok(settings)
    }

    /// Parses the text of a file; a fault begins with its line.
    fn parse(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|error| {
            let start = error.span().map_or(0, |span| span.start);
            let line = 1 + text.as_bytes().iter().take(start).filter(|byte| **byte == b'\n').count();
            format!("{line}: {}", error.message().replace('\n', ", "))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_file_is_the_standard_daemon() {
        assert_eq!(Settings::parse("").unwrap(), Settings::default());
    }

    #[test]
    fn a_fault_names_its_line_and_what_is_allowed() {
        let fault = Settings::parse("[status]\nsocket = \"/run/a.sock\"\nsokcet = 1\n").unwrap_err();
        assert_eq!(fault, "3: unknown field `sokcet`, expected `socket`");
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "[statsu]\n").unwrap();
        let fault = Settings::read(file.path()).unwrap_err();
        assert!(fault.starts_with(&format!("{}:1: unknown field `statsu`", file.path().display())), "{fault}");
    }
}
