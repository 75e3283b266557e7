//! Checks that involve several keys, or a key and the cell model. Checking continues after a fault.

use super::alarm::{self, RatedCell};
use super::cells;
use crate::cell::{CapacityState, CellModel};
use crate::config::document::TablePlace;
use crate::config::schema::RawTables;
use crate::config::schema::keys::{
    CellVoltageInput, CurrentSign, DiagnosticInput, MethodKey, Pack, PackVoltageInput, TemperatureInput,
};

/// Maximum number of interfaces of one daemon. No vehicle computer has more, and the number fits a `BusIndex`.
const MAX_INTERFACES: usize = 16;
/// Longest kernel name of an interface (IFNAMSIZ without the closing zero).
const MAX_INTERFACE_NAME: usize = 15;
/// Maximum number of characters in the name of a vehicle or pack, because one status line shows name, id and pack.
const MAX_VEHICLE_TEXT: usize = 64;

pub(crate) fn check(raw: &RawTables, model: Option<&CellModel>) {
    vehicle(raw);
    interfaces(raw);
    sources(raw);
    current_sign(raw);
    voltages(raw);
    balancing(raw, model);
    if let Some(pack) = &raw.pack {
        temperatures(pack, raw);
        cells::check(pack);
    }
    limits(raw);
    health(raw, model);
    let rated =
        raw.rated_ah(model).zip(raw.recharge.as_ref()).map(|(rated_ah, recharge)| RatedCell::new(rated_ah, recharge));
    alarm::check(raw, rated.as_ref());
    output(raw);
}

/// Checks the lengths and characters of the vehicle's and pack's names, so that each name fits on one line of a label
/// or title.
fn vehicle(raw: &RawTables) {
    let Some(keys) = &raw.vehicle else { return };
    for (key, text) in [("name", &keys.name), ("id", &keys.id), ("pack", &keys.pack)] {
        let Some(text) = text else { continue };
        if text.chars().count() > MAX_VEHICLE_TEXT || text.contains(char::is_control) {
            keys.place.fault(key, format!("must be at most {MAX_VEHICLE_TEXT} characters without control characters"));
        }
    }
}

/// Checks that the direction of the current is known: from the sign of the current, or from another signal.
fn current_sign(raw: &RawTables) {
    let Some(keys) = raw.current.as_ref().filter(|keys| keys.positive.is_none()) else { return };
    if !raw.is_written::<CurrentSign>() && !raw.broken {
        let what =
            "input.current.positive is missing, must be charge or discharge: Meaning of a positive value on the bus";
        raw.faults.add_at(&keys.place.at, what);
    }
}

fn interfaces(raw: &RawTables) {
    if raw.interfaces.is_empty() && raw.has_all_interfaces() {
        raw.faults.add(&raw.file, 1, "the file has no table [[interface]], must have at least one");
    }
    if let Some(one_too_many) = raw.interfaces.get(MAX_INTERFACES) {
        one_too_many
            .place
            .fault("name", format!("is one interface too many, the file must have at most {MAX_INTERFACES}"));
    }
    for (index, interface) in raw.interfaces.iter().enumerate() {
        let name = &interface.name;
        if name.len() > MAX_INTERFACE_NAME || name.contains('/') || name.contains(char::is_whitespace) {
            let what = format!("must be at most {MAX_INTERFACE_NAME} characters without spaces or /");
            interface.place.fault("name", &what);
        }
        if let Some(first) = raw.interfaces[..index].iter().find(|other| other.name == *name) {
            let first = first.place.line_of("name").beside(interface.place.line_of("name"));
            interface.place.fault("name", format!("must be unique, but is also the name in {first}"));
        }
    }
}

fn known_interface(name: &str, place: &TablePlace, key: &str, raw: &RawTables) {
    if !raw.interfaces.is_empty() && !raw.interfaces.iter().any(|interface| interface.name == name) {
        place.fault(key, format!("must be {}", raw.interface_names()));
    }
}

fn voltages(raw: &RawTables) {
    match (raw.is_written::<CellVoltageInput>(), raw.is_written::<PackVoltageInput>()) {
        (false, false) if raw.broken => {}
        (false, false) => {
            let text = "input has no voltage, must have [input.cell_voltage] or [input.pack_voltage]";
            raw.note(raw.input.as_ref().map(|input| &input.place), text);
        }
        (true, true) => {
            let text = "input.pack_voltage and input.cell_voltage are both given, must be only one of them";
            raw.note(raw.pack_voltage.as_ref().map(|input| &input.place), text);
        }
        (true, false) | (false, true) => {}
    }
}

/// Checks that balancing signals are given only for a pack with cell voltages and a BMS that balances, and that the
/// bleed current is plausible.
fn balancing(raw: &RawTables, model: Option<&CellModel>) {
    let (Some(keys), Some(pack)) = (&raw.balancing, &raw.pack) else { return };
    if raw.is_pack_total() {
        keys.place.table_fault(
            "must not be given together with [input.pack_voltage]: the pack is then estimated as one cell",
        );
    }
    if !pack.balancing {
        pack.place.fault("balancing", "must be true if [input.balancing] is given");
    }
    // Passive balancing usually bleeds at most a few hundredths of 1 C. Only an implausible current exceeds C/5.
    let most_a = raw.rated_ah(model).map(|rated_ah| 0.2 * rated_ah * f64::from(pack.strings));
    if let Some(most_a) = most_a.filter(|most_a| keys.bleed_a > *most_a) {
        let what = format!("must be at most {most_a:?} A (C/5 of the pack's rated capacity)");
        keys.place.fault("bleed_a", &what);
    }
}

/// Checks that the configuration has a source of signals: a DBC file, or a diagnostic answer with signals.
fn sources(raw: &RawTables) {
    let Some(input) = raw.input.as_ref().filter(|input| input.dbc.is_empty()) else { return };
    if !raw.broken && !raw.is_written::<DiagnosticInput>() {
        input.place.fault("dbc", "must be a list of DBC files if there is no [[input.diagnostic]]");
    }
}

/// Checks that every cell has at most one sensor, and that every listed cell exists.
fn temperatures(pack: &Pack, raw: &RawTables) {
    if raw.is_pack_total() && !raw.is_written::<CellVoltageInput>() {
        for sensor in raw.temperatures.iter().skip(1) {
            sensor.place.table_fault(
                "is one sensor too many, must be one: with [input.pack_voltage] the pack is estimated as one cell",
            );
        }
        for sensor in raw.temperatures.iter().filter(|sensor| sensor.cells.is_some()) {
            sensor.place.fault(
                "cells",
                "must not be given together with [input.pack_voltage]: the pack is then estimated as one cell",
            );
        }
        return;
    }
    for (index, sensor) in raw.temperatures.iter().enumerate() {
        let earlier = raw.temperatures[..index].iter().map(|other| (&other.place, cells_of(other, pack.cells)));
        cells::check_cells(&sensor.place, &cells_of(sensor, pack.cells), earlier, pack.cells);
    }
}

fn cells_of(sensor: &TemperatureInput, cells: u16) -> Vec<u16> {
    match &sensor.cells {
        Some(ranges) => ranges.0.iter().cloned().flatten().collect(),
        None => (1..=cells).collect(),
    }
}

fn limits(raw: &RawTables) {
    let rising = |place: &TablePlace, key: &str, low: Option<f64>, high: Option<f64>| {
        if let (Some(low), Some(high)) = (low, high)
            && high <= low
        {
            place.fault(key, format!("must be above {low}, the lower limit"));
        }
    };
    if let Some(keys) = &raw.voltage_limits {
        rising(&keys.place, "max_v", keys.min_v, keys.max_v);
    }
    if let Some(keys) = &raw.temperature_limits {
        rising(&keys.place, "max_c", keys.min_c, keys.max_c);
    }
}

fn health(raw: &RawTables, model: Option<&CellModel>) {
    if let Some(recharge) = &raw.recharge
        && recharge.to_soc <= recharge.from_soc
    {
        let what = format!("must be above recharge.from_soc = {}", recharge.from_soc);
        let key = if recharge.place.has("to_soc") { "to_soc" } else { "from_soc" };
        let other = format!("must be below recharge.to_soc = {}", recharge.to_soc);
        recharge.place.fault(key, if key == "to_soc" { &what } else { &other });
    }
    if let (Some(capacity), Some(estimator)) = (&raw.capacity, &raw.estimator) {
        // With the methods of the paper that packwatch follows ("nominal" and "held"), the filter keeps the capacity
        // constant between half-cycles. With packwatch's own methods ("swing" and "joint"), the filter estimates the
        // capacity. A mixture of the two pairs is not supported.
        let (key, needed) = match (capacity.method, estimator.capacity_state) {
            (MethodKey::Swing, CapacityState::Joint) | (MethodKey::Nominal, CapacityState::Held) => ("", ""),
            (MethodKey::Swing, CapacityState::Held) => ("swing", "joint"),
            (MethodKey::Nominal, CapacityState::Joint) => ("nominal", "held"),
        };
        if !key.is_empty() {
            estimator.place.fault("capacity_state", format!("must be \"{needed}\" with capacity.method = \"{key}\""));
        }
    }
    if let Some(outlook) = &raw.outlook
        && let (Some(min_c), Some(max_c)) = (outlook.min_temperature_c, outlook.max_temperature_c)
        && max_c <= min_c
    {
        outlook.place.fault("max_temperature_c", format!("must be above min_temperature_c = {min_c}"));
    }
    // If the model's own range is invalid, only the model's fault is reported.
    let has_range = |model: &&CellModel| model.voltage_min_v < model.voltage_max_v;
    if let (Some(outlook), Some(model)) = (&raw.outlook, model.filter(has_range)) {
        let min_v = outlook.min_voltage_v.unwrap_or(model.voltage_min_v);
        let [low_v, high_v] = [0.5 * model.voltage_min_v, model.voltage_max_v + 0.5];
        if !(low_v..model.voltage_max_v).contains(&min_v) {
            let what =
                format!("must be from {low_v} to below the cell model's voltage_max_v = {}", model.voltage_max_v);
            outlook.place.fault("min_voltage_v", &what);
        }
        if outlook.max_voltage_v.is_some_and(|max_v| max_v <= min_v || max_v > high_v) {
            outlook.place.fault("max_voltage_v", format!("must be above min_voltage_v = {min_v} and at most {high_v}"));
        }
    }
    if let (Some(usable), Some(model)) = (&raw.usable, model)
        && usable.cutoff_v >= model.voltage_max_v
    {
        let what = format!("must be below the cell model's voltage_max_v = {}", model.voltage_max_v);
        usable.place.fault("cutoff_v", &what);
    }
}

fn output(raw: &RawTables) {
    let Some(output) = raw.output.as_ref().filter(|output| output.enabled && raw.has_all_interfaces()) else {
        return;
    };
    for name in output.interfaces.iter().flatten() {
        known_interface(name, &output.place, "interfaces", raw);
    }
}
