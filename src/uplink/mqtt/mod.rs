//! `packwatch mqtt`: sends the daemon's status to an MQTT broker and Home Assistant, with a queue for times without a connection.
//!
//! | module | content |
//! | --- | --- |
//! | `settings` | the table `[mqtt]` |
//! | `entity` | the table of entities |
//! | `payload` | the published documents |
//! | `discovery` | Home Assistant discovery messages |
//! | `queue` | pending messages on disk |
//! | `recorder` | which documents and events are queued |
//! | `connect` | one connection |
//! | `link` | publishing and forwarding |
//!
//! The recorder and the link share one thread and the queue. The recorder does not wait for the link.

pub mod connect;
pub mod discovery;
pub mod entity;
pub mod link;
pub mod message;
pub mod payload;
pub mod queue;
pub mod recorder;
pub mod settings;

use packwatch_host::io::runtime::new_runtime;
use packwatch_host::io::stop::Stop;
use tokio::sync::watch;

use crate::settings::Settings;
use crate::status_stream::follow;
use crate::{Failure, Options};
use link::Link;
use queue::Queue;
use recorder::Recorder;
use settings::MqttSettings;

/// Topics below the base topic. `info`, `spec_data`, `events` and `status` match Battery-Emulator.
pub mod topic {
    /// Whether the uplink is online: retained, and the last will.
    pub const STATUS: &str = "status";
    /// Whether the daemon is online: retained.
    pub const DAEMON: &str = "daemon";
    /// Current values of the pack: retained.
    pub const INFO: &str = "info";
    /// Current values of the cells: retained.
    pub const CELLS: &str = "spec_data";
    /// Events in order. An event that was not acknowledged is sent again with the same sequence number.
    pub const EVENTS: &str = "events";
    /// Samples in order. A sample that was not acknowledged is sent again with the same sequence number.
    pub const HISTORY: &str = "history";
    /// Fill of the queue: retained.
    pub const UPLINK: &str = "uplink";
}

/// Payload that reports the uplink or the daemon as online. Home Assistant expects this word by default.
pub const ONLINE: &str = "online";
/// Payload that reports the uplink or the daemon as offline.
pub const OFFLINE: &str = "offline";

/// Runs until a signal of [`Stop`].
///
/// # Errors
/// Fails if the settings are invalid or lack the table `[mqtt]`, or if the queue cannot be opened.
pub fn run(options: &Options) -> Result<(), Failure> {
    let settings = options.start()?;
    let config = options.config.display();
    let mqtt = settings
        .mqtt
        .as_ref()
        .ok_or_else(|| Failure::config(format!("{config}: no table [mqtt]; add it, with host = \"...\"")))?;
    serve(&settings, mqtt).map_err(|error| Failure::new(format!("{config}: {error}")))
}

fn serve(settings: &Settings, mqtt: &MqttSettings) -> Result<(), String> {
    if mqtt.password_file.is_some() && mqtt.tls.is_none() && !is_this_computer(&mqtt.host) {
        tracing::warn!(host = mqtt.host, "the password is sent in plain text; add a table [mqtt.tls]");
    }
    let queue = Queue::open(&mqtt.history)?;
    let runtime = new_runtime().map_err(|error| format!("cannot start: {error}"))?;
    runtime.block_on(async {
        let mut stop = Stop::new(None).map_err(|error| format!("signals: {error}"))?;
        let documents = follow(&settings.status.socket);
        let (stopping, stopped) = watch::channel(false);
        let recorder = Recorder::new(&queue, mqtt.history.period_s).run(documents.clone());
        let link = Link { settings: mqtt, queue: &queue, documents };
        let waits_for_stop = async {
            stop.wait().await;
            stopping.send_replace(true);
            std::future::pending::<()>().await;
        };
        tokio::select! {
            () = link.run(stopped) => {}
            () = recorder => {}
            () = waits_for_stop => {}
        }
        Ok(())
    })
}

fn is_this_computer(host: &str) -> bool {
    host == "localhost" || host.parse().is_ok_and(|address: std::net::IpAddr| address.is_loopback())
}
