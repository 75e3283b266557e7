//! The simulator: a pack whose true state is known, the sensors that look at it, and the scenarios that load it.
//!
//! In: a cell model, settings and a seed. Out: readings (as a BMS would measure them) at their sampling times,
//! beside the true state. Everything is seeded and uses `libm`: one seed gives the same bytes on every machine.
//!
//! | file | what |
//! | --- | --- |
//! | [`truth`] | the cells as they really are: circuit, hysteresis, heat, ageing, spread |
//! | [`sensor`] | what a sensor makes of a true value: gain, offset, noise, resolution, dropout |
//! | `noise` | the seeded generator |
//! | [`scenario`] | the named scenarios and their settings |
//! | `course` | what a scenario asks of the pack next |
//! | [`run`] | the loop: truth, course and sensors stepped together |
mod course;
mod noise;
pub mod run;
pub mod scenario;
pub mod sensor;
pub mod truth;

pub use run::{Moment, Simulation, Wiring};
pub use scenario::{Scenario, Settings};
pub use sensor::{SensorError, Sensors};
pub use truth::{Ageing, Hysteresis, Pack, PackSettings, Spread, TruthCell};
