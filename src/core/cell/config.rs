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
    /// SOC process noise per charge moved, fraction per sqrt(SOC): errors of the current reading.
    pub charge_noise_per_sqrt_soc: f64,
    /// Branch voltage process noise, V per sqrt(s).
    pub branch_noise_v_per_sqrt_s: f64,
    /// ln(resistance) process noise, per sqrt(s).
    pub log_resistance_noise_per_sqrt_s: f64,
    /// SOC process noise while nobody measures the current, fraction per sqrt(s).
    pub gap_noise_per_sqrt_s: f64,
    /// What the cell may lose by itself, fraction of SOC per s.
    pub self_discharge_per_s: f64,
    /// What may be taken out or charged while the program does not run, fraction of SOC per s.
    pub away_use_per_s: f64,
    /// A current beyond this beside a gap may have gone on in it; below it the cell was left alone. A per cell.
    pub rest_current_a: f64,
    /// White part of a voltage reading's error, V (sensor noise), per sample.
    pub voltage_noise_v: f64,
    /// Slow model error expressed as information per second: standard deviation of a 1 s average, V. Holds where the
    /// cell model has no error of its own.
    pub model_error_v_sqrt_s: f64,
    /// The same in proportion to the voltage lost in the cell at the reading: fraction of it, over one second.
    pub drop_error_sqrt_s: f64,
    /// The same in proportion to the voltage the load of the last minutes drops in the cell.
    pub load_error_sqrt_s: f64,
    /// How long the model's error outlives the load that made it (slow diffusion), s.
    pub load_memory_s: f64,
    /// Longest time one voltage reading may speak for, s: readings further apart are no better than this.
    pub max_information_s: f64,
    /// A voltage innovation beyond this many standard deviations moves nothing.
    pub gate_sigma: f64,
    /// Model error a single reading may show, V (standard deviation): for the gate and the consistency monitor,
    /// where the information-per-second variance would let anything through at high sample rates.
    pub gate_model_error_v: f64,
    /// The same as an error along the OCV curve, fraction of SOC.
    pub gate_soc_error: f64,
    /// When every reading has been beyond the gate for this long, the filter has lost its cell and starts again, s.
    pub lost_after_s: f64,
    /// Window of the consistency monitor, s.
    pub consistency_window_s: f64,
    /// Mean normalised innovation squared above which the estimate is not to be trusted.
    pub consistency_limit: f64,
}
