//! Faults that a simulation injects: cells, contacts, a replaced module, sensors.
//!
//! A fault begins at a time of the simulation and stays. Faults of cells change the truth ([`Pack`](super::Pack)); faults of
//! sensors change only what is read. The text form is `KIND:...@WHEN` ([`Fault`]'s `FromStr`); cells and temperature sensors
//! count from 1 there and from 0 inside.

mod parse;
pub(crate) mod sensed;

use crate::quantity::{CellIndex, SensorIndex};

/// One fault and when it begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    /// Kind, place and size.
    pub kind: FaultKind,
    /// Begins this long after the start of the simulation, s.
    pub from_s: f64,
}

/// Path of a leak inside a cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Leak {
    /// A constant current, A.
    Current(f64),
    /// A soft short of this resistance, ohm: the current is the unloaded cell voltage over it.
    Resistance(f64),
}

/// Size of a contact's resistance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ContactResistance {
    /// Ohm.
    Ohm(f64),
    /// Share of the cell's own ohmic resistance at SOC 50 % and 25 degrees C when the fault begins.
    OfCell(f64),
}

/// Kind, place and size of a fault. Changes are relative: 0.1 = 10 % more.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FaultKind {
    /// The cell loses charge all the time, also at rest.
    Leak {
        /// The cell.
        cell: CellIndex,
        /// Its leak.
        leak: Leak,
    },
    /// A resistance in series with the cell, between its two voltage taps. It has no temperature law, and its heat
    /// warms no cell.
    Contact {
        /// The cell.
        cell: CellIndex,
        /// Its size.
        resistance: ContactResistance,
    },
    /// The cell's capacity changes; its SOC stays.
    Weak {
        /// The cell.
        cell: CellIndex,
        /// Change of the capacity.
        change: f64,
    },
    /// All resistances of the cell change; they keep following the model's temperature law.
    Resistance {
        /// The cell.
        cell: CellIndex,
        /// Change of the resistance.
        change: f64,
    },
    /// Several cells are replaced: capacity changed, resistance as new, SOC the mean of the cells they replace.
    Module {
        /// First cell.
        first: CellIndex,
        /// Last cell.
        last: CellIndex,
        /// Change of the capacity.
        change: f64,
    },
    /// The current sensor's offset changes by this, A, positive = discharge.
    CurrentOffset(f64),
    /// The current sensor's gain changes by this, relative.
    CurrentGain(f64),
    /// The current's value is frozen.
    CurrentStuck,
    /// The offset of a voltage channel changes.
    VoltageOffset {
        /// The channel.
        cell: CellIndex,
        /// Change, V.
        offset_v: f64,
    },
    /// The value of a voltage channel is frozen.
    VoltageStuck {
        /// The channel.
        cell: CellIndex,
    },
    /// Two voltage channels are exchanged.
    Swap(CellIndex, CellIndex),
    /// The second voltage channel shows the first one's value.
    Double {
        /// The channel that is shown twice.
        shown: CellIndex,
        /// The channel that is not shown.
        hidden: CellIndex,
    },
    /// The value of a temperature sensor is frozen.
    TemperatureStuck(SensorIndex),
    /// A temperature sensor fell off: it shows the surroundings.
    TemperatureOff(SensorIndex),
}

/// A fault that cannot be read or that the pack cannot have.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{what} = {found}, must be {allowed}")]
pub struct FaultError {
    /// The part of the fault.
    pub what: &'static str,
    /// Its text.
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
    /// Cells that the fault names, the highest last.
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

    /// Checks that the pack has the cells and sensors the fault names.
    ///
    /// # Errors
    /// The first one that it does not have.
    pub fn check(&self, cells: u16, temperature_sensors: u16) -> Result<(), FaultError> {
        if let Some(cell) = self.cells().into_iter().flatten().find(|cell| cell.0 >= cells) {
            return Err(FaultError::new("cell", u32::from(cell.0) + 1, format!("1 to {cells}")));
        }
        match *self {
            Self::TemperatureStuck(sensor) | Self::TemperatureOff(sensor) if sensor.0 >= temperature_sensors => {
                let allowed = match temperature_sensors {
                    0 => "absent: the configuration has none".to_owned(),
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
