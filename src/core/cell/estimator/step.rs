//! Input and outcome of one step of the estimator.

/// A voltage reading, and the charge and time since the previous reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellStep {
    /// Time with a measured current (s).
    pub measured_s: f64,
    /// Charge taken out in the measured time (A s).
    pub charge_as: f64,
    /// Part of the measured time (s) in which the charge contains the current sensor's offset. Readings of exactly zero
    /// contain no offset.
    pub offset_s: f64,
    /// Time without a current measurement (s), for example during sleep.
    pub unmeasured_s: f64,
    /// Cell current at the reading (A). If it is `None`, the voltage changes the published SOC, but not the filter.
    pub current_a: Option<f64>,
    /// Cell temperature (degrees C). If it is `None`, the thermal model predicts it.
    pub temperature_c: Option<f64>,
    /// Ambient temperature for the thermal model (degrees C).
    pub ambient_c: f64,
    /// Terminal voltage (V).
    pub voltage_v: f64,
    /// Whether the voltage is frozen. A frozen voltage is not used.
    pub is_voltage_frozen: bool,
}

/// Outcome of an update with a voltage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Update {
    /// Measured voltage minus predicted voltage (V).
    pub innovation: f64,
    /// Predicted variance of the innovation (V^2).
    pub innovation_variance: f64,
    /// Square of the innovation, divided by the variance that the gate uses. The reading is an outlier if this ratio
    /// exceeds the square of the gate's width in standard deviations.
    pub test_ratio: f64,
    /// Whether the innovation passed the gate and moved the state.
    pub accepted: bool,
}

/// Outcome of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepResult {
    /// The update with the voltage; `None` if the current is unknown, or if the step could not be computed.
    pub update: Option<Update>,
    /// Whether the filter was restarted from the voltage.
    pub reset: bool,
    /// Whether the SOC after a gap differs from the SOC before the gap by far more than the counted charge and the
    /// uncertainty before the gap explain.
    pub jumped: bool,
}
