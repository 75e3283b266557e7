//! Input and outcome of one step of the estimator.

/// A voltage reading, with charge and time since the previous reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellStep {
    /// Time with a measured current, s.
    pub measured_s: f64,
    /// Charge taken out in that time, A s.
    pub charge_as: f64,
    /// Part of that time in which the charge contains the current sensor's offset, s: readings of exactly zero have no offset.
    pub offset_s: f64,
    /// Time without a current measurement, s (asleep, sensor lost).
    pub unmeasured_s: f64,
    /// Cell current at the reading, A; `None` = unknown; the voltage is then not used.
    pub current_a: Option<f64>,
    /// Cell temperature, degrees C; `None` = unknown; the thermal model then predicts it.
    pub temperature_c: Option<f64>,
    /// Temperature of the surroundings for the thermal model, degrees C.
    pub ambient_c: f64,
    /// Terminal voltage, V.
    pub voltage_v: f64,
}

/// Outcome of an update with a voltage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Update {
    /// Measured less predicted voltage, V.
    pub innovation: f64,
    /// Predicted variance of the innovation, V^2.
    pub innovation_variance: f64,
    /// innovation^2 over its variance for the gate: beyond the gate's square the reading is an outlier.
    pub test_ratio: f64,
    /// Whether the innovation passed the gate and moved the state.
    pub accepted: bool,
}

/// Outcome of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepResult {
    /// The measurement update; `None` without a known current.
    pub update: Option<Update>,
    /// The filter has restarted from the voltage.
    pub reset: bool,
}
