//! Settings of the sample stage: plausible values, maximum ages, and the sensor of each cell. The host crate checks the
//! settings.

use crate::quantity::SensorIndex;

/// Limits of one kind of reading. A value outside them is a bad reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// In the channel's unit.
    pub min: f64,
    pub max: f64,
    /// `None` = not checked.
    pub max_rate_per_s: Option<f64>,
    /// After this time, an unchanged value that should change is stuck; `None` = not checked.
    pub stuck_after_s: Option<f64>,
    /// An older value is stale.
    pub max_age_s: f64,
}

/// Source of the cells' voltages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VoltageSource {
    Cells,
    /// Only the total voltage of the pack. `series` equal cells are estimated as one cell.
    PackTotal {
        /// Number of cells in series.
        series: u16,
    },
}

/// Settings of the contactor signal.
#[derive(Debug, Clone, PartialEq)]
pub struct ContactorConfig {
    pub open: Vec<f64>,
    /// After the maximum age, the state of the contactors is unknown.
    pub limits: Limits,
}

/// Checked settings of the sample stage.
#[derive(Debug, Clone, PartialEq)]
pub struct SampleConfig {
    /// 1 to [`crate::quantity::MAX_CELLS`]; 1 with [`VoltageSource::PackTotal`].
    pub cells: u16,
    pub voltage_source: VoltageSource,
    /// Parallel strings share the pack current equally.
    pub strings: u16,
    /// Per pack, not per string.
    pub current: Limits,
    pub voltage: Limits,
    pub temperature: Limits,
    /// `None` = not reported.
    pub reported_soc: Option<Limits>,
    pub reported_soh: Option<Limits>,
    /// Direction of the current; `None` = the current has a sign of its own. While the direction is unknown, the
    /// current is unknown.
    pub direction: Option<Limits>,
    /// `None` = no contactor signal, so that the measured current always counts.
    pub contactor: Option<ContactorConfig>,
    /// `None` = no sensor, so that the thermal model gives the temperature.
    pub sensor_of_cell: Vec<Option<SensorIndex>>,
    /// Standard deviation of a voltage sensor's noise.
    pub voltage_noise_v: f64,
    /// For cells without a sensor.
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
