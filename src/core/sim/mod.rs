//! The simulator: a pack with a known true state, its sensors, and the scenarios that load it.
//!
//! In: a cell model, settings and a seed. Out: readings at their sampling times, as a BMS would measure them, and the
//! true state. All randomness is seeded, and functions such as `exp` and `sin` come from `libm`. The same seed
//! therefore gives the same bytes on every machine.
//!
//! | file | purpose |
//! | --- | --- |
//! | [`truth`] | the true cells: circuit, hysteresis, heat, ageing, spread |
//! | [`sensor`] | sensor errors: gain, offset, noise, resolution, dropout; qualities |
//! | `noise` | the seeded random numbers |
//! | [`scenario`] | the named scenarios and their settings |
//! | `course` | the current that a scenario demands next |
//! | [`fault`] | injected faults of cells, contacts, modules and sensors |
//! | [`balancing`] | passive balancing by the BMS |
//! | [`run`] | the loop: truth, course and sensors stepped together |

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
