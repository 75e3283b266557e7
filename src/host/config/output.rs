//! The sent frames: layout, identifiers, interfaces, periods, protection. No sent frame may be mistaken for an input.

use std::path::Path;

use super::describe::OutputUse;
use super::document::Faults;
use super::keys::{Commands, E2eKey, FrameKeys, Output};
use super::resolve::{Checks, check_no_input, read_dbc};
use super::tables::RawTables;
use super::{ReadFile, beside};

use crate::can::CanId;
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::Protection;
use crate::can::encode::{E2eSetting, LayoutBase, LayoutMessage, LayoutSettings, MessageSettings, OutputPlan, layout};
use crate::cell::CellModel;
use crate::monitor::OutputConfig;
use crate::quantity::BusIndex;

/// Names of the frames, in the order of the plan.
const FRAMES: [&str; 3] = ["status", "health", "alarm"];

/// The sent frames and their layout; `None` = none (not configured, or faults noted).
pub(super) fn output(
    checks: &mut Checks<'_>,
    config: &Path,
    model: Option<&CellModel>,
    read: ReadFile<'_>,
) -> Option<(OutputConfig, Database)> {
    let raw = checks.raw;
    let keys = raw.output.as_ref().filter(|keys| keys.enabled)?;
    let command = raw.commands.as_ref().filter(|commands| commands.enabled);
    let frames = [
        raw.output_status.as_ref()?.config(),
        raw.output_health.as_ref()?.config(),
        raw.output_alarm.as_ref()?.config(),
    ];
    let [status, health, alarm] = frames.map(|frame| message_settings(&frame, checks.faults));
    let command_settings = match command {
        Some(keys) => Some(message_settings(&keys.config(), checks.faults)?),
        None => None,
    };
    let settings = LayoutSettings { status: status?, health: health?, alarm: alarm?, command: command_settings };
    let laid_out: Vec<_> = frames.into_iter().chain(command.map(Commands::config)).collect();
    let own = match &keys.dbc {
        Some(name) => Some(read_dbc(&beside(config, name), read, checks.faults)?),
        None => None,
    };
    let rated = raw.pack.as_ref().and_then(|pack| pack.rated_capacity_ah).or(model.map(|m| m.rated_capacity_ah));
    // Without a usable cell model there is a fault already, and any layout shows what else is wrong.
    let rated_capacity_ah = rated.unwrap_or(1.0);
    let base = own.as_ref().map_or(LayoutBase::BuiltIn { rated_capacity_ah }, LayoutBase::Own);
    let database = database(base, &settings, &laid_out, checks.faults)?;
    let missing = |error: &String, faults: &mut Faults| keys.place.fault(faults, "dbc", error);
    let plan = OutputPlan::new(&database).map_err(|all| all.0.iter().for_each(|e| missing(e, checks.faults))).ok()?;
    let buses = buses(raw, keys);
    check_ids(&frames, &plan, &buses, checks);
    check_data_ids(&frames, &plan, checks.faults);
    for (_, frame) in plan.formats().iter().zip(&frames).filter(|(format, _)| **format != FrameFormat::Classic) {
        raw.check_fd(frame.place, &buses, checks.faults);
    }
    let [status_period_s, health_period_s, alarm_period_s] = plan.cycle_times_ms().map(|ms| f64::from(ms) / 1000.0);
    Some((OutputConfig { status_period_s, health_period_s, alarm_period_s, plan, buses }, database))
}

/// The settings of a frame's message; `None` = faults noted.
pub(super) fn message_settings(keys: &FrameKeys<'_>, faults: &mut Faults) -> Option<MessageSettings> {
    let id = match keys.id {
        Some(id) => Some(configured_id(keys, id, faults)?),
        None if keys.extended => {
            keys.place.fault(faults, "extended", "must have an id beside it");
            return None;
        }
        None => None,
    };
    let e2e = protection(keys, faults)?;
    Some(MessageSettings { id, fd: keys.fd, brs: keys.brs, period_ms: keys.period_ms, e2e })
}

fn configured_id(keys: &FrameKeys<'_>, id: u32, faults: &mut Faults) -> Option<CanId> {
    let can_id = if keys.extended { CanId::extended(id) } else { CanId::standard(id) };
    if can_id.is_none() {
        keys.place.fault(faults, "id", "must be 0 to 0x7FF, or extended = true");
    }
    can_id
}

fn protection(keys: &FrameKeys<'_>, faults: &mut Faults) -> Option<E2eSetting> {
    let profile = match keys.e2e {
        None if keys.data_id.is_some() => {
            keys.place.fault(faults, "data_id", "must have e2e beside it");
            return None;
        }
        None => return Some(E2eSetting::AsBase),
        Some(E2eKey(None)) => return Some(E2eSetting::Off),
        Some(E2eKey(Some(profile))) => profile,
    };
    let Some(data_id) = keys.data_id else {
        let what = format!("must be given, 0 to {:#X}, with e2e = \"{}\"", profile.max_data_id(), profile.name());
        keys.place.fault(faults, "data_id", &what);
        return None;
    };
    Some(E2eSetting::On(Protection { profile, data_id }))
}

/// The layout; a setting that does not fit it is noted at its key.
fn database(
    base: LayoutBase<'_>,
    settings: &LayoutSettings,
    frames: &[FrameKeys<'_>],
    faults: &mut Faults,
) -> Option<Database> {
    let refused = match layout(base, settings) {
        Ok(database) => return Some(database),
        Err(refused) => refused,
    };
    for fault in refused {
        let frame = LayoutMessage::ALL.iter().zip(frames).find(|(which, _)| **which == fault.message);
        if let Some((_, frame)) = frame {
            frame.place.fault(faults, fault.key, &fault.what);
        }
    }
    None
}

/// Notes an identifier that is used twice or that an input has on the same interface.
fn check_ids(frames: &[FrameKeys<'_>; 3], plan: &OutputPlan, buses: &[BusIndex], checks: &mut Checks<'_>) {
    let ids = plan.ids();
    for (index, (id, frame)) in ids.iter().zip(frames).enumerate() {
        if let Some(other) = ids[..index].iter().position(|other| other == id) {
            let what = format!("{} and {} frame would both be {id}, must differ", FRAMES[index], FRAMES[other]);
            frame.place.fault(checks.faults, "id", &what);
        }
        check_no_input(frame.place, *id, buses, checks);
    }
}

/// Notes a data id that is used twice: one frame could be accepted as another.
fn check_data_ids(frames: &[FrameKeys<'_>; 3], plan: &OutputPlan, faults: &mut Faults) {
    let data_ids = plan.protections().map(|protection| protection.map(|protection| protection.data_id));
    for (index, (data_id, frame)) in data_ids.iter().zip(frames).enumerate() {
        let Some(data_id) = data_id else { continue };
        if let Some(other) = data_ids[..index].iter().position(|other| other.as_ref() == Some(data_id)) {
            let what =
                format!("{} and {} frame would both have {data_id:#X}, must differ", FRAMES[index], FRAMES[other]);
            frame.place.fault(faults, "data_id", &what);
        }
    }
}

/// The interfaces on which frames are sent.
fn buses(raw: &RawTables, keys: &Output) -> Vec<BusIndex> {
    let wanted = |name: &str| keys.interfaces.as_ref().is_none_or(|names| names.iter().any(|n| n == name));
    let indexed = (0..).zip(&raw.interfaces).filter(|(_, interface)| wanted(&interface.name));
    indexed.map(|(index, _)| BusIndex(index)).collect()
}

/// Describes the sent frames.
pub(super) fn uses(raw: &RawTables, output: Option<&OutputConfig>) -> Vec<OutputUse> {
    let Some(output) = output else { return Vec::new() };
    let names = output.buses.iter().filter_map(|bus| raw.interfaces.get(bus.index()));
    let names: Vec<String> = names.map(|interface| interface.name.clone()).collect();
    let periods_s = [output.status_period_s, output.health_period_s, output.alarm_period_s];
    let plan = &output.plan;
    let frames = FRAMES.into_iter().zip(plan.ids()).zip(periods_s).zip(plan.formats()).zip(plan.protections());
    let used = frames.map(|((((frame, id), period_s), format), protection)| OutputUse {
        frame,
        id: id.to_string(),
        interfaces: names.clone(),
        period_ms: 1000.0 * period_s,
        kind: match format {
            FrameFormat::Classic => "classic",
            FrameFormat::Fd { brs: false } => "FD",
            FrameFormat::Fd { brs: true } => "FD with bit rate switch",
        },
        protection: protection.map_or("none".to_owned(), |Protection { profile, data_id }| {
            format!("profile {}, data id {data_id:#X}", profile.name())
        }),
    });
    used.collect()
}
