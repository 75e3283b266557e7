//! Follows the daemon's stream socket, which sends one document a second.
//!
//! Input: the socket. Output: lines of JSON, or an error message while the daemon is silent. The daemon counts as silent
//! if nothing arrives for [`SILENCE`], if the stream ends, or if the handler rejects a line. After each failure,
//! [`follow`] waits for [`RETRY`] and opens the stream again.

use std::io;
use std::path::Path;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, BufReader};
use tokio::net::UnixStream;
use tokio::time::{sleep, timeout};

use super::client::{MAX_DOCUMENT_BYTES, explain};
use super::stream_path;

/// Time without a document after which the daemon counts as silent. The daemon sends no document that is older than 3
/// s.
pub const SILENCE: Duration = Duration::from_secs(5);
/// Pause before reconnecting.
pub const RETRY: Duration = Duration::from_secs(1);

/// Passes each line of the stream that belongs to the status socket `socket` to `handle`, and an error message after
/// each failure. `setting` is the option or the key that names the socket. Logs when the daemon starts or stops
/// reporting.
pub async fn follow(socket: &Path, setting: &str, mut handle: impl FnMut(Result<&[u8], &str>) -> Result<(), String>) {
    let mut was_up = None;
    loop {
        let error: io::Error = match read(&stream_path(socket), &mut handle, &mut was_up).await {
            Ok(()) => io::ErrorKind::UnexpectedEof.into(),
            Err(error) => error,
        };
        let error = explain(socket, setting, &error);
        if was_up != Some(false) {
            tracing::warn!(error, "no status from the daemon");
        }
        was_up = Some(false);
        // The handler may reject a line, but not an error message, so its result is ignored here.
        let _ = handle(Err(&error));
        sleep(RETRY).await;
    }
}

async fn read(
    path: &Path,
    handle: &mut impl FnMut(Result<&[u8], &str>) -> Result<(), String>,
    was_up: &mut Option<bool>,
) -> io::Result<()> {
    let mut stream = BufReader::new(timeout(SILENCE, UnixStream::connect(path)).await??);
    let mut line = Vec::new();
    loop {
        line.clear();
        let limit = u64::try_from(MAX_DOCUMENT_BYTES).unwrap_or(u64::MAX);
        timeout(SILENCE, (&mut stream).take(limit).read_until(b'\n', &mut line)).await??;
        if line.last() != Some(&b'\n') {
            return Ok(());
        }
        handle(Ok(&line)).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))?;
        if *was_up != Some(true) {
            tracing::info!("the daemon reports its status");
        }
        *was_up = Some(true);
    }
}
