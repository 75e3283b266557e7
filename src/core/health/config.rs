//! Settings of the learning at charge/discharge transitions. `config` checks their ranges.

/// Classification of the current as charge, rest or discharge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransitionConfig {
    /// |current| (per pack) at and below which the pack rests, A.
    pub dead_band_a: f64,
    /// A mode is left only when the current is this far beyond the dead band's edge, A.
    pub hysteresis_a: f64,
    /// Shortest duration of a mode, s.
    pub min_duration_s: f64,
    /// Half-cycles with less charge than this fraction of the rated capacity are joined to their neighbours.
    pub min_swing: f64,
}

/// Source of a half-cycle's capacity measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CapacityMethod {
    /// Charge over the SOC swing by the voltages, with a variance from the swing's uncertainty.
    Swing,
    /// As in the paper: charge / nominal swing, fixed measurement variance.
    Nominal {
        /// Assumed swing, fraction (paper: 0.6).
        swing: f64,
        /// Measurement variance, Ah^2 (paper: 0.1).
        variance_ah2: f64,
    },
}

/// The event-based capacity filter (A = C = 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CapacityConfig {
    /// Source of the measurement.
    pub method: CapacityMethod,
    /// Process noise: standard deviation gained per equivalent full cycle (Swing) or per event (Nominal), Ah.
    pub noise_ah_per_cycle: f64,
    /// Process noise of rest: standard deviation gained in a day without current (capacity recovers), Ah; at
    /// most one day counts per half-cycle. Not used by `Nominal`.
    pub noise_ah_per_rest_day: f64,
    /// Lasting error of the open-circuit curve at the ends of a half-cycle, V; `None` = half of the model's own error there. Not used by
    /// `Nominal`.
    pub end_error_v: Option<f64>,
    /// Standard deviation of the current sensor's gain: a floor under the capacity's uncertainty, fraction.
    pub current_gain_std: f64,
    /// Standard deviation of the current sensor's offset at the start, per cell, A; 0 = not learned. Not used by `Nominal`.
    pub current_offset_std_a: f64,
    /// Standard deviation of the fade at the start, Ah per full cycle; 0 = not learned. Not used by `Nominal`.
    pub fade_std_ah_per_cycle: f64,
    /// Process noise of the fade: standard deviation gained per equivalent full cycle, Ah per full cycle.
    pub fade_noise_ah_per_cycle: f64,
}

/// Recharge period that the alarm rule compares.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RechargeAlarm {
    /// Measured, with the actual charger.
    Raw,
    /// Computed for the reference charger.
    Normalised,
}

/// SOC window whose charging time is the recharge period.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RechargeConfig {
    /// Lower SOC, fraction (0.3).
    pub from_soc: f64,
    /// Upper SOC, fraction (0.9).
    pub to_soc: f64,
    /// Current of the reference charger per cell, A, positive.
    pub reference_current_a: f64,
    /// Part of the window that a charge must cover to report a normalised period, fraction.
    pub min_coverage: f64,
    /// Period that the alarm rule compares.
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
    /// A charge whose current has fallen to this (per cell, A) at the model's highest voltage ended full: the next usable
    /// capacity starts from its final SOC. Before the first such charge, from SOC 1.
    pub taper_current_a: f64,
}

/// Settings of the learning at transitions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HealthConfig {
    /// Mode detection.
    pub transition: TransitionConfig,
    /// Capacity filter.
    pub capacity: CapacityConfig,
    /// Recharge period.
    pub recharge: RechargeConfig,
    /// Capacity at which a cell is at the end of its life, Ah.
    pub end_of_life_ah: f64,
    /// Usable capacity; `None` = not reported.
    pub usable: Option<UsableConfig>,
}
