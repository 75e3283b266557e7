//! `kuksa`: provides the daemon's values to a KUKSA databroker (protocol `kuksa.val.v2`) until stopped.
//!
//! Input: settings, and status documents of the daemon. Output: values in the databroker, one batch a second. After a
//! lost connection, the program reconnects. The pauses between attempts grow from [`FIRST_PAUSE`] to [`LONGEST_PAUSE`].
//! Documents are never queued: the first batch of a connection has the values of the newest document. On `SIGTERM` and
//! `SIGINT`, the program sends a batch without values and ends.
//!
//! | module | content |
//! | --- | --- |
//! | `settings` | the table `[kuksa]` |
//! | `signals` | paths, datatypes and units; derivation of each value from a document |
//! | `value` | datatypes, limits |
//! | `messages` | the protocol |
//! | `routes` | signal ids of one connection |
//! | `outgoing` | pending messages; only the newest batch is kept |
//! | `value_requests` | requests of the broker for values, and when not to answer |
//! | `session` | one connection |
//! | `journal` | counters and log lines |

mod journal;
mod messages;
mod outgoing;
mod routes;
mod session;
pub(crate) mod settings;
pub(crate) mod signals;
pub(crate) mod value;
mod value_requests;

use std::time::Duration;

use packwatch_host::io::runtime::new_runtime;
use packwatch_host::io::stop::Stop;
use tokio::sync::watch;
use tokio::time::timeout;

use crate::settings::Settings;
use crate::status_stream;
use crate::{Failure, Options};
use journal::Journal;

/// Pause after the first failure; doubles with each further failure.
pub(crate) const FIRST_PAUSE: Duration = Duration::from_millis(500);
/// Longest pause, so that a restarted broker is used within ten seconds.
pub(crate) const LONGEST_PAUSE: Duration = Duration::from_secs(8);

/// Runs the command until it is stopped.
///
/// # Errors
/// Fails if the settings are invalid or the runtime cannot be started.
pub fn run(options: &Options) -> Result<(), Failure> {
    let settings = options.start()?;
    let runtime = new_runtime().map_err(|error| Failure::new(format!("runtime: {error}")))?;
    runtime.block_on(serve(&settings)).map_err(|error| Failure::new(format!("signals: {error}")))
}

async fn serve(settings: &Settings) -> std::io::Result<()> {
    let mut stop = stop_requests()?;
    let mut documents = status_stream::follow(&settings.status.socket);
    let mut journal = Journal::default();
    let (mut pause, mut latest_error) = (FIRST_PAUSE, String::new());
    loop {
        let connections = journal.counts.connections;
        // Marks the newest document as unread, so that each connection begins with a batch of its values. While the
        // daemon is silent, there is no document, and this batch reports every value as unknown.
        documents.mark_changed();
        let Err(error) = session::run(&settings.kuksa, &mut documents, &mut stop, &mut journal).await else { break };
        let was_connected = journal.counts.connections > connections;
        if was_connected {
            pause = FIRST_PAUSE;
            journal.summarise();
        }
        if was_connected || error != latest_error {
            tracing::warn!(address = settings.kuksa.address, error, "no connection to the databroker; trying again");
        }
        latest_error = error;
        if timeout(pause, stop.wait_for(|stop| *stop)).await.is_ok() {
            break;
        }
        pause = (2 * pause).min(LONGEST_PAUSE);
    }
    journal.summarise();
    Ok(())
}

/// Watches for a signal that ends the program; the value becomes true with the first signal.
fn stop_requests() -> std::io::Result<watch::Receiver<bool>> {
    let mut stop = Stop::new(None)?;
    let (sender, receiver) = watch::channel(false);
    tokio::spawn(async move {
        stop.wait().await;
        sender.send_replace(true);
        // The sender must stay alive, because all waits for a stop end when the sender is dropped.
        sender.closed().await;
    });
    Ok(receiver)
}
