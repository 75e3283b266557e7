//! Defines and checks the table `[mqtt]` of the uplink's settings: the broker, what is published when, and the queue
//! for a lost link.
//!
//! Input: TOML. Output: validated settings. A value that is outside its range is reported with its line. The files
//! named here are read at each connection, so a new certificate or password needs no restart.

use std::path::PathBuf;

use serde::{Deserialize, Deserializer, de};

use crate::files::read_credential;

/// Longest base topic, bytes. MQTT allows 65,535 bytes for the base and its suffix.
const MAX_TOPIC_BYTES: usize = 200;

/// Key of the password's file, for messages.
const PASSWORD_FILE: &str = "mqtt.password_file";

/// The broker, and what is sent to it.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MqttSettings {
    /// Host name or address of the broker.
    #[serde(deserialize_with = "text")]
    pub host: String,
    /// Port; `None` = 1883, or 8883 with TLS.
    pub port: Option<u16>,
    /// Name of this client at the broker, unique for each uplink; `None` = `packwatch-` and the topic.
    pub client_id: Option<String>,
    /// User name; `None` = anonymous.
    pub user: Option<String>,
    /// File with the password. A relative path is relative to `CREDENTIALS_DIRECTORY`, if systemd has set it.
    pub password_file: Option<PathBuf>,
    /// Base of all topics of this pack.
    #[serde(deserialize_with = "topic")]
    pub topic: String,
    /// Period at which current values are published (s).
    #[serde(deserialize_with = "whole::<1, 3600, _>")]
    pub period_s: u64,
    /// Longest silence on the connection (s). If the connection is silent for 1.5 times this duration, the broker
    /// publishes the last will.
    #[serde(deserialize_with = "whole::<5, 3600, _>")]
    pub keep_alive_s: u64,
    /// Longest pause between attempts to connect (s).
    #[serde(deserialize_with = "whole::<1, 3600, _>")]
    pub retry_max_s: u64,
    /// TLS; `None` = unencrypted.
    pub tls: Option<TlsSettings>,
    /// Discovery by Home Assistant.
    pub discovery: DiscoverySettings,
    /// Queue for messages while there is no connection.
    pub history: HistorySettings,
}

/// TLS to the broker.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TlsSettings {
    /// PEM file of the authorities that may sign the broker's certificate; `None` = the authorities of the system.
    pub ca_file: Option<PathBuf>,
    /// PEM file with the client's certificate; `None` = no client certificate.
    pub certificate_file: Option<PathBuf>,
    /// PEM file with the private key of the client's certificate.
    pub key_file: Option<PathBuf>,
}

/// Discovery by Home Assistant.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DiscoverySettings {
    /// Whether discovery messages are published.
    pub enabled: bool,
    /// First part of the discovery topics.
    #[serde(deserialize_with = "topic")]
    pub prefix: String,
    /// Whether each cell voltage is an entity.
    pub cells: bool,
    /// Name of the device; `None` = the vehicle's name in the daemon's configuration. If that name is missing too, the
    /// topic is used.
    pub device_name: Option<String>,
}

/// Queue for messages while there is no connection.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HistorySettings {
    /// Time between samples on the daemon's clock (s); 0 = no samples.
    #[serde(deserialize_with = "whole::<0, 86_400, _>")]
    pub period_s: u64,
    /// Folder of the queue.
    pub folder: PathBuf,
    /// Maximum number of messages in the queue.
    #[serde(deserialize_with = "whole::<1, 10_000_000, _>")]
    pub max_messages: u64,
    /// Largest total size of queued messages, bytes.
    #[serde(deserialize_with = "whole::<100_000, 100_000_000_000, _>")]
    pub max_bytes: u64,
}

impl Default for MqttSettings {
    fn default() -> Self {
        Self {
            host: "127.0.0.1".to_owned(),
            port: None,
            client_id: None,
            user: None,
            password_file: None,
            topic: "packwatch".to_owned(),
            period_s: 5,
            keep_alive_s: 30,
            retry_max_s: 60,
            tls: None,
            discovery: DiscoverySettings::default(),
            history: HistorySettings::default(),
        }
    }
}

impl Default for DiscoverySettings {
    fn default() -> Self {
        Self { enabled: true, prefix: "homeassistant".to_owned(), cells: true, device_name: None }
    }
}

impl Default for HistorySettings {
    fn default() -> Self {
        Self {
            period_s: 10,
            folder: PathBuf::from("/var/lib/packwatch-mqtt"),
            max_messages: 100_000,
            max_bytes: 64 << 20,
        }
    }
}

impl MqttSettings {
    /// Returns the broker's port.
    pub fn port(&self) -> u16 {
        self.port.unwrap_or(if self.tls.is_some() { 8883 } else { 1883 })
    }

    /// Returns the name of this client at the broker.
    pub fn client_id(&self) -> String {
        self.client_id.clone().unwrap_or_else(|| format!("packwatch-{}", self.node()))
    }

    /// Returns the topic `name` of this pack.
    pub fn topic(&self, name: &str) -> String {
        format!("{}/{name}", self.topic)
    }

    /// Converts the topic to a word of letters, digits, `-` and `_`, as Home Assistant requires in topics and
    /// identifiers.
    pub fn node(&self) -> String {
        let allowed = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        self.topic.chars().map(|c| if allowed(c) { c } else { '_' }).collect()
    }

    /// Checks combinations of keys.
    ///
    /// # Errors
    /// Returns an error that states the keys and what is allowed.
    pub(crate) fn check(&self) -> Result<(), String> {
        let Some(tls) = &self.tls else { return Ok(()) };
        if tls.certificate_file.is_some() != tls.key_file.is_some() {
            return Err("mqtt.tls: certificate_file and key_file must be given together".to_owned());
        }
        if tls.certificate_file.is_some() && tls.ca_file.is_none() {
            return Err("mqtt.tls.certificate_file needs mqtt.tls.ca_file".to_owned());
        }
        Ok(())
    }

    /// Reads the password and removes line ends at its end.
    ///
    /// # Errors
    /// Fails if the file cannot be read or is empty.
    pub fn password(&self) -> Result<Option<Vec<u8>>, String> {
        let Some(path) = &self.password_file else { return Ok(None) };
        let mut password = read_credential(PASSWORD_FILE, path)?;
        while matches!(password.last(), Some(b'\n' | b'\r')) {
            password.pop();
        }
        if password.is_empty() {
            return Err(format!("{PASSWORD_FILE}: {}: contains no password", path.display()));
        }
        Ok(Some(password))
    }
}

fn whole<'de, const LEAST: u64, const MOST: u64, D: Deserializer<'de>>(source: D) -> Result<u64, D::Error> {
    let value = i64::deserialize(source)?;
    let allowed = u64::try_from(value).ok().filter(|value| (LEAST..=MOST).contains(value));
    allowed.ok_or_else(|| de::Error::custom(format!("must be {LEAST} to {MOST}")))
}

fn text<'de, D: Deserializer<'de>>(source: D) -> Result<String, D::Error> {
    let text = String::deserialize(source)?;
    if text.is_empty() { Err(de::Error::custom("must not be empty")) } else { Ok(text) }
}

fn topic<'de, D: Deserializer<'de>>(source: D) -> Result<String, D::Error> {
    let topic = String::deserialize(source)?;
    let has_empty_level = topic.split('/').any(str::is_empty);
    if has_empty_level || topic.starts_with('$') || topic.contains(['+', '#']) || topic.contains(char::is_control) {
        return Err(de::Error::custom(
            "must be a topic: non-empty levels separated by '/', without '+' and '#', not starting with '$'",
        ));
    }
    if topic.len() > MAX_TOPIC_BYTES {
        return Err(de::Error::custom(format!("must be at most {MAX_TOPIC_BYTES} bytes")));
    }
    Ok(topic)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topic_levels_become_one_identifier_word() {
        let settings = MqttSettings { topic: "fleet/Bus 12/pack-1".to_owned(), ..MqttSettings::default() };
        assert_eq!(
            (settings.node().as_str(), settings.topic("info").as_str()),
            ("fleet_Bus_12_pack-1", "fleet/Bus 12/pack-1/info")
        );
        assert_eq!(settings.client_id(), "packwatch-fleet_Bus_12_pack-1");
    }

    #[test]
    fn default_port_depends_on_tls() {
        let tls = MqttSettings { tls: Some(TlsSettings::default()), ..MqttSettings::default() };
        assert_eq!((MqttSettings::default().port(), tls.port()), (1883, 8883));
    }

    #[test]
    fn password_is_trimmed_and_not_empty() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let settings = MqttSettings { password_file: Some(file.path().to_owned()), ..MqttSettings::default() };
        for (text, password) in [("a b", "a b"), ("a b\n", "a b"), ("a b\r\n", "a b"), (" a\n\n", " a")] {
            std::fs::write(file.path(), text).unwrap();
            assert_eq!(settings.password().unwrap().unwrap(), password.as_bytes());
        }
        std::fs::write(file.path(), "\n").unwrap();
        assert!(settings.password().unwrap_err().ends_with("contains no password"));
        std::fs::remove_file(file.path()).unwrap();
        let error = settings.password().unwrap_err();
        assert!(error.starts_with("mqtt.password_file: /") && error.contains("No such file"), "{error}");
    }
}
