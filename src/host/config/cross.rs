//! Checks that concern several keys, or a key and the cell model. Nothing here stops at the first fault.

use super::alarm::{self, Rated};
use super::convert::Raw;
use super::document::{Faults, Place};
use super::keys::{Interface, Method, Pack, TemperatureInput};
use crate::cell::{CapacityState, CellModel};

/// Interfaces one daemon may watch: more than any vehicle computer has, few enough for one byte in journals.
const MAX_INTERFACES: usize = 16;
/// Longest kernel name of an interface (IFNAMSIZ without its closing zero).
const MAX_INTERFACE_NAME: usize = 15;

/// Notes everything that does not fit together.
pub(super) fn check(raw: &Raw, model: Option<&CellModel>, faults: &mut Faults) {
    interfaces(raw, faults);
    voltages(raw, faults);
    if let Some(pack) = &raw.pack {
        temperatures(pack, raw, faults);
    }
    limits(raw, faults);
    health(raw, model, faults);
    let rated_ah = raw.pack.as_ref().and_then(|pack| pack.rated_capacity_ah).or(model.map(|m| m.rated_capacity_ah));
    let rated = rated_ah.zip(raw.recharge.as_ref()).map(|(rated_ah, recharge)| Rated::new(rated_ah, recharge));
    alarm::check(raw, rated.as_ref(), faults);
    output(raw, faults);
}

fn interfaces(raw: &Raw, faults: &mut Faults) {
    if raw.interfaces.is_empty() && raw.interfaces_whole {
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
            let what = format!("must be unique, is also the name in line {}", first.place.line_of("name"));
            interface.place.fault(faults, "name", &what);
        }
    }
    let current = raw.current.iter().map(|s| s.source());
    let cells = raw.cell_voltage.iter().map(|s| s.source());
    let pack = raw.pack_voltage.iter().map(|s| s.source());
    let temperatures = raw.temperatures.iter().map(|s| s.source());
    let reported = raw.reported_soc.iter().map(|s| s.source()).chain(raw.reported_soh.iter().map(|s| s.source()));
    let reported = reported.chain(raw.pack_identity.iter().map(|s| s.source()));
    if !raw.interfaces_whole {
        return;
    }
    let signals = current.chain(cells).chain(pack).chain(temperatures).chain(reported);
    let signals = signals.map(|source| (source.interface, source.place));
    let protected = raw.protected.iter().map(|protected| (protected.interface.as_deref(), &protected.place));
    for (interface, place) in signals.chain(protected) {
        match interface {
            Some(name) => known_interface(name, place, "interface", &raw.interfaces, faults),
            None if raw.interfaces.len() > 1 => {
                place.fault(faults, "interface", &format!("must be {}", names(&raw.interfaces)));
            }
            None => {}
        }
    }
}

fn known_interface(name: &str, place: &Place, key: &str, interfaces: &[Interface], faults: &mut Faults) {
    if !interfaces.is_empty() && !interfaces.iter().any(|interface| interface.name == name) {
        place.fault(faults, key, &format!("must be {}", names(interfaces)));
    }
}

fn names(interfaces: &[Interface]) -> String {
    let names: Vec<&str> = interfaces.iter().map(|interface| interface.name.as_str()).collect();
    names.join(" or ")
}

fn voltages(raw: &Raw, faults: &mut Faults) {
    match raw.voltages_written {
        (false, false) if raw.broken => {}
        (false, false) => {
            let line = raw.input.as_ref().map_or(1, |input| input.place.line);
            faults.add(&raw.file, line, "input has no voltage, must have [input.cell_voltage] or [input.pack_voltage]");
        }
        (true, true) => {
            let line = raw.pack_voltage.as_ref().map_or(1, |input| input.place.line);
            let text = "input.pack_voltage stands beside [input.cell_voltage], must be one of them";
            faults.add(&raw.file, line, text);
        }
        (true, false) | (false, true) => {}
    }
}

/// Every cell has at most one sensor, and every numbered cell exists.
fn temperatures(pack: &Pack, raw: &Raw, faults: &mut Faults) {
    if raw.voltages_written == (false, true) {
        for sensor in raw.temperatures.iter().skip(1) {
            let text = format!("{} is one too many, must be one: the pack is estimated as one cell", sensor.place.path);
            faults.add(&sensor.place.file, sensor.place.line, text);
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
            let what = format!("must not name cells of {} (line {})", other.place.path, other.place.line);
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

fn limits(raw: &Raw, faults: &mut Faults) {
    let rising = |place: &Place, key: &str, low: Option<f64>, high: Option<f64>, faults: &mut Faults| {
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

fn health(raw: &Raw, model: Option<&CellModel>, faults: &mut Faults) {
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
            (Method::Swing, CapacityState::Joint) | (Method::Nominal, CapacityState::Held) => ("", ""),
            (Method::Swing, CapacityState::Held) => ("swing", "joint"),
            (Method::Nominal, CapacityState::Joint) => ("nominal", "held"),
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

fn output(raw: &Raw, faults: &mut Faults) {
    let Some(output) = raw.output.as_ref().filter(|output| raw.output_written && output.enabled) else {
        return;
    };
    for name in output.interfaces.iter().flatten().filter(|_| raw.interfaces_whole) {
        known_interface(name, &output.place, "interfaces", &raw.interfaces, faults);
    }
}
