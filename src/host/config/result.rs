//! The checked configuration that the rest of the program uses, and the steps that produce it.

mod config;
mod key_source;
mod partial;
mod read;
mod vehicle;

pub use config::{Config, InterfaceConfig, StoreConfig};
pub use key_source::KeySource;
pub(crate) use partial::PartialConfig;
pub(crate) use read::read_and;
pub use read::{load, load_with};
pub use vehicle::VehicleIdentity;
