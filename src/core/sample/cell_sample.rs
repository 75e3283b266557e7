//! Defines [`CellSample`], the input of a cell's estimator, and [`Moment`], the current and the counters at one time,
//! which all voltages measured at this time share.
//!
//! A sample contains a voltage (V), the fresh current (A) and temperature (degrees C), and the charge counted up to the
//! time of the voltage (As).

use serde::{Deserialize, Serialize};

use crate::quantity::bounds;
use crate::quantity::{CellIndex, InvalidState, Timestamp};

/// Inputs of a cell's estimator, at the time of a voltage.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellSample {
    pub time: Timestamp,
    pub cell: CellIndex,
    pub voltage_v: f64,
    /// Positive = discharge; `None` = the last good reading is too old.
    pub current_a: Option<f64>,
    /// Cumulative charge taken out of the cell; only differences are meaningful. The charge after the last current
    /// reading is extrapolated, and later readings may correct it.
    pub charge_as: f64,
    /// Cumulative time in which the sensor's offset acts on the charge, because the current reading was not exactly
    /// zero.
    pub offset_s: f64,
    /// Cumulative time without a usable current.
    pub unmeasured_s: f64,
    /// `None` = no sensor, or the last good reading is too old.
    pub temperature_c: Option<f64>,
}

impl CellSample {
    /// Checks a stored sample and returns the first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        bounds::VOLTAGE_V.check("the voltage of a pending sample", self.voltage_v)?;
        bounds::CURRENT_A.check_all("the current of a pending sample", self.current_a)?;
        bounds::CHARGE_AS.check("the charge of a pending sample", self.charge_as)?;
        bounds::TEMPERATURE_C.check_all("the temperature of a pending sample", self.temperature_c)?;
        bounds::TIME_S.check_all("a time of a pending sample", [self.offset_s, self.unmeasured_s])
    }

    /// The same voltage, as measured at `moment`.
    #[must_use]
    pub fn measured_at(self, moment: &Moment) -> Self {
        let Moment { time, current_a, charge_as, offset_s, unmeasured_s } = *moment;
        Self { time, current_a, charge_as, offset_s, unmeasured_s, ..self }
    }
}

/// Current and counters at one time. Voltages that were measured at this time but arrive later (responses to diagnostic
/// requests) share them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Moment {
    pub(super) time: Timestamp,
    pub(super) current_a: Option<f64>,
    pub(super) charge_as: f64,
    pub(super) offset_s: f64,
    pub(super) unmeasured_s: f64,
}
