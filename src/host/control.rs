//! The control socket: how people on this computer look at the alarms of a running daemon and tell it what to do.
//!
//! A Unix stream socket; one JSON document per line in, one per line out, in the order of asking:
//! ```text
//! {"version":1,"request":"alarms"}                    {"version":1,"ok":true,"time":...,"alarms":[...],...}
//! {"version":1,"request":"clear","rule":"soc_low"}    {"version":1,"ok":true,"changed":1,"refused":0,...}
//! {"version":1,"request":"nonsense"}                  {"version":1,"ok":false,"error":"..."}
//! ```
//! [`protocol`] has every request and answer; cells count from 0 there, as in events.
//!
//! * Whoever can open the socket may look (mode 0660); what changes something is done only for the daemon's own user
//!   and for root, as the kernel names them (`SO_PEERCRED`). Others get an error.
//! * Connections are tasks of their own. They talk with the loop over a bounded queue, one request each at a time; one
//!   that never reads or writes holds up nobody and is closed.
//! * A command reaches the core as an input like any other, so it is in the journal and replays.

pub mod answer;
pub mod client;
pub mod protocol;
mod server;
pub mod test_alarm;

use std::path::PathBuf;
use std::time::Duration;

use crate::io::unix_socket::runtime_folder;

pub use crate::io::unix_socket::SocketSetting as ControlSetting;
pub use server::{Asked, ControlServer};

/// Connections at once: a person, a display and a script, with room; each is a task and a few kilobytes.
pub const MAX_CONNECTIONS: usize = 8;
/// Bytes of a request, its line's end included: the longest that makes sense has under 200.
pub const MAX_REQUEST_BYTES: usize = 4096;
/// Time a client has for a request and for taking its answer: a script needs milliseconds, and a place of the few must
/// not be held for ever.
pub const MAX_SILENCE: Duration = Duration::from_secs(10);
/// Alarms listed in an answer: a line of a few hundred kilobytes, made in a few milliseconds; the rest is counted.
pub const MAX_LISTED: usize = 1024;

/// Its name in the folder of the daemon.
const FILE_NAME: &str = "control.sock";
/// Owner and group may connect.
const MODE: u32 = 0o660;

/// Where the socket is when nobody says where.
pub fn standard_path() -> PathBuf {
    runtime_folder().join(FILE_NAME)
}
