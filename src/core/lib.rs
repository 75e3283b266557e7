//! The pure core: frames in, estimates and alarms out. Never reads a clock, a file or a socket, and never logs: the same
//! inputs give the same outputs, byte for byte. The crate has no dependency that could do otherwise.

pub mod alarm;
pub mod can;
pub mod cell;
pub mod doctor;
pub mod filter;
pub mod health;
pub mod monitor;
pub mod quantity;
pub mod sample;
pub mod sim;
