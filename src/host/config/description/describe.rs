//! Describes the meaning of a configuration in words and numbers, for `packwatch check`.

use std::path::Path;

use serde::Serialize;

use super::traffic::{self, OutputUse};
use crate::alarm::{Comparison, Direction, Rule, RuleConfig, Unit};
use crate::can::CanId;
use crate::can::dbc::Message;
use crate::can::signal::{ByteOrder, ValueType};
use crate::cell::CellModel;
use crate::config::checks::{ResolvedSignal, channel_words, ranges};
use crate::config::document::{ConfigFaults, ConfigFiles, ReadFile, read_file};
use crate::config::result::{Config, InterfaceConfig, VehicleIdentity, read_and};
use crate::config::schema::RawTables;
use crate::config::schema::keys::TemperatureInput;
use crate::health::RechargeAlarm;
use crate::monitor::MonitorConfig;
use crate::quantity::{BusIndex, Channel};
use crate::sample::VoltageSource;

/// What a valid configuration means, in words and numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Description {
    /// The configuration file.
    pub file: String,
    /// Values that are allowed but unlikely, one line each.
    pub warnings: Vec<String>,
    /// The drop-ins of the configuration file, in merge order.
    pub drop_ins: Vec<String>,
    /// The vehicle.
    pub vehicle: VehicleIdentity,
    /// The cell model.
    pub cell: String,
    /// Assumptions about the pack, in sentences.
    pub pack: Vec<String>,
    /// Interfaces and their kernel filters.
    pub interfaces: Vec<InterfaceUse>,
    /// Every configured signal, as found in its DBC file or diagnostic answer.
    pub signals: Vec<SignalUse>,
    /// Ranges of plausible readings.
    pub limits: Vec<String>,
    /// Checks of a frame before it is decoded (rate limit, end-to-end protection), in sentences.
    pub intake: Vec<String>,
    /// The sent frames.
    pub outputs: Vec<OutputUse>,
    /// Alarms, in sentences.
    pub alarms: Vec<String>,
    /// The diagnostic requests that are sent, in sentences; empty = no requests are sent.
    pub polling: Vec<String>,
    /// The J1939 node and its codes, in sentences; empty = no node.
    pub j1939: Vec<String>,
}

/// An interface and the identifiers read from it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct InterfaceUse {
    /// Kernel name.
    pub name: String,
    /// Whether FD frames are accepted.
    pub fd: bool,
    /// Identifiers of inputs that pass the kernel filter, in candump notation.
    pub filter_ids: Vec<String>,
    /// The program's own identifiers, which pass the filter so that foreign senders are detected.
    pub own_ids: Vec<String>,
}

/// A configured signal as found in its DBC file or diagnostic answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SignalUse {
    /// Input that the signal feeds: `pack current`, `cell 7 voltage`.
    pub channel: String,
    /// Interface that carries the signal.
    pub interface: String,
    /// Identifier in candump notation.
    pub id: String,
    /// DBC file, or table of the diagnostic answer.
    pub dbc: String,
    /// Message name.
    pub message: String,
    /// Signal name.
    pub signal: String,
    /// Condition for the signal: `Page = 3` in a multiplexed frame, `answer of 7EC to 22 01 01` in a diagnostic answer.
    /// Empty = the signal is in every frame.
    pub multiplex: String,
    /// DBC start bit. In a diagnostic answer: the first bit, counted after the echoed service and identifier.
    pub start_bit: usize,
    /// Length, bits.
    pub length_bits: u16,
    /// Byte order: `little-endian` or `big-endian`.
    pub byte_order: &'static str,
    /// Type of the value: `unsigned`, `signed`, `float32` or `float64`.
    pub value_type: &'static str,
    /// DBC factor.
    pub factor: f64,
    /// DBC offset.
    pub offset: f64,
    /// DBC unit.
    pub unit: String,
    /// Factor from the DBC's unit and sign to packwatch's (positive = discharge). The factor is negative if charge is
    /// positive on the bus.
    pub scale: f64,
    /// Offset in packwatch's unit and sign, added after the scale.
    pub added: f64,
    /// Smallest and largest value stated by the DBC, in packwatch's unit and sign.
    pub range: Option<[f64; 2]>,
    /// Raw codes that mean "not available", hex.
    pub not_available: Vec<String>,
    /// Cells served by a temperature sensor.
    pub serves: Option<String>,
}

/// Reads and checks a configuration and describes it.
///
/// # Errors
/// Returns every fault found, not only the first.
pub fn describe(path: &Path) -> Result<Description, ConfigFaults> {
    describe_with(&ConfigFiles::find(path)?, &read_file).map(|(_, description)| description)
}

/// Like [`describe`], but reads files with `read` and also returns the configuration.
///
/// # Errors
/// Returns every fault found, not only the first.
pub fn describe_with(files: &ConfigFiles, read: ReadFile<'_>) -> Result<(Config, Description), ConfigFaults> {
    read_and(files, read, |raw, config, found| description(files, raw, config, found))
}

/// Describes a checked configuration and the signals found for it.
fn description(files: &ConfigFiles, raw: &RawTables, config: &Config, found: &[ResolvedSignal<'_>]) -> Description {
    let model = &config.monitor.model;
    let voltage_step_v = ranges(found, raw.pack.as_ref().map_or(1, |pack| pack.cells)).voltage_step_v;
    let rounding_v = raw.estimator.as_ref().map_or(0.0, |keys| keys.rounding_v(voltage_step_v));
    let cell = format!(
        "{}: rated {} Ah, {} Ah when new, {} to {} V, {} RC branch{}{}",
        model.name,
        model.rated_capacity_ah,
        model.capacity_ah,
        model.voltage_min_v,
        model.voltage_max_v,
        model.branches.len(),
        if model.branches.len() == 1 { "" } else { "es" },
        if model.thermal.is_some() { ", thermal model" } else { ", no thermal model" },
    );
    Description {
        file: config.path.display().to_string(),
        warnings: config.warnings.clone(),
        drop_ins: files.drop_ins.iter().map(|file| file.display().to_string()).collect(),
        vehicle: config.vehicle.clone(),
        cell,
        pack: pack(config, voltage_step_v, rounding_v),
        interfaces: (0..).zip(&config.interfaces).map(|(bus, i)| interface(BusIndex(bus), i, config)).collect(),
        signals: found.iter().map(|resolved| signal(raw, config, resolved)).collect(),
        limits: limits(config),
        intake: traffic::intake(config, found),
        outputs: traffic::outputs(config),
        alarms: config.monitor.rules.iter().map(|rule| alarm(rule, &config.monitor)).collect(),
        polling: traffic::polling(config),
        j1939: traffic::j1939(config),
    }
}

fn pack(config: &Config, voltage_step_v: f64, rounding_v: f64) -> Vec<String> {
    let sample = &config.monitor.sample;
    let mut words = vec![match sample.voltage_source {
        VoltageSource::Cells => format!("{} cells in series, each with its own voltage", sample.cells),
        VoltageSource::PackTotal { series } => format!(
            "only the total voltage is known: {series} equal cells are assumed and estimated as one; a weak cell cannot be detected"
        ),
    }];
    for module in &config.monitor.modules {
        let cells: Vec<u16> = module.cells.iter().map(|cell| cell.0 + 1).collect();
        let CellModel { name, rated_capacity_ah, capacity_ah, .. } = &module.model;
        words.push(format!(
            "cells {}: another type of cell, {name}: rated {rated_capacity_ah} Ah, {capacity_ah} Ah when new; not compared with the others",
            cell_list(&cells)
        ));
    }
    if sample.strings > 1 {
        words.push(format!(
            "{} parallel strings: each is assumed to carry an equal share of the current",
            sample.strings
        ));
    }
    let bare = (1..).zip(&sample.sensor_of_cell).filter(|(_, sensor)| sensor.is_none()).map(|(cell, _)| cell);
    let bare: Vec<u16> = bare.collect();
    if !bare.is_empty() {
        let ambient_c = sample.ambient_c;
        let cells = match bare.len() == usize::from(sample.cells) {
            true => String::new(),
            false => format!(" for cells {}", cell_list(&bare)),
        };
        let from = if config.monitor.model.thermal.is_some() { "from the thermal model at" } else { "taken as" };
        words.push(format!("no temperature sensor{cells}: {from} {ambient_c} degrees C"));
    }
    if rounding_v > 0.0 {
        words.push(format!(
            "voltage resolution is {} mV: rounding counts as noise of {:.1} mV",
            round(1000.0 * voltage_step_v),
            1000.0 * rounding_v
        ));
    }
    words.push("a positive current is a discharge in everything reported".to_owned());
    words
}

fn interface(bus: BusIndex, interface: &InterfaceConfig, config: &Config) -> InterfaceUse {
    let groups = config.monitor.input.groups();
    let named = |id: &CanId| match groups.has_any_source(bus, *id) {
        true => format!("{id} (any source address)"),
        false => id.to_string(),
    };
    let filter_ids: Vec<_> = config.monitor.listened_ids(bus).iter().map(named).collect();
    let all: Vec<_> = config.monitor.wanted_ids(bus).iter().map(named).collect();
    let own_ids = all.into_iter().filter(|id| !filter_ids.contains(id)).collect();
    InterfaceUse { name: interface.name.clone(), fd: interface.fd, filter_ids, own_ids }
}

fn signal(raw: &RawTables, config: &Config, resolved: &ResolvedSignal<'_>) -> SignalUse {
    let layout = &resolved.signal.layout;
    let range = resolved.range();
    SignalUse {
        channel: channel_words(resolved.channel),
        interface: config.interface_name(resolved.bus).to_owned(),
        id: resolved.message.id.to_string(),
        dbc: resolved.file.to_owned(),
        message: resolved.message.name.clone(),
        signal: resolved.signal.name.clone(),
        multiplex: resolved.answer.map_or_else(|| multiplex(resolved), |answer| answer.words()),
        start_bit: resolved.answer.map_or(usize::from(layout.start_bit), |answer| answer.bit(layout)),
        length_bits: layout.length_bits,
        byte_order: match layout.byte_order {
            ByteOrder::LittleEndian => "little-endian",
            ByteOrder::BigEndian => "big-endian",
        },
        value_type: match layout.value_type {
            ValueType::Unsigned => "unsigned",
            ValueType::Signed => "signed",
            ValueType::Float32 => "float32",
            ValueType::Float64 => "float64",
        },
        factor: layout.factor,
        offset: layout.offset,
        unit: resolved.signal.unit.clone(),
        scale: resolved.scale,
        added: resolved.offset,
        range: range.0.is_finite().then_some([range.0, range.1]),
        not_available: resolved.not_available.iter().map(|code| format!("{code:X}")).collect(),
        serves: match resolved.channel {
            Channel::Temperature(sensor) => raw.temperatures.get(usize::from(sensor.0)).map(serves),
            _ => None,
        },
    }
}

fn multiplex(resolved: &ResolvedSignal<'_>) -> String {
    let name = |message: &Message, index: usize| message.signals.get(index).map(|s| s.name.clone()).unwrap_or_default();
    let conditions = resolved.signal.conditions.iter().map(|condition| {
        let ranges: Vec<String> = condition.ranges.iter().map(|(low, high)| span(low, high)).collect();
        format!("{} = {}", name(resolved.message, condition.selector), ranges.join(", "))
    });
    conditions.collect::<Vec<_>>().join(" and ")
}

fn serves(sensor: &TemperatureInput) -> String {
    match &sensor.cells {
        Some(cells) => format!(
            "cells {}",
            cells.0.iter().map(|cells| span(cells.start(), cells.end())).collect::<Vec<_>>().join(", ")
        ),
        None => "all cells".to_owned(),
    }
}

/// Formats increasing numbers as `1-3, 7`.
fn cell_list(cells: &[u16]) -> String {
    let mut runs: Vec<(u16, u16)> = Vec::new();
    for &cell in cells {
        match runs.last_mut() {
            Some((_, last)) if *last + 1 == cell => *last = cell,
            _ => runs.push((cell, cell)),
        }
    }
    runs.iter().map(|(first, last)| span(first, last)).collect::<Vec<_>>().join(", ")
}

/// Formats a range as `1-3`, or as `7` if both ends are equal.
fn span<T: PartialEq + std::fmt::Display>(first: &T, last: &T) -> String {
    if first == last { format!("{first}") } else { format!("{first}-{last}") }
}

fn limits(config: &Config) -> Vec<String> {
    let sample = &config.monitor.sample;
    let kinds = [
        ("pack current", sample.current, "A"),
        ("cell voltage", sample.voltage, "V"),
        ("temperature", sample.temperature, "degrees C"),
    ];
    let words = kinds.iter().map(|(name, limits, unit)| {
        let mut words = match (limits.min.is_finite(), limits.max.is_finite()) {
            (true, true) => format!("{name} from {} to {} {unit}", limits.min, limits.max),
            (true, false) => format!("{name} of {} {unit} or more", limits.min),
            (false, true) => format!("{name} of {} {unit} or less", limits.max),
            (false, false) => format!("{name} of any size"),
        };
        if let Some(rate) = limits.max_rate_per_s {
            words.push_str(&format!(", moving at most {rate} {unit}/s"));
        }
        if let Some(stuck_after_s) = limits.stuck_after_s {
            words.push_str(&format!(", stuck after {stuck_after_s} s"));
        }
        words.push_str(&format!(", stale after {} s", limits.max_age_s));
        words
    });
    words.collect()
}

fn alarm(rule: &RuleConfig, monitor: &MonitorConfig) -> String {
    let row = rule.rule.spec();
    let what = match (rule.rule, monitor.health.recharge.alarm_on) {
        (Rule::RechargePeriodLow, RechargeAlarm::Normalised) => "the normalised recharge period",
        _ => row.about,
    };
    let side = match row.direction {
        Direction::Below => "below",
        Direction::Above => "above",
    };
    let severity = rule.severity.name();
    let of_rated = match row.unit {
        Unit::AmpereHours => {
            format!(" ({} % of rated)", round(100.0 * rule.threshold / monitor.model.rated_capacity_ah))
        }
        _ => String::new(),
    };
    let (set, clear) = (amount(rule.threshold, row.unit), amount(rule.clear, row.unit));
    let mut words = format!("{severity} when {what} is {side} {set}{of_rated}");
    if let Comparison::Probability(level) = rule.when {
        words.push_str(&format!(" with a probability above {} %", round(100.0 * level)));
    }
    if rule.debounce_s > 0.0 {
        words.push_str(&format!(" for {} s", rule.debounce_s));
    }
    if rule.debounce_events > 1 {
        words.push_str(&format!(" in {} consecutive values", rule.debounce_events));
    }
    words.push_str(&format!(", cleared at {clear}"));
    if rule.is_latching {
        words.push_str(" and on command");
    }
    words
}

/// A value of a rule with its unit. Fractions are shown as percentages.
fn amount(value: f64, unit: Unit) -> String {
    match unit {
        Unit::Fraction => format!("{} %", round(100.0 * value)),
        Unit::FractionPerDay => format!("{} %/d", round(100.0 * value)),
        Unit::Ratio => round(value).to_string(),
        Unit::AmpereHours | Unit::Seconds | Unit::Celsius | Unit::Cycles => {
            format!("{} {}", round(value), unit.symbol())
        }
    }
}

/// Removes the digits that binary floating point adds to a decimal number.
fn round(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}
