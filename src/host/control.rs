//! The control socket: lists the alarms of a running daemon on the same computer and sends it commands.
//!
//! The control socket is a Unix stream socket. Requests and answers are lines of JSON. Answers have the order of the
//! requests:
//! ```text
//! {"version":1,"request":"alarms"}                    {"version":1,"ok":true,"time":...,"alarms":[...],...}
//! {"version":1,"request":"clear","rule":"soc_low"}    {"version":1,"ok":true,"changed":1,"refused":0,...}
//! {"version":1,"request":"nonsense"}                  {"version":1,"ok":false,"error":"..."}
//! ```
//! [`protocol`] defines every request and answer; in requests and answers, cells count from 0, as in events.
//!
//! * The socket's owner and group may read (mode 0660). Commands are executed only for the daemon's own user and for
//!   root. The kernel identifies the user (`SO_PEERCRED`). Other users get an error.
//! * Each connection is a task. It sends the daemon's loop one request at a time over a bounded queue. A connection
//!   that never reads or writes does not block other connections and is closed. If all slots are taken, a new
//!   connection replaces the one that has been idle longest.
//! * A command reaches the core as an input, so the journal records the command and a replay repeats it.

pub mod answer;
pub mod client;
pub mod protocol;
mod server;
pub mod test_alarm;

use std::path::PathBuf;
use std::time::Duration;

use crate::io::unix_socket::{client_folder, runtime_folder};

pub use server::{ControlServer, PendingRequest};

/// Maximum number of connections, enough for a person, a display and a script. Each connection is a task with a few
/// kilobytes.
pub const MAX_CONNECTIONS: usize = 8;
/// Maximum number of connections of one process.
pub const MAX_PER_PROCESS: usize = 4;
/// Longest request, bytes, including the end of the line. The longest valid request has less than 200 bytes.
pub const MAX_REQUEST_BYTES: usize = 4096;
/// Time within which a client must send its request, and time within which it must read the answer. A script needs
/// milliseconds, and a client must not keep one of the few slots for ever.
pub const MAX_SILENCE: Duration = Duration::from_secs(10);
/// Maximum number of alarms in an answer. So many alarms make a line of a few hundred kilobytes, which is serialised in
/// a few milliseconds. Further alarms are counted.
pub const MAX_LISTED: usize = 1024;

/// The socket's name in the folder of the daemon.
const FILE_NAME: &str = "control.sock";
/// File mode of the socket: owner and group may connect.
const MODE: u32 = 0o660;

/// The default path of a daemon's socket.
pub fn daemon_path() -> PathBuf {
    runtime_folder().join(FILE_NAME)
}

/// The socket's default path for clients.
pub fn standard_path() -> PathBuf {
    client_folder().join(FILE_NAME)
}
