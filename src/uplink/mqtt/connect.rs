//! A connection to the broker: options, credentials, certificates, and its faults in words.
//!
//! In: settings and the files they name. Out: a client whose last will is `offline` on the status topic.

use rumqttc::mqttbytes::QoS;
use rumqttc::mqttbytes::v5::{ConnectReturnCode, LastWill};
use rumqttc::{AsyncClient, Broker, ConnectionError, EventLoop, MqttOptions, TlsConfiguration, Transport};

use super::settings::{MqttSettings, TlsSettings};
use super::{OFFLINE, topic};
use crate::files::read_credential;

/// Longest wait for the connection and the broker's answer, s.
const CONNECT_LIMIT_S: u64 = 15;
/// Requests that wait in memory for the connection: a window of messages of the queue.
const REQUESTS: usize = 64;
/// Messages on their way at once, of the queue and of the current values.
const IN_FLIGHT: u16 = 64;
/// Longest packet that the broker may send, bytes: nothing is subscribed.
const MAX_INCOMING_BYTES: u32 = 64 << 10;

/// A client that is not connected yet; its event loop connects.
///
/// # Errors
/// When a file of the settings cannot be read or used.
pub fn client(settings: &MqttSettings) -> Result<(AsyncClient, EventLoop), String> {
    let broker = Broker::tcp(settings.host.clone(), settings.port());
    let mut options = MqttOptions::new(settings.client_id(), broker);
    options.set_keep_alive(u16::try_from(settings.keep_alive_s).unwrap_or(u16::MAX));
    // What was not acknowledged is in the queue on disk: a session at the broker would only repeat old values.
    options.set_clean_start(true);
    options.set_last_will(LastWill::new(settings.topic(topic::STATUS), OFFLINE, QoS::AtLeastOnce, true, None));
    options.set_incoming_packet_size_limit(rumqttc::IncomingPacketSizeLimit::Bytes(MAX_INCOMING_BYTES));
    // Places in memory for messages on their way: by default there are 65,535.
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
    // The settings' check has found those together that belong together.
    let client_auth = match (&tls.certificate_file, &tls.key_file) {
        (Some(certificate), Some(key)) => Some((read_credential(certificate)?, read_credential(key)?)),
        _ => None,
    };
    match &tls.ca_file {
        Some(path) => Ok(TlsConfiguration::Simple { ca: read_credential(path)?, alpn: None, client_auth }),
        None => TlsConfiguration::try_default_rustls().map_err(|error| format!("authorities of the system: {error}")),
    }
}

/// Why a connection failed, and what to do where that is clear.
pub fn explain(error: &ConnectionError) -> String {
    match error {
        ConnectionError::ConnectionRefused(
            ConnectReturnCode::BadUserNamePassword | ConnectReturnCode::NotAuthorized,
        ) => "the broker refuses user or password (mqtt.user, mqtt.password_file)".to_owned(),
        ConnectionError::ConnectionRefused(code) => format!("the broker refuses the connection: {code:?}"),
        ConnectionError::Timeout(_) => format!("no answer within {CONNECT_LIMIT_S} s"),
        ConnectionError::Io(error) if error.kind() == std::io::ErrorKind::PermissionDenied => {
            format!("{error}: a firewall forbids it, or the unit (IPAddressAllow=)")
        }
        // "TLS: I/O: ..." names the certificate's fault.
        other => other.to_string(),
    }
}
