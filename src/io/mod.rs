//! Files and sockets: logs in every form, journals, result files, CAN interfaces.

pub mod candump;
pub mod csv_log;
pub mod journal;
pub mod lines;
pub mod log;
pub mod result_file;
pub mod stamp;
pub mod ticks;
