//! Settings of the sample stage: plausible values, maximum ages, and the sensor of each cell. The configuration module
//! of the host crate checks the settings.

use crate::quantity::SensorIndex;

/// Limits of one kind of reading. A value outside the limits is a bad reading and changes no estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Smallest plausible value, in the channel's unit.
    pub min: f64,
    /// Largest plausible value.
    pub max: f64,
    /// Fastest plausible change, unit per second; `None` = not checked.
    pub max_rate_per_s: Option<f64>,
    /// A value that is unchanged for this long while it should change is stuck; `None` = not checked.
    pub stuck_after_s: Option<f64>,
    /// Age above which a value is stale (s).
    pub max_age_s: f64,
}

/// Source of the cells' voltages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VoltageSource {
    /// One signal per cell.
    Cells,
    /// Only the total voltage of the pack: `series` equal cells are assumed and estimated as one.
    PackTotal {
        /// Number of cells in series, by which the total is divided.
        series: u16,
    },
}

/// Settings of the contactor signal.
#[derive(Debug, Clone, PartialEq)]
pub struct ContactorConfig {
    /// Values that mean "open".
    pub open: Vec<f64>,
    /// Limits of the signal's readings. After the maximum age, the state of the contactors is unknown.
    pub limits: Limits,
}

/// Checked settings of the sample stage.
#[derive(Debug, Clone, PartialEq)]
pub struct SampleConfig {
    /// Number of estimated cells (1 with [`VoltageSource::PackTotal`]), 1 to [`crate::quantity::MAX_CELLS`].
    pub cells: u16,
    /// Source of the voltages.
    pub voltage_source: VoltageSource,
    /// Number of parallel strings, which share the pack current equally.
    pub strings: u16,
    /// Limits of the pack current (per pack, not per string) (A).
    pub current: Limits,
    /// Limits of a cell's voltage (V).
    pub voltage: Limits,
    /// Limits of a temperature (degrees C).
    pub temperature: Limits,
    /// Limits of the SOC reported by the pack; `None` = not reported.
    pub reported_soc: Option<Limits>,
    /// Limits of the SOH reported by the pack; `None` = not reported.
    pub reported_soh: Option<Limits>,
    /// Limits of the direction of the current; `None` = the current has a sign of its own. While the direction is
    /// unknown, so is the current.
    pub direction: Option<Limits>,
    /// The contactors; `None` = no signal, so that the measured current always counts.
    pub contactor: Option<ContactorConfig>,
    /// Temperature sensor of each cell; `None` = no sensor, so that the thermal model gives the temperature.
    pub sensor_of_cell: Vec<Option<SensorIndex>>,
    /// Standard deviation of a voltage sensor's noise (V).
    pub voltage_noise_v: f64,
    /// Ambient temperature for cells without a sensor (degrees C).
    pub ambient_c: f64,
}

impl SampleConfig {
    /// Number of temperature sensors in use.
    pub fn sensors(&self) -> u16 {
        self.sensor_of_cell.iter().flatten().map(|sensor| sensor.0.saturating_add(1)).max().unwrap_or(0)
    }

    /// Number of cells in series.
    pub const fn series(&self) -> u16 {
        match self.voltage_source {
            VoltageSource::Cells => self.cells,
            VoltageSource::PackTotal { series } => series,
        }
    }
}
