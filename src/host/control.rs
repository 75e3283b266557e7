//! The control socket: lists the alarms of a running daemon and sends it commands, from the same computer.
//!
//! A Unix stream socket; one JSON document per line in, one per line out, in the order of the requests:
//! ```text
//! {"version":1,"request":"alarms"}                    {"version":1,"ok":true,"time":...,"alarms":[...],...}
//! {"version":1,"request":"clear","rule":"soc_low"}    {"version":1,"ok":true,"changed":1,"refused":0,...}
//! {"version":1,"request":"nonsense"}                  {"version":1,"ok":false,"error":"..."}
//! ```
//! [`protocol`] has every request and answer; cells count from 0 there, as in events.
//!
//! * Owner and group may read (mode 0660); commands are executed only for the daemon's own user and for root, as the
//!   kernel reports them (`SO_PEERCRED`). Others get an error.
//! * Each connection is a task. It sends the loop one request at a time over a bounded queue; a connection that never
//!   reads or writes blocks no other and is closed. When all places are taken, the one that has been idle longest is closed
//!   for a new one.
//! * A command reaches the core as an input, so it is in the journal and replays.

pub mod answer;
pub mod client;
pub mod protocol;
mod server;
pub mod test_alarm;

use std::path::PathBuf;
use std::time::Duration;

use crate::io::unix_socket::{client_folder, runtime_folder};

pub use server::{ControlServer, PendingRequest};

/// Connections at once: a person, a display and a script, with room; each is a task and a few kilobytes.
pub const MAX_CONNECTIONS: usize = 8;
/// Connections of one process at once.
pub const MAX_PER_PROCESS: usize = 4;
/// Bytes of a request with the end of its line: the longest valid one has under 200.
pub const MAX_REQUEST_BYTES: usize = 4096;
/// Longest time for a request and for reading its answer: a script needs milliseconds, and a client must not keep one of
/// the few places for ever.
pub const MAX_SILENCE: Duration = Duration::from_secs(10);
/// Alarms listed in an answer: a line of a few hundred kilobytes, serialised in a few milliseconds; the rest is counted.
pub const MAX_LISTED: usize = 1024;

/// Its name in the folder of the daemon.
const FILE_NAME: &str = "control.sock";
/// Owner and group may connect.
const MODE: u32 = 0o660;

/// The default path of a daemon's socket.
pub fn daemon_path() -> PathBuf {
    runtime_folder().join(FILE_NAME)
}

/// The default path at which a client looks for it.
pub fn standard_path() -> PathBuf {
    client_folder().join(FILE_NAME)
}
