//! Sends and receives on SocketCAN interfaces, for the daemon and for commands.
//!
//! * [`CanSender`]: a blocking sender for `replay --to` and `simulate --to`:
//!   `CanSender::open("vcan0", fd)?`, then `sender.send(&frame)?`. If the transmit queue is full, `send` waits up to a
//!   limit.
//! * `PassiveSocket`: receives everything on an interface for `doctor`, or frames of some identifiers for `test-alarm`.
//! * `Link`: the daemon's task for one interface. It receives and sends, and keeps running in every state of the
//!   interface.
//!
//! These types use two layers: `raw` is one socket, and `wire` converts frames to and from the kernel's byte layouts.

mod counters;
mod link;
mod passive_socket;
mod raw;
mod sender;
mod wire;

pub use counters::{LinkCounts, LinkHealth, LinkState};
pub use link::{Link, LinkConfig, LinkOutput};
pub use passive_socket::PassiveSocket;
pub use raw::DEFAULT_RECEIVE_BUFFER_BYTES;
pub(crate) use raw::explained;
pub use sender::CanSender;
