//! Faults that a simulation injects into cells, contacts, modules and sensors.
//!
//! A fault starts at a given time and lasts until the end of the simulation. Faults of cells change the true state
//! ([`Pack`](super::Pack)). Faults of sensors change only the readings. The text form is `KIND:...@WHEN` ([`Fault`]'s
//! `FromStr`). In this text, cells and temperature sensors count from 1. In the code, they count from 0.

mod parse;
pub(crate) mod sensed;

use crate::quantity::{CellIndex, SensorIndex};

/// One fault and its start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    /// Kind, location and size.
    pub kind: FaultKind,
    /// Time from the start of the simulation to the start of the fault (s).
    pub from_s: f64,
}

/// Size of a leak inside a cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Leak {
    /// A constant leakage current (A).
    Current(f64),
    /// A soft short circuit with this resistance (ohm). Its current is the unloaded cell voltage divided by the
    /// resistance.
    Resistance(f64),
}

/// Size of a contact resistance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ContactResistance {
    /// Resistance (ohm).
    Ohm(f64),
    /// Share of the cell's ohmic resistance at SOC 50 % and 25 degrees C when the fault starts.
    OfCell(f64),
}

/// Kind, location and size of a fault. Changes are relative unless they have a unit: 0.1 = 10 % more.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FaultKind {
    /// The cell loses charge continuously, even at rest.
    Leak {
        /// The cell.
        cell: CellIndex,
        /// Size of the leak.
        leak: Leak,
    },
    /// A resistance in series with the cell, between its voltage taps. It does not depend on temperature and warms no
    /// cell.
    Contact {
        /// The cell.
        cell: CellIndex,
        /// Size of the resistance.
        resistance: ContactResistance,
    },
    /// The cell's capacity changes, but its SOC does not.
    Weak {
        /// The cell.
        cell: CellIndex,
        /// Change of the capacity.
        change: f64,
    },
    /// All resistances of the cell change. They still depend on temperature as in the model.
    Resistance {
        /// The cell.
        cell: CellIndex,
        /// Change of the resistance.
        change: f64,
    },
    /// The cells of a module are replaced. Their capacity changes, their resistance is as new, and their SOC becomes
    /// the mean SOC of the replaced cells.
    Module {
        /// First cell.
        first: CellIndex,
        /// Last cell.
        last: CellIndex,
        /// Change of the capacity.
        change: f64,
    },
    /// The current sensor's offset changes by this value (A), positive = discharge.
    CurrentOffset(f64),
    /// The current sensor's gain changes by this relative value.
    CurrentGain(f64),
    /// The current reading is frozen.
    CurrentStuck,
    /// The offset of a voltage channel changes.
    VoltageOffset {
        /// The channel.
        cell: CellIndex,
        /// Change (V).
        offset_v: f64,
    },
    /// The reading of a voltage channel is frozen.
    VoltageStuck {
        /// The channel.
        cell: CellIndex,
    },
    /// Two voltage channels are swapped.
    Swap(CellIndex, CellIndex),
    /// Two voltage channels show the same cell.
    Double {
        /// The channel whose cell is shown twice.
        shown: CellIndex,
        /// The channel whose own cell is not shown.
        hidden: CellIndex,
    },
    /// The reading of a temperature sensor is frozen.
    TemperatureStuck(SensorIndex),
    /// A temperature sensor has fallen off and measures the ambient temperature.
    TemperatureOff(SensorIndex),
}

/// A fault that cannot be parsed or does not fit the pack.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{what} = {found}, must be {allowed}")]
pub struct FaultError {
    /// The part of the fault.
    pub what: &'static str,
    /// The text that was found.
    pub found: String,
    /// What is allowed.
    pub allowed: String,
}

impl FaultError {
    fn new(what: &'static str, found: impl ToString, allowed: impl Into<String>) -> Self {
        Self { what, found: found.to_string(), allowed: allowed.into() }
    }
}

impl FaultKind {
    fn cells(&self) -> [Option<CellIndex>; 2] {
        match *self {
            Self::Leak { cell, .. }
            | Self::Contact { cell, .. }
            | Self::Weak { cell, .. }
            | Self::Resistance { cell, .. }
            | Self::VoltageOffset { cell, .. }
            | Self::VoltageStuck { cell } => [Some(cell), None],
            Self::Module { first, last, .. } => [Some(first), Some(last)],
            Self::Swap(first, second) => [Some(first), Some(second)],
            Self::Double { shown, hidden } => [Some(shown), Some(hidden)],
            Self::CurrentOffset(_)
            | Self::CurrentGain(_)
            | Self::CurrentStuck
            | Self::TemperatureStuck(_)
            | Self::TemperatureOff(_) => [None, None],
        }
    }

    /// Checks that the pack has the cells and sensors that the fault names.
    ///
    /// # Errors
    /// The first cell or sensor that the pack does not have.
    pub fn check(&self, cells: u16, temperature_sensors: u16) -> Result<(), FaultError> {
        if let Some(cell) = self.cells().into_iter().flatten().find(|cell| cell.0 >= cells) {
            return Err(FaultError::new("cell", u32::from(cell.0) + 1, format!("1 to {cells}")));
        }
        match *self {
            Self::TemperatureStuck(sensor) | Self::TemperatureOff(sensor) if sensor.0 >= temperature_sensors => {
                let allowed = match temperature_sensors {
                    0 => "absent: the configuration has no temperature sensors".to_owned(),
                    n => format!("1 to {n}"),
                };
                Err(FaultError::new("temperature sensor", u32::from(sensor.0) + 1, allowed))
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests;
