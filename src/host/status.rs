//! Publishes the daemon's status once a second.
//!
//! There are two Unix sockets. The daemon only writes to them and reads nothing from a client:
//!
//! | socket | what a client receives |
//! | --- | --- |
//! | `status.sock` | one [`StatusDocument`] as a line of JSON, then end of file |
//! | `status-stream.sock` | one [`StatusDocument`] as a line of JSON every second, until the client closes |
//!
//! * Every user who can reach the sockets may read (mode 0666), because the document contains no secrets and the
//!   exporter runs as a separate user. With the shipped units, only root, the exporter and the uplinks can reach the
//!   sockets: the service runs as a dynamic user, and systemd keeps the folder of such a service inside a folder that
//!   only root can enter. A client can change something only through the control socket, which not every user may open.
//! * Once a second, the service loop copies the values of a document into a draft and offers the draft to a separate
//!   thread. That thread serialises the draft and serves the clients, so no client affects the loop. A draft offered
//!   while the thread is busy is dropped and counted.
//! * `SLOTS` limits the number of clients. Further clients are rejected immediately and counted. A client that does
//!   not read within [`MAX_SILENCE`] is dropped and counted.
//! * A document older than [`STALE`] is not sent. The client waits for a fresh document, and receives nothing if no
//!   fresh document is published within [`MAX_SILENCE`]. A loop that hangs therefore does not look healthy.

pub mod client;
pub mod collect;
pub mod counters;
pub mod document;
pub mod event_words;
pub mod metrics;
#[cfg(test)]
#[path = "status/tests/quantities.rs"]
mod quantities;
#[cfg(test)]
#[path = "status/tests/sample.rs"]
pub mod sample;
mod server;
pub mod stream;

use std::path::{Path, PathBuf};
use std::time::Duration;

pub use server::StatusServer;

use crate::io::connection_slots::SlotLimits;
use crate::io::unix_socket::{client_folder, runtime_folder};

/// Limits of the clients of both sockets together. A vehicle needs far fewer: a display, an exporter and a few scripts.
/// Each client uses a descriptor and a few kilobytes. One user cannot take all slots, and four slots are reserved for
/// root.
const SLOTS: SlotLimits = SlotLimits { total: 64, for_root: 4, per_user: 40, per_client: 16 };
/// Longest time that a client may take to read a document, and longest wait of a client for a fresh document.
pub const MAX_SILENCE: Duration = Duration::from_secs(5);
/// Time between documents.
pub const PERIOD: Duration = Duration::from_secs(1);
/// Age at which a document is stale: three periods.
pub const STALE: Duration = Duration::from_secs(3);

/// The socket's name in the folder of the daemon.
const FILE_NAME: &str = "status.sock";
/// File mode of the sockets: every user may connect.
const MODE: u32 = 0o666;

/// The default path of a daemon's socket.
pub fn daemon_path() -> PathBuf {
    runtime_folder().join(FILE_NAME)
}

/// The socket's default path for clients.
pub fn standard_path() -> PathBuf {
    client_folder().join(FILE_NAME)
}

/// The streaming socket that belongs to a status socket: `status-stream.sock` for `status.sock`.
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
    fn stream_socket_is_next_to_status_socket() {
        assert_eq!(
            stream_path(Path::new("/run/packwatch/status.sock")),
            Path::new("/run/packwatch/status-stream.sock")
        );
        assert_eq!(stream_path(Path::new("/tmp/see")), Path::new("/tmp/see-stream"));
    }
}
