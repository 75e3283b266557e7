//! CAN frames and their contents: layouts from DBC files, decoding of received frames, encoding of sent frames,
//! end-to-end protection and authentication, diagnostics over ISO-TP, J1939.
//!
//! In: frames with interface and time. Out: readings in the program's units and signs, and frames. Any bytes are
//! accepted: bad input becomes a fault of its reading. Pure: no socket, no file, no clock.

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
