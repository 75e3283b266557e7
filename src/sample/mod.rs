//! Readings that arrive at different times and rates, made into samples a cell can use.
pub mod config;
pub use config::{Limits, SampleConfig, VoltageSource};
