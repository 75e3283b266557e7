//! News of the stream socket, for ever: a connection that is lost is made again.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::io::AsyncReadExt;
use tokio::net::UnixStream;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};

use super::app::News;
use crate::io::clock::Reading;
use crate::quantity::Timestamp;
use crate::status::client::{check_length, explain, parse};

/// Pause before a daemon that is not there is looked for again.
const RETRY: Duration = Duration::from_secs(1);
/// Without a line for this long the connection is given up: a daemon that is stopped keeps it open.
const SILENCE: Duration = Duration::from_secs(5);

/// The computer's clock.
pub(super) fn now() -> Timestamp {
    Timestamp::from_nanos(Reading::now().realtime_ns)
}

/// Begins to listen.
pub(super) fn start(path: PathBuf) -> mpsc::Receiver<News> {
    // One is drawn while the next is read.
    let (news, received) = mpsc::channel(1);
    tokio::spawn(async move {
        loop {
            let Err(error) = listen(&path, &news).await else { return };
            if news.send(News::Lost(error)).await.is_err() {
                return;
            }
            sleep(RETRY).await;
        }
    });
    received
}

/// Until the connection is lost (`Err`) or nobody wants news.
async fn listen(path: &Path, news: &mpsc::Sender<News>) -> Result<(), String> {
    let failed = |error: io::Error| explain(path, &error);
    let mut stream = UnixStream::connect(path).await.map_err(failed)?;
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
            if news.send(News::Document(Box::new(document))).await.is_err() {
                return Ok(());
            }
        }
    }
}
