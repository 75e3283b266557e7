//! Settings for learning at charge/discharge transitions. `config` checks their ranges.

/// Classification of the current as charge, rest or discharge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransitionConfig {
    /// The pack rests while |pack current| is at most this, A.
    pub dead_band_a: f64,
    /// A new mode is entered only if the current exceeds the dead band by this much, A.
    pub hysteresis_a: f64,
    /// Shortest duration of a mode, s.
    pub min_duration_s: f64,
    /// A half-cycle that moves less charge than this fraction of the rated capacity is joined to the next one.
    pub min_swing: f64,
}

/// Source of a half-cycle's capacity measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CapacityMethod {
    /// Charge divided by the SOC swing from the voltages; the variance follows from the swing's uncertainty.
    Swing,
    /// As in the paper: charge divided by a nominal swing, with a fixed measurement variance.
    Nominal {
        /// Assumed swing, fraction (paper: 0.6).
        swing: f64,
        /// Measurement variance, Ah^2 (paper: 0.1).
        variance_ah2: f64,
    },
}

/// Settings of the capacity filter, a random walk that steps once per half-cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CapacityConfig {
    /// Source of the measurement.
    pub method: CapacityMethod,
    /// Process noise: standard deviation gained per equivalent full cycle (Swing) or per event (Nominal), Ah.
    pub noise_ah_per_cycle: f64,
    /// Process noise of rest: standard deviation gained in a day without current, Ah. Rest adds noise because capacity
    /// recovers. At most one day counts per half-cycle. Not used by `Nominal`.
    pub noise_ah_per_rest_day: f64,
    /// Constant error of the open-circuit curve at the ends of a half-cycle, V; `None` = half of the model's own error
    /// there. Not used by `Nominal`.
    pub end_error_v: Option<f64>,
    /// Standard deviation of the current sensor's gain, fraction: a lower bound on the capacity's relative
    /// uncertainty.
    pub current_gain_std: f64,
    /// Initial standard deviation of the current sensor's offset, per cell, A; 0 = not learned. Not used by `Nominal`.
    pub current_offset_std_a: f64,
    /// Initial standard deviation of the fade, Ah per full cycle; 0 = not learned. Not used by `Nominal`.
    pub fade_std_ah_per_cycle: f64,
    /// Process noise of the fade: standard deviation gained per equivalent full cycle, Ah per full cycle.
    pub fade_noise_ah_per_cycle: f64,
}

/// Recharge period that the alarm rule uses.
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
    /// Current of the reference charger per cell, A, positive.
    pub reference_current_a: f64,
    /// Part of the window that a charge must cover before its normalised period is reported, fraction.
    pub min_coverage: f64,
    /// Period that the alarm rule uses.
    pub alarm_on: RechargeAlarm,
}

/// Load that defines the usable capacity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UsableConfig {
    /// Discharge current per cell, A.
    pub current_a: f64,
    /// Cell temperature, degrees C.
    pub temperature_c: f64,
    /// Voltage under load at which discharge ends, V.
    pub cutoff_v: f64,
    /// Charging current at the end of a full charge, per cell, A. A charge counts as full if the current falls to this
    /// value at the model's highest voltage. The next usable capacity is then computed from the final SOC of that
    /// charge. Before the first full charge, it is computed from SOC 1.
    pub taper_current_a: f64,
}

/// Settings for learning at charge/discharge transitions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HealthConfig {
    /// Settings of the mode detection.
    pub transition: TransitionConfig,
    /// Settings of the capacity filter.
    pub capacity: CapacityConfig,
    /// Settings of the recharge period.
    pub recharge: RechargeConfig,
    /// Capacity at which a cell is at the end of its life, Ah.
    pub end_of_life_ah: f64,
    /// Load for the usable capacity; `None` = the usable capacity is not computed.
    pub usable: Option<UsableConfig>,
}
