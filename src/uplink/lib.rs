//! Sends the daemon's status to other software inside or outside the vehicle: MQTT brokers (`mqtt`) and KUKSA
//! databrokers (`kuksa`). Diagnostic testers can read the status over SOVD (`sovd`).
//!
//! This crate is a separate program, which reads the daemon's status stream like the exporter. A slow, missing or
//! hostile broker can therefore not delay the estimates, and the daemon needs no network library.
//! `packwatch mqtt`, `packwatch kuksa`, `packwatch sovd` and `packwatch vss` start this program.
//!
//! | module | content |
//! | --- | --- |
//! | `files` | bounded reads of the settings file and of the files that it names |
//! | `kuksa` | provider of a KUKSA databroker |
//! | `mqtt` | the MQTT broker: current values, discovery, the queue for a lost link |
//! | `options` | options of the commands that run until stopped |
//! | `settings` | the settings file (`-c`): TOML to validated settings |
//! | `sovd` | HTTP server in the style of ASAM SOVD |
//! | `status_stream` | documents of the daemon, one a second; `None` while the daemon is silent |
//! | `vss` | the overlay of the vehicle signal specification |

mod files;
pub mod kuksa;
pub mod mqtt;
mod options;
pub mod settings;
pub mod sovd;
pub mod status_stream;
pub mod vss;

pub use options::Options;
pub use packwatch_host::failure::Failure;
