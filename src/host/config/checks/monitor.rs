//! The settings the other modules take, from the tables of a checked file.

use std::num::NonZeroU32;

use super::alarm::RatedCell;
use super::cells::{self, Module};

use super::signals::DbcRanges;
use crate::can::CanId;
use crate::can::decode::InputMap;
use crate::can::flood::FloodConfig;
use crate::can::guard::GuardConfig;
use crate::can::poll::PollConfig;
use crate::can::uds::Answer;
use crate::cell::{CellModel, CellModule};
use crate::cell_faults::BalancingConfig;
use crate::config::schema::RawTables;
use crate::config::schema::keys::{Pack, TemperatureInput};
use crate::health::HealthConfig;
use crate::monitor::{CommandConfig, J1939Config, MonitorConfig, OutputConfig, SupplyConfig};
use crate::quantity::{BusIndex, SensorIndex};
use crate::sample::{ContactorConfig, Limits, SampleConfig, VoltageSource};

/// The frames of the buses, received and sent.
#[derive(Debug)]
pub(crate) struct Traffic {
    pub input: InputMap,
    pub answers: Vec<Answer>,
    pub poll: Option<PollConfig>,
    pub guards: Vec<GuardConfig>,
    pub cycle_times_s: Vec<(BusIndex, CanId, f64)>,
    pub output: Option<OutputConfig>,
    pub commands: Option<CommandConfig>,
    pub j1939: Option<J1939Config>,
}

/// The settings of the core; `None` when a table is missing or faulty (and noted).
pub(crate) fn monitor(
    raw: &RawTables,
    mut model: CellModel,
    modules: Vec<Module<'_>>,
    found: &DbcRanges,
    traffic: Traffic,
) -> Option<MonitorConfig> {
    let pack = raw.pack.as_ref()?;
    model.rated_capacity_ah = pack.rated_capacity_ah.unwrap_or(model.rated_capacity_ah);
    let rated_ah = model.rated_capacity_ah;
    let rated = RatedCell::new(rated_ah, raw.recharge.as_ref()?);
    model.aged_ocv.set_shift_std(raw.capacity.as_ref()?.shift_std());
    let capacity = raw.capacity.as_ref()?.config(rated_ah);
    let estimator = |model: &CellModel, initial_ah| {
        Some(raw.estimator.as_ref()?.config(initial_ah, model, &capacity, found.voltage_step_v))
    };
    let ranged = cells::with_voltages_of(&model, &modules);
    let modules = modules.into_iter().map(|Module { keys, cells, mut model }| {
        model.aged_ocv.set_shift_std(raw.capacity.as_ref()?.shift_std());
        let estimator = estimator(&model, (keys.initial_capacity_ah, keys.initial_capacity_std_ah))?;
        Some(CellModule { cells, model, estimator, is_given: keys.cell_model.is_some() })
    });
    let modules = modules.collect::<Option<Vec<_>>>()?;
    let estimator = estimator(&model, (pack.initial_capacity_ah, pack.initial_capacity_std_ah))?;
    let rules = raw.alarms.iter().flat_map(|alarm| alarm.rules(&rated)).collect();
    Some(MonitorConfig {
        interfaces: raw.interfaces.len(),
        input: traffic.input,
        answers: traffic.answers,
        poll: traffic.poll,
        supply: raw
            .supply_voltage
            .as_ref()
            .map(|keys| SupplyConfig { minimum_v: keys.minimum_v, max_age_s: keys.max_age_s }),
        guards: traffic.guards,
        cycle_times_s: traffic.cycle_times_s,
        asleep_after_s: Some(raw.input.as_ref()?.asleep_after_s).filter(|after_s| *after_s > 0.0),
        identity_readings: raw.pack_identity.as_ref().map_or(1, |keys| keys.readings),
        flood: FloodConfig { max_frames_per_s: NonZeroU32::new(raw.input.as_ref()?.max_frames_per_s)? },
        output: traffic.output,
        commands: traffic.commands,
        j1939: traffic.j1939,
        sample: SampleConfig { voltage_noise_v: estimator.voltage.noise_v, ..sample(raw, pack, &ranged, found)? },
        estimator,
        health: HealthConfig {
            transition: raw.transition.as_ref()?.config(rated_ah * f64::from(pack.strings)),
            capacity,
            recharge: raw.recharge.as_ref()?.config(rated_ah),
            end_of_life_ah: raw.capacity.as_ref()?.end_of_life * rated_ah,
            usable: raw.usable.as_ref().map(|keys| keys.config(rated_ah)),
        },
        rules,
        model,
        modules,
        label: cells::label(pack).filter(|_| pack.learn_model),
        is_balanced: pack.balancing,
        balancing: raw.balancing.as_ref().map(|keys| BalancingConfig {
            bleed_a: keys.bleed_a / f64::from(pack.strings),
            max_age_s: keys.max_age_s,
            is_only_while_sent: keys.only_while_sent,
        }),
    })
}

fn sample(raw: &RawTables, pack: &Pack, model: &CellModel, found: &DbcRanges) -> Option<SampleConfig> {
    let (cells, voltage_source) = if raw.is_pack_total() {
        (1, VoltageSource::PackTotal { series: pack.cells })
    } else {
        (pack.cells, VoltageSource::Cells)
    };
    Some(SampleConfig {
        cells,
        voltage_source,
        strings: pack.strings,
        current: raw.current_limits.as_ref()?.config(found.current_a),
        voltage: raw.voltage_limits.as_ref()?.config(model, found.voltage_v),
        temperature: raw.temperature_limits.as_ref()?.config(found.temperature_c),
        reported_soc: raw.reported_soc.as_ref().map(|keys| reported_limits(keys.max_age_s)),
        reported_soh: raw.reported_soh.as_ref().map(|keys| reported_limits(keys.max_age_s)),
        contactor: raw.contactor.as_ref().map(|keys| ContactorConfig {
            open: keys.open.clone(),
            limits: Limits { min: f64::NEG_INFINITY, max: f64::INFINITY, ..reported_limits(keys.max_age_s) },
        }),
        sensor_of_cell: sensors(&raw.temperatures, cells),
        voltage_noise_v: 0.0,
        ambient_c: pack.ambient_c,
    })
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
