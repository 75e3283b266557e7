//! Settings for what is learned whenever the pack changes between charge and discharge: capacity, recharge period,
//! usable capacity. Each charge and each discharge is a half-cycle. The host's `config` module checks the ranges.

use super::OutlookConfig;

/// Settings for classifying the current as charge, rest or discharge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransitionConfig {
    /// The pack rests while |pack current| is at most this (A).
    pub dead_band_a: f64,
    /// Charge or discharge is entered only if the current exceeds the dead band by this much (A).
    pub hysteresis_a: f64,
    /// Minimum duration of a charge, rest or discharge (s).
    pub min_duration_s: f64,
    /// A half-cycle that moves less charge than this fraction of the rated capacity is merged with the next half-cycle.
    pub min_swing: f64,
}

/// How a half-cycle's charge gives a measurement of the capacity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CapacityMethod {
    /// Charge divided by the SOC swing that follows from the voltages; the variance follows from the uncertainty of the
    /// swing.
    Swing,
    /// As in the paper that packwatch follows: charge divided by a fixed nominal swing; the variance is also fixed.
    Nominal {
        /// Assumed swing, fraction (paper: 0.6).
        swing: f64,
        /// Measurement variance (Ah^2) (paper: 0.1).
        variance_ah2: f64,
    },
}

/// Settings of the capacity filter, a random walk that steps once per half-cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CapacityConfig {
    pub method: CapacityMethod,
    /// Process noise: standard deviation gained per equivalent full cycle (`Swing`) or per half-cycle (`Nominal`) (Ah).
    pub noise_ah_per_cycle: f64,
    /// Process noise of rest: standard deviation gained per day without current (Ah). Rest adds noise because capacity
    /// recovers during rest. At most one day per half-cycle counts. Not used by `Nominal`.
    pub noise_ah_per_rest_day: f64,
    /// Constant error of the open-circuit curve at the ends of a half-cycle (V). `None` = half of the error that the
    /// cell model states for these points. Not used by `Nominal`.
    pub end_error_v: Option<f64>,
    /// Standard deviation of the current sensor's gain, fraction. The relative standard deviation of a capacity never
    /// falls below this value.
    pub current_gain_std: f64,
    /// Initial standard deviation of the current sensor's offset per cell (A); 0 = the offset is not learned. Not used
    /// by `Nominal`.
    pub current_offset_std_a: f64,
    /// Initial standard deviation of the fade (Ah per full cycle); 0 = the fade is not learned. Not used by `Nominal`.
    pub fade_std_ah_per_cycle: f64,
    /// Process noise of the fade: standard deviation (Ah per full cycle) gained per equivalent full cycle.
    pub fade_noise_ah_per_cycle: f64,
}

/// Which recharge period the alarm rule uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RechargeAlarm {
    /// The raw period, measured with the actual charger.
    Raw,
    /// The normalised period, computed for the reference charger.
    Normalised,
}

/// SOC window whose charging time is the recharge period.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RechargeConfig {
    /// Lower SOC, fraction.
    pub from_soc: f64,
    /// Upper SOC, fraction.
    pub to_soc: f64,
    /// Current of the reference charger per cell (A), positive.
    pub reference_current_a: f64,
    /// If a charge covers less than this fraction of the window, the normalised period of the charge is not reported.
    pub min_coverage: f64,
    pub alarm_on: RechargeAlarm,
}

/// Load that defines the usable capacity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UsableConfig {
    /// Discharge current per cell (A).
    pub current_a: f64,
    /// Cell temperature (degrees C).
    pub temperature_c: f64,
    /// Voltage under load at which discharge ends (V).
    pub cutoff_v: f64,
    /// Charging current at the end of a full charge, per cell (A). A charge counts as full if the current falls to this
    /// value at the model's highest voltage. The usable capacity is then computed from the final SOC of that charge.
    /// Before the first full charge, the usable capacity is computed from SOC 1.
    pub taper_current_a: f64,
}

/// Settings for what is learned whenever the pack changes between charge and discharge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HealthConfig {
    pub transition: TransitionConfig,
    pub capacity: CapacityConfig,
    pub recharge: RechargeConfig,
    /// Capacity at which a cell is at the end of its life (Ah).
    pub end_of_life_ah: f64,
    /// Load for the usable capacity; `None` = the usable capacity is not computed.
    pub usable: Option<UsableConfig>,
    pub outlook: OutlookConfig,
}
