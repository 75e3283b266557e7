//! Settings of the per-cell estimator. `config` checks their ranges; the estimator uses them as they are.

use crate::filter::ScalarGaussian;

/// How the circuit's equations are stepped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Discretisation {
    /// exp(-dt/RC): exact for a current constant over the step.
    Exact,
    /// Forward Euler, as in the paper.
    Euler,
}

/// Whether the sample-by-sample filter carries the capacity as a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CapacityState {
    /// Estimated with the SOC, so that their correlation is known.
    Joint,
    /// Held at the last learned value, as in the paper.
    Held,
}

/// Checked settings of the estimator. Noises are densities: per square root of a second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EstimatorConfig {
    /// Spread of the sigma points.
    pub points: SigmaPointSettings,
    /// Exact or Euler.
    pub discretisation: Discretisation,
    /// Joint or held capacity.
    pub capacity_state: CapacityState,
    /// State of a cell without any history.
    pub initial: InitialState,
    /// Noise of the states while the current is measured.
    pub process: ProcessNoise,
    /// Possible change of the SOC without measurement.
    pub gap: GapSettings,
    /// Error of a voltage reading against the cell model.
    pub voltage: VoltageError,
    /// Constant errors of the sensors.
    pub sensor: SensorErrors,
    /// Rejection of outliers.
    pub gate: GateSettings,
    /// Check of the innovations against their covariance.
    pub consistency: ConsistencySettings,
}

/// Spread and weights of the sigma points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SigmaPointSettings {
    /// Sigma point spread alpha, (0, 1].
    pub alpha: f64,
    /// Prior knowledge of the distribution, 2 for Gaussian.
    pub beta: f64,
    /// Secondary scaling.
    pub kappa: f64,
}

/// State that a filter starts from, with its uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InitialState {
    /// SOC to start from; `None` = from the first voltage through the OCV curve.
    pub soc: Option<f64>,
    /// Standard deviation of the first SOC, fraction.
    pub soc_std: f64,
    /// Standard deviation of the first branch voltages, V.
    pub branch_std_v: f64,
    /// Capacity to start from, Ah.
    pub capacity_ah: f64,
    /// Its standard deviation, Ah.
    pub capacity_std_ah: f64,
    /// Capacity of the open-circuit curve before the first half-cycle, Ah.
    pub curve: ScalarGaussian,
    /// Standard deviation of ln(resistance relative to new) at the start.
    pub log_resistance_std: f64,
}

/// Densities of the process noise while the current is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProcessNoise {
    /// SOC process noise, fraction per sqrt(s).
    pub soc_per_sqrt_s: f64,
    /// SOC process noise per charge moved, fraction per sqrt(SOC): errors of the current reading.
    pub charge_per_sqrt_soc: f64,
    /// Branch voltage process noise, V per sqrt(s).
    pub branch_v_per_sqrt_s: f64,
    /// ln(resistance) process noise, per sqrt(s).
    pub log_resistance_per_sqrt_s: f64,
}

/// Possible change of the SOC while the current is not measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GapSettings {
    /// SOC process noise while the current is not measured, fraction per sqrt(s).
    pub noise_per_sqrt_s: f64,
    /// Largest self-discharge, fraction of SOC per s.
    pub self_discharge_per_s: f64,
    /// Largest rate at which the cell may be used or charged while the program does not run, fraction of SOC per s.
    pub away_use_per_s: f64,
    /// A current above this next to a gap may have continued through the gap; below it the cell rested. A per cell.
    pub rest_current_a: f64,
    /// Whether the cell rested in every longer gap without any reading, whatever the current next to it.
    pub silence_is_rest: bool,
}

/// Error of a voltage reading against the cell model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoltageError {
    /// White part of a voltage reading's error, V (sensor noise), per sample.
    pub noise_v: f64,
    /// Slow model error as information per second: standard deviation of a 1 s average, V. Used where the cell model
    /// states no error of its own.
    pub model_error_v_sqrt_s: f64,
    /// Model error in proportion to the voltage drop in the cell at the reading: fraction of it, over one second.
    pub drop_error_sqrt_s: f64,
    /// Model error in proportion to the voltage that the load of the last minutes drops in the cell, over one second.
    pub load_error_sqrt_s: f64,
    /// Time constant of the model error after its load has ended (slow diffusion), s.
    pub load_memory_s: f64,
    /// Longest time that one voltage reading stands for, s: readings further apart count no more than this.
    pub max_information_s: f64,
}

/// Constant errors of the sensors: standard deviations. The filter considers them, so that they never average out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorErrors {
    /// Offset of a cell's voltage, V, with that of its open-circuit curve against the model.
    pub voltage_offset_v: f64,
    /// Offset of the current, per cell, A, as far as it has not been learned.
    pub current_offset_a: f64,
    /// Gain error of the current, fraction.
    pub current_gain: f64,
    /// Error of the slowest branch's resistance in the model, beside that of all resistances, as far as it has not been
    /// learned: fraction.
    pub slow_branch: f64,
}

impl SensorErrors {
    /// Sensors without constant errors, as in the paper.
    pub const NONE: Self = Self { voltage_offset_v: 0.0, current_offset_a: 0.0, current_gain: 0.0, slow_branch: 0.0 };
}

/// Rejection of outliers among the voltage readings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateSettings {
    /// Gate: a voltage innovation beyond this many standard deviations is rejected.
    pub sigma: f64,
    /// Model error of a single reading, V (standard deviation). Used by the gate and the consistency monitor, where the
    /// information-per-second variance would accept every reading at high sample rates.
    pub model_error_v: f64,
    /// Model error of a single reading along the OCV curve, fraction of SOC.
    pub soc_error: f64,
    /// The filter restarts from the voltage after every reading has been beyond the gate for this time, s.
    pub lost_after_s: f64,
}

/// Check of the innovations against their covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConsistencySettings {
    /// Window of the consistency monitor, s.
    pub window_s: f64,
    /// Mean normalised innovation squared above which the estimate is not trusted.
    pub limit: f64,
}
