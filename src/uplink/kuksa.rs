//! `kuksa`: provides the daemon's values to a KUKSA databroker (protocol `kuksa.val.v2`), for ever.
//!
//! In: settings, documents of the daemon. Out: values in the databroker, one batch a second. A broker that is gone is tried again, with
//! pauses from [`FIRST_PAUSE`] to [`LONGEST_PAUSE`]; meanwhile documents are dropped, never queued. `SIGTERM` withdraws the values.
//!
//! | module | what lives there |
//! | --- | --- |
//! | `settings` | the table `[kuksa]` |
//! | `signals` | paths, datatypes and units; how each value follows from a document |
//! | `value` | datatypes, limits |
//! | `messages` | the protocol |
//! | `routes` | ids of one connection |
//! | `outgoing` | what waits to be sent: the newest only |
//! | `questions` | values that the broker asks for, and when not to answer |
//! | `session` | one connection |
//! | `journal` | counts and log lines |

mod journal;
mod messages;
mod outgoing;
mod questions;
mod routes;
mod session;
pub(crate) mod settings;
pub(crate) mod signals;
pub(crate) mod value;

use std::time::Duration;

use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use tokio::time::timeout;

use crate::settings::Settings;
use crate::status_stream;
use crate::{Failure, Options};
use journal::Journal;

/// Pause after the first failure; it doubles with each further one.
pub(crate) const FIRST_PAUSE: Duration = Duration::from_millis(500);
/// Longest pause: a broker that is back is used within ten seconds.
pub(crate) const LONGEST_PAUSE: Duration = Duration::from_secs(8);

/// Runs the command until it is asked to stop.
///
/// # Errors
/// When the settings are not usable, or the runtime cannot be started.
pub fn run(options: &Options) -> Result<(), Failure> {
    let settings = options.start()?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| Failure::new(format!("runtime: {error}")))?;
    runtime.block_on(serve(&settings)).map_err(|error| Failure::new(format!("signals: {error}")))
}

async fn serve(settings: &Settings) -> std::io::Result<()> {
    let mut stop = stop_requests()?;
    let mut documents = status_stream::follow(&settings.status.socket);
    let mut journal = Journal::default();
    let (mut pause, mut latest_error) = (FIRST_PAUSE, String::new());
    loop {
        let connections = journal.counts.connections;
        // The first batch of a connection is for the document that is there, or says that there is none.
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

/// Becomes true with `SIGTERM` or `SIGINT`.
fn stop_requests() -> std::io::Result<watch::Receiver<bool>> {
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    let (sender, receiver) = watch::channel(false);
    tokio::spawn(async move {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
        }
        sender.send_replace(true);
        // Without a sender every wait would end.
        sender.closed().await;
    });
    Ok(receiver)
}
