//! Seeing in: what the daemon knows, told once a second to whoever looks.
//!
//! Two Unix sockets that only tell; nothing is ever read from a client:
//!
//! | socket | what a client gets |
//! | --- | --- |
//! | `status.sock` | one [`Document`] as a line of JSON, then the end |
//! | `status-stream.sock` | the same, one line a second, until the client goes |
//!
//! * Whoever reaches the sockets may look (mode 0666): there is nothing secret in it, and the exporter runs as a user of
//!   its own. Under the shipped unit root and the exporter do: the folder of a dynamic user's service is within one that
//!   is closed to others. Changing something is the control socket's, which is not open to others anywhere.
//! * The loop fills in a [`Draft`] once a second (structs copied) and offers it; a thread of its own writes it down as
//!   JSON and serves the clients. Nothing a client does reaches the loop's thread. A draft that finds the thread still
//!   busy with the one before is dropped and counted.
//! * At most [`MAX_CLIENTS`] at once; others are turned away at once and counted. One that does not take what it was sent
//!   within [`MAX_SILENCE`] is dropped and counted.
//! * A document older than [`STALE`] is not served: a client waits for a fresh one, and when there is none within
//!   [`MAX_SILENCE`] it gets nothing. A loop that hangs does not look healthy.

pub mod client;
pub mod collect;
pub mod counters;
pub mod document;
pub mod metrics;
#[cfg(test)]
pub mod sample;
mod server;

use std::path::{Path, PathBuf};
use std::time::Duration;

pub use server::StatusServer;

use crate::io::unix_socket::runtime_folder;

/// Clients at once, of both sockets: a display, an exporter and a few scripts, many times over; each is a descriptor and
/// a few kilobytes.
pub const MAX_CLIENTS: usize = 64;
/// Time a client has to take what it was sent.
pub const MAX_SILENCE: Duration = Duration::from_secs(5);
/// Documents are made this often.
pub const PERIOD: Duration = Duration::from_secs(1);
/// A document older than this says nothing about now: three periods.
pub const STALE: Duration = Duration::from_secs(3);

/// The socket's name in the folder of the daemon.
const FILE_NAME: &str = "status.sock";
/// Whoever reaches it may look.
const MODE: u32 = 0o666;

/// Where the socket is when nobody says where.
pub fn standard_path() -> PathBuf {
    runtime_folder().join(FILE_NAME)
}

/// The streaming socket that belongs to a status socket: `status.sock` has `status-stream.sock` beside it.
pub fn stream_path(path: &Path) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let name = match path.extension() {
        Some(extension) => format!("{stem}-stream.{}", extension.to_string_lossy()),
        None => format!("{stem}-stream"),
    };
    path.with_file_name(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stream_is_beside_the_document() {
        assert_eq!(
            stream_path(Path::new("/run/packwatch/status.sock")),
            Path::new("/run/packwatch/status-stream.sock")
        );
        assert_eq!(stream_path(Path::new("/tmp/see")), Path::new("/tmp/see-stream"));
    }
}
