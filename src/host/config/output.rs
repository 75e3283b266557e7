//! The sent frames: layout, identifiers, interfaces, periods, protection. No sent frame may be mistaken for an input.

use std::path::Path;

use super::describe::OutputUse;
use super::document::Faults;
use super::keys::{E2eKey, FrameKeys, Output};
use super::resolve::{Checks, check_no_input, read_dbc};
use super::tables::RawTables;
use super::{ReadFile, beside};

use crate::can::CanId;
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::Protection;
use crate::can::encode::{
    DEFAULT_PERIOD_MS, E2eSetting, LayoutBase, LayoutMessage, LayoutSettings, MessageSettings, OutputPlan, SentMessage,
    layout,
};
use crate::cell::CellModel;
use crate::monitor::OutputConfig;
use crate::quantity::BusIndex;

/// The messages that are sent.
const SENT: [LayoutMessage; 5] =
    [LayoutMessage::Status, LayoutMessage::Health, LayoutMessage::Alarm, LayoutMessage::Digest, LayoutMessage::Reply];

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
        raw.output_digest.as_ref()?.config(),
        raw.output_reply.as_ref()?.config(),
    ];
    let [status, health, alarm, digest, reply] = frames.map(|frame| message_settings(&frame, checks.faults));
    let command_settings = match command {
        Some(keys) => Some(message_settings(&keys.config(), checks.faults)?),
        None => None,
    };
    if frames[4].period_ms.is_some() {
        frames[4].place.fault(checks.faults, "period_ms", "must not be given: a reply is sent on a command only");
    }
    let (status, health, alarm, digest, reply) = (status?, health?, alarm?, digest?, reply?);
    let settings = LayoutSettings { status, health, alarm, command: command_settings, digest, reply };
    let frames: Vec<_> = SENT.into_iter().zip(frames).collect();
    let laid_out: Vec<_> =
        frames.iter().copied().chain(command.map(|keys| (LayoutMessage::Command, keys.config()))).collect();
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
    for sent in plan.messages().filter(|sent| sent.format != FrameFormat::Classic) {
        if let Some(frame) = keys_of(&frames, sent.message) {
            raw.check_fd(frame.place, &buses, checks.faults);
        }
    }
    let period_s = |wanted| {
        let sent = plan.messages().find(|sent| sent.message == wanted);
        f64::from(sent.and_then(|sent| sent.cycle_time_ms).unwrap_or(DEFAULT_PERIOD_MS)) / 1000.0
    };
    let output = OutputConfig {
        status_period_s: period_s(LayoutMessage::Status),
        health_period_s: period_s(LayoutMessage::Health),
        alarm_period_s: period_s(LayoutMessage::Alarm),
        digest_period_s: period_s(LayoutMessage::Digest),
        plan,
        buses,
    };
    Some((output, database))
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
    frames: &[(LayoutMessage, FrameKeys<'_>)],
    faults: &mut Faults,
) -> Option<Database> {
    let refused = match layout(base, settings) {
        Ok(database) => return Some(database),
        Err(refused) => refused,
    };
    for fault in refused {
        if let Some(frame) = keys_of(frames, fault.message) {
            frame.place.fault(faults, fault.key, &fault.what);
        }
    }
    None
}

/// The keys of a message's table.
fn keys_of<'k, 'a>(frames: &'k [(LayoutMessage, FrameKeys<'a>)], message: LayoutMessage) -> Option<&'k FrameKeys<'a>> {
    frames.iter().find(|(which, _)| *which == message).map(|(_, keys)| keys)
}

/// Notes an identifier that is used twice or that an input has on the same interface.
fn check_ids(
    frames: &[(LayoutMessage, FrameKeys<'_>)],
    plan: &OutputPlan,
    buses: &[BusIndex],
    checks: &mut Checks<'_>,
) {
    let sent: Vec<_> = plan.messages().collect();
    for (index, message) in sent.iter().enumerate() {
        let Some(keys) = keys_of(frames, message.message) else { continue };
        let id = message.id;
        if let Some(other) = sent[..index].iter().find(|other| other.id == id) {
            let (one, other) = (message.message.name(), other.message.name());
            keys.place.fault(checks.faults, "id", &format!("{one} and {other} frame would both be {id}, must differ"));
        }
        check_no_input(keys.place, id, buses, checks);
    }
}

/// Notes a data id that is used twice: one frame could be accepted as another.
fn check_data_ids(frames: &[(LayoutMessage, FrameKeys<'_>)], plan: &OutputPlan, faults: &mut Faults) {
    let sent: Vec<_> = plan.messages().collect();
    let data_id = |message: &SentMessage| message.protection.map(|protection| protection.data_id);
    for (index, message) in sent.iter().enumerate() {
        let (Some(keys), Some(found)) = (keys_of(frames, message.message), data_id(message)) else { continue };
        if let Some(other) = sent[..index].iter().find(|other| data_id(other) == Some(found)) {
            let (one, other) = (message.message.name(), other.message.name());
            let what = format!("{one} and {other} frame would both have {found:#X}, must differ");
            keys.place.fault(faults, "data_id", &what);
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
    let used = output.plan.messages().map(|sent| OutputUse {
        frame: sent.message.name(),
        id: sent.id.to_string(),
        interfaces: names.clone(),
        period_ms: sent.cycle_time_ms.map(f64::from),
        kind: match sent.format {
            FrameFormat::Classic => "classic",
            FrameFormat::Fd { brs: false } => "FD",
            FrameFormat::Fd { brs: true } => "FD with bit rate switch",
        },
        protection: sent.protection.map_or("none".to_owned(), |Protection { profile, data_id }| {
            format!("profile {}, data id {data_id:#X}", profile.name())
        }),
    });
    used.collect()
}
