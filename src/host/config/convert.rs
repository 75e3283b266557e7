//! Keys as written to the settings the other modules take. One line per key.

use std::num::NonZeroU32;

use super::StoreConfig;
use super::alarm::Rated;
use super::document::{Document, Faults};
use super::keys::{
    Alarm, Capacity, CellVoltageInput, Commands, CurrentInput, CurrentLimits, Estimator, Input, Interface, J1939,
    Method, Output, OutputAlarm, OutputHealth, OutputStatus, Pack, PackIdentityInput, PackVoltageInput, ProtectedInput,
    Recharge, ReportedSocInput, ReportedSohInput, SECTIONS, Store, TemperatureInput, TemperatureLimits, Transition,
    Usable, VoltageLimits,
};
use super::schema::{Section as _, Walk};
use crate::can::decode::InputMap;
use crate::can::flood::FloodConfig;
use crate::can::guard::GuardConfig;
use crate::cell::{CellModel, EstimatorConfig};
use crate::health::{CapacityConfig, CapacityMethod, HealthConfig, RechargeConfig, TransitionConfig, UsableConfig};
use crate::monitor::{CommandConfig, J1939Config, MonitorConfig, OutputConfig};
use crate::quantity::SensorIndex;
use crate::sample::{Limits, SampleConfig, VoltageSource};

/// The tables of a file; `None` = not there, or faulty (and noted).
#[derive(Debug)]
pub(super) struct Raw {
    pub file: String,
    /// Whether the file's syntax or a table is broken, so that a table not found may still be there.
    pub broken: bool,
    pub pack: Option<Pack>,
    /// `pack.cell_model`, also when another key of `[pack]` is faulty: that file's faults are told with the rest.
    pub cell_model: Option<String>,
    pub interfaces: Vec<Interface>,
    /// Whether every `[[interface]]` that is written is in `interfaces`; otherwise names cannot be judged.
    pub interfaces_whole: bool,
    pub input: Option<Input>,
    pub current: Option<CurrentInput>,
    pub cell_voltage: Option<CellVoltageInput>,
    pub pack_voltage: Option<PackVoltageInput>,
    /// Whether `[input.cell_voltage]` and `[input.pack_voltage]` are written, faulty or not.
    pub voltages_written: (bool, bool),
    pub temperatures: Vec<TemperatureInput>,
    pub reported_soc: Option<ReportedSocInput>,
    pub reported_soh: Option<ReportedSohInput>,
    pub pack_identity: Option<PackIdentityInput>,
    /// Whether one of the two is written, faulty or not.
    pub reported_written: bool,
    pub protected: Vec<ProtectedInput>,
    pub current_limits: Option<CurrentLimits>,
    pub voltage_limits: Option<VoltageLimits>,
    pub temperature_limits: Option<TemperatureLimits>,
    pub estimator: Option<Estimator>,
    pub transition: Option<Transition>,
    pub capacity: Option<Capacity>,
    pub recharge: Option<Recharge>,
    pub usable: Option<Usable>,
    pub usable_written: bool,
    pub alarms: Vec<Alarm>,
    pub j1939: Option<J1939>,
    pub j1939_written: bool,
    pub output: Option<Output>,
    pub output_status: Option<OutputStatus>,
    pub output_health: Option<OutputHealth>,
    pub output_alarm: Option<OutputAlarm>,
    pub output_written: bool,
    pub commands: Option<Commands>,
    pub store: Option<Store>,
}

impl Raw {
    /// Reads every table; faults of single keys and unknown keys are noted.
    pub(super) fn read(document: &Document<'_>, faults: &mut Faults) -> Self {
        let mut walk = Walk::new(document, SECTIONS, faults);
        let interfaces: Vec<Interface> = walk.many();
        Self {
            file: document.file.clone(),
            broken: walk.broken,
            pack: walk.one(),
            cell_model: walk.text("pack.cell_model"),
            interfaces_whole: !walk.broken && Some(interfaces.len()) == walk.count(Interface::PATH),
            interfaces,
            input: walk.one(),
            current: walk.one(),
            voltages_written: (walk.has::<CellVoltageInput>(), walk.has::<PackVoltageInput>()),
            cell_voltage: walk.optional(),
            pack_voltage: walk.optional(),
            temperatures: walk.many(),
            reported_written: walk.has::<ReportedSocInput>() || walk.has::<ReportedSohInput>(),
            reported_soc: walk.optional(),
            reported_soh: walk.optional(),
            pack_identity: walk.optional(),
            protected: walk.many(),
            current_limits: walk.one(),
            voltage_limits: walk.one(),
            temperature_limits: walk.one(),
            estimator: walk.one(),
            transition: walk.one(),
            capacity: walk.one(),
            recharge: walk.one(),
            usable_written: walk.has::<Usable>(),
            usable: walk.optional(),
            alarms: walk.many(),
            commands: walk.one(),
            j1939_written: walk.has::<J1939>(),
            j1939: walk.optional(),
            output_written: walk.has::<Output>(),
            output: walk.one(),
            output_status: walk.one(),
            output_health: walk.one(),
            output_alarm: walk.one(),
            store: walk.one(),
        }
    }
}

/// What the frames of the buses mean, both ways.
#[derive(Debug)]
pub(super) struct Traffic {
    pub input: InputMap,
    pub guards: Vec<GuardConfig>,
    pub output: Option<OutputConfig>,
    pub commands: Option<CommandConfig>,
    pub j1939: Option<J1939Config>,
}

/// Everything the core must know; `None` when a table is missing or faulty (and noted).
pub(super) fn monitor(raw: &Raw, mut model: CellModel, found: &Ranges, traffic: Traffic) -> Option<MonitorConfig> {
    let pack = raw.pack.as_ref()?;
    model.rated_capacity_ah = pack.rated_capacity_ah.unwrap_or(model.rated_capacity_ah);
    let rated_ah = model.rated_capacity_ah;
    let rated = Rated::new(rated_ah, raw.recharge.as_ref()?);
    let rules = raw.alarms.iter().flat_map(|alarm| alarm.rules(&rated)).collect();
    Some(MonitorConfig {
        interfaces: raw.interfaces.len(),
        input: traffic.input,
        guards: traffic.guards,
        identity_readings: raw.pack_identity.as_ref().map_or(1, |keys| keys.readings),
        flood: FloodConfig { max_frames_per_s: NonZeroU32::new(raw.input.as_ref()?.max_frames_per_s)? },
        output: traffic.output,
        commands: traffic.commands,
        j1939: traffic.j1939,
        sample: sample(raw, pack, &model, found)?,
        estimator: estimator(raw.estimator.as_ref()?, pack, &model),
        health: HealthConfig {
            transition: transition(raw.transition.as_ref()?, rated_ah * f64::from(pack.strings)),
            capacity: capacity(raw.capacity.as_ref()?, rated_ah),
            recharge: recharge(raw.recharge.as_ref()?, rated_ah),
            end_of_life_ah: raw.capacity.as_ref()?.end_of_life * rated_ah,
            usable: raw.usable.as_ref().map(|keys| usable(keys, rated_ah)),
        },
        rules,
        model,
    })
}

/// Ranges the DBC gives, in our units and sign; infinite where it gives none.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Ranges {
    /// Pack current, A, positive = discharge.
    pub current_a: (f64, f64),
    /// Cell voltage, V.
    pub voltage_v: (f64, f64),
    /// Temperature, degrees C.
    pub temperature_c: (f64, f64),
}

/// A range that refuses nothing.
pub(super) const UNLIMITED: (f64, f64) = (f64::NEG_INFINITY, f64::INFINITY);

fn sample(raw: &Raw, pack: &Pack, model: &CellModel, found: &Ranges) -> Option<SampleConfig> {
    let (cells, voltage_source) = match raw.voltages_written {
        (_, true) => (1, VoltageSource::PackTotal { series: pack.cells }),
        (_, false) => (pack.cells, VoltageSource::Cells),
    };
    let (current, voltage) = (raw.current_limits.as_ref()?, raw.voltage_limits.as_ref()?);
    Some(SampleConfig {
        cells,
        voltage_source,
        strings: pack.strings,
        current: current_limits(current, found.current_a),
        voltage: voltage_limits(voltage, model, found.voltage_v),
        temperature: temperature_limits(raw.temperature_limits.as_ref()?, found.temperature_c),
        reported_soc: raw.reported_soc.as_ref().map(|keys| reported_limits(keys.max_age_s)),
        reported_soh: raw.reported_soh.as_ref().map(|keys| reported_limits(keys.max_age_s)),
        sensor_of_cell: sensors(&raw.temperatures, cells),
        ambient_c: pack.ambient_c,
    })
}

fn current_limits(keys: &CurrentLimits, found: (f64, f64)) -> Limits {
    Limits {
        min: keys.max_charge_a.map_or(found.0, |limit| -limit),
        max: keys.max_discharge_a.unwrap_or(found.1),
        max_rate_per_s: keys.max_rate_a_per_s,
        stuck_after_s: keys.stuck_after_s,
        max_age_s: keys.max_age_s,
    }
}

fn voltage_limits(keys: &VoltageLimits, model: &CellModel, found: (f64, f64)) -> Limits {
    Limits {
        min: keys.min_v.unwrap_or(found.0.max(0.5 * model.voltage_min_v)),
        max: keys.max_v.unwrap_or(found.1.min(model.voltage_max_v + 0.5)),
        max_rate_per_s: keys.max_rate_v_per_s,
        stuck_after_s: keys.stuck_after_s,
        max_age_s: keys.max_age_s,
    }
}

fn temperature_limits(keys: &TemperatureLimits, found: (f64, f64)) -> Limits {
    Limits {
        min: keys.min_c.unwrap_or(found.0.max(-60.0)),
        max: keys.max_c.unwrap_or(found.1.min(150.0)),
        max_rate_per_s: keys.max_rate_c_per_s,
        stuck_after_s: keys.stuck_after_s,
        max_age_s: keys.max_age_s,
    }
}

/// A fraction; packs that count above 100 % exist.
fn reported_limits(max_age_s: f64) -> Limits {
    Limits { min: -0.1, max: 1.5, max_rate_per_s: None, stuck_after_s: None, max_age_s }
}

/// The sensor of each cell; a sensor without `cells` serves all.
fn sensors(temperatures: &[TemperatureInput], cells: u16) -> Vec<Option<SensorIndex>> {
    let mut sensor_of_cell = vec![None; usize::from(cells)];
    for (index, temperature) in (0..).zip(temperatures) {
        for (cell, sensor) in (1..).zip(&mut sensor_of_cell) {
            if temperature.cells.as_ref().is_none_or(|ranges| ranges.0.iter().any(|range| range.contains(&cell))) {
                *sensor = Some(SensorIndex(index));
            }
        }
    }
    sensor_of_cell
}

fn estimator(keys: &Estimator, pack: &Pack, model: &CellModel) -> EstimatorConfig {
    let initial_capacity_ah = pack.initial_capacity_ah.unwrap_or(model.capacity_ah);
    EstimatorConfig {
        alpha: keys.alpha,
        beta: keys.beta,
        kappa: keys.kappa,
        discretisation: keys.discretisation,
        capacity_state: keys.capacity_state,
        initial_soc: keys.initial_soc,
        initial_soc_std: keys.initial_soc_std,
        initial_branch_std_v: keys.initial_branch_std_v,
        initial_capacity_ah,
        initial_capacity_std_ah: pack.initial_capacity_std_ah.unwrap_or(0.1 * initial_capacity_ah),
        initial_log_resistance_std: keys.initial_log_resistance_std,
        soc_noise_per_sqrt_s: keys.soc_noise_per_sqrt_s,
        charge_noise_per_sqrt_soc: keys.charge_noise_per_sqrt_soc,
        branch_noise_v_per_sqrt_s: keys.branch_noise_v_per_sqrt_s,
        log_resistance_noise_per_sqrt_s: keys.log_resistance_noise_per_sqrt_s,
        gap_noise_per_sqrt_s: keys.gap_noise_per_sqrt_s,
        self_discharge_per_s: keys.self_discharge_per_month / SECONDS_PER_MONTH,
        away_use_per_s: keys.away_use_per_h / 3600.0,
        rest_current_a: keys.rest_current_a.unwrap_or(model.rated_capacity_ah / 50.0),
        voltage_noise_v: keys.voltage_noise_v,
        model_error_v_sqrt_s: keys.model_error_v_sqrt_s,
        drop_error_sqrt_s: keys.drop_error_sqrt_s,
        load_error_sqrt_s: keys.load_error_sqrt_s,
        load_memory_s: keys.load_memory_s,
        max_information_s: keys.max_information_s,
        gate_sigma: keys.gate_sigma,
        gate_model_error_v: keys.gate_model_error_v,
        gate_soc_error: keys.gate_soc_error,
        lost_after_s: keys.lost_after_s,
        consistency_window_s: keys.consistency_window_s,
        consistency_limit: keys.consistency_limit,
    }
}

/// Of 365.25 / 12 days.
const SECONDS_PER_MONTH: f64 = 2_629_800.0;

pub(super) fn transition(keys: &Transition, pack_ah: f64) -> TransitionConfig {
    let dead_band_a = keys.dead_band_a.unwrap_or(pack_ah / 50.0);
    TransitionConfig {
        dead_band_a,
        hysteresis_a: keys.hysteresis_a.unwrap_or(0.5 * dead_band_a),
        min_duration_s: keys.min_duration_s,
        min_swing: keys.min_swing,
    }
}

fn capacity(keys: &Capacity, rated_ah: f64) -> CapacityConfig {
    let (method, usual_noise_ah) = match keys.method {
        Method::Swing => (CapacityMethod::Swing, 0.005 * rated_ah),
        Method::Nominal => {
            let (swing, variance_ah2) = (keys.nominal_swing, keys.nominal_variance_ah2);
            (CapacityMethod::Nominal { swing, variance_ah2 }, 1.0)
        }
    };
    CapacityConfig {
        method,
        noise_ah_per_cycle: keys.noise_ah_per_cycle.unwrap_or(usual_noise_ah),
        noise_ah_per_rest_day: keys.noise_ah_per_rest_day.unwrap_or(0.02 * rated_ah),
        end_error_v: keys.end_error_v,
        end_load_error: keys.end_load_error,
        ageing_shift_error: keys.ageing_shift_error,
        current_gain_std: keys.current_gain_std,
        current_offset_std_a: keys.current_offset_std_a,
        fade_std_ah_per_cycle: keys.fade_std_ah_per_cycle,
        fade_noise_ah_per_cycle: keys.fade_noise_ah_per_cycle,
    }
}

fn recharge(keys: &Recharge, rated_ah: f64) -> RechargeConfig {
    RechargeConfig {
        from_soc: keys.from_soc,
        to_soc: keys.to_soc,
        reference_current_a: keys.reference_current_a.unwrap_or(rated_ah / 2.0),
        min_coverage: keys.min_coverage,
        alarm_on: keys.alarm_on,
    }
}

/// How state and history are kept.
pub(super) fn store(keys: &Store) -> StoreConfig {
    StoreConfig { checkpoint_s: keys.checkpoint_s, max_half_cycles: keys.max_half_cycles }
}

fn usable(keys: &Usable, rated_ah: f64) -> UsableConfig {
    UsableConfig {
        current_a: keys.current_a,
        temperature_c: keys.temperature_c,
        cutoff_v: keys.cutoff_v,
        taper_current_a: keys.taper_current_a.unwrap_or(rated_ah / 20.0),
    }
}
