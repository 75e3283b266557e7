//! Readings that arrive at different times and rates, made into samples a cell can use.
//!
//! In: readings (V, A with positive = discharge, degrees C) with their time. Out: one [`CellSample`] per good
//! voltage reading, and [`SignalChange`]s when a signal turns bad or good.
//! * [`signal`] judges one signal: range, rate, stuck, stale;
//! * [`charge`] counts charge, and the time nobody measured it;
//! * [`sampler`] holds one signal per channel and puts samples together.

pub mod charge;
pub mod config;
pub mod counts;
pub mod sampler;
pub mod signal;

pub use config::{Limits, SampleConfig, VoltageSource};
pub use counts::ReadingCounts;
pub use sampler::{CellSample, Sampler, SamplerShape, SamplerState, SignalChange};
