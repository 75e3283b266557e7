//! Builds the settings of the core from the tables of a checked file.

use std::num::NonZeroU32;
use std::path::Path;

use super::alarm::RatedCell;
use super::cells::{self, Module};
use super::signals::{self, DbcRanges, ResolvedSignal};
use super::{commands, j1939, output, polling, protect};
use crate::can::CanId;
use crate::can::dbc::Database;
use crate::can::flood::FloodConfig;
use crate::cell::{CellModel, CellModule};
use crate::cell_faults::BalancingConfig;
use crate::config::document::ReadFile;
use crate::config::schema::RawTables;
use crate::config::schema::keys::{Pack, TemperatureInput};
use crate::health::HealthConfig;
use crate::monitor::{MonitorConfig, SupplyConfig};
use crate::quantity::{BusIndex, SensorIndex};
use crate::sample::{ContactorConfig, Limits, SampleConfig, VoltageSource};

/// The settings of the core and the layout of the sent frames. If a table is missing or faulty (reported), the result
/// is `None`. `inputs_whole` states whether every configured signal was found.
pub(crate) fn monitor(
    raw: &RawTables,
    signals: &[ResolvedSignal<'_>],
    inputs_whole: bool,
    model: Option<CellModel>,
    modules: Vec<Module<'_>>,
    path: &Path,
    read: ReadFile<'_>,
) -> Option<(MonitorConfig, Option<Database>)> {
    // Builds every part before returning, so that each fault is reported.
    let mut guards = protect::guards(raw, signals, inputs_whole);
    let laid_out = output::output(raw, signals, path, model.as_ref(), read);
    let (commands, guard) = commands::commands(raw, signals, laid_out.as_ref()).unzip();
    guards.extend(guard.flatten());
    let poll = polling::poll(raw, signals);
    let j1939 = j1939::node(raw, signals, laid_out.as_ref().map(|(output, _)| output));
    let (output, layout) = laid_out.unzip();
    let pack = raw.pack.as_ref()?;
    let found = &signals::ranges(signals, pack.cells);
    let mut model = model?;
    model.rated_capacity_ah = pack.rated_capacity_ah.unwrap_or(model.rated_capacity_ah);
    let rated_ah = model.rated_capacity_ah;
    let rated = RatedCell::new(rated_ah, raw.recharge.as_ref()?);
    model.aged_ocv.set_shift_std(raw.capacity.as_ref()?.shift_std());
    let health = health(raw, pack, rated_ah)?;
    let estimator = |model: &CellModel, initial_ah| {
        Some(raw.estimator.as_ref()?.config(initial_ah, model, &health.capacity, found.voltage_step_v))
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
    let monitor = MonitorConfig {
        interfaces: raw.interfaces.len(),
        input: signals::input_map(signals)?,
        answers: polling::answers(signals).ok()?,
        poll,
        supply: raw
            .supply_voltage
            .as_ref()
            .map(|keys| SupplyConfig { minimum_v: keys.minimum_v, max_age_s: keys.max_age_s }),
        guards,
        cycle_times_s: cycle_times_s(signals),
        asleep_after_s: Some(raw.input.as_ref()?.asleep_after_s).filter(|after_s| *after_s > 0.0),
        identity_readings: raw.pack_identity.as_ref().map_or(1, |keys| keys.readings),
        flood: FloodConfig { max_frames_per_s: NonZeroU32::new(raw.input.as_ref()?.max_frames_per_s)? },
        output,
        commands,
        j1939,
        sample: SampleConfig { voltage_noise_v: estimator.voltage.noise_v, ..sample(raw, pack, &ranged, found)? },
        estimator,
        health,
        rules,
        model,
        modules,
        label: cells::label(pack).filter(|_| pack.learn_model),
        fleet: None,
        is_balanced: pack.balancing,
        balancing: raw.balancing.as_ref().map(|keys| BalancingConfig {
            bleed_a: keys.bleed_a / f64::from(pack.strings),
            max_age_s: keys.max_age_s,
            is_only_while_sent: keys.only_while_sent,
        }),
    };
    Some((monitor, layout))
}

fn health(raw: &RawTables, pack: &Pack, rated_ah: f64) -> Option<HealthConfig> {
    let capacity = raw.capacity.as_ref()?;
    Some(HealthConfig {
        transition: raw.transition.as_ref()?.config(rated_ah * f64::from(pack.strings)),
        capacity: capacity.config(rated_ah),
        recharge: raw.recharge.as_ref()?.config(rated_ah),
        end_of_life_ah: capacity.end_of_life * rated_ah,
        usable: raw.usable.as_ref().map(|keys| keys.config(rated_ah)),
        outlook: raw.outlook.as_ref()?.config(raw.usable.as_ref().map(|keys| keys.config(rated_ah)), rated_ah),
    })
}

/// Cycle times (s) of the input messages, from the DBC files.
fn cycle_times_s(found: &[ResolvedSignal<'_>]) -> Vec<(BusIndex, CanId, f64)> {
    let in_frames = found.iter().filter(|resolved| resolved.answer.is_none());
    let times = in_frames.filter_map(|resolved| {
        let cycle_ms = resolved.message.cycle_time_ms.filter(|cycle_ms| *cycle_ms > 0)?;
        Some((resolved.bus, resolved.message.id, f64::from(cycle_ms) / 1000.0))
    });
    let mut times: Vec<_> = times.collect();
    times.dedup_by_key(|(bus, id, _)| (*bus, *id));
    times
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
        direction: raw.current_sign.as_ref().map(|_| Limits {
            min: -1.0,
            max: 1.0,
            ..reported_limits(raw.current_limits.as_ref().map_or(0.0, |keys| keys.max_age_s))
        }),
        contactor: raw.contactor.as_ref().map(|keys| ContactorConfig {
            open: keys.open.clone(),
            limits: Limits { min: f64::NEG_INFINITY, max: f64::INFINITY, ..reported_limits(keys.max_age_s) },
        }),
        sensor_of_cell: sensors(&raw.temperatures, cells),
        voltage_noise_v: 0.0,
        ambient_c: pack.ambient_c,
    })
}

/// Limits of a reported fraction. Some packs report more than 100 %.
fn reported_limits(max_age_s: f64) -> Limits {
    Limits { min: -0.1, max: 1.5, max_rate_per_s: None, stuck_after_s: None, max_age_s }
}

/// The sensor of each cell. A sensor without the key `cells` serves all cells.
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
