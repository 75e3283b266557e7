//! Settings of the sample stage: plausible values, largest ages, and the sensor of each cell. `config` checks their ranges.

use crate::quantity::SensorIndex;

/// Limits on one kind of reading. A value outside them is a bad reading and changes no estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Smallest plausible value, in the channel's unit.
    pub min: f64,
    /// Largest plausible value.
    pub max: f64,
    /// Fastest plausible change, unit per second; `None` = not checked.
    pub max_rate_per_s: Option<f64>,
    /// A value unchanged for this long while current flows is stuck; `None` = not checked.
    pub stuck_after_s: Option<f64>,
    /// A value older than this is stale.
    pub max_age_s: f64,
}

/// Source of the cells' voltages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VoltageSource {
    /// One reading per cell.
    Cells,
    /// Only the pack's total: `series` equal cells are assumed and estimated as one.
    PackTotal {
        /// Cells in series the total is divided by.
        series: u16,
    },
}

/// Settings of the contactors' signal.
#[derive(Debug, Clone, PartialEq)]
pub struct ContactorConfig {
    /// Values that mean open.
    pub open: Vec<f64>,
    /// Limits of its readings; after the largest age the state is unknown.
    pub limits: Limits,
}

/// Checked settings of the sample stage.
#[derive(Debug, Clone, PartialEq)]
pub struct SampleConfig {
    /// Estimated cells (1 with [`VoltageSource::PackTotal`]), 1 to [`crate::quantity::MAX_CELLS`].
    pub cells: u16,
    /// Source of the voltages.
    pub voltage_source: VoltageSource,
    /// Parallel strings that share the pack current equally.
    pub strings: u16,
    /// Limits of the pack current (per pack, not per string), A.
    pub current: Limits,
    /// Limits of a cell's voltage, V.
    pub voltage: Limits,
    /// Limits of a temperature, degrees C.
    pub temperature: Limits,
    /// Limits of the SOC the pack reports; `None` = it reports none.
    pub reported_soc: Option<Limits>,
    /// Limits of the SOH the pack reports; `None` = it reports none.
    pub reported_soh: Option<Limits>,
    /// The contactors; `None` = no signal, and the current is always as measured.
    pub contactor: Option<ContactorConfig>,
    /// Temperature sensor of each cell; `None` = no sensor, the thermal model alone.
    pub sensor_of_cell: Vec<Option<SensorIndex>>,
    /// Standard deviation of a voltage sensor's noise, V.
    pub voltage_noise_v: f64,
    /// Ambient temperature without a sensor, degrees C.
    pub ambient_c: f64,
}

impl SampleConfig {
    /// Cells in series.
    pub const fn series(&self) -> u16 {
        match self.voltage_source {
            VoltageSource::Cells => self.cells,
            VoltageSource::PackTotal { series } => series,
        }
    }
}
