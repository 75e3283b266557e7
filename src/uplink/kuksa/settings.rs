//! Defines and checks the table `[kuksa]` of the uplink's settings.

use std::net::IpAddr;
use std::path::PathBuf;

use serde::Deserialize;

use super::signals::STANDARD_BRANCH;

/// Longest branch, bytes. The databroker accepts paths of up to 1,000 bytes.
const MAX_BRANCH_BYTES: usize = 200;

/// The databroker, and the branch of the overlay's signals. The overlay adds packwatch's own signals to the standard
/// signals (VSS) that the databroker knows.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct KuksaSettings {
    /// `http://HOST:PORT`, `https://HOST:PORT` or `unix:PATH`.
    pub address: String,
    /// PEM file of the authorities that signed the databroker's certificate; required with `https`, not allowed
    /// otherwise.
    pub ca_file: Option<PathBuf>,
    /// Name in the databroker's certificate, if it differs from the host of `address`.
    pub server_name: Option<String>,
    /// File with the token (JWT) that permits providing the signals.
    pub token_file: Option<PathBuf>,
    /// Branch of the overlay's signals.
    pub branch: String,
    /// Whether the daemon has run since the battery was new, so that the daemon's sums cover the battery's whole life.
    pub recorded_from_new: bool,
}

impl Default for KuksaSettings {
    fn default() -> Self {
        Self {
            address: "http://127.0.0.1:55555".to_owned(),
            ca_file: None,
            server_name: None,
            token_file: None,
            branch: format!("{STANDARD_BRANCH}.Packwatch"),
            recorded_from_new: false,
        }
    }
}

impl KuksaSettings {
    /// Checks each key and combinations of keys.
    ///
    /// # Errors
    /// Returns an error that states the key, the value found and the values allowed.
    pub(crate) fn check(&self) -> Result<(), String> {
        let address = &self.address;
        let (scheme, rest) = address.split_once(':').unwrap_or_default();
        let host = rest.strip_prefix("//").filter(|host| !host.is_empty() && !host.contains('/'));
        match (scheme, host) {
            ("http" | "https", Some(_)) => {}
            ("unix", _) if rest.trim_start_matches("//").starts_with('/') => {}
            _ => {
                return Err(format!(
                    "kuksa.address = \"{address}\", must be http://HOST:PORT, https://HOST:PORT or unix:/PATH"
                ));
            }
        }
        let is_tls = scheme == "https";
        if is_tls != self.ca_file.is_some() {
            return Err(format!(
                "kuksa.ca_file is required with https:// and not allowed otherwise; kuksa.address = \"{address}\""
            ));
        }
        if self.server_name.is_some() && !is_tls {
            return Err(format!("kuksa.server_name is allowed with https:// only; kuksa.address = \"{address}\""));
        }
        if self.token_file.is_some() && scheme == "http" && !host.is_some_and(is_loopback) {
            return Err(format!(
                "kuksa.token_file: without TLS the token could be read on the network; kuksa.address = \"{address}\", must be https://"
            ));
        }
        self.check_branch()
    }

    fn check_branch(&self) -> Result<(), String> {
        let branch = &self.branch;
        let is_name = |name: &str| {
            name.starts_with(|first: char| first.is_ascii_uppercase())
                && name.chars().all(|letter| letter.is_ascii_alphanumeric())
        };
        let is_allowed = branch.starts_with("Vehicle.") && branch.split('.').all(is_name) && branch != STANDARD_BRANCH;
        if is_allowed && branch.len() <= MAX_BRANCH_BYTES {
            return Ok(());
        }
        Err(format!(
            "kuksa.branch = \"{branch}\", must be a branch below Vehicle other than {STANDARD_BRANCH}, with at most {MAX_BRANCH_BYTES} \
            bytes; each part must begin with a capital letter and contain only letters and digits"
        ))
    }
}

/// Whether the host of `HOST:PORT` is this computer.
fn is_loopback(authority: &str) -> bool {
    if authority.contains('@') {
        return false; // the host follows a user's name
    }
    let host = authority.rsplit_once(':').map_or(authority, |(host, _)| host);
    let address: Result<IpAddr, _> = host.trim_start_matches('[').trim_end_matches(']').parse();
    host == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(text: &str) -> String {
        let settings: KuksaSettings = toml::from_str(text).unwrap();
        settings.check().err().unwrap_or_default()
    }

    #[test]
    fn valid_addresses_and_branches_are_accepted() {
        for text in [
            "",
            "address = 'http://databroker:55555'",
            "address = 'unix:/run/kuksa/databroker.sock'\ntoken_file = '/t'",
            "address = 'unix:///run/kuksa/databroker.sock'",
            "address = 'https://10.0.0.1:55555'\nca_file = '/ca.pem'\nserver_name = 'Server'\ntoken_file = '/t'",
            "token_file = '/t'",
            "address = 'http://[::1]:55555'\ntoken_file = '/t'",
            "branch = 'Vehicle.Private.Packwatch2'",
        ] {
            assert_eq!(fault(text), "", "{text}");
        }
    }

    #[test]
    fn fault_names_key_and_allowed_values() {
        for (text, expected) in [
            ("address = '127.0.0.1:55555'", "kuksa.address = \"127.0.0.1:55555\", must be"),
            ("address = 'http://a/b'", "kuksa.address"),
            ("address = 'unix:relative'", "kuksa.address"),
            ("address = 'https://a:1'", "kuksa.ca_file is required with https://"),
            ("ca_file = '/ca.pem'", "kuksa.ca_file is required with https://"),
            ("server_name = 'x'", "kuksa.server_name is allowed with https:// only"),
            (
                "address = 'http://10.0.0.1:1'\ntoken_file = '/t'",
                "kuksa.token_file: without TLS the token could be read on the network",
            ),
            (
                "address = 'http://127.0.0.1:80@evil:1'\ntoken_file = '/t'",
                "kuksa.token_file: without TLS the token could be read on the network",
            ),
            ("branch = 'Vehicle.Powertrain.TractionBattery'", "kuksa.branch"),
            ("branch = 'Vehicle.private'", "kuksa.branch"),
            ("branch = 'Vehicle..A'", "kuksa.branch"),
            ("branch = 'Car.Battery'", "kuksa.branch"),
        ] {
            assert!(fault(text).starts_with(expected), "{text}: {}", fault(text));
        }
    }
}
