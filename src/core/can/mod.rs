//! Decodes and encodes CAN frames, with layouts from DBC files, end-to-end protection, authentication, diagnostics over
//! ISO-TP, and J1939.
//!
//! In: frames with interface and time. Out: readings in the program's units and signs, and frames. Any bytes are
//! accepted: if a signal cannot be decoded, its reading contains a fault instead of a value.

pub mod dbc;
pub mod decode;
pub mod e2e;
pub mod encode;
pub mod flood;
pub mod frame;
pub mod guard;
mod id_table;
pub mod isotp;
pub mod j1939;
pub mod own_frames;
pub mod poll;
pub mod rate;
pub mod secoc;
pub mod signal;
pub mod uds;
pub mod unit;

pub use frame::{CanId, Frame, FrameKind, MAX_DATA};
