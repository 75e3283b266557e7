//! What the daemon knows, for other software of the vehicle and outside: MQTT brokers (`mqtt`) and KUKSA (`kuksa`).
//!
//! A program of its own, which reads the daemon's status stream like the exporter: a broker that is slow, gone or hostile does
//! not delay an estimate, and the vehicle program has no network library. `packwatch mqtt`, `packwatch kuksa` and
//! `packwatch vss` start it.
//!
//! | module | what lives there |
//! | --- | --- |
//! | `files` | files that the settings name, read within bounds |
//! | `kuksa` | provider of a KUKSA databroker |
//! | `mqtt` | the MQTT broker: current values, discovery, the queue for a lost link |
//! | `options` | options of the commands that run for ever |
//! | `settings` | the file of `-c`: TOML to checked settings |
//! | `status_stream` | documents of the daemon, one a second; `None` while there is none |
//! | `vss` | the overlay of the vehicle signal specification |

mod files;
pub mod kuksa;
pub mod mqtt;
mod options;
pub mod settings;
pub mod status_stream;
pub mod vss;

pub use options::Options;
pub use packwatch_host::failure::Failure;
