//! Builds the [`Plan`] of `packwatch doctor`: what a configuration expects from the buses. A configuration with faults
//! is read as far as possible.
//!
//! In: the configuration file. Out: the plan, all faults as [`config::load`](crate::config::load) reports them, and the
//! position of each key. A configuration is rejected if it has no interface or if none of its signals is found.

mod beside;

use std::collections::BTreeMap;
use std::path::Path;

use crate::bounded_file;
use crate::can::dbc::{Message, Signal};
use crate::can::decode::{Binding, InputMap};
use crate::can::encode::SentMessage;
use crate::can::uds::Answer;
use crate::cell::CellModel;
use crate::config::{
    Config, ConfigFaults, Databases, NamedSignal, PartialConfig, Pattern, RawTables, ReadFile, ResolvedSignal,
    SignalSource, TablePlace, answers, input_map, label_of,
};
use crate::quantity::{CellIndex, Channel, MAX_CELLS};
use crate::wiring::{InterfacePlan, MessagePlan, OutputPlan, PackPlan, Plan, SignalPlan};

/// Capacity that is used if the configuration states none (Ah). This capacity is typical of a car's cell.
const USUAL_AH: f64 = 50.0;

/// The readable part of a configuration, as `packwatch doctor` needs it.
#[derive(Debug)]
pub struct Survey {
    /// What the configuration expects from the buses.
    pub plan: Plan,
    /// The signals that were found.
    pub input: InputMap,
    /// The diagnostic answers that were found.
    pub answers: Vec<Answer>,
    /// The whole configuration, if it is valid.
    pub config: Option<Config>,
    /// All faults; empty if there are none.
    pub faults: Vec<String>,
    places: BTreeMap<String, TablePlace>,
}

impl Survey {
    /// Returns the position of a key as `file:line`, and its value. If the key is absent, returns the position of its
    /// table.
    pub fn locate(&self, table: &str, key: &str) -> Option<(String, Option<String>)> {
        let place = self.places.get(table)?;
        let found = place.found(key).map(str::to_owned);
        Some((place.line_of(key).to_string(), found))
    }
}

/// Reads the readable part of a configuration.
///
/// # Errors
/// Fails if no interface is configured or no signal can be found, and returns all faults.
pub fn survey(path: &Path) -> Result<Survey, ConfigFaults> {
    survey_with(path, &bounded_file::read)
}

/// Like [`survey`], but reads files with `read`.
pub(super) fn survey_with(path: &Path, read: ReadFile<'_>) -> Result<Survey, ConfigFaults> {
    let partial = PartialConfig::read(path, read)?;
    let found = partial.signals();
    let answers = answers(&found).unwrap_or_default();
    let input = input_map(&found).filter(|_| !partial.raw.interfaces.is_empty() && !found.is_empty());
    let Some(input) = input else { return Err(ConfigFaults(partial.faults)) };
    let plan = plan(&partial, &found);
    let places = partial.raw.places().map(|place| (place.path.clone(), place.clone())).collect();
    Ok(Survey { plan, input, answers, places, config: partial.config, faults: partial.faults })
}

fn plan(partial: &PartialConfig, found: &[ResolvedSignal<'_>]) -> Plan {
    let PartialConfig { config, raw, model, databases, .. } = partial;
    let (pack, config, model) = (raw.pack.as_ref(), config.as_ref(), model.as_ref());
    let in_frames: Vec<ResolvedSignal<'_>> = found.iter().filter(|input| input.answer.is_none()).cloned().collect();
    let signals: Vec<SignalPlan> = found.iter().filter_map(|resolved| signal(raw, resolved)).collect();
    let strings = pack.map_or(1, |pack| pack.strings);
    let pack_ah = model.map_or(USUAL_AH, |model| model.rated_capacity_ah) * f64::from(strings);
    let pack_plan = PackPlan {
        cells: pack.map_or_else(|| cells_of(found), |pack| pack.cells),
        is_total: raw.is_pack_total(),
        strings,
        capacity_ah: capacity_ah(raw, model),
        model: model.cloned(),
        label: pack.and_then(label_of),
        ambient_c: pack.map_or(25.0, |pack| pack.ambient_c),
        dead_band_a: raw.transition.as_ref().map_or(pack_ah / 50.0, |keys| keys.config(pack_ah).dead_band_a),
        voltage_noise_v: raw.estimator.as_ref().map_or(0.0, |keys| keys.voltage_noise_v),
    };
    Plan {
        interfaces: raw.interfaces.iter().map(|i| InterfacePlan { name: i.name.clone(), fd: i.fd }).collect(),
        more_cells: more_cells(raw, databases),
        unconfigured: beside::signals(raw, databases, found),
        messages: messages(&in_frames, &signals),
        signals,
        pack: pack_plan,
        limits: config.map(limits).unwrap_or_default(),
        max_ages_s: max_ages_s(raw),
        guards: partial.guards(found),
        outputs: config.map(outputs).unwrap_or_default(),
        is_csv: false,
    }
}

fn capacity_ah(raw: &RawTables, model: Option<&CellModel>) -> f64 {
    let configured = raw.pack.as_ref().and_then(|pack| pack.initial_capacity_ah.or(pack.rated_capacity_ah));
    configured.or(model.map(|model| model.capacity_ah)).unwrap_or(USUAL_AH)
}

fn cells_of(found: &[ResolvedSignal<'_>]) -> u16 {
    let cells = found.iter().filter(|resolved| matches!(resolved.channel, Channel::CellVoltage(_))).count();
    u16::try_from(cells).unwrap_or(1).max(1)
}

fn signal(raw: &RawTables, resolved: &ResolvedSignal<'_>) -> Option<SignalPlan> {
    let source = raw.source(resolved.channel)?;
    let mut plan = signal_plan(&source, resolved.message, resolved.signal, resolved.binding().ok()?);
    plan.answer = resolved.answer.map(|place| place.source(resolved.bus));
    Some(plan)
}

fn signal_plan(source: &SignalSource<'_>, message: &Message, signal: &Signal, binding: Binding) -> SignalPlan {
    SignalPlan {
        binding,
        layout: signal.layout,
        answer: None,
        table: source.place.path.clone(),
        message: message.name.clone(),
        name: format!("{}.{}", message.name, signal.name),
        unit: signal.unit.clone(),
        scale: source.scale,
        offset: source.offset,
    }
}

/// Returns signals that match the pattern of the cell voltages but are not configured. Their numbers continue the
/// numbers of the configured cells without a gap.
fn more_cells(raw: &RawTables, databases: &Databases) -> Vec<SignalPlan> {
    let (Some(keys), Some(pack)) = (&raw.cell_voltage, &raw.pack) else { return Vec::new() };
    let source = keys.config();
    let (Ok(pattern), Some(bus)) = (Pattern::parse(source.signal), raw.bus_of(source.interface)) else {
        return Vec::new();
    };
    let end = u32::from(keys.first) + u32::from(pack.cells);
    let mut numbered: BTreeMap<u32, SignalPlan> = BTreeMap::new();
    for NamedSignal { message, signal, .. } in databases.signals().filter(|signal| signal.answer.is_none()) {
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
        numbered.insert(number, signal_plan(&source, message, signal, binding));
    }
    (end..).zip(numbered).take_while(|(next, (number, _))| next == number).map(|(_, (_, plan))| plan).collect()
}

fn messages(found: &[ResolvedSignal<'_>], signals: &[SignalPlan]) -> Vec<MessagePlan> {
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

fn max_ages_s(raw: &RawTables) -> [Option<f64>; 3] {
    let RawTables { current_limits, voltage_limits, temperature_limits, .. } = raw;
    [
        current_limits.as_ref().map(|keys| keys.max_age_s),
        voltage_limits.as_ref().map(|keys| keys.max_age_s),
        temperature_limits.as_ref().map(|keys| keys.max_age_s),
    ]
}

fn limits(config: &Config) -> [(f64, f64); 3] {
    let sample = &config.monitor.sample;
    [sample.current, sample.voltage, sample.temperature].map(|limits| (limits.min, limits.max))
}

fn outputs(config: &Config) -> Vec<OutputPlan> {
    let Some(output) = &config.monitor.output else { return Vec::new() };
    let plan = |sent: SentMessage| {
        let name = sent.message.name();
        OutputPlan { buses: output.buses.clone(), id: sent.id, name, table: format!("output.{name}") }
    };
    output.plan.messages().map(plan).collect()
}
