//! Defines [`CellSample`], which the sampler passes to a cell's estimator, and [`Moment`], which voltages share if they
//! were measured together.
//!
//! A sample contains a voltage (V), the fresh current (A) and temperature (degrees C), and the charge counted up to the
//! time of the voltage (As). Stored samples are checked ([`CellSample::check`]).

use serde::{Deserialize, Serialize};

use crate::quantity::bounds;
use crate::quantity::{CellIndex, InvalidState, Timestamp};

/// Inputs of a cell's update, at the time of its voltage.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellSample {
    /// Time of the voltage reading.
    pub time: Timestamp,
    pub cell: CellIndex,
    /// Cell voltage (V).
    pub voltage_v: f64,
    /// Cell current (A), positive = discharge; `None` = the last good reading is too old.
    pub current_a: Option<f64>,
    /// Cumulative charge taken out of the cell (As); only differences are meaningful. Later readings may correct the
    /// part between the last current reading and `time`.
    pub charge_as: f64,
    /// Cumulative time in which the current reading was not exactly zero (s).
    pub offset_s: f64,
    /// Cumulative time without a usable current (s). The charge of this time is unknown.
    pub unmeasured_s: f64,
    /// Cell temperature (degrees C); `None` = no sensor, or the last good reading is too old.
    pub temperature_c: Option<f64>,
}

impl CellSample {
    /// Checks the numbers of a stored sample.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        bounds::VOLTAGE_V.check("the voltage of a pending sample", self.voltage_v)?;
        bounds::CURRENT_A.check_all("the current of a pending sample", self.current_a)?;
        bounds::CHARGE_AS.check("the charge of a pending sample", self.charge_as)?;
        bounds::TEMPERATURE_C.check_all("the temperature of a pending sample", self.temperature_c)?;
        bounds::TIME_S.check_all("a time of a pending sample", [self.offset_s, self.unmeasured_s])
    }

    /// Returns the same voltage as measured at `moment`.
    #[must_use]
    pub fn measured_at(self, moment: &Moment) -> Self {
        let Moment { time, current_a, charge_as, offset_s, unmeasured_s } = *moment;
        Self { time, current_a, charge_as, offset_s, unmeasured_s, ..self }
    }
}

/// Current and counters at a moment, for voltages that are measured together but arrive later (responses to diagnostic
/// requests).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Moment {
    pub(super) time: Timestamp,
    pub(super) current_a: Option<f64>,
    pub(super) charge_as: f64,
    pub(super) offset_s: f64,
    pub(super) unmeasured_s: f64,
}
