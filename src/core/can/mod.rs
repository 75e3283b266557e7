//! CAN frames and what they mean: layouts from DBC files, decoding of what comes in, encoding of what
//! goes out. Pure: no socket, no file, no clock. Wire units and wire signs end here.

pub mod dbc;
pub mod decode;
pub mod e2e;
pub mod encode;
pub mod flood;
pub mod frame;
pub mod guard;
mod id_table;
pub mod j1939;
pub mod signal;

pub use frame::{CanId, Frame, FrameKind, MAX_DATA};
