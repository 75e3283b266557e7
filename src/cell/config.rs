//! Settings of the per-cell estimator.

/// How the circuit's equations are stepped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Discretisation {
    /// exp(-dt/RC): exact for a current constant over the step.
    Exact,
    /// Forward Euler, as the paper.
    Euler,
}

/// Whether the sample-by-sample filter carries the capacity as a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CapacityState {
    /// Estimated with the SOC, so that their correlation is known.
    Joint,
    /// Held at the last learned value, as the paper.
    Held,
}

/// Checked settings of the estimator. Noises are densities: per square root of a second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EstimatorConfig {
    /// Sigma point spread alpha, (0, 1].
    pub alpha: f64,
    /// Prior knowledge of the distribution, 2 for Gaussian.
    pub beta: f64,
    /// Secondary scaling.
    pub kappa: f64,
    /// Exact or Euler.
    pub discretisation: Discretisation,
    /// Joint or held capacity.
    pub capacity_state: CapacityState,
    /// SOC to start from; `None` = from the first voltage through the OCV curve.
    pub initial_soc: Option<f64>,
    /// Standard deviation of the first SOC, fraction.
    pub initial_soc_std: f64,
    /// Standard deviation of the first branch voltages, V.
    pub initial_branch_std_v: f64,
    /// Capacity to start from, Ah.
    pub initial_capacity_ah: f64,
    /// Its standard deviation, Ah.
    pub initial_capacity_std_ah: f64,
    /// Standard deviation of ln(resistance relative to new) at the start.
    pub initial_log_resistance_std: f64,
    /// SOC process noise, fraction per sqrt(s).
    pub soc_noise_per_sqrt_s: f64,
    /// Branch voltage process noise, V per sqrt(s).
    pub branch_noise_v_per_sqrt_s: f64,
    /// ln(resistance) process noise, per sqrt(s).
    pub log_resistance_noise_per_sqrt_s: f64,
    /// White part of a voltage reading's error, V (sensor noise), per sample.
    pub voltage_noise_v: f64,
    /// Slow model error expressed as information per second: standard deviation of a 1 s average, V.
    pub model_error_v_sqrt_s: f64,
    /// Standard deviation of a constant current-sensor offset, A per cell.
    pub current_offset_std_a: f64,
    /// Current assumed possible in a gap nobody measured, standard deviation, A per cell.
    pub gap_current_std_a: f64,
    /// A voltage innovation beyond this many standard deviations moves nothing.
    pub gate_sigma: f64,
    /// Window of the consistency monitor, s.
    pub consistency_window_s: f64,
    /// Mean normalised innovation squared above which the estimate is not to be trusted.
    pub consistency_limit: f64,
}
