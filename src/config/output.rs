//! What is sent: identifiers, interfaces, periods, and that nothing sent can be taken for an input.

use super::convert::Raw;
use super::describe::OutputUse;
use super::document::Faults;
use super::keys::Output;
use super::resolve::Resolved;
use crate::can::CanId;
use crate::quantity::BusIndex;

/// Largest 11-bit identifier.
const MAX_STANDARD: u32 = 0x7FF;

/// The three frames: name, key, identifier, period.
fn frames(keys: &Output) -> [(&'static str, &'static str, Option<u32>, u32); 3] {
    [
        ("status", "status_id", keys.status_id, keys.status_period_ms),
        ("health", "health_id", keys.health_id, keys.health_period_ms),
        ("alarm", "alarm_id", keys.alarm_id, keys.alarm_period_ms),
    ]
}

/// Notes identifiers that are too large, equal, or also an input's on the same interface.
pub(crate) fn check(raw: &Raw, found: &[Resolved<'_>], faults: &mut Faults) {
    let Some(keys) = raw.output.as_ref().filter(|keys| raw.output_written && keys.enabled) else {
        return;
    };
    let frames = frames(keys);
    if frames.iter().all(|(_, _, id, _)| id.is_none()) {
        let text = "output has no identifier, must have status_id, health_id or alarm_id, or enabled = false";
        faults.add(&keys.place.file, keys.place.line, text);
    }
    let buses = buses(raw, keys);
    for (index, (_, key, id, _)) in frames.iter().enumerate() {
        let Some(id) = id else { continue };
        if !keys.extended && *id > MAX_STANDARD {
            keys.place.fault(faults, key, "must be 0 to 0x7FF, or output.extended = true");
        }
        if let Some((_, other, ..)) = frames[..index].iter().find(|(_, _, other, _)| *other == Some(*id)) {
            keys.place.fault(faults, key, &format!("must differ from output.{other}"));
        }
        let input = |f: &&Resolved<'_>| buses.contains(&f.bus) && Some(f.message.id) == can_id(*id, keys.extended);
        if let Some(input) = found.iter().find(input) {
            let what = format!("must not be the identifier of an input, {} has it", input.message.name);
            keys.place.fault(faults, key, &what);
        }
    }
}

fn can_id(id: u32, extended: bool) -> Option<CanId> {
    if extended { CanId::extended(id) } else { CanId::standard(id) }
}

/// The interfaces frames go out on.
fn buses(raw: &Raw, keys: &Output) -> Vec<BusIndex> {
    let wanted = |name: &str| keys.interfaces.as_ref().is_none_or(|names| names.iter().any(|n| n == name));
    let indexed = (0..).zip(&raw.interfaces).filter(|(_, interface)| wanted(&interface.name));
    indexed.map(|(index, _)| BusIndex(index)).collect()
}

/// What is sent, for people.
pub(crate) fn uses(raw: &Raw) -> Vec<OutputUse> {
    let Some(keys) = raw.output.as_ref().filter(|keys| raw.output_written && keys.enabled) else {
        return Vec::new();
    };
    let names = buses(raw, keys).into_iter().filter_map(|bus| raw.interfaces.get(bus.index()));
    let names: Vec<String> = names.map(|interface| interface.name.clone()).collect();
    let used = frames(keys).into_iter().filter_map(|(frame, _, id, period_ms)| {
        let id = can_id(id?, keys.extended)?.to_string();
        Some(OutputUse { frame, id, interfaces: names.clone(), period_ms })
    });
    used.collect()
}
