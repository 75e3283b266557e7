//! Reads the uplink's settings from a TOML file that is separate from the daemon's configuration. A new broker address
//! therefore changes neither the daemon nor the hash of the daemon's configuration.
//!
//! Input: the file given with `-c`. Output: validated settings. An error names the file, the key and the allowed
//! values. If the error occurs while the TOML is parsed, it also names the line. Later checks (of `[kuksa]` and of
//! combinations of keys) name no line.

use std::path::{Path, PathBuf};

use packwatch_host::status::standard_path;
use serde::Deserialize;

use crate::files;
use crate::kuksa::settings::KuksaSettings;
use crate::mqtt::settings::MqttSettings;
use crate::sovd::settings::SovdSettings;

/// Contents of the file.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Source of the daemon's status.
    pub status: StatusSettings,
    /// The MQTT broker; `None` = `packwatch mqtt` cannot run.
    pub mqtt: Option<MqttSettings>,
    /// The KUKSA databroker.
    pub kuksa: KuksaSettings,
    /// The SOVD server.
    pub sovd: SovdSettings,
}

/// The daemon's status.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StatusSettings {
    /// The daemon's status socket; the stream socket is in the same folder.
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
    /// Fails if the file cannot be read or is invalid. The message names the file and the reason, and the line if the
    /// file cannot be parsed.
    pub fn read(path: &Path) -> Result<Self, String> {
        let at = path.display();
        let text = String::from_utf8(files::read(path)?).map_err(|error| format!("{at}: {error}"))?;
        let settings = Self::parse(&text).map_err(|fault| format!("{at}:{fault}"))?;
        let checked = settings.kuksa.check().and_then(|()| settings.mqtt.as_ref().map_or(Ok(()), MqttSettings::check));
        checked.map_err(|fault| format!("{at}: {fault}"))?;
        Ok(settings)
    }

    /// Parses the text of a file; an error begins with its line.
    fn parse(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|error| {
            let start = error.span().map_or(0, |span| span.start);
            let line = 1 + text.as_bytes().iter().take(start).filter(|byte| **byte == b'\n').count();
            let found = text.lines().nth(line - 1).unwrap_or_default().trim();
            let message = error.message().replace('\n', ", ");
            let message = message.replace("expected u16", "must be a whole number from 0 to 65535");
            // For a wrong value, the message quotes the line, which shows the key and the value found.
            if message.starts_with("must ") || message.starts_with("invalid ") {
                format!("{line}: {found}, {message}")
            } else {
                format!("{line}: {message}")
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn empty_file_gives_defaults() {
        assert_eq!(Settings::parse("").unwrap(), Settings::default());
    }

    #[test]
    fn fault_shows_key_and_value() {
        let fault = |text: &str| Settings::parse(text).unwrap_err();
        assert_eq!(fault("[mqtt]\nperiod_s = 0\n"), "2: period_s = 0, must be 1 to 3600");
        assert_eq!(fault("[mqtt.history]\nmax_bytes = -1"), "2: max_bytes = -1, must be 100000 to 100000000000");
        assert!(fault("[mqtt]\ntopic = \"a/#\"").starts_with("2: topic = \"a/#\", must be a topic"));
        let listen = "[sovd]\nlisten = \"0.0.0.0:9560\"";
        assert!(fault(listen).starts_with("2: listen = \"0.0.0.0:9560\", must be an address of this computer"));
        assert!(fault("[mqtt]\nport = 70000").starts_with("2: "), "{}", fault("[mqtt]\nport = 70000"));
    }

    #[test]
    fn example_lists_every_key_with_default() {
        let example = include_str!("../../config/uplink.toml");
        let shown = Settings { mqtt: Some(MqttSettings::default()), ..Settings::default() };
        assert_eq!(Settings::parse(example).unwrap(), shown);
        // Commented keys must exist too.
        let is_key =
            |line: &str| line.starts_with('[') || line.split_once(" = ").is_some_and(|(key, _)| !key.contains(' '));
        let uncomment = |line| match str::strip_prefix(line, "# ") {
            Some(key) if is_key(key) => key,
            _ => line,
        };
        let all: Vec<&str> = example.lines().map(uncomment).collect();
        // Certificates are allowed on encrypted connections only.
        let Settings { mqtt, kuksa, .. } = Settings::parse(&all.join("\n").replace("http://", "https://")).unwrap();
        let mqtt = mqtt.unwrap();
        assert!(kuksa.ca_file.is_some() && kuksa.server_name.is_some() && kuksa.token_file.is_some());
        assert!(mqtt.tls.unwrap().key_file.is_some() && mqtt.discovery.device_name.is_some() && mqtt.user.is_some());
    }

    #[test]
    fn fault_names_line_and_allowed_keys() {
        let fault = Settings::parse("[status]\nsocket = \"/run/a.sock\"\nsokcet = 1\n").unwrap_err();
        assert_eq!(fault, "3: unknown field `sokcet`, expected `socket`");
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "[statsu]\n").unwrap();
        let fault = Settings::read(file.path()).unwrap_err();
        assert!(fault.starts_with(&format!("{}:1: unknown field `statsu`", file.path().display())), "{fault}");
    }
}
