//! Reads the daemon's stream socket and reconnects after a failure. Output: updates for the live view (`packwatch
//! status --watch`).

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::io::AsyncReadExt;
use tokio::net::UnixStream;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};

use super::app::FeedUpdate;
use crate::io::clock::Reading;
use crate::quantity::Timestamp;
use crate::status::client::{check_length, explain, parse};
use crate::status::stream_path;

/// Pause before reconnecting.
const RETRY: Duration = Duration::from_secs(1);
/// Longest wait for data. After this time the connection is closed, because a suspended daemon keeps a connection open
/// without sending.
const SILENCE: Duration = Duration::from_secs(5);

/// The computer's clock.
pub(super) fn now() -> Timestamp {
    Timestamp::from_nanos(Reading::now().realtime_ns)
}

/// Starts reading the stream socket next to the status socket at `path`. Errors name the status socket, as the options
/// `--status` and `--socket` do.
pub(super) fn start(path: PathBuf) -> mpsc::Receiver<FeedUpdate> {
    // One update is drawn while the next is read.
    let (updates, received) = mpsc::channel(1);
    tokio::spawn(async move {
        loop {
            let Err(error) = listen(&path, &updates).await else { return };
            if updates.send(FeedUpdate::Lost(error)).await.is_err() {
                return;
            }
            sleep(RETRY).await;
        }
    });
    received
}

/// Reads until the connection fails (`Err`) or the view ends (`Ok`).
async fn listen(path: &Path, updates: &mpsc::Sender<FeedUpdate>) -> Result<(), String> {
    let failed = |error: io::Error| explain(path, "--socket", &error);
    let mut stream = UnixStream::connect(stream_path(path)).await.map_err(failed)?;
    let mut unread = Vec::new();
    loop {
        let read = timeout(SILENCE, stream.read_buf(&mut unread)).await;
        if read.map_err(|late| failed(late.into()))?.map_err(failed)? == 0 {
            return Err(failed(io::ErrorKind::UnexpectedEof.into()));
        }
        check_length(unread.len()).map_err(failed)?;
        while let Some(end) = unread.iter().position(|byte| *byte == b'\n') {
            let document = parse(&unread[..end])?;
            unread.drain(..=end);
            if updates.send(FeedUpdate::StatusDocument(Box::new(document))).await.is_err() {
                return Ok(());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn hint_without_daemon_names_status_socket() {
        let (updates, _received) = mpsc::channel(1);
        let said = listen(Path::new("/nonexistent/status.sock"), &updates).await.unwrap_err();
        assert!(said.starts_with("/nonexistent/status.sock: no daemon listens there"), "{said}");
        assert!(
            said.contains("packwatch run -c FILE --status /nonexistent/status.sock"),
            "an option that there is: {said}"
        );
    }
}
