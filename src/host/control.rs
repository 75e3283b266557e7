//! The control socket, a Unix stream socket. Over this socket, clients on the same computer list the alarms of a
//! running daemon and send commands to it. Requests and answers are lines of JSON. Requests are answered in order:
//! ```text
//! {"version":1,"request":"alarms"}                    {"version":1,"ok":true,"time":...,"alarms":[...],...}
//! {"version":1,"request":"clear","rule":"soc_low"}    {"version":1,"ok":true,"changed":1,"refused":0,...}
//! {"version":1,"request":"nonsense"}                  {"version":1,"ok":false,"error":"..."}
//! ```
//! [`protocol`] defines every request and answer. In both, cells count from 0, as in events.
//!
//! * The socket's owner and group may read (mode 0660). Commands are executed only for the daemon's own user and for
//!   root. The kernel identifies the user (`SO_PEERCRED`). Other users get an error.
//! * Each connection is a task. The task sends the daemon's loop one request at a time over a bounded queue. A client
//!   that never reads or writes does not block other clients, and its connection is closed.
//! * If the maximum number of connections is open, a new connection replaces the one that has been idle longest. If
//!   none has been idle for long enough, the new connection is rejected.
//! * A command reaches the core as an input, so the journal records the command and a replay repeats it.

pub mod answer;
pub mod client;
pub mod protocol;
mod server;
pub mod test_alarm;

use std::path::PathBuf;
use std::time::Duration;

use crate::io::connection_slots::SlotLimits;
use crate::io::unix_socket::{client_folder, runtime_folder};

pub use server::{ControlServer, PendingRequest};

/// Maximum number of connections, enough for a person, a display and a script. Each connection is a task with a few
/// kilobytes.
pub const MAX_CONNECTIONS: usize = 8;
/// Limits of the connections. One user cannot take all connections, and one connection is reserved for root.
pub(crate) const SLOTS: SlotLimits = SlotLimits { total: MAX_CONNECTIONS, for_root: 1, per_user: 6, per_client: 4 };
/// Longest request, bytes, including the end of the line. The longest valid request has less than 200 bytes.
pub const MAX_REQUEST_BYTES: usize = 4096;
/// Time that a client has to send a request, and again to read the answer. A script needs milliseconds. Without this
/// limit, a silent client could keep one of the few connections for ever.
pub const MAX_SILENCE: Duration = Duration::from_secs(10);
/// Maximum number of alarms in an answer. An answer with this many alarms has a few hundred kilobytes and is serialised
/// in a few milliseconds. Further alarms are only counted.
pub const MAX_LISTED: usize = 1024;

const FILE_NAME: &str = "control.sock";
/// File mode of the socket: owner and group may connect.
const MODE: u32 = 0o660;

/// The default path at which a daemon opens its socket.
pub fn daemon_path() -> PathBuf {
    runtime_folder().join(FILE_NAME)
}

/// The default path at which clients look for the socket.
pub fn standard_path() -> PathBuf {
    client_folder().join(FILE_NAME)
}
