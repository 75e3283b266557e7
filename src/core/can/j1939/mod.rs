//! J1939 beside the plain frames: this program as one node that claims an address and tells its trouble codes.
//!
//! In: times, received frames, the codes that are active now. Out: frames to send and events to log. Pure as the rest
//! of [`can`](crate::can): everything the node does follows from what is handed to it, so replay gives the same frames.
//!
//! | part | what |
//! | --- | --- |
//! | `name` | the 64-bit NAME of J1939-81 |
//! | `id` | priorities, parameter group numbers and addresses in an extended identifier |
//! | `trouble_code` | a code, the lamps, and the payload of DM1 and DM2 |
//! | `codes` | which codes the bus is shown: at most one change a second each, nothing lost in between |
//! | `transport` | payloads of more than 8 bytes, broadcast in packets (BAM) |
//! | `dm1_receiver` | the other side, for tests of what goes out: puts the DM1 of one address together again |
//! | `address` | claiming the address, defending it, falling silent |
//! | `node` | all of it together |
//!
//! Promise: no frame but an address claim is sent before the address is ours or after it was lost; unknown frames,
//! short frames and floods of requests are counted, answered at a limited rate and never panic.
//!
//! Deviations from the standard:
//! 1. The arbitrary address capability is not used: a node that loses its address falls silent instead of taking
//!    another. A battery monitor whose address wanders cannot be told from another one by a consumer that knows it by address.
//! 2. Every payload of more than 8 bytes goes by BAM, also when one node asked for it alone (the standard has a connection
//!    with flow control for that). Who asks hears the broadcast as well; the effect is bus load, bounded by [`MAX_CODES`].
//! 3. The delay before "cannot claim" is drawn from the NAME, not at random, so that replay equals live.

mod address;
mod codes;
mod dm1_receiver;
mod id;
mod name;
mod node;
mod transport;
mod trouble_code;

pub use codes::ActiveCode;
pub use dm1_receiver::{Dm1Receiver, HeardDm1};
pub use id::{
    GLOBAL_ADDRESS, MAX_ADDRESS, NULL_ADDRESS, PGN_ACKNOWLEDGEMENT, PGN_ADDRESS_CLAIMED, PGN_DM1, PGN_DM2, PGN_REQUEST,
    PGN_TRANSPORT_CONTROL, PGN_TRANSPORT_DATA,
};
pub use name::{Name, NameFields, OutOfRange};
pub use node::{Node, NodeConfig, NodeCounters, NodeEvent, NodeOutputs};
pub use trouble_code::{DmPayload, Lamp, LampState, Lamps, MAX_CODES, TroubleCode, dm_codes, dm_payload};
