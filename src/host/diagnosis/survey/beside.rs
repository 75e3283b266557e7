//! Signals of the DBC files that are not configured and can be compared with those that are.
//!
//! In: the DBC files and the configured signals. Out: signals that are the pack's voltage or a state of charge by their name and
//! unit, bound to every interface, for a DBC does not state its bus.

use crate::can::dbc::{Message, Signal};
use crate::can::decode::Binding;
use crate::can::unit::{Quantity, SignalUnit};
use crate::config::{Databases, RawTables, ResolvedSignal};
use crate::doctor::SignalPlan;
use crate::quantity::{BusIndex, Channel};

/// Most signals that are followed, on all interfaces together.
const MAX_SIGNALS: usize = 64;

/// The comparable signals.
pub(super) fn signals(raw: &RawTables, databases: &Databases, found: &[ResolvedSignal<'_>]) -> Vec<SignalPlan> {
    let is_configured = |signal: &Signal| found.iter().any(|resolved| std::ptr::eq(resolved.signal, signal));
    let free = databases.signals().filter(|(_, _, signal)| !is_configured(signal));
    let wanted = free.filter_map(|(_, message, signal)| Some((message, signal, channel_of(raw, message, signal)?)));
    let buses = u8::try_from(raw.interfaces.len()).unwrap_or(u8::MAX);
    let bound = wanted.flat_map(|(message, signal, channel)| {
        (0..buses).filter_map(move |bus| plan(BusIndex(bus), message, signal, channel))
    });
    bound.take(MAX_SIGNALS).collect()
}

/// What a signal is by its name and unit; `None` = nothing to compare.
fn channel_of(raw: &RawTables, message: &Message, signal: &Signal) -> Option<Channel> {
    let unit = SignalUnit::parse(&signal.unit);
    let name = format!("{}{}", message.name, signal.name).to_ascii_lowercase().replace('_', "");
    let own = signal.name.to_ascii_lowercase().replace('_', "");
    let has = |text: &str, words: &[&str]| words.iter().any(|word| text.contains(word));
    if has(&own, &["min", "max", "lim", "target", "request", "avg", "cell", "aux", "12v", "lv", "charger"]) {
        return None;
    }
    let is_volt = unit.is_some_and(|unit| unit.quantity == Quantity::Voltage);
    let is_share = signal.unit.is_empty() || unit.is_some_and(|unit| unit.quantity == Quantity::Other("a percentage"));
    if is_volt && has(&name, &["pack", "total", "batt", "hv", "bms", "stack"]) && has(&own, &["volt", "sum", "ubat"]) {
        (!raw.is_pack_total()).then_some(Channel::PackVoltage)
    } else if is_share && (own.ends_with("soc") || own.starts_with("soc") || has(&own, &["stateofcharge"])) {
        Some(Channel::ReportedSoc)
    } else {
        None
    }
}

fn plan(bus: BusIndex, message: &Message, signal: &Signal, channel: Channel) -> Option<SignalPlan> {
    let unit = SignalUnit::parse(&signal.unit);
    let scale = match channel {
        Channel::PackVoltage => unit.map_or(1.0, |unit| unit.factor),
        // Without a unit, what reaches beyond 1.5 counts percent.
        _ if unit.is_some() || signal.layout.extent().1 > 1.5 => 0.01,
        _ => 1.0,
    };
    let mut binding = Binding::new(bus, message, signal, channel).ok()?;
    binding.scale = scale;
    Some(SignalPlan {
        binding,
        layout: signal.layout,
        table: String::new(),
        message: message.name.clone(),
        name: format!("{}.{}", message.name, signal.name),
        unit: signal.unit.clone(),
        scale,
        offset: 0.0,
    })
}
