//! Checks that concern several keys, or a key and the cell model. Nothing here stops at the first fault.

use super::alarm::{self, RatedCell};
use super::label;
use crate::cell::{CapacityState, CellModel};
use crate::config::document::{Faults, TablePlace};
use crate::config::schema::RawTables;
use crate::config::schema::keys::{
    CellVoltageInput, DiagnosticInput, MethodKey, Pack, PackVoltageInput, TemperatureInput,
};

/// Interfaces one daemon may watch: more than any vehicle computer has, few enough for one byte in journals.
const MAX_INTERFACES: usize = 16;
/// Longest kernel name of an interface (IFNAMSIZ without its closing zero).
const MAX_INTERFACE_NAME: usize = 15;
/// Largest current of a balancing resistor, part of the rated capacity per hour: passive ones take a few hundredths.
const MAX_BLEED_PER_H: f64 = 0.2;
/// Longest name of a vehicle or pack, characters: a line of the status shows all three.
const MAX_VEHICLE_TEXT: usize = 64;

/// Notes keys that do not fit together.
pub(crate) fn check(raw: &RawTables, model: Option<&CellModel>, faults: &mut Faults) {
    vehicle(raw, faults);
    interfaces(raw, faults);
    sources(raw, faults);
    voltages(raw, faults);
    balancing(raw, model, faults);
    if let Some(pack) = &raw.pack {
        temperatures(pack, raw, faults);
        label::check(pack, faults);
    }
    limits(raw, faults);
    health(raw, model, faults);
    let rated_ah = raw.pack.as_ref().and_then(|pack| pack.rated_capacity_ah).or(model.map(|m| m.rated_capacity_ah));
    let rated = rated_ah.zip(raw.recharge.as_ref()).map(|(rated_ah, recharge)| RatedCell::new(rated_ah, recharge));
    alarm::check(raw, rated.as_ref(), faults);
    output(raw, faults);
}

/// Texts that fit a label, a title and a line.
fn vehicle(raw: &RawTables, faults: &mut Faults) {
    let Some(keys) = &raw.vehicle else { return };
    for (key, text) in [("name", &keys.name), ("id", &keys.id), ("pack", &keys.pack)] {
        let Some(text) = text else { continue };
        if text.chars().count() > MAX_VEHICLE_TEXT || text.contains(char::is_control) {
            let what = format!("must be at most {MAX_VEHICLE_TEXT} characters without control characters");
            keys.place.fault(faults, key, &what);
        }
    }
}

fn interfaces(raw: &RawTables, faults: &mut Faults) {
    if raw.interfaces.is_empty() && raw.has_all_interfaces() {
        faults.add(&raw.file, 1, "interface is missing, must be at least one table [[interface]]");
    }
    if let Some(one_too_many) = raw.interfaces.get(MAX_INTERFACES) {
        one_too_many.place.fault(faults, "name", &format!("must be at most {MAX_INTERFACES} interfaces"));
    }
    for (index, interface) in raw.interfaces.iter().enumerate() {
        let name = &interface.name;
        if name.len() > MAX_INTERFACE_NAME || name.contains('/') || name.contains(char::is_whitespace) {
            let what = format!("must be at most {MAX_INTERFACE_NAME} characters without blank or /");
            interface.place.fault(faults, "name", &what);
        }
        if let Some(first) = raw.interfaces[..index].iter().find(|other| other.name == *name) {
            let first = first.place.line_of("name").beside(interface.place.line_of("name"));
            let what = format!("must be unique, is also the name in {first}");
            interface.place.fault(faults, "name", &what);
        }
    }
}

fn known_interface(name: &str, place: &TablePlace, key: &str, raw: &RawTables, faults: &mut Faults) {
    if !raw.interfaces.is_empty() && !raw.interfaces.iter().any(|interface| interface.name == name) {
        place.fault(faults, key, &format!("must be {}", raw.interface_names()));
    }
}

fn voltages(raw: &RawTables, faults: &mut Faults) {
    match (raw.is_written::<CellVoltageInput>(), raw.is_written::<PackVoltageInput>()) {
        (false, false) if raw.broken => {}
        (false, false) => {
            let text = "input has no voltage, must have [input.cell_voltage] or [input.pack_voltage]";
            note_at(raw.input.as_ref().map(|input| &input.place), text, raw, faults);
        }
        (true, true) => {
            let text = "input.pack_voltage stands beside [input.cell_voltage], must be one of them";
            note_at(raw.pack_voltage.as_ref().map(|input| &input.place), text, raw, faults);
        }
        (true, false) | (false, true) => {}
    }
}

/// Bits of single cells, of a BMS that balances, and a current that a resistor can take.
fn balancing(raw: &RawTables, model: Option<&CellModel>, faults: &mut Faults) {
    let (Some(keys), Some(pack)) = (&raw.balancing, &raw.pack) else { return };
    if raw.is_pack_total() {
        let text =
            "input.balancing stands beside [input.pack_voltage], must be without it: the pack is estimated as one cell";
        faults.add_at(&keys.place.at, text);
    }
    if !pack.balancing {
        pack.place.fault(faults, "balancing", "must be true where there is [input.balancing]");
    }
    let rated_ah = pack.rated_capacity_ah.or(model.map(|model| model.rated_capacity_ah));
    let most_a = rated_ah.map(|rated_ah| MAX_BLEED_PER_H * rated_ah * f64::from(pack.strings));
    if let Some(most_a) = most_a.filter(|most_a| keys.bleed_a > *most_a) {
        let what = format!("must be at most {most_a:?} A, a fifth of the pack's rated capacity in an hour");
        keys.place.fault(faults, "bleed_a", &what);
    }
}

/// Notes `text` about a table; about the file, where it could not be read.
fn note_at(place: Option<&TablePlace>, text: &str, raw: &RawTables, faults: &mut Faults) {
    match place {
        Some(place) => faults.add_at(&place.at, text),
        None => faults.add(&raw.file, 1, text),
    }
}

/// Signals are looked up somewhere.
fn sources(raw: &RawTables, faults: &mut Faults) {
    let Some(input) = raw.input.as_ref().filter(|input| input.dbc.is_empty()) else { return };
    if !raw.broken && !raw.is_written::<DiagnosticInput>() {
        input.place.fault(faults, "dbc", "must be a list of DBC files where there is no [[input.diagnostic]]");
    }
}

/// Every cell has at most one sensor, and every numbered cell exists.
fn temperatures(pack: &Pack, raw: &RawTables, faults: &mut Faults) {
    if raw.is_pack_total() && !raw.is_written::<CellVoltageInput>() {
        for sensor in raw.temperatures.iter().skip(1) {
            let text = format!("{} is one too many, must be one: the pack is estimated as one cell", sensor.place.path);
            faults.add_at(&sensor.place.at, text);
        }
        for sensor in raw.temperatures.iter().filter(|sensor| sensor.cells.is_some()) {
            sensor.place.fault(faults, "cells", "must not be given: the pack is estimated as one cell");
        }
        return;
    }
    for (index, sensor) in raw.temperatures.iter().enumerate() {
        let cells = cells_of(sensor, pack.cells);
        if cells.iter().any(|&cell| cell > pack.cells) {
            sensor.place.fault(faults, "cells", &format!("must be within 1 to {} (pack.cells)", pack.cells));
        }
        let shared = |other: &&TemperatureInput| {
            let others = cells_of(other, pack.cells);
            cells.iter().any(|cell| others.contains(cell))
        };
        if let Some(other) = raw.temperatures[..index].iter().find(shared) {
            let line = other.place.at.beside(sensor.place.line_of("cells"));
            let what = format!("must not name cells of {} ({line})", other.place.path);
            sensor.place.fault(faults, "cells", &what);
        }
    }
}

fn cells_of(sensor: &TemperatureInput, cells: u16) -> Vec<u16> {
    match &sensor.cells {
        Some(ranges) => ranges.0.iter().cloned().flatten().collect(),
        None => (1..=cells).collect(),
    }
}

fn limits(raw: &RawTables, faults: &mut Faults) {
    let rising = |place: &TablePlace, key: &str, low: Option<f64>, high: Option<f64>, faults: &mut Faults| {
        if let (Some(low), Some(high)) = (low, high)
            && high <= low
        {
            place.fault(faults, key, &format!("must be above {low}, the smallest"));
        }
    };
    if let Some(keys) = &raw.voltage_limits {
        rising(&keys.place, "max_v", keys.min_v, keys.max_v, faults);
    }
    if let Some(keys) = &raw.temperature_limits {
        rising(&keys.place, "max_c", keys.min_c, keys.max_c, faults);
    }
}

fn health(raw: &RawTables, model: Option<&CellModel>, faults: &mut Faults) {
    if let Some(recharge) = &raw.recharge
        && recharge.to_soc <= recharge.from_soc
    {
        let what = format!("must be above recharge.from_soc = {}", recharge.from_soc);
        let key = if recharge.place.has("to_soc") { "to_soc" } else { "from_soc" };
        let other = format!("must be below recharge.to_soc = {}", recharge.to_soc);
        recharge.place.fault(faults, key, if key == "to_soc" { &what } else { &other });
    }
    if let (Some(capacity), Some(estimator)) = (&raw.capacity, &raw.estimator) {
        // The paper's filter holds the capacity between half-cycles, ours carries it: half of each is neither.
        let (key, needed) = match (capacity.method, estimator.capacity_state) {
            (MethodKey::Swing, CapacityState::Joint) | (MethodKey::Nominal, CapacityState::Held) => ("", ""),
            (MethodKey::Swing, CapacityState::Held) => ("swing", "joint"),
            (MethodKey::Nominal, CapacityState::Joint) => ("nominal", "held"),
        };
        if !key.is_empty() {
            let what = format!("must be \"{needed}\" with capacity.method = \"{key}\"");
            estimator.place.fault(faults, "capacity_state", &what);
        }
    }
    if let (Some(usable), Some(model)) = (&raw.usable, model)
        && usable.cutoff_v >= model.voltage_max_v
    {
        let what = format!("must be below the cell model's voltage_max_v = {}", model.voltage_max_v);
        usable.place.fault(faults, "cutoff_v", &what);
    }
}

fn output(raw: &RawTables, faults: &mut Faults) {
    let Some(output) = raw.output.as_ref().filter(|output| output.enabled && raw.has_all_interfaces()) else {
        return;
    };
    for name in output.interfaces.iter().flatten() {
        known_interface(name, &output.place, "interfaces", raw, faults);
    }
}
