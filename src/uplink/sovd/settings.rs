//! Defines and checks the table `[sovd]` of the uplink's settings.

use std::net::SocketAddr;

use serde::{Deserialize, Deserializer, de::Error as _};

/// Address of the server.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SovdSettings {
    /// Address and port. The address must be a loopback address, because the server has no access control.
    #[serde(deserialize_with = "loopback")]
    pub listen: SocketAddr,
}

impl Default for SovdSettings {
    fn default() -> Self {
        Self { listen: SocketAddr::from(([127, 0, 0, 1], 9560)) }
    }
}

fn loopback<'de, D: Deserializer<'de>>(deserializer: D) -> Result<SocketAddr, D::Error> {
    let text = String::deserialize(deserializer)?;
    let address = text.parse().ok().filter(|address: &SocketAddr| address.ip().is_loopback());
    address.ok_or_else(|| D::Error::custom("must be an address of this computer, such as 127.0.0.1:9560 or [::1]:9560"))
}
