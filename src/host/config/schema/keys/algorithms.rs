//! The tables of the algorithms: cell filter, transitions, capacity, recharge, usable capacity. Each gives the parameters
//! of its algorithm; what a key means where it is not written stands next to the key.

use super::choices::{DEVIATION, MethodKey, TEMPERATURE_C};
use crate::cell::{
    CapacityState, CellModel, ConsistencySettings, Discretisation, EstimatorConfig, GapSettings, GateSettings,
    InitialState, ModelSpread, ProcessNoise, SensorErrors, SigmaPointSettings, VoltageError,
};
use crate::config::schema::key::Presence::{Default, Optional, Required};
use crate::config::schema::key::ValueRange::{Above, Any, Between};
use crate::config::schema::key::within;
use crate::config::schema::section::section;
use crate::filter::ScalarGaussian;
use crate::health::{CapacityConfig, CapacityMethod, RechargeAlarm, RechargeConfig, TransitionConfig, UsableConfig};
use crate::quantity::bounds;

/// Standard deviation of the capacity that a cell may have lost before its first half-cycle, part of the new cell's: its
/// open-circuit curve is that of a new one until then.
const FIRST_LOSS_STD: f64 = 0.03;

section! {
    /// The unscented Kalman filter of each cell. Noises are densities, per square root of a second, so that the sample rate does not change the result.
    Estimator at "estimator" {
        /// Spread of the sigma points.
        alpha: f64, "", within(bounds::SIGMA_POINT_SPREAD), Default("1.0");
        /// Prior knowledge of the distribution; 2 for a Gaussian one.
        beta: f64, "", Between(0.0, 10.0), Default("2.0");
        /// Secondary scaling of the sigma points.
        kappa: f64, "", Between(0.0, 10.0), Default("0.0");
        /// How the circuit is stepped: exactly, or by forward Euler as in the paper.
        discretisation: Discretisation, "", Any, Default("\"exact\"");
        /// Whether the filter carries the capacity as a state ("joint", with method "swing"), or uses the learned one as in the paper ("held", with method "nominal").
        capacity_state: CapacityState, "", Any, Default("\"joint\"");
        /// SOC to start from. Without it: from the first voltage through the open-circuit voltage curve.
        initial_soc: Option<f64>, "fraction", Between(0.0, 1.0), Optional;
        /// Standard deviation of the first SOC.
        initial_soc_std: f64, "fraction", Above(0.0, 1.0), Default("0.3");
        /// Standard deviation of the first branch voltages.
        initial_branch_std_v: f64, "V", Between(0.0, 10.0), Default("0.05");
        /// Standard deviation of the logarithm of the resistance relative to new, at the start. Without it: 0.2, or what the cell model states for its cells.
        initial_log_resistance_std: Option<f64>, "", Between(0.0, 5.0), Optional;
        /// Process noise of the SOC.
        soc_noise_per_sqrt_s: f64, "fraction/sqrt(s)", DEVIATION, Default("3e-5");
        /// Process noise of the SOC per charge moved: errors of the current reading.
        charge_noise_per_sqrt_soc: f64, "fraction/sqrt(SOC)", DEVIATION, Default("3e-3");
        /// Process noise of the branch voltages.
        branch_noise_v_per_sqrt_s: f64, "V/sqrt(s)", DEVIATION, Default("1e-3");
        /// Process noise of the logarithm of the resistance: how fast a cell may age, and how far its resistance may be from the tables in the cold or in the next minutes of a drive.
        log_resistance_noise_per_sqrt_s: f64, "1/sqrt(s)", DEVIATION, Default("1e-3");
        /// Process noise of the SOC while no current is measured (asleep).
        gap_noise_per_sqrt_s: f64, "fraction/sqrt(s)", DEVIATION, Default("1.5e-5");
        /// Self-discharge of a cell in a month: the deviation of the SOC grows with the time without measurement (asleep, off).
        self_discharge_per_month: f64, "fraction", Between(0.0, 1.0), Default("0.03");
        /// Charge or discharge that is possible in an hour while the program does not run. The first voltage after that time shows whether it happened; until then the deviation of the SOC covers it. 0: the cells are certainly not used.
        away_use_per_h: f64, "fraction", Between(0.0, 100.0), Default("0.5");
        /// A current up to this is rest; a larger one next to a gap may have flowed through all of it. Without it: the rated capacity over 50 h (C/50), per cell.
        rest_current_a: Option<f64>, "A", Between(0.0, 1e6), Optional;
        /// Whether a silent bus means zero current: in more than five seconds between two voltages of a cell without any current it rested, whatever the current before and after; its voltage must come more often. False: a load next to the gap may have continued through it, and a charger may have come.
        silence_is_rest: bool, "", Any, Default("false");
        /// Standard deviation of the voltage sensor's noise. Where the signals have coarser steps than this, their rounding is added: 5.8 mV for steps of 20 mV.
        voltage_noise_v: f64, "V", within(bounds::VOLTAGE_NOISE_V), Default("0.005");
        /// Standard deviation of the voltage sensor's offset, together with that of the cell's open-circuit curve against the model's. It never averages out. What a cell model states for its cells is added.
        voltage_offset_std_v: f64, "V", DEVIATION, Default("0.004");
        /// Standard deviation of the slowest branch's resistance in a cell, relative to the model's: diffusion varies between cells and ages apart from the other resistances. In a model with several branches it is learned. Without it: what the cell model states for its cells, else 0.2, and 0.1 in a model with one branch.
        slow_branch_std: Option<f64>, "fraction", DEVIATION, Optional;
        /// Slow error of the cell model: standard deviation of its average over one second. More samples per second add no information beyond this. A `voltage_error_v` of the cell model replaces it.
        model_error_v_sqrt_s: f64, "V sqrt(s)", DEVIATION, Default("0.15");
        /// Slow error of the cell model, relative to the voltage dropped in the cell at the reading: standard deviation of its average over one second.
        drop_error_sqrt_s: f64, "sqrt(s)", DEVIATION, Default("0.3");
        /// Slow error of the cell model under load, relative to the voltage that the load of the last minutes drops in the cell: standard deviation of its average over one second.
        load_error_sqrt_s: f64, "sqrt(s)", DEVIATION, Default("0.5");
        /// Time constant with which that error decays after the load (slow diffusion).
        load_memory_s: f64, "s", Above(0.0, 1e6), Default("1200.0");
        /// Longest time that one voltage reading may represent: readings further apart carry no more information.
        max_information_s: f64, "s", Between(0.001, 1e6), Default("100.0");
        /// A voltage further from its prediction than this many standard deviations changes no estimate.
        gate_sigma: f64, "", Above(0.0, 1e6), Default("5.0");
        /// Standard deviation of the cell model's error in a single reading, for the gate and the consistency monitor.
        gate_model_error_v: f64, "V", Between(0.0, 10.0), Default("0.06");
        /// The same as an error along the open-circuit voltage curve.
        gate_soc_error: f64, "fraction", Between(0.0, 1.0), Default("0.02");
        /// When every reading has been beyond the gate for this long, the filter starts again from the voltage.
        lost_after_s: f64, "s", Above(0.0, 1e9), Default("30.0");
        /// Window over which the filter's consistency is judged.
        consistency_window_s: f64, "s", Above(0.0, 1e9), Default("600.0");
        /// Mean normalised innovation squared above which an estimate is not to be trusted (1 = as expected). The mismatch of a cell model is stated in parts of it.
        consistency_limit: f64, "", Above(0.0, 1e9), Default("4.0");
    }
}

impl Estimator {
    /// Standard deviation of the rounding to steps of the voltage, V (uniform: step / sqrt 12). Steps within the sensor's
    /// noise are part of it.
    pub(crate) fn rounding_v(&self, step_v: f64) -> f64 {
        if step_v > self.voltage_noise_v { step_v / 12.0_f64.sqrt() } else { 0.0 }
    }

    /// The parameters these keys stand for; `initial_ah` is the capacity to start from and its deviation, where they are given,
    /// `voltage_step_v` the resolution of the cells' voltages.
    pub(crate) fn config(
        &self,
        (initial_ah, initial_std_ah): (Option<f64>, Option<f64>),
        model: &CellModel,
        capacity: &CapacityConfig,
        voltage_step_v: f64,
    ) -> EstimatorConfig {
        let rounding_v = self.rounding_v(voltage_step_v);
        let initial_ah = initial_ah.unwrap_or(model.capacity_ah);
        let spread = model.spread.unwrap_or(ModelSpread::usual(model.branches.len()));
        EstimatorConfig {
            points: SigmaPointSettings { alpha: self.alpha, beta: self.beta, kappa: self.kappa },
            discretisation: self.discretisation,
            capacity_state: self.capacity_state,
            initial: InitialState {
                soc: self.initial_soc,
                soc_std: self.initial_soc_std,
                branch_std_v: self.initial_branch_std_v,
                capacity_ah: initial_ah,
                capacity_std_ah: initial_std_ah.unwrap_or(spread.capacity * initial_ah),
                curve: match self.capacity_state {
                    CapacityState::Joint => {
                        ScalarGaussian::from_std(model.capacity_ah, FIRST_LOSS_STD * model.capacity_ah)
                    }
                    CapacityState::Held => ScalarGaussian::from_std(initial_ah, 0.0),
                },
                log_resistance_std: self.initial_log_resistance_std.unwrap_or(spread.log_resistance),
            },
            process: ProcessNoise {
                soc_per_sqrt_s: self.soc_noise_per_sqrt_s,
                charge_per_sqrt_soc: self.charge_noise_per_sqrt_soc,
                branch_v_per_sqrt_s: self.branch_noise_v_per_sqrt_s,
                log_resistance_per_sqrt_s: self.log_resistance_noise_per_sqrt_s,
            },
            gap: GapSettings {
                noise_per_sqrt_s: self.gap_noise_per_sqrt_s,
                // A month of 365.25 / 12 days.
                self_discharge_per_s: self.self_discharge_per_month / 2_629_800.0,
                away_use_per_s: self.away_use_per_h / 3600.0,
                rest_current_a: self.rest_current_a.unwrap_or(model.rated_capacity_ah / 50.0),
                silence_is_rest: self.silence_is_rest,
            },
            voltage: VoltageError {
                noise_v: self.voltage_noise_v.hypot(rounding_v),
                model_error_v_sqrt_s: self.model_error_v_sqrt_s,
                drop_error_sqrt_s: self.drop_error_sqrt_s.hypot(spread.drop_sqrt_s),
                load_error_sqrt_s: self.load_error_sqrt_s.hypot(spread.drop_sqrt_s),
                load_memory_s: self.load_memory_s,
                max_information_s: self.max_information_s,
            },
            sensor: match self.capacity_state {
                CapacityState::Joint => SensorErrors {
                    // At rest all readings are rounded alike.
                    voltage_offset_v: self.voltage_offset_std_v.hypot(rounding_v).hypot(spread.curve_v),
                    current_offset_a: capacity.current_offset_std_a,
                    current_gain: capacity.current_gain_std,
                    slow_branch: self.slow_branch_std.unwrap_or(spread.slow_branch),
                },
                CapacityState::Held => SensorErrors::NONE,
            },
            gate: GateSettings {
                sigma: self.gate_sigma,
                model_error_v: self.gate_model_error_v,
                soc_error: self.gate_soc_error,
                lost_after_s: self.lost_after_s,
            },
            consistency: ConsistencySettings { window_s: self.consistency_window_s, limit: self.consistency_limit },
        }
    }
}

section! {
    /// Detection of charge, rest and discharge.
    Transition at "transition" gives TransitionConfig, |keys, pack_ah: f64| {
        /// Pack current up to which the pack rests. Without it: the rated capacity of all strings over 50 h (C/50).
        dead_band_a: Option<f64>, "A", Between(0.0, 1e6), Optional => dead_band_a: keys.dead_band_a(pack_ah);
        /// The current must be this far beyond the dead band's edge for a mode to change. Without it: half the dead band.
        hysteresis_a: Option<f64>, "A", Between(0.0, 1e6), Optional
            => hysteresis_a: keys.hysteresis_a.unwrap_or(0.5 * keys.dead_band_a(pack_ah));
        /// A new mode must hold this long before it counts.
        min_duration_s: f64, "s", Between(0.0, 1e6), Default("10.0");
        /// A charge or discharge of less than this part of the rated capacity is joined to the following ones until their sum reaches it. For method "nominal": most of its swing, so that a pause does not cut a half-cycle in two.
        min_swing: f64, "fraction", Between(0.0, 1.0), Default("0.02");
    }
}

impl Transition {
    /// The dead band, or its default: C/50 of the pack.
    fn dead_band_a(&self, pack_ah: f64) -> f64 {
        self.dead_band_a.unwrap_or(pack_ah / 50.0)
    }
}

section! {
    /// The capacity filter, which runs at each transition.
    Capacity at "capacity" gives CapacityConfig, |keys, rated_ah: f64| {
        /// Charge over the SOC swing that the voltages show (variance from the swing's uncertainty), or over a nominal swing as in the paper.
        method: MethodKey, "", Any, Default("\"swing\"") => method: keys.method();
        /// Swing assumed by method "nominal".
        nominal_swing: f64, "fraction", Above(0.0, 1.0), Default("0.6") =>;
        /// Measurement variance of method "nominal".
        nominal_variance_ah2: f64, "Ah^2", Above(0.0, 1e9), Default("0.1") =>;
        /// Standard deviation gained per equivalent full cycle ("swing") or per event ("nominal"). Without it: 0.5 % of the rated capacity ("swing"), 1 Ah ("nominal", as in the paper).
        noise_ah_per_cycle: Option<f64>, "Ah", DEVIATION, Optional
            => noise_ah_per_cycle: keys.noise_ah_per_cycle.unwrap_or(keys.usual_noise_ah(rated_ah));
        /// Standard deviation gained in a day of rest, in which some capacity recovers ("swing" only). Without it: 1 % of the rated capacity.
        noise_ah_per_rest_day: Option<f64>, "Ah", DEVIATION, Optional
            => noise_ah_per_rest_day: keys.noise_ah_per_rest_day.unwrap_or(0.01 * rated_ah);
        /// Error of the cell model's open-circuit curve at the ends of a half-cycle ("swing" only). It is the same in every half-cycle that ends there and never averages out. Without it: half of the model's own error, which its fit has found; 0 where it states none.
        end_error_v: Option<f64>, "V", DEVIATION, Optional;
        /// Standard deviation of the cell model's `ocv_ageing_shift` ("swing" only): uncertainty of how the curve changes with lost capacity. With `[electrodes]` the model states its own.
        ageing_shift_error: f64, "", DEVIATION, Default("0.3") =>;
        /// Standard deviation of the current sensor's gain error: no capacity is more accurate than this.
        current_gain_std: f64, "fraction", Between(0.0, 1.0), Default("0.005");
        /// Standard deviation of the current sensor's offset, per cell. The offset is learned from the charge that the voltages do not confirm, at rest most of all, and subtracted from the current ("swing" only; 0 = none). A reading of exactly zero has none. Without it: the rated capacity over 100 h (C/100).
        current_offset_std_a: Option<f64>, "A", DEVIATION, Optional
            => current_offset_std_a: keys.current_offset_std_a(rated_ah);
        /// Standard deviation of the capacity lost in a full cycle, at the start. The loss is learned and predicted at the end of each charge ("swing" only; 0 = not learned). Without it: 0.05 % of the rated capacity; cells that lose several percent in a cycle need more.
        fade_std_ah_per_cycle: Option<f64>, "Ah", DEVIATION, Optional
            => fade_std_ah_per_cycle: keys.fade_std_ah_per_cycle.unwrap_or(5e-4 * rated_ah);
        /// Rate at which that loss may change: standard deviation gained per equivalent full cycle. Without it: 0.005 % of the rated capacity.
        fade_noise_ah_per_cycle: Option<f64>, "Ah", DEVIATION, Optional
            => fade_noise_ah_per_cycle: keys.fade_noise_ah_per_cycle.unwrap_or(5e-5 * rated_ah);
        /// Part of the rated capacity at which the life of a cell ends; the remaining life until then is forecast.
        end_of_life: f64, "fraction", Above(0.0, 1.0), Default("0.8") =>;
    }
}

impl Capacity {
    /// Deviation of the current's offset; the paper's filter knows none.
    pub(crate) fn current_offset_std_a(&self, rated_ah: f64) -> f64 {
        match self.method {
            MethodKey::Swing => self.current_offset_std_a.unwrap_or(rated_ah / 100.0),
            MethodKey::Nominal => 0.0,
        }
    }

    /// Deviation of a shift of the open-circuit curve; the paper's filter knows none.
    pub(crate) fn shift_std(&self) -> f64 {
        match self.method {
            MethodKey::Swing => self.ageing_shift_error,
            MethodKey::Nominal => 0.0,
        }
    }

    fn method(&self) -> CapacityMethod {
        match self.method {
            MethodKey::Swing => CapacityMethod::Swing,
            MethodKey::Nominal => {
                CapacityMethod::Nominal { swing: self.nominal_swing, variance_ah2: self.nominal_variance_ah2 }
            }
        }
    }

    /// Noise where none is configured.
    fn usual_noise_ah(&self, rated_ah: f64) -> f64 {
        match self.method {
            MethodKey::Swing => 0.005 * rated_ah,
            MethodKey::Nominal => 1.0,
        }
    }
}

section! {
    /// The SOC window whose charging time is the recharge period: raw, the time of the actual charge; normalised, the time a reference charger would need.
    Recharge at "recharge" gives RechargeConfig, |keys, rated_ah: f64| {
        /// Lower SOC.
        from_soc: f64, "fraction", Between(0.0, 1.0), Default("0.3");
        /// Upper SOC.
        to_soc: f64, "fraction", Between(0.0, 1.0), Default("0.9");
        /// Current of the reference charger, per cell, constant over the whole window: the normalised period is the window's share of the learned capacity divided by this current. Without it: the rated capacity over 2 h (C/2).
        reference_current_a: Option<f64>, "A", Between(1e-6, 1e6), Optional
            => reference_current_a: keys.reference_current_a.unwrap_or(rated_ah / 2.0);
        /// Part of the window that a charge must cover for a normalised period to be reported (a raw period needs all of it).
        min_coverage: f64, "fraction", Above(0.0, 1.0), Default("0.5");
        /// What the alarm `recharge_period_low` compares. "raw": each period as soon as the charge leaves the window; a stronger charger looks like a worn pack, a weaker one hides wear. "normalised": the period of the reference charger, at the end of each charge that covers enough of the window.
        alarm_on: RechargeAlarm, "", Any, Default("\"raw\"");
    }
}

section! {
    /// The load at which usable capacity is stated; without this table it is not reported.
    Usable at "usable" gives UsableConfig, |keys, rated_ah: f64| {
        /// Discharge current, per cell.
        current_a: f64, "A", Above(0.0, 1e6), Required;
        /// Cell temperature.
        temperature_c: f64, "degrees C", TEMPERATURE_C, Required;
        /// Voltage under load at which the discharge ends.
        cutoff_v: f64, "V", Above(0.0, 100.0), Required;
        /// A charge whose current, per cell, has fallen to this at the cell model's highest voltage ends full: usable capacity is counted from the SOC it leaves. Without it: the rated capacity over 20 h (C/20).
        taper_current_a: Option<f64>, "A", Above(0.0, 1e6), Optional
            => taper_current_a: keys.taper_current_a.unwrap_or(rated_ah / 20.0);
    }
}
