//! Reads the daemon's stream socket. Output: updates for the live view (`packwatch status --watch`).

use std::path::PathBuf;

use tokio::sync::mpsc;

use super::app::FeedUpdate;
use crate::io::clock::Reading;
use crate::quantity::Timestamp;
use crate::status::client::parse;
use crate::status::stream::follow;

pub(super) fn now() -> Timestamp {
    Timestamp::from_nanos(Reading::now().realtime_ns)
}

/// Starts reading the stream socket that belongs to the status socket at `path`. Errors name the status socket, because
/// this is the socket that users choose with `--status` and `--socket`.
pub(super) fn start(path: PathBuf) -> mpsc::Receiver<FeedUpdate> {
    // The channel holds one update while the view draws another. An update that arrives while the channel is full is
    // dropped.
    let (updates, received) = mpsc::channel(1);
    tokio::spawn(async move {
        let handle = |line: Result<&[u8], &str>| {
            let update = match line {
                Ok(line) => FeedUpdate::StatusDocument(Box::new(parse(line)?)),
                Err(error) => FeedUpdate::Lost(error.to_owned()),
            };
            let _ = updates.try_send(update);
            Ok(())
        };
        follow(&path, "--socket", handle).await;
    });
    received
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn hint_without_daemon_names_status_socket() {
        let update = start(PathBuf::from("/nonexistent/status.sock")).recv().await;
        let Some(FeedUpdate::Lost(said)) = update else { panic!("{update:?}") };
        assert!(said.starts_with("/nonexistent/status.sock: no daemon listens there"), "{said}");
        assert!(
            said.contains("packwatch run -c FILE --status /nonexistent/status.sock"),
            "an option that there is: {said}"
        );
    }
}
