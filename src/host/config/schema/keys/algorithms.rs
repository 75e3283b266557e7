//! Declares the tables of the algorithms: cell filter, transitions, capacity, recharge, usable capacity, outlook. Each table
//! gives the parameters of its algorithm. Defaults that depend on the cell or on other keys are also computed here.

use super::choices::{DEVIATION, MethodKey, TEMPERATURE_C};
use crate::cell::{
    CapacityState, CellModel, ConsistencySettings, Discretisation, EstimatorConfig, GapSettings, GateSettings,
    InitialState, ProcessNoise, SensorErrors, SigmaPointSettings, VoltageError,
};
use crate::config::schema::key::Presence::{Default, Optional, Required};
use crate::config::schema::key::ValueRange::{Above, Any, Between};
use crate::config::schema::key::within;
use crate::config::schema::section::section;
use crate::filter::ScalarGaussian;
use crate::health::{
    CapacityConfig, CapacityMethod, OutlookConfig, RechargeAlarm, RechargeConfig, TransitionConfig, UsableConfig,
};
use crate::quantity::bounds;

/// Standard deviation of the capacity that a cell has lost before its first half-cycle is measured, as a fraction of a
/// new cell's capacity. Until then, the cell is assumed to have a new cell's open-circuit curve. The curve changes with
/// the lost capacity, so this value determines the uncertainty of the curve.
const FIRST_LOSS_STD: f64 = 0.03;

section! {
    /// The unscented Kalman filter of each cell. Noises are densities per square root of a second, so results do not depend on the sample rate.
    Estimator at "estimator" {
        /// Spread of the sigma points (alpha).
        alpha: f64, "", within(bounds::SIGMA_POINT_SPREAD), Default("1.0");
        /// Prior knowledge of the distribution (beta); 2 is optimal for a Gaussian.
        beta: f64, "", Between(0.0, 10.0), Default("2.0");
        /// Secondary scaling of the sigma points (kappa).
        kappa: f64, "", Between(0.0, 10.0), Default("0.0");
        /// How the equivalent circuit is discretised: "exact", or "euler" (forward Euler, as in the paper).
        discretisation: Discretisation, "", Any, Default("\"exact\"");
        /// "joint": the filter estimates the capacity as a state (use with `capacity.method = "swing"`). "held": the filter uses the learned capacity, as in the paper (use with "nominal").
        capacity_state: CapacityState, "", Any, Default("\"joint\"");
        /// Initial SOC.
        initial_soc: Option<f64>, "fraction", Between(0.0, 1.0), Optional("from the first voltage and the open-circuit curve");
        /// Standard deviation of the initial SOC.
        initial_soc_std: f64, "fraction", Above(0.0, 1.0), Default("0.3");
        /// Standard deviation of the initial branch voltages.
        initial_branch_std_v: f64, "V", Between(0.0, 10.0), Default("0.05");
        /// Initial standard deviation of ln(resistance relative to a new cell).
        initial_log_resistance_std: Option<f64>, "", Between(0.0, 5.0), Optional("the cell model's `spread.log_resistance`, else 0.2");
        /// Process noise of the SOC.
        soc_noise_per_sqrt_s: f64, "fraction/sqrt(s)", DEVIATION, Default("3e-5");
        /// Process noise of the SOC while charge flows, per square root of the SOC change. It covers errors of the current reading.
        charge_noise_per_sqrt_soc: f64, "fraction/sqrt(SOC)", DEVIATION, Default("3e-3");
        /// Process noise of the branch voltages.
        branch_noise_v_per_sqrt_s: f64, "V/sqrt(s)", DEVIATION, Default("1e-3");
        /// Process noise of ln(resistance). It covers ageing, errors of the cell model's resistance tables in the cold, and changes of the resistance within a few minutes of driving.
        log_resistance_noise_per_sqrt_s: f64, "1/sqrt(s)", DEVIATION, Default("1e-3");
        /// Process noise of the SOC while no current is measured (vehicle asleep).
        gap_noise_per_sqrt_s: f64, "fraction/sqrt(s)", DEVIATION, Default("1.5e-5");
        /// Self-discharge of a cell in a month. While nothing is measured (asleep or not running), the standard deviation of the SOC grows at this rate.
        self_discharge_per_month: f64, "fraction", Between(0.0, 1.0), Default("0.03");
        /// Largest charge or discharge per hour, as a fraction of the capacity, that is possible while the program does not run. The standard deviation of the SOC covers this change until the first voltage after the downtime shows what happened. 0: the cells are certainly not used.
        away_use_per_h: f64, "fraction", Between(0.0, 100.0), Default("0.5");
        /// Largest current, per cell, that counts as rest. A larger current next to a gap in the readings may have flowed during the whole gap.
        rest_current_a: Option<f64>, "A", Between(0.0, 1e6), Optional("C/50: the rated capacity over 50 h");
        /// `true`: a silent bus means zero current. If the current is unmeasured for more than 5 s between two voltages of a cell, the cell counts as resting in that time, whatever the current before and after. Use this only if each cell's voltage arrives more often than every 5 s; otherwise a failed current sensor is mistaken for a silent bus. `false`: the load before the gap may have continued, or a charger may have been connected.
        silence_is_rest: bool, "", Any, Default("false");
        /// Standard deviation of the voltage sensor's noise. If the signal's resolution is coarser, its rounding noise is added (5.8 mV for steps of 20 mV).
        voltage_noise_v: f64, "V", within(bounds::VOLTAGE_NOISE_V), Default("0.005");
        /// Standard deviation of the voltage offset: sensor offset plus the constant error of the model's open-circuit curve. It never averages out. A cell model's `spread.curve_v` is added.
        voltage_offset_std_v: f64, "V", DEVIATION, Default("0.004");
        /// Standard deviation of the slowest branch's resistance relative to the model: diffusion differs between cells and ages independently of the other resistances. If the model has several branches, the filter learns this resistance.
        slow_branch_std: Option<f64>, "fraction", DEVIATION, Optional("the cell model's `spread.slow_branch`, else 0.2 (0.1 with one branch)");
        /// Slow error of the cell model: standard deviation of its average over one second. More samples per second do not reduce it. A cell model's `voltage_error_v` replaces this key.
        model_error_v_sqrt_s: f64, "V sqrt(s)", DEVIATION, Default("0.15");
        /// Slow error of the cell model that is proportional to the present voltage drop in the cell. The value is the standard deviation of its average over one second, relative to this drop.
        drop_error_sqrt_s: f64, "sqrt(s)", DEVIATION, Default("0.3");
        /// Slow error of the cell model under load: standard deviation of its average over one second. It is relative to the voltage drop that the load of the last minutes causes.
        load_error_sqrt_s: f64, "sqrt(s)", DEVIATION, Default("0.5");
        /// Time constant with which the error of `load_error_sqrt_s` decays after a load (slow diffusion).
        load_memory_s: f64, "s", Above(0.0, 1e6), Default("1200.0");
        /// Longest time that one voltage reading may represent. Readings further apart carry no additional information.
        max_information_s: f64, "s", Between(0.001, 1e6), Default("100.0");
        /// A voltage that differs from its prediction by more than this many standard deviations changes no estimate.
        gate_sigma: f64, "", Above(0.0, 1e6), Default("5.0");
        /// Standard deviation of the cell model's error in a single reading, used by the gate and the consistency
        /// monitor.
        gate_model_error_v: f64, "V", Between(0.0, 10.0), Default("0.06");
        /// Standard deviation of a further error of the cell model, stated as an error of the SOC on the open-circuit curve. It is added to `gate_model_error_v`.
        gate_soc_error: f64, "fraction", Between(0.0, 1.0), Default("0.02");
        /// If every reading has been outside the gate for this long, the filter restarts from the voltage.
        lost_after_s: f64, "s", Above(0.0, 1e9), Default("30.0");
        /// Window over which the filter's consistency is evaluated.
        consistency_window_s: f64, "s", Above(0.0, 1e9), Default("600.0");
        /// Mean normalised innovation squared (1 = as expected) above which an estimate is untrusted. The cell model's mismatch is given in multiples of this limit.
        consistency_limit: f64, "", Above(0.0, 1e9), Default("4.0");
    }
}

impl Estimator {
    /// Standard deviation of the voltage's rounding error (V): step / sqrt(12), because the error is uniform. The
    /// result is 0 if the step does not exceed the sensor's noise, because the noise then covers the rounding error.
    pub(crate) fn rounding_v(&self, step_v: f64) -> f64 {
        if step_v > self.voltage_noise_v { step_v / 12.0_f64.sqrt() } else { 0.0 }
    }

    /// The estimator's configuration. `initial_ah` and `initial_std_ah` are the configured capacity and its standard
    /// deviation. `voltage_step_v` is the resolution of the cell voltages.
    pub(crate) fn config(
        &self,
        (initial_ah, initial_std_ah): (Option<f64>, Option<f64>),
        model: &CellModel,
        capacity: &CapacityConfig,
        voltage_step_v: f64,
    ) -> EstimatorConfig {
        let rounding_v = self.rounding_v(voltage_step_v);
        let initial_ah = initial_ah.unwrap_or(model.capacity_ah);
        let spread = model.spread();
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
                    // At rest all readings have the same rounding error, so it acts as an offset.
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
        /// Pack currents up to this value count as rest.
        dead_band_a: Option<f64>, "A", Between(0.0, 1e6), Optional("C/50: the rated capacity of all strings over 50 h") => dead_band_a: keys.dead_band_a(pack_ah);
        /// The current must pass the edge of the dead band by this much before the mode changes.
        hysteresis_a: Option<f64>, "A", Between(0.0, 1e6), Optional("half the dead band")
            => hysteresis_a: keys.hysteresis_a.unwrap_or(0.5 * keys.dead_band_a(pack_ah));
        /// A new mode must last this long before it is accepted.
        min_duration_s: f64, "s", Between(0.0, 1e6), Default("10.0");
        /// A charge or discharge smaller than this fraction of the rated capacity is merged with the following ones until their sum reaches it. For method "nominal", choose a value somewhat below `nominal_swing`; otherwise a pause can split a half-cycle.
        min_swing: f64, "fraction", Between(0.0, 1.0), Default("0.02");
    }
}

impl Transition {
    fn dead_band_a(&self, pack_ah: f64) -> f64 {
        self.dead_band_a.unwrap_or(pack_ah / 50.0)
    }
}

section! {
    /// The capacity filter. It runs at each transition.
    Capacity at "capacity" gives CapacityConfig, |keys, rated_ah: f64| {
        /// "swing": capacity = charge / SOC swing. The swing follows from the voltages, and the variance from the uncertainty of the swing. "nominal": capacity = charge / `nominal_swing`, as in the paper.
        method: MethodKey, "", Any, Default("\"swing\"") => method: keys.method();
        /// Swing assumed by method "nominal".
        nominal_swing: f64, "fraction", Above(0.0, 1.0), Default("0.6") =>;
        /// Measurement variance of method "nominal".
        nominal_variance_ah2: f64, "Ah^2", Above(0.0, 1e9), Default("0.1") =>;
        /// Standard deviation gained per equivalent full cycle ("swing") or per half-cycle ("nominal").
        noise_ah_per_cycle: Option<f64>, "Ah", DEVIATION, Optional("0.5 % of the rated capacity (\"swing\"), 1 Ah (\"nominal\", as in the paper)")
            => noise_ah_per_cycle: keys.noise_ah_per_cycle.unwrap_or(keys.usual_noise_ah(rated_ah));
        /// Standard deviation gained per day of rest, because some capacity recovers at rest ("swing" only).
        noise_ah_per_rest_day: Option<f64>, "Ah", DEVIATION, Optional("1 % of the rated capacity")
            => noise_ah_per_rest_day: keys.noise_ah_per_rest_day.unwrap_or(0.01 * rated_ah);
        /// Error of the cell model's open-circuit curve at the ends of a half-cycle ("swing" only). Half-cycles that end at the same SOC have the same error, so it never averages out.
        end_error_v: Option<f64>, "V", DEVIATION, Optional("half of the error stated by the cell model, else 0");
        /// Standard deviation of the cell model's `ocv_ageing_shift`, that is, how uncertain the ageing of the open-circuit curve is ("swing" only). A cell model with `[electrodes]` states its own.
        ageing_shift_error: f64, "", DEVIATION, Default("0.3") =>;
        /// Standard deviation of the current sensor's gain error. No capacity is more accurate than this.
        current_gain_std: f64, "fraction", Between(0.0, 1.0), Default("0.005");
        /// Standard deviation of the current sensor's offset, per cell. The offset is learned from the charge that the voltages do not confirm, mainly at rest, and is subtracted from the current ("swing" only; 0 = none). The offset is not subtracted from a reading of exactly zero.
        current_offset_std_a: Option<f64>, "A", DEVIATION, Optional("C/100: the rated capacity over 100 h")
            => current_offset_std_a: keys.current_offset_std_a(rated_ah);
        /// Initial standard deviation of the capacity lost per full cycle. The loss is learned, and predicted at the end of each charge ("swing" only; 0 = not learned). Cells that lose several percent per cycle need a larger value.
        fade_std_ah_per_cycle: Option<f64>, "Ah", DEVIATION, Optional("0.05 % of the rated capacity")
            => fade_std_ah_per_cycle: keys.fade_std_ah_per_cycle.unwrap_or(5e-4 * rated_ah);
        /// How fast the loss per cycle may change: standard deviation gained per equivalent full cycle.
        fade_noise_ah_per_cycle: Option<f64>, "Ah", DEVIATION, Optional("0.005 % of the rated capacity")
            => fade_noise_ah_per_cycle: keys.fade_noise_ah_per_cycle.unwrap_or(5e-5 * rated_ah);
        /// Fraction of the rated capacity that defines a cell's end of life. The remaining life is forecast up to this point.
        end_of_life: f64, "fraction", Above(0.0, 1.0), Default("0.8") =>;
    }
}

impl Capacity {
    /// Standard deviation of the current sensor's offset; 0 for method "nominal", which does not learn an offset.
    pub(crate) fn current_offset_std_a(&self, rated_ah: f64) -> f64 {
        match self.method {
            MethodKey::Swing => self.current_offset_std_a.unwrap_or(rated_ah / 100.0),
            MethodKey::Nominal => 0.0,
        }
    }

    /// Standard deviation of the open-circuit curve's ageing shift; 0 for method "nominal", which ignores the shift.
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

    /// Default of `noise_ah_per_cycle`.
    fn usual_noise_ah(&self, rated_ah: f64) -> f64 {
        match self.method {
            MethodKey::Swing => 0.005 * rated_ah,
            MethodKey::Nominal => 1.0,
        }
    }
}

section! {
    /// The SOC window whose charging time is the recharge period. The raw period is the time of the actual charge; the normalised period is the time that a reference charger would need.
    Recharge at "recharge" gives RechargeConfig, |keys, rated_ah: f64| {
        /// Lower end of the window.
        from_soc: f64, "fraction", Between(0.0, 1.0), Default("0.3");
        /// Upper end of the window.
        to_soc: f64, "fraction", Between(0.0, 1.0), Default("0.9");
        /// Constant current of the reference charger, per cell. The normalised period is the window's share of the learned capacity divided by this current.
        reference_current_a: Option<f64>, "A", Between(1e-6, 1e6), Optional("C/2: the rated capacity over 2 h")
            => reference_current_a: keys.reference_current_a.unwrap_or(rated_ah / 2.0);
        /// Fraction of the window that a charge must cover before a normalised period is reported (a raw period needs the whole window).
        min_coverage: f64, "fraction", Above(0.0, 1.0), Default("0.5");
        /// What the alarm `recharge_period_low` compares. "raw": each raw period, as soon as the charge leaves the window. With this setting, a stronger charger looks like a worn pack, and a weaker charger hides wear. "normalised": the normalised period, at the end of each charge that covers enough of the window.
        alarm_on: RechargeAlarm, "", Any, Default("\"raw\"");
    }
}

section! {
    /// The load that defines usable capacity. Without this table, usable capacity is not reported.
    Usable at "usable" gives UsableConfig, |keys, rated_ah: f64| {
        /// Discharge current, per cell.
        current_a: f64, "A", Above(0.0, 1e6), Required;
        /// Cell temperature.
        temperature_c: f64, "degrees C", TEMPERATURE_C, Required;
        /// Cut-off voltage of the discharge, under load.
        cutoff_v: f64, "V", Above(0.0, 100.0), Required;
        /// A charge is complete when its current, per cell, has dropped to this value at the cell model's highest voltage. Usable capacity is counted from the SOC at that moment.
        taper_current_a: Option<f64>, "A", Above(0.0, 1e6), Optional("C/20: the rated capacity over 20 h")
            => taper_current_a: keys.taper_current_a.unwrap_or(rated_ah / 20.0);
    }
}

section! {
    /// Limits for the remaining energy, the times to empty and to full, the power, and the record of use.
    Outlook at "outlook" gives OutlookConfig, |keys, usable: Option<UsableConfig>, rated_ah: f64| {
        /// Lowest voltage of a cell under load. The value must be at least half of the cell model's lowest voltage and below its highest voltage.
        min_voltage_v: Option<f64>, "V", Above(0.0, 100.0), Optional("the cell model's lowest voltage");
        /// Highest voltage of a cell under charge. The value must be at most 0.5 V above the cell model's highest voltage.
        max_voltage_v: Option<f64>, "V", Above(0.0, 100.0), Optional("the cell model's highest voltage");
        /// Largest discharge current, per cell.
        max_discharge_a: Option<f64>, "A", Above(0.0, 1e6), Optional("only the voltages limit the current");
        /// Largest charging current, per cell. Set it for use below 0 degrees C: there, the voltage limit alone allows currents that cause lithium plating.
        max_charge_a: Option<f64>, "A", Above(0.0, 1e6), Optional("only the voltages limit the current");
        /// Lowest temperature of a sensor. It does not change energy, times and power; time below it is counted in the record of use.
        min_temperature_c: Option<f64>, "degrees C", TEMPERATURE_C, Optional("time at low temperatures is not counted");
        /// Highest temperature of a sensor. It does not change energy, times and power; time above it is counted in the record of use.
        max_temperature_c: Option<f64>, "degrees C", TEMPERATURE_C, Optional("time at high temperatures is not counted");
        /// A charge is complete when its current, per cell, has dropped to this value at the highest voltage.
        taper_current_a: Option<f64>, "A", Above(0.0, 1e6), Optional("`taper_current_a` of `[usable]`, else C/20: the rated capacity over 20 h")
            => taper_current_a: keys.taper_current_a.or(usable.map(|usable| usable.taper_current_a)).unwrap_or(rated_ah / 20.0);
        /// State of charge up to which the charging time is reported.
        target_soc: f64, "fraction", Between(0.0, 1.0), Default("0.8");
    }
}
