//! What is sent: layout, identifiers, interfaces, periods, and that nothing sent can be taken for an input.

use std::path::Path;

use super::convert::Raw;
use super::describe::OutputUse;
use super::document::Faults;
use super::keys::Output;
use super::resolve::{Resolved, read_dbc};
use super::{ReadFile, beside};
use crate::can::CanId;
use crate::can::encode::{IdOverrides, OutputPlan, default_database};
use crate::monitor::OutputConfig;
use crate::quantity::BusIndex;

/// Period of a frame for which neither configuration nor DBC says one, ms.
const USUAL_PERIOD_MS: u32 = 1000;

/// Frame and key of its identifier, in the order of the plan.
const FRAMES: [(&str, &str); 3] = [("status", "status_id"), ("health", "health_id"), ("alarm", "alarm_id")];

/// What is sent; `None` = nothing (not configured, or faults noted).
pub(crate) fn output(
    raw: &Raw,
    config: &Path,
    found: &[Resolved<'_>],
    read: ReadFile<'_>,
    faults: &mut Faults,
) -> Option<OutputConfig> {
    let keys = raw.output.as_ref().filter(|keys| raw.output_written && keys.enabled)?;
    let id = |key, id: Option<u32>, faults: &mut Faults| configured_id(keys, key, id, faults);
    let ids = IdOverrides {
        status: id("status_id", keys.status_id, faults),
        health: id("health_id", keys.health_id, faults),
        alarm: id("alarm_id", keys.alarm_id, faults),
    };
    let plan = plan(keys, config, &ids, read, faults)?;
    let buses = buses(raw, keys);
    check_ids(keys, &plan.ids(), &buses, found, faults);
    let [status, health, alarm] = plan.cycle_times_ms();
    let period_s = |key: Option<u32>, dbc: Option<u32>| f64::from(key.or(dbc).unwrap_or(USUAL_PERIOD_MS)) / 1000.0;
    Some(OutputConfig {
        status_period_s: period_s(keys.status_period_ms, status),
        health_period_s: period_s(keys.health_period_ms, health),
        alarm_period_s: period_s(keys.alarm_period_ms, alarm),
        plan,
        buses,
    })
}

fn configured_id(keys: &Output, key: &str, id: Option<u32>, faults: &mut Faults) -> Option<CanId> {
    let id = id?;
    let can_id = if keys.extended { CanId::extended(id) } else { CanId::standard(id) };
    if can_id.is_none() {
        keys.place.fault(faults, key, "must be 0 to 0x7FF, or output.extended = true");
    }
    can_id
}

fn plan(
    keys: &Output,
    config: &Path,
    ids: &IdOverrides,
    read: ReadFile<'_>,
    faults: &mut Faults,
) -> Option<OutputPlan> {
    let database = match &keys.dbc {
        Some(name) => read_dbc(&beside(config, name), read, faults)?,
        None => default_database().map_err(|error| keys.place.fault(faults, "dbc", &error.to_string())).ok()?,
    };
    match OutputPlan::new(&database, ids) {
        Ok(plan) => Some(plan),
        Err(missing) => {
            for fault in missing.0 {
                keys.place.fault(faults, "dbc", &fault);
            }
            None
        }
    }
}

/// No identifier twice, and none that an input has on the same interface.
fn check_ids(keys: &Output, ids: &[CanId; 3], buses: &[BusIndex], found: &[Resolved<'_>], faults: &mut Faults) {
    for (index, (id, (frame, key))) in ids.iter().zip(FRAMES).enumerate() {
        if let Some(other) = ids[..index].iter().position(|other| other == id) {
            let what = format!("{frame} and {} frame would both be {id}, must differ", FRAMES[other].0);
            keys.place.fault(faults, key, &what);
        }
        if let Some(input) = found.iter().find(|f| buses.contains(&f.bus) && f.message.id == *id) {
            let what = format!("must not be the identifier of an input, {} has {id}", input.message.name);
            keys.place.fault(faults, key, &what);
        }
    }
}

/// The interfaces frames go out on.
fn buses(raw: &Raw, keys: &Output) -> Vec<BusIndex> {
    let wanted = |name: &str| keys.interfaces.as_ref().is_none_or(|names| names.iter().any(|n| n == name));
    let indexed = (0..).zip(&raw.interfaces).filter(|(_, interface)| wanted(&interface.name));
    indexed.map(|(index, _)| BusIndex(index)).collect()
}

/// What is sent, for people.
pub(crate) fn uses(raw: &Raw, output: Option<&OutputConfig>) -> Vec<OutputUse> {
    let Some(output) = output else { return Vec::new() };
    let names = output.buses.iter().filter_map(|bus| raw.interfaces.get(bus.index()));
    let names: Vec<String> = names.map(|interface| interface.name.clone()).collect();
    let periods_s = [output.status_period_s, output.health_period_s, output.alarm_period_s];
    let frames = FRAMES.iter().zip(output.plan.ids()).zip(periods_s);
    let used = frames.map(|(((frame, _), id), period_s)| OutputUse {
        frame,
        id: id.to_string(),
        interfaces: names.clone(),
        period_ms: 1000.0 * period_s,
    });
    used.collect()
}
