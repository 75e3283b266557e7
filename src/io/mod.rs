//! Files and sockets: logs in every form, journals, result files, CAN interfaces.

pub mod candump;
pub mod ticks;
