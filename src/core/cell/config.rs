//! Settings of the per-cell estimator. The configuration checks their ranges. "The paper" is "Battery Predictions for
//! Electronic Prognostics".

use crate::filter::ScalarGaussian;

/// How the circuit's equations are integrated over a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Discretisation {
    /// exp(-dt/RC), which is exact if the current is constant during the step.
    Exact,
    /// Forward Euler, as in the paper.
    Euler,
}

/// Whether the filter estimates the capacity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CapacityState {
    /// The capacity is a state and is estimated together with the SOC.
    Joint,
    /// The capacity is held at the last learned value, as in the paper.
    Held,
}

/// Checked settings of the estimator. Process noises are densities: standard deviations per square root of a second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EstimatorConfig {
    /// Spread of the sigma points.
    pub points: SigmaPointSettings,
    /// Exact or Euler integration.
    pub discretisation: Discretisation,
    /// Estimated or held capacity.
    pub capacity_state: CapacityState,
    /// Initial state of a cell without history.
    pub initial: InitialState,
    /// Noise of the states while the current is measured.
    pub process: ProcessNoise,
    /// Possible change of the SOC while no current is measured.
    pub gap: GapSettings,
    /// Errors of a voltage reading and of the voltage that the cell model predicts.
    pub voltage: VoltageError,
    /// Constant errors of the sensors.
    pub sensor: SensorErrors,
    /// Rejection of outlying voltage readings.
    pub gate: GateSettings,
    /// Check whether the innovations (measured minus predicted voltage) are as large as their variance says.
    pub consistency: ConsistencySettings,
}

/// Spread and weights of the sigma points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SigmaPointSettings {
    /// Spread alpha of the sigma points, above 0 and at most 1.
    pub alpha: f64,
    /// Weight beta of the centre, from knowledge of the distribution; 2 for a Gaussian distribution.
    pub beta: f64,
    /// Secondary scaling kappa of the sigma points.
    pub kappa: f64,
}

/// Initial state of a filter with its uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InitialState {
    /// Initial SOC (fraction); `None` = from the first voltage and the OCV curve.
    pub soc: Option<f64>,
    /// Standard deviation of the initial SOC (fraction).
    pub soc_std: f64,
    /// Standard deviation of the initial branch voltages (V).
    pub branch_std_v: f64,
    /// Initial capacity (Ah).
    pub capacity_ah: f64,
    /// Standard deviation of the initial capacity (Ah).
    pub capacity_std_ah: f64,
    /// Capacity (Ah) that selects the open-circuit curve of the aged cell until the first charge or discharge has
    /// ended.
    pub curve: ScalarGaussian,
    /// Standard deviation of the initial ln(resistance relative to new).
    pub log_resistance_std: f64,
}

/// Densities of the process noise while the current is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProcessNoise {
    /// Noise of the SOC (fraction per sqrt(s)).
    pub soc_per_sqrt_s: f64,
    /// Noise of the SOC caused by random errors of the current, per square root of the charge moved. Noise and charge
    /// are fractions of the capacity.
    pub charge_per_sqrt_soc: f64,
    /// Noise of a branch voltage (V per sqrt(s)).
    pub branch_v_per_sqrt_s: f64,
    /// Noise of ln(resistance) (1 per sqrt(s)).
    pub log_resistance_per_sqrt_s: f64,
}

/// Possible change of the SOC while no current is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GapSettings {
    /// Process noise of the SOC (fraction per sqrt(s)).
    pub noise_per_sqrt_s: f64,
    /// Largest self-discharge (fraction of SOC per s).
    pub self_discharge_per_s: f64,
    /// Largest change of the SOC by use or charging while the program does not run (fraction of SOC per s).
    pub away_use_per_s: f64,
    /// Largest current (A) of a resting cell. If a larger current flows before or after a gap, it may also have flowed
    /// during the gap.
    pub rest_current_a: f64,
    /// Whether the cell counts as resting during every gap of more than 5 s without a measured current, even if a
    /// current flows before and after the gap.
    pub silence_is_rest: bool,
}

/// Errors of a voltage reading and of the voltage that the cell model predicts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoltageError {
    /// White sensor noise of one voltage reading (V).
    pub noise_v: f64,
    /// Slow model error: standard deviation of its average over one second (V). Used if the cell model states no error.
    pub model_error_v_sqrt_s: f64,
    /// Part of the model error that is proportional to the present voltage drop in the cell: fraction of the drop,
    /// averaged over one second.
    pub drop_error_sqrt_s: f64,
    /// Part of the model error that is proportional to the voltage drop by the load of the last minutes: fraction of
    /// this drop, averaged over one second.
    pub load_error_sqrt_s: f64,
    /// Time constant (s) with which the model error decays after a load has ended (slow diffusion).
    pub load_memory_s: f64,
    /// A voltage reading gives at most as much information as readings over this time (s), even if the readings are
    /// further apart.
    pub max_information_s: f64,
}

/// Standard deviations of the sensors' constant errors (errors that do not change with time). The filter adds their
/// effect to its variances, and this effect never averages out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorErrors {
    /// Offset of a cell's voltage (V), including a constant error of the model's open-circuit curve.
    pub voltage_offset_v: f64,
    /// Offset of the current sensor that remains after learning (A), divided by the number of parallel strings.
    pub current_offset_a: f64,
    /// Gain error of the current (fraction).
    pub current_gain: f64,
    /// Error of the slowest branch's resistance (fraction) that remains after learning, in addition to the common error
    /// of all resistances.
    pub slow_branch: f64,
}

impl SensorErrors {
    /// No constant errors, as in the paper.
    pub const NONE: Self = Self { voltage_offset_v: 0.0, current_offset_a: 0.0, current_gain: 0.0, slow_branch: 0.0 };
}

/// Rejection of outlying voltage readings (the "gate").
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateSettings {
    /// Maximum accepted innovation, in standard deviations.
    pub sigma: f64,
    /// Model error of a single reading (V, standard deviation). The gate and the consistency monitor use it instead of
    /// the error averaged over one second, with which they would accept every reading at a high sample rate.
    pub model_error_v: f64,
    /// Model error of a single reading along the OCV curve (fraction of SOC).
    pub soc_error: f64,
    /// If all readings during this time (s) are beyond the gate, the filter restarts from the voltage.
    pub lost_after_s: f64,
}

/// Check whether the innovations (measured minus predicted voltage) are as large as their variance says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConsistencySettings {
    /// Window of the consistency monitor (s).
    pub window_s: f64,
    /// An estimate is trusted if the mean of squared innovation divided by variance is at most this limit.
    pub limit: f64,
}
