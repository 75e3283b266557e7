//! State of the cell estimator outside its Kalman filter: duration of rest, recent load, consistency of the readings,
//! rejected readings, and the estimates that are kept when the filter restarts.
//!
//! In: steps (current in A, duration in s) and the results of the filter's updates. Out: the time that a reading
//! represents (s), the load (A), and whether the filter must restart. A gap is a time without a measured current.
//! Downtime is such a time during which the cell may have been used.

use serde::{Deserialize, Serialize};

use super::slow_branch::SlowBranch;
use super::state_vector::{KNOWN_VARIANCE, square, widened, within_bounds};
use super::step::{CellStep, Update};
use super::voltage_reach::reach_of_error;
use crate::cell::{CapacityState, CellModel, EstimatorConfig};
use crate::filter::{Measurement, ScalarGaussian};
use crate::quantity::InvalidState;
use crate::quantity::bounds::{self, Bounds};

/// If a load current flows before or after a gap, a load of at least 1 C (the rated capacity in one hour) is assumed
/// during the gap.
const GAP_LOAD_PER_H: f64 = 1.0;

/// Prior probability that a cell was used while the program did not run.
pub(super) const USED_PRIOR: f64 = 0.2;

/// Prior probability that a cell was used during a gap, if a load current flowed before or after the gap. It is equally
/// likely that the load continued and that it ended.
const LOADED_PRIOR: f64 = 0.5;

/// Prior probability that the cell was charged during a gap, if the gap lasted at least half a day and the cell rested
/// before and after it. Such a charge is rare, because charging causes bus traffic, which wakes the computer of
/// packwatch.
const CHARGER_PRIOR: f64 = 0.05;

/// A downtime is negligible if the standard deviation of the SOC change during the downtime is at most this value
/// (fraction).
const NEGLIGIBLE_STD: f64 = 0.002;

/// State of the estimator in addition to its filter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Memory {
    /// Capacity (Ah) that is used until the filter has its first voltage, and that is kept while the filter restarts.
    pub(super) capacity: ScalarGaussian,
    /// Capacity that selects the open-circuit curve of the aged cell (Ah).
    pub(super) curve: ScalarGaussian,
    pub(super) log_resistance: ScalarGaussian,
    pub(super) temperature_c: Option<f64>,
    pub(super) last_current_a: f64,
    /// |current| (A) after a low-pass filter with the time constant `load_memory_s`: the load that still drives slow
    /// diffusion.
    pub(super) load_a: f64,
    /// Mean normalised innovation squared over the consistency window.
    pub(super) mean_nis: f64,
    /// Innovation of the last accepted reading since the filter's start (V).
    pub(super) innovation_v: f64,
    /// Time that the next voltage reading represents (s): the time since the last used reading. A long rest counts
    /// less.
    pub(super) information_s: f64,
    pub(super) rest_s: f64,
    /// Information about the current sensor's offset since its last correction: sum of d^2 / R. d is the effect of one
    /// standard deviation of the offset on an innovation. R is the variance of the innovation without this effect.
    pub(super) offset_information: f64,
    /// Evidence about the current sensor's offset from the same voltages: sum of d x innovation / R.
    pub(super) offset_score: f64,
    pub(super) slow_branch: SlowBranch,
    /// Standard deviation of the SOC change (fraction) during downtime, until a voltage is used.
    pub(super) downtime_std: f64,
    /// Part of the next unmeasured time that has already been noted as downtime (s).
    pub(super) noted_s: f64,
    pub(super) used_prior: f64,
    /// Whether the current was unknown at the last reading.
    pub(super) is_current_unknown: bool,
    /// While the current is unknown: SOC according to the latest voltage alone.
    #[serde(default)]
    pub(super) by_voltage: Option<ScalarGaussian>,
    /// Whether no voltage has been used since the last sleep or unknown gap.
    pub(super) is_unseen: bool,
    /// After a gap of unknown length, the SOC is unknown, and the filter restarts from the next voltage.
    pub(super) is_soc_unknown: bool,
    pub(super) rejected: u32,
    /// Duration of the run of rejected readings (s).
    pub(super) rejected_s: f64,
    /// Whether the run of rejected readings started after a gap. If so, the gap is the cause and not the sensor.
    pub(super) rejected_after_gap: bool,
}

impl Memory {
    pub(super) fn new(config: &EstimatorConfig) -> Self {
        let (capacity, log_resistance) = configured(config);
        Self {
            capacity,
            curve: config.initial.curve,
            log_resistance,
            temperature_c: None,
            last_current_a: 0.0,
            load_a: 0.0,
            mean_nis: 0.0,
            innovation_v: 0.0,
            information_s: config.voltage.max_information_s,
            rest_s: 0.0,
            offset_information: 0.0,
            offset_score: 0.0,
            slow_branch: SlowBranch::default(),
            downtime_std: 0.0,
            noted_s: 0.0,
            used_prior: 0.0,
            is_current_unknown: false,
            by_voltage: None,
            is_unseen: false,
            is_soc_unknown: false,
            rejected: 0,
            rejected_s: 0.0,
            rejected_after_gap: false,
        }
    }

    /// Adds a downtime. `used`: probability that the cell was used. `most`: maximum SOC change (fraction).
    pub(super) fn note_downtime(&mut self, most: f64, used: f64) {
        self.downtime_std = (self.downtime_std + most / 3.0_f64.sqrt()).min(1.0);
        self.used_prior = 1.0 - (1.0 - self.used_prior) * (1.0 - used);
        self.by_voltage = None;
    }

    /// The published SOC, given the `soc` of the filter. Downtime raises the variance. While the current is unknown,
    /// the latest voltage also counts. The filter does not use this voltage: all readings contain the same unknown
    /// current, so their errors do not average out. A voltage without a current cannot make the SOC more certain than
    /// it was when the current was last known.
    pub(super) fn published(&self, soc: ScalarGaussian) -> ScalarGaussian {
        let known = soc.variance;
        let variance = self.downtime_std_if_any().map_or(known, |std| widened(known, square(std)));
        let mut soc = within_bounds(ScalarGaussian { variance, ..soc });
        if let Some(by_voltage) = self.by_voltage {
            soc.update(Measurement { value: by_voltage.mean, variance: by_voltage.variance });
            soc.variance = soc.variance.max(known);
        }
        soc
    }

    /// Determines the SOC from the voltage of a step without a known current. The unknown current is at most the last
    /// known current, or [`GAP_LOAD_PER_H`] if that is larger. All currents up to this limit, in both directions, are
    /// equally likely. `log_resistance`: ln of the resistance relative to a new cell.
    pub(super) fn note_voltage(
        &mut self,
        model: &CellModel,
        config: &EstimatorConfig,
        step: &CellStep,
        log_resistance: f64,
    ) {
        if step.is_voltage_frozen {
            self.by_voltage = None;
        }
        if step.is_voltage_frozen || step.unmeasured_s <= 0.0 {
            return;
        }
        let temperature = model.temperature_position(step.temperature_c.unwrap_or(step.ambient_c));
        let mean = model.soc_of_aged_ocv(&temperature, self.curve.mean, step.voltage_v).clamp(0.0, 1.0);
        let ohm = model.settled_ohm(&model.grid_position_at(&temperature, mean)) * libm::exp(log_resistance);
        let most_a = self.last_current_a.abs().max(model.rated_capacity_ah * GAP_LOAD_PER_H);
        let voltage_variance =
            square(config.sensor.voltage_offset_v) + square(config.gate.model_error_v) + square(most_a * ohm) / 3.0;
        let std = reach_of_error(model, &temperature, self.curve.mean, (mean, voltage_variance.sqrt()));
        self.by_voltage = Some(ScalarGaussian { mean, variance: square(std).max(KNOWN_VARIANCE) });
    }

    /// Notes the unmeasured time of a step. The load before or after this time may have continued, or a charger may
    /// have been connected. The next voltage with a known current decides whether this happened.
    ///
    /// If the current is known before and after the unmeasured time and the possible change of the SOC is negligible,
    /// no downtime is noted. The standard deviation of the change (fraction of SOC) is returned instead.
    pub(super) fn note_gap(&mut self, config: &EstimatorConfig, step: &CellStep, capacity_ah: f64) -> f64 {
        let noted_s = std::mem::take(&mut self.noted_s).min(step.unmeasured_s);
        let is_unknown = step.current_a.is_none() && step.unmeasured_s > 0.0;
        let continues = self.is_current_unknown || is_unknown;
        self.is_current_unknown = is_unknown;
        let adjacent_a = self.gap_load_a(config, step);
        let is_loaded = adjacent_a > config.gap.rest_current_a;
        let unnoted_s = step.unmeasured_s - noted_s;
        if is_silent_rest(config, step) {
            return 0.0;
        }
        let load_per_s = if is_loaded { adjacent_a / (3600.0 * capacity_ah) } else { 0.0 };
        let away_per_s = config.gap.away_use_per_s;
        // If only the current is missing and the cell still reports its voltage, the cell may be used at any time. In a
        // gap shorter than an hour without any reading, no use is assumed, because slow relaxation of the voltage would
        // be mistaken for a charge.
        let use_per_s = if continues || unnoted_s >= 3600.0 { away_per_s } else { 0.0 };
        let most = load_per_s.max(use_per_s) * step.unmeasured_s - away_per_s * noted_s;
        if most <= 0.0 {
            return 0.0;
        }
        let std = most / 3.0_f64.sqrt();
        if std <= NEGLIGIBLE_STD && !continues {
            return std;
        }
        let used_at_rest = CHARGER_PRIOR * (unnoted_s / 43_200.0).min(1.0);
        let used = if is_loaded { LOADED_PRIOR } else { used_at_rest };
        if continues {
            // Consecutive steps without a known current count as one gap with one constant unknown current, so the
            // standard deviation of the SOC change grows linearly.
            self.downtime_std = (self.downtime_std + std).min(1.0);
            self.used_prior = self.used_prior.max(used.max(USED_PRIOR));
        } else {
            self.note_downtime(most, if noted_s > 0.0 { 0.0 } else { used });
        }
        0.0
    }

    /// The load (A) before or after a step's gap, whichever is larger. 0 if the cell counts as resting in the gap.
    fn gap_load_a(&self, config: &EstimatorConfig, step: &CellStep) -> f64 {
        if is_silent_rest(config, step) {
            return 0.0;
        }
        self.last_current_a.abs().max(step.current_a.unwrap_or(0.0).abs())
    }

    /// Updates load and rest for the unmeasured time of a step, which follows the measured time. If a load flows before
    /// or after the gap, the gap counts as a load of at least 1 C.
    pub(super) fn pass_gap(&mut self, model: &CellModel, config: &EstimatorConfig, step: &CellStep) {
        self.rest_s = 0.0;
        self.load_a *= libm::exp(-step.unmeasured_s / config.voltage.load_memory_s);
        let adjacent_a = self.gap_load_a(config, step);
        if adjacent_a > config.gap.rest_current_a {
            self.load_a = self.load_a.max(adjacent_a).max(model.rated_capacity_ah * GAP_LOAD_PER_H);
        }
    }

    /// Standard deviation of the SOC change during downtime since the last used voltage; `None` if it is negligible.
    #[inline]
    pub(super) fn downtime_std_if_any(&self) -> Option<f64> {
        (self.downtime_std > NEGLIGIBLE_STD).then_some(self.downtime_std)
    }

    /// Ends the uncertainty about the downtime, because a voltage has shown whether the cell was used.
    #[inline]
    pub(super) fn end_downtime(&mut self) {
        (self.downtime_std, self.used_prior, self.noted_s, self.is_unseen) = (0.0, 0.0, 0.0, false);
        self.by_voltage = None;
    }

    /// Whether the SOC dates from before a downtime or sleep, because no voltage has been used since.
    #[inline]
    pub(super) fn is_carried_over(&self) -> bool {
        self.is_unseen || self.downtime_std_if_any().is_some()
    }

    /// Adds an update to the run of rejected readings and to the consistency monitor (exponentially weighted mean of
    /// the normalised innovation squared).
    #[inline]
    pub(super) fn record_update(&mut self, config: &EstimatorConfig, step: &CellStep, update: &Update) {
        let elapsed_s = step.measured_s + step.unmeasured_s;
        let forget = -libm::expm1(-elapsed_s.max(1e-3) / config.consistency.window_s);
        self.mean_nis += forget * (update.test_ratio - self.mean_nis);
        if update.accepted {
            self.innovation_v = update.innovation;
            (self.information_s, self.rejected, self.rejected_s) = (0.0, 0, 0.0);
        } else {
            // The run starts at the first rejected reading.
            if self.rejected == 0 {
                (self.rejected_s, self.rejected_after_gap) = (0.0, step.unmeasured_s > 0.0);
            } else {
                self.rejected_s += elapsed_s;
            }
            self.rejected = self.rejected.saturating_add(1);
        }
    }

    /// Whether the filter must restart, because too many consecutive readings were rejected (their innovations were
    /// beyond the gate).
    #[inline]
    pub(super) fn has_lost_cell(&self, config: &EstimatorConfig) -> bool {
        // One or two readings can be outliers.
        let long_enough = self.rejected >= 3 && self.rejected_s >= config.gate.lost_after_s;
        // After a gap, the counted charge is incomplete, so two readings suffice.
        long_enough || (self.rejected_after_gap && self.rejected >= 2)
    }

    /// Resets an unusable capacity or resistance to its configured value. Otherwise, the filter would restart at every
    /// reading.
    pub(super) fn reset_unusable(&mut self, config: &EstimatorConfig) {
        let (capacity, log_resistance) = configured(config);
        let is_usable = |x: &ScalarGaussian, bounds: Bounds| {
            bounds.has(x.mean) && (KNOWN_VARIANCE * KNOWN_VARIANCE..=bounds::NUMBER.high).contains(&x.variance)
        };
        if !is_usable(&self.capacity, bounds::CAPACITY_AH) {
            self.capacity = capacity;
        }
        if !is_usable(&self.log_resistance, bounds::LOG_RESISTANCE) {
            self.log_resistance = log_resistance;
        }
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        InvalidState::unless_capacity("the capacity a cell's reset keeps", self.capacity.mean)?;
        check_log_resistance(self.log_resistance.mean)?;
        InvalidState::unless_capacity("the capacity of a cell's open-circuit curve", self.curve.mean)?;
        InvalidState::unless_natural("its variance", self.curve.variance)?;
        for variance in [self.capacity.variance, self.log_resistance.variance] {
            InvalidState::unless_positive("a variance a cell's reset keeps", variance)?;
        }
        let signed = [self.temperature_c.unwrap_or(0.0), self.last_current_a, self.innovation_v, self.offset_score];
        InvalidState::unless_numbers("a cell's last temperature, current or innovation, or its offset", signed)?;
        bounds::TEMPERATURE_C.check_all("a cell's last temperature", self.temperature_c)?;
        bounds::CURRENT_A.check("a cell's last current", self.last_current_a)?;
        InvalidState::unless_natural("the information about a current's offset", self.offset_information)?;
        if let Some(soc) = self.by_voltage {
            bounds::STORED_SOC.check("a cell's SOC by voltage", soc.mean)?;
            InvalidState::unless_positive("the variance of a cell's SOC by voltage", soc.variance)?;
        }
        self.slow_branch.check()?;
        InvalidState::unless(
            (0.0..=1.0).contains(&self.used_prior),
            "the probability of use in a gap",
            self.used_prior,
            "0 to 1",
        )?;
        let natural = [
            self.load_a,
            self.mean_nis,
            self.information_s,
            self.rest_s,
            self.downtime_std,
            self.noted_s,
            self.rejected_s,
        ];
        InvalidState::unless_naturals("a cell's load, consistency or a time", natural)
    }
}

fn is_silent_rest(config: &EstimatorConfig, step: &CellStep) -> bool {
    // If the current has not been measured for more than 5 s, the bus counts as silent.
    config.gap.silence_is_rest && step.unmeasured_s > 5.0
}

pub(super) fn check_log_resistance(log_resistance: f64) -> Result<(), InvalidState> {
    bounds::LOG_RESISTANCE.check("ln of a cell's resistance ratio", log_resistance)
}

fn configured(config: &EstimatorConfig) -> (ScalarGaussian, ScalarGaussian) {
    let capacity_variance = match config.capacity_state {
        CapacityState::Joint => square(config.initial.capacity_std_ah),
        CapacityState::Held => KNOWN_VARIANCE,
    };
    let log_variance = square(config.initial.log_resistance_std);
    (
        ScalarGaussian { mean: config.initial.capacity_ah, variance: capacity_variance.max(KNOWN_VARIANCE) },
        ScalarGaussian { mean: 0.0, variance: log_variance.max(KNOWN_VARIANCE) },
    )
}

#[cfg(test)]
mod tests;
