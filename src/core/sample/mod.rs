//! Combines readings that arrive at different times and rates into samples for the cells' estimators.
//!
//! In: readings (V, A with positive = discharge, degrees C) with their time. Out: one [`CellSample`] per good voltage
//! reading, and a [`SignalChange`] when a signal turns bad or good. The value of a bad reading never enters a sample.
//! * [`signal`] checks one signal: range, rate, stuck, stale;
//! * [`charge`] counts charge and the time without a current measurement;
//! * [`sampler`] holds one signal per channel and combines them into samples.

pub mod cell_sample;
mod channels;
pub mod charge;
pub mod config;
pub mod counts;
mod frozen;
pub mod sampler;
pub mod signal;

pub use cell_sample::{CellSample, Moment};
pub use config::{ContactorConfig, Limits, SampleConfig, VoltageSource};
pub use counts::ReadingCounts;
pub use sampler::{Sampler, SamplerState, SensorRange, SignalChange};
