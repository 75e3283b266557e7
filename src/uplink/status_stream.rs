//! Receives the daemon's status, one document a second.
//!
//! Input: the daemon's stream socket. Output: [`StatusDocument`]s. When the daemon falls silent, the output is `None`
//! once. The daemon counts as silent if nothing arrives for [`SILENCE`], if the stream ends, or if a document cannot
//! be parsed. After each failure, the program waits for [`RETRY`] and opens the stream again. A reader that is slower
//! than the daemon gets only the newest document.

use std::io;
use std::path::Path;
use std::time::Duration;

use packwatch_host::status::client::{MAX_DOCUMENT_BYTES, explain, parse};
use packwatch_host::status::document::StatusDocument;
use packwatch_host::status::stream_path;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, BufReader};
use tokio::net::UnixStream;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};

/// Time without a document after which the daemon counts as silent. The daemon sends no document that is older than 3
/// s.
pub const SILENCE: Duration = Duration::from_secs(5);
/// Pause before reconnecting.
pub const RETRY: Duration = Duration::from_secs(1);

/// The newest document, as a watched value; `None` = the daemon is silent.
pub type Documents = watch::Receiver<Option<Box<StatusDocument>>>;

/// Reads the stream next to the status socket `socket` in a task of the current runtime, until the last receiver is
/// dropped.
pub fn follow(socket: &Path) -> Documents {
    let (sender, receiver) = watch::channel(None);
    let socket = socket.to_owned();
    tokio::spawn(async move {
        tokio::select! {
            () = read_for_ever(&socket, &sender) => {}
            () = sender.closed() => {}
        }
    });
    receiver
}

async fn read_for_ever(socket: &Path, sender: &watch::Sender<Option<Box<StatusDocument>>>) {
    let mut was_up = None;
    loop {
        let error: io::Error = match read(&stream_path(socket), sender, &mut was_up).await {
            Ok(()) => io::ErrorKind::UnexpectedEof.into(),
            Err(error) => error,
        };
        let error = explain(socket, "the key status.socket of the settings file", &error);
        if was_up != Some(false) {
            tracing::warn!(error, "no status from the daemon");
        }
        was_up = Some(false);
        sender.send_if_modified(|document| document.take().is_some());
        sleep(RETRY).await;
    }
}

/// Reads one connection until it ends.
async fn read(
    path: &Path,
    sender: &watch::Sender<Option<Box<StatusDocument>>>,
    was_up: &mut Option<bool>,
) -> io::Result<()> {
    let mut stream = BufReader::new(timeout(SILENCE, UnixStream::connect(path)).await??);
    let mut line = Vec::new();
    loop {
        line.clear();
        let limit = u64::try_from(MAX_DOCUMENT_BYTES).unwrap_or(u64::MAX);
        if timeout(SILENCE, (&mut stream).take(limit).read_until(b'\n', &mut line)).await?? == 0 {
            return Ok(());
        }
        let document = parse(&line).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))?;
        if *was_up != Some(true) {
            tracing::info!("the daemon reports its status");
        }
        *was_up = Some(true);
        sender.send_replace(Some(Box::new(document)));
    }
}
