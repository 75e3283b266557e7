//! Creates a client of the broker from the settings, credentials and certificates, and describes connection errors.
//!
//! Input: settings and the files they name. Output: a client. Its last will is the message `offline` on the status
//! topic.

use rumqttc::mqttbytes::QoS;
use rumqttc::mqttbytes::v5::{ConnectReturnCode, LastWill};
use rumqttc::{AsyncClient, Broker, ConnectionError, EventLoop, MqttOptions, TlsConfiguration, Transport};

use super::settings::{MqttSettings, TlsSettings};
use super::{OFFLINE, topic};
use crate::files::read_credential;

/// Longest wait for the connection and for the broker's answer (s).
const CONNECT_LIMIT_S: u64 = 15;
/// Maximum number of requests that wait in memory for the connection.
const REQUESTS: usize = 64;
/// Maximum number of unacknowledged messages. Messages from the disk queue and periodic messages with the latest values
/// share this limit.
const IN_FLIGHT: u16 = 64;
/// Largest packet accepted from the broker, bytes. This program subscribes to nothing, so all packets are small.
const MAX_INCOMING_BYTES: u32 = 64 << 10;

/// Creates a client. Its event loop connects.
///
/// # Errors
/// Fails if a file named by the settings cannot be read or used.
pub fn client(settings: &MqttSettings) -> Result<(AsyncClient, EventLoop), String> {
    let broker = Broker::tcp(settings.host.clone(), settings.port());
    let mut options = MqttOptions::new(settings.client_id(), broker);
    options.set_keep_alive(u16::try_from(settings.keep_alive_s).unwrap_or(u16::MAX));
    // The queue on disk keeps the unacknowledged messages. A session stored by the broker would only repeat old values.
    options.set_clean_start(true);
    options.set_last_will(LastWill::new(settings.topic(topic::STATUS), OFFLINE, QoS::AtLeastOnce, true, None));
    options.set_incoming_packet_size_limit(rumqttc::IncomingPacketSizeLimit::Bytes(MAX_INCOMING_BYTES));
    // This limit bounds the memory for unacknowledged messages; the default is 65,535 messages.
    options.set_outgoing_inflight_upper_limit(IN_FLIGHT);
    let mut network = options.network_options();
    network.set_connection_timeout(CONNECT_LIMIT_S);
    network.set_tcp_nodelay(true);
    options.set_network_options(network);
    match (&settings.user, settings.password()?) {
        (Some(user), Some(password)) => options.set_credentials(user.clone(), password),
        (Some(user), None) => options.set_username(user.clone()),
        (None, Some(password)) => options.set_password(password),
        (None, None) => &mut options,
    };
    if let Some(tls) = &settings.tls {
        options.set_transport(Transport::Tls(certificates(tls)?));
    }
    AsyncClient::builder(options).capacity(REQUESTS).try_build().map_err(|error| error.to_string())
}

fn certificates(tls: &TlsSettings) -> Result<TlsConfiguration, String> {
    // The check of the settings ensures that both files or neither are given.
    let client_auth = match (&tls.certificate_file, &tls.key_file) {
        (Some(certificate), Some(key)) => Some((
            read_credential("mqtt.tls.certificate_file", certificate)?,
            read_credential("mqtt.tls.key_file", key)?,
        )),
        _ => None,
    };
    match &tls.ca_file {
        Some(path) => {
            Ok(TlsConfiguration::Simple { ca: read_credential("mqtt.tls.ca_file", path)?, alpn: None, client_auth })
        }
        None => TlsConfiguration::try_default_rustls().map_err(|error| format!("authorities of the system: {error}")),
    }
}

/// Describes why a connection failed and, if known, what to do.
pub fn explain(error: &ConnectionError) -> String {
    match error {
        ConnectionError::ConnectionRefused(
            ConnectReturnCode::BadUserNamePassword | ConnectReturnCode::NotAuthorized,
        ) => "the broker rejects user or password (mqtt.user, mqtt.password_file)".to_owned(),
        ConnectionError::ConnectionRefused(code) => format!("the broker rejects the connection: {code:?}"),
        ConnectionError::Timeout(_) => format!("no answer within {CONNECT_LIMIT_S} s"),
        ConnectionError::Io(error) if error.kind() == std::io::ErrorKind::PermissionDenied => {
            format!("{error}: blocked by a firewall or by IPAddressAllow= of the unit")
        }
        // The library's text also describes certificate errors ("TLS: I/O: ...").
        other => other.to_string(),
    }
}
