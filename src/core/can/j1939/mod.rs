//! J1939: packwatch is a node that claims an address and sends trouble codes.
//!
//! In: times, received frames and active codes. Out: frames to send and events to log. The output depends only on the
//! input, so a replay gives the same frames.
//!
//! | file | purpose |
//! | --- | --- |
//! | `name` | the 64-bit NAME of J1939-81 |
//! | `id` | priorities, parameter group numbers and addresses in an extended identifier |
//! | `trouble_code` | a code, the lamps, and the payload of DM1 and DM2 |
//! | `codes` | sends at most one change of each code a second; a code that was active only briefly is still sent |
//! | `transport` | payloads of more than 8 bytes, broadcast in packets (BAM) |
//! | `address` | claiming the address, defending it, falling silent |
//! | `event` | events of the node |
//! | `node` | the node that consists of these parts |
//!
//! While the node has no address, it sends only address claims. It ignores unknown and short frames and answers
//! requests at a limited rate.
//!
//! Deviations from the standard:
//! 1. A node that loses its address falls silent instead of claiming another address. If addresses changed, a consumer
//!    that identifies battery monitors by address could not distinguish them.
//! 2. Every payload of more than 8 bytes is broadcast (BAM), even if a single node requested it. For a single node, the
//!    standard uses a connection with flow control. This node also receives the broadcast, but cannot request a lost
//!    packet again. [`MAX_CODES`] limits the length of a broadcast.
//! 3. The delay before "cannot claim" is derived from the NAME instead of being random, so that a replay gives the same
//!    frames.

mod address;
mod codes;
mod event;
mod id;
mod name;
mod node;
mod transport;
mod trouble_code;

pub use codes::ActiveCode;
pub use event::NodeEvent;
pub use id::{
    GLOBAL_ADDRESS, MAX_ADDRESS, NULL_ADDRESS, PGN_ACKNOWLEDGEMENT, PGN_ADDRESS_CLAIMED, PGN_DM1, PGN_DM2, PGN_REQUEST,
    PGN_TRANSPORT_CONTROL, PGN_TRANSPORT_DATA, parameter_group,
};
pub(crate) use id::{any_source, has_destination};
pub use name::{Name, NameFields, OutOfRange};
pub use node::{Node, NodeConfig, NodeOutputs};
pub use trouble_code::{DmPayload, Lamp, LampState, Lamps, MAX_CODES, TroubleCode, dm_payload};
