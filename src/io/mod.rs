//! Files and sockets: logs in every form, journals, result files, CAN interfaces.

pub mod candump;
pub(crate) mod clock;
pub mod csv_log;
pub mod journal;
pub mod lines;
pub mod log;
pub mod result_file;
pub mod socket;
pub mod stamp;
pub mod ticks;
