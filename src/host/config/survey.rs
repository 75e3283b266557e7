//! As much of a configuration as can be read, faults and all: for `packwatch doctor`.
//!
//! In: the file. Out: the [`Plan`] of what it expects of the buses, every fault as [`load`](super::load) tells them, and
//! where each key stands. A configuration of which no signal can be looked up is refused.

use std::collections::BTreeMap;
use std::path::Path;

use super::convert::{self, Raw};
use super::document::{Document, Faults, Place};
use super::keys::SignalSource;
use super::pattern::Pattern;
use super::resolve::{self, Databases, Resolved};
use super::{Config, ConfigFaults, beside, cell_model, load, protect, read_file, read_text};
use crate::can::decode::{Binding, InputMap};
use crate::cell::CellModel;
use crate::doctor::{Ages, InterfacePlan, MessagePlan, OutputPlan, PackPlan, Plan, SignalPlan};
use crate::quantity::{BusIndex, CellIndex, Channel, MAX_CELLS};

/// What could be read.
#[derive(Debug)]
pub struct Survey {
    /// What is expected of the buses.
    pub plan: Plan,
    /// The signals that were found.
    pub input: InputMap,
    /// The whole, when it is good.
    pub config: Option<Config>,
    /// Every fault; empty when it is good.
    pub faults: Vec<String>,
    places: BTreeMap<String, Place>,
}

impl Survey {
    /// Where a key stands (its table, when it is not written) as `file:line`, and what is written there.
    pub fn locate(&self, table: &str, key: &str) -> Option<(String, Option<String>)> {
        let place = self.places.get(table)?;
        let found = place.found(key).map(str::to_owned);
        Some((format!("{}:{}", place.file, place.line_of(key)), found))
    }
}

/// Reads what can be read.
///
/// # Errors
/// When no interface is configured or no signal can be looked up: every fault found.
pub fn survey(path: &Path) -> Result<Survey, ConfigFaults> {
    let (config, told) = match load(path) {
        Ok(config) => (Some(config), Vec::new()),
        Err(faults) => (None, faults.0),
    };
    // The second reading notes the same faults, which are told already.
    let mut faults = Faults::default();
    read(path, config, told.clone(), &mut faults).ok_or(ConfigFaults(told))
}

fn read(path: &Path, config: Option<Config>, told: Vec<String>, faults: &mut Faults) -> Option<Survey> {
    let text = read_text(path, &read_file, faults)?;
    let document = Document::parse(&path.display().to_string(), &text, faults);
    let raw = Raw::read(&document, faults);
    let names = raw.input.as_ref().map_or(&[][..], |input| &input.dbc);
    let databases = Databases::load(path, names, &read_file, faults)?;
    let found = resolve::resolve(&raw, &databases, faults);
    if raw.interfaces.is_empty() || found.is_empty() {
        return None;
    }
    let model =
        raw.cell_model.as_ref().and_then(|named| cell_model::load_with(&beside(path, named), &read_file, faults));
    let signals: Vec<SignalPlan> = found.iter().filter_map(|resolved| signal(&raw, resolved)).collect();
    let guards = match &config {
        Some(config) => config.monitor.guards.clone(),
        None => protect::guards(&raw, &found, false, faults),
    };
    let pack_ah =
        model.as_ref().map_or(50.0, |m| m.rated_capacity_ah) * raw.pack.as_ref().map_or(1.0, |p| f64::from(p.strings));
    let dead_band_a = raw.transition.as_ref().map(|keys| convert::transition(keys, pack_ah).dead_band_a);
    let pack = PackPlan {
        cells: raw.pack.as_ref().map_or_else(|| cells_of(&found), |pack| pack.cells),
        is_total: raw.voltages_written.1,
        strings: raw.pack.as_ref().map_or(1, |pack| pack.strings),
        capacity_ah: capacity_ah(&raw, model.as_ref()),
        model,
        ambient_c: raw.pack.as_ref().map_or(25.0, |pack| pack.ambient_c),
        dead_band_a: dead_band_a.unwrap_or(pack_ah / 50.0),
        voltage_noise_v: raw.estimator.as_ref().map_or(0.0, |keys| keys.voltage_noise_v),
    };
    let plan = Plan {
        interfaces: raw.interfaces.iter().map(|i| InterfacePlan { name: i.name.clone(), fd: i.fd }).collect(),
        more_cells: more_cells(&raw, &databases),
        messages: messages(&found, &signals),
        signals,
        pack,
        limits: config.as_ref().map(limits).unwrap_or_default(),
        ages: ages(&raw),
        guards,
        outputs: config.as_ref().map(outputs).unwrap_or_default(),
        is_csv: false,
    };
    let input = resolve::input_map(&found)?;
    Some(Survey { plan, input, config, faults: told, places: places(&raw) })
}

fn capacity_ah(raw: &Raw, model: Option<&CellModel>) -> f64 {
    /// Where nothing says one: a car's cell.
    const USUAL_AH: f64 = 50.0;
    let configured = raw.pack.as_ref().and_then(|pack| pack.initial_capacity_ah.or(pack.rated_capacity_ah));
    configured.or(model.map(|model| model.capacity_ah)).unwrap_or(USUAL_AH)
}

fn cells_of(found: &[Resolved<'_>]) -> u16 {
    let cells = found.iter().filter(|resolved| matches!(resolved.channel, Channel::CellVoltage(_))).count();
    u16::try_from(cells).unwrap_or(1).max(1)
}

fn source_of(raw: &Raw, channel: Channel) -> Option<SignalSource<'_>> {
    match channel {
        Channel::Current => raw.current.as_ref().map(|keys| keys.source()),
        Channel::Temperature(sensor) => raw.temperatures.get(usize::from(sensor.0)).map(|keys| keys.source()),
        Channel::PackVoltage => raw.pack_voltage.as_ref().map(|keys| keys.source()),
        Channel::CellVoltage(_) => raw.cell_voltage.as_ref().map(|keys| keys.source()),
        Channel::ReportedSoc => raw.reported_soc.as_ref().map(|keys| keys.source()),
        Channel::ReportedSoh => raw.reported_soh.as_ref().map(|keys| keys.source()),
        Channel::PackIdentity => raw.pack_identity.as_ref().map(|keys| keys.source()),
    }
}

fn signal(raw: &Raw, resolved: &Resolved<'_>) -> Option<SignalPlan> {
    let source = source_of(raw, resolved.channel)?;
    Some(SignalPlan {
        binding: resolved.binding().ok()?,
        layout: resolved.signal.layout,
        table: source.place.path.clone(),
        message: resolved.message.name.clone(),
        name: format!("{}.{}", resolved.message.name, resolved.signal.name),
        unit: resolved.signal.unit.clone(),
        scale: source.scale,
        offset: source.offset,
    })
}

/// Signals that fit the cells' pattern beyond the configured number, one after the other.
fn more_cells(raw: &Raw, databases: &Databases) -> Vec<SignalPlan> {
    let (Some(keys), Some(pack)) = (&raw.cell_voltage, &raw.pack) else { return Vec::new() };
    let source = keys.source();
    let (Ok(pattern), Some(bus)) = (Pattern::parse(source.signal), resolve::bus_of(raw, source.interface)) else {
        return Vec::new();
    };
    let end = u32::from(keys.first) + u32::from(pack.cells);
    let mut numbered: BTreeMap<u32, SignalPlan> = BTreeMap::new();
    for (_, message, signal) in databases.signals() {
        let name = format!("{}.{}", message.name, signal.name);
        let Some(Some(number)) = pattern.fits(&name).filter(|number| number.is_some_and(|n| n >= end)) else {
            continue;
        };
        let Some(cell) = u16::try_from(number - u32::from(keys.first)).ok().filter(|c| usize::from(*c) < MAX_CELLS)
        else {
            continue;
        };
        let Ok(mut binding) = Binding::new(bus, message, signal, Channel::CellVoltage(CellIndex(cell))) else {
            continue;
        };
        (binding.scale, binding.offset) = (source.scale, source.offset);
        binding.not_available.extend(source.not_available);
        let plan = SignalPlan {
            binding,
            layout: signal.layout,
            table: source.place.path.clone(),
            message: message.name.clone(),
            name,
            unit: signal.unit.clone(),
            scale: source.scale,
            offset: source.offset,
        };
        numbered.insert(number, plan);
    }
    (end..).zip(numbered).take_while(|(next, (number, _))| next == number).map(|(_, (_, plan))| plan).collect()
}

fn messages(found: &[Resolved<'_>], signals: &[SignalPlan]) -> Vec<MessagePlan> {
    let mut messages: Vec<MessagePlan> = Vec::new();
    for resolved in found {
        let (bus, id) = (resolved.bus, resolved.message.id);
        if messages.iter().any(|message| (message.bus, message.id) == (bus, id)) {
            continue;
        }
        let mut pages: Vec<_> =
            signals.iter().filter(|s| (s.binding.bus, s.binding.id) == (bus, id)).map(|s| &s.binding.mux).collect();
        pages.dedup();
        messages.push(MessagePlan {
            bus,
            id,
            name: resolved.message.name.clone(),
            cycle_time_s: resolved.message.cycle_time_ms.map(|ms| f64::from(ms) / 1000.0),
            pages: pages.len(),
        });
    }
    messages
}

fn ages(raw: &Raw) -> Ages {
    Ages {
        current_s: raw.current_limits.as_ref().map_or(f64::INFINITY, |keys| keys.max_age_s),
        voltage_s: raw.voltage_limits.as_ref().map_or(f64::INFINITY, |keys| keys.max_age_s),
        temperature_s: raw.temperature_limits.as_ref().map_or(f64::INFINITY, |keys| keys.max_age_s),
    }
}

fn limits(config: &Config) -> [(f64, f64); 3] {
    let sample = &config.monitor.sample;
    [sample.current, sample.voltage, sample.temperature].map(|limits| (limits.min, limits.max))
}

fn outputs(config: &Config) -> Vec<OutputPlan> {
    let Some(output) = &config.monitor.output else { return Vec::new() };
    let named = output.plan.ids().into_iter().zip(["status", "health", "alarm"]);
    let buses: Vec<BusIndex> = output.buses.clone();
    named.map(|(id, name)| OutputPlan { buses: buses.clone(), id, name, table: format!("output.{name}") }).collect()
}

/// The place of every table a finding may name.
fn places(raw: &Raw) -> BTreeMap<String, Place> {
    let mut all: Vec<&Place> = raw.interfaces.iter().map(|keys| &keys.place).collect();
    all.extend(raw.pack.as_ref().map(|keys| &keys.place));
    all.extend(raw.input.as_ref().map(|keys| &keys.place));
    all.extend(raw.current.as_ref().map(|keys| &keys.place));
    all.extend(raw.cell_voltage.as_ref().map(|keys| &keys.place));
    all.extend(raw.pack_voltage.as_ref().map(|keys| &keys.place));
    all.extend(raw.temperatures.iter().map(|keys| &keys.place));
    all.extend(raw.reported_soc.as_ref().map(|keys| &keys.place));
    all.extend(raw.reported_soh.as_ref().map(|keys| &keys.place));
    all.extend(raw.pack_identity.as_ref().map(|keys| &keys.place));
    all.extend(raw.protected.iter().map(|keys| &keys.place));
    all.extend(raw.current_limits.as_ref().map(|keys| &keys.place));
    all.extend(raw.voltage_limits.as_ref().map(|keys| &keys.place));
    all.extend(raw.temperature_limits.as_ref().map(|keys| &keys.place));
    all.extend(raw.estimator.as_ref().map(|keys| &keys.place));
    all.extend(raw.transition.as_ref().map(|keys| &keys.place));
    all.extend(raw.output_status.as_ref().map(|keys| &keys.place));
    all.extend(raw.output_health.as_ref().map(|keys| &keys.place));
    all.extend(raw.output_alarm.as_ref().map(|keys| &keys.place));
    all.into_iter().map(|place| (place.path.clone(), place.clone())).collect()
}
