//! The plan that turns input frames into readings.

pub use crate::quantity::{Channel, Reading, SensorIndex};
