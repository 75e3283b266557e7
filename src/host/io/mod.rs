//! Reads and writes files and sockets: logs in every format, journals, result files and CAN interfaces.

pub mod background_file;
pub mod can_key;
pub mod candump;
pub mod clock;
pub mod connection_slots;
pub mod csv_log;
pub mod event_log;
pub mod journal;
pub mod json;
pub mod lines;
pub mod log;
pub mod paths;
pub mod place;
pub mod plausible;
pub mod reading;
pub mod record;
pub mod result_file;
mod row_limit;
pub mod runtime;
pub mod segments;
pub mod snapshot_file;
pub mod socket;
pub mod stamp;
pub mod stop;
pub mod table;
pub mod text_table;
pub mod ticks;
#[cfg(feature = "formats")]
mod tool_log;
pub mod units;
pub mod unix_socket;
