//! Finds unconfigured signals of the DBC files that can be compared with configured signals.
//!
//! In: the DBC files and the configured signals. Out: signals whose names and units say that they measure the pack's
//! voltage, a temperature of its cells or a state of charge. Each signal is bound to every interface, because a DBC
//! does not state which bus it describes.

use crate::can::dbc::{Message, Signal};
use crate::can::decode::Binding;
use crate::can::unit::{Quantity, SignalUnit};
use crate::config::{Databases, NamedSignal, RawTables, ResolvedSignal};
use crate::quantity::{BusIndex, Channel, SensorIndex};
use crate::wiring::SignalPlan;
use crate::wiring::evidence::{PackQuantity, SignalLabel};

/// Returns the comparable signals.
pub(super) fn signals(raw: &RawTables, databases: &Databases, found: &[ResolvedSignal<'_>]) -> Vec<SignalPlan> {
    let is_configured = |signal: &Signal| found.iter().any(|resolved| std::ptr::eq(resolved.signal, signal));
    let free = databases.signals().filter(|named| !is_configured(named.signal));
    let wanted = free.filter_map(|named| Some((named, channel_of(raw, named.message, named.signal)?)));
    // Temperatures come last, because a pack may have more temperatures than the limit below allows.
    let mut wanted: Vec<_> = wanted.collect();
    wanted.sort_by_key(|(_, channel)| matches!(channel, Channel::Temperature(_)));
    let buses = u8::try_from(raw.interfaces.len()).unwrap_or(u8::MAX);
    let bound = wanted.into_iter().flat_map(|(NamedSignal { message, signal, answer, .. }, channel)| {
        (0..buses).map(BusIndex).filter_map(move |bus| {
            let mut plan = plan(bus, message, signal, channel)?;
            plan.answer = answer.map(|place| place.source(bus));
            Some(plan)
        })
    });
    // The limit applies to all interfaces together.
    bound.take(64).collect()
}

/// The channel that a signal measures, according to its name and unit; `None` = the signal is not comparable.
fn channel_of(raw: &RawTables, message: &Message, signal: &Signal) -> Option<Channel> {
    let label = SignalLabel::new(&message.name, &signal.name, &signal.unit);
    let is = |quantity| !label.says_extreme() && label.score(quantity).is_some_and(|score| score.points >= 3.0);
    if is(PackQuantity::PackVoltage) && label.has_unit_of(Quantity::Voltage) && label.is_of_pack() {
        (!raw.is_pack_total()).then_some(Channel::PackVoltage)
    } else if is(PackQuantity::Temperature) && label.is_of_pack() && !label.is_of_other_part() {
        Some(Channel::Temperature(SensorIndex(0)))
    } else {
        // A state of charge must be able to exceed half of its range. A signal with a smaller range contains only the
        // decimal places of a state of charge.
        let highest = signal.layout.extent().1;
        let is_whole = highest > 50.0 || signal.unit.is_empty() && (0.9..=1.5).contains(&highest);
        (is(PackQuantity::Soc) && is_whole && !label.is_of_low_voltage()).then_some(Channel::ReportedSoc)
    }
}

fn plan(bus: BusIndex, message: &Message, signal: &Signal, channel: Channel) -> Option<SignalPlan> {
    let unit = SignalUnit::parse(&signal.unit);
    let scale = match channel {
        Channel::PackVoltage | Channel::Temperature(_) => unit.map_or(1.0, |unit| unit.factor),
        // A SOC with a unit is in percent. A SOC without a unit is in percent if the signal can exceed 1.5.
        _ if unit.is_some() || signal.layout.extent().1 > 1.5 => 0.01,
        _ => 1.0,
    };
    let mut binding = Binding::new(bus, message, signal, channel).ok()?;
    binding.scale = scale;
    if matches!(channel, Channel::Temperature(_)) {
        binding.offset = unit.map_or(0.0, |unit| unit.offset);
    }
    Some(SignalPlan {
        binding,
        layout: signal.layout,
        answer: None,
        table: String::new(),
        message: message.name.clone(),
        name: format!("{}.{}", message.name, signal.name),
        unit: signal.unit.clone(),
        scale,
        offset: 0.0,
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::can::dbc::Database;
    use crate::config::PartialConfig;

    #[test]
    fn names_and_units_select_comparable_signals() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config");
        let raw = PartialConfig::read(&folder.join("example.toml"), &|path: &Path| std::fs::read(path)).unwrap().raw;
        let channel = |message: &str, signal: &str, unit: &str| {
            let text = format!("BO_ 1 {message}: 8 X\n SG_ {signal} : 0|16@1+ (1,0) [0|0] \"{unit}\" X\n");
            let database = Database::parse(&format!("VERSION \"\"\nNS_ :\nBS_:\nBU_: X\n{text}")).unwrap();
            channel_of(&raw, &database.messages[0], &database.messages[0].signals[0])
        };
        let voltage = Some(Channel::PackVoltage);
        assert_eq!(channel("PackStatus", "PackVoltage", "V"), voltage);
        assert_eq!((channel("Bms", "Volt", "V"), channel("X", "HV_Batt_U", "V")), (voltage, voltage));
        assert_eq!(channel("Car", "BATTERY_DC_VOLTAGE", "V"), voltage);
        for other in ["PackVoltageMax", "DcLinkVoltage", "ChargeVoltageLimit", "CellVoltage1"] {
            assert_eq!(channel("Bms", other, "V"), None, "{other}");
        }
        assert_eq!(channel("Bms", "PackVoltage", "A"), None);
        for soc in ["DisplaySOC", "SOC_dash", "State_of_Charge"] {
            assert_eq!(channel("Dash", soc, "%"), Some(Channel::ReportedSoc), "{soc}");
        }
        assert_eq!((channel("Dash", "SocMin", "%"), channel("Dash", "Soc", "V")), (None, None));
    }
}
