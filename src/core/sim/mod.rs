//! The simulator: a pack with a known true state, its sensors, and the scenarios that load it.
//!
//! In: a cell model, settings and a seed. Out: readings at their sampling times, and the true state. The same seed
//! gives the same bytes on every machine, because all randomness is seeded, and `exp`, `sin` and similar functions come
//! from `libm`.
//!
//! | file | purpose |
//! | --- | --- |
//! | [`truth`] | the true cells: circuit, hysteresis, heat, ageing, differences between cells |
//! | [`sensor`] | sensor errors: gain, offset, noise, resolution, dropout |
//! | `noise` | seeded random numbers |
//! | [`scenario`] | the named scenarios and their settings |
//! | `course` | the next current of a scenario |
//! | [`fault`] | injected faults of cells, contacts, modules and sensors |
//! | [`balancing`] | passive balancing by the BMS |
//! | [`run`] | the loop that steps true state, course and sensors |

pub mod balancing;
mod course;
pub mod fault;
mod noise;
pub mod run;
pub mod scenario;
pub mod sensor;
pub mod truth;

pub use balancing::Balancing;
pub use fault::{Fault, FaultError, FaultKind};
pub use run::{Moment, Simulation, Wiring};
pub use scenario::{Scenario, Settings};
pub use sensor::{SensorError, SensorQuality, Sensors};
pub use truth::{Ageing, Hysteresis, Pack, PackSettings, Spread, TruthCell};
