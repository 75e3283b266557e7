//! Checks the sent frames and builds their settings: layout, identifiers, interfaces, periods and protection. No sent
//! frame may have the identifier of an input.

use std::path::Path;

use super::signals::{ResolvedSignal, check_no_input, read_dbc};
use crate::config::document::{ReadFile, beside};
use crate::config::schema::RawTables;
use crate::config::schema::keys::{E2eKey, FrameKeys, Output};

use crate::can::CanId;
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::Protection;
use crate::can::encode::{
    DEFAULT_PERIOD_MS, E2eSetting, LayoutBase, LayoutMessage, LayoutSettings, MessageSettings, OutputPlan,
    SettingFault, layout,
};
use crate::can::secoc::{self, Authentication};
use crate::cell::CellModel;
use crate::monitor::OutputConfig;
use crate::quantity::BusIndex;

const SENT: [LayoutMessage; 6] = [
    LayoutMessage::Status,
    LayoutMessage::Health,
    LayoutMessage::Alarm,
    LayoutMessage::Digest,
    LayoutMessage::Reply,
    LayoutMessage::Freshness,
];

/// The sent frames and their layout. `None` = no frames are configured, or faults are reported.
pub(crate) fn output(
    raw: &RawTables,
    found: &[ResolvedSignal<'_>],
    config: &Path,
    model: Option<&CellModel>,
    read: ReadFile<'_>,
) -> Option<(OutputConfig, Database)> {
    let keys = raw.output.as_ref().filter(|keys| keys.enabled)?;
    let command = raw.commands.as_ref().filter(|commands| commands.enabled);
    let frames = [
        raw.output_status.as_ref()?.config(),
        raw.output_health.as_ref()?.config(),
        raw.output_alarm.as_ref()?.config(),
        raw.output_digest.as_ref()?.config(),
        raw.output_reply.as_ref()?.config(),
        raw.output_freshness.as_ref()?.config(),
    ];
    let [status, health, alarm, digest, reply] = [0, 1, 2, 3, 4].map(|place| message_settings(&frames[place]));
    let command_settings = match command {
        Some(keys) => Some(message_settings(&keys.config())?),
        None => None,
    };
    if frames[4].period_ms.is_some() {
        frames[4].place.fault("period_ms", "must not be given: a reply is sent only after a command");
    }
    frames[..5].iter().for_each(check_sent_secoc);
    let freshness = freshness_settings(&frames[5], command_settings.as_ref());
    let (status, health, alarm, digest, reply, freshness) = (status?, health?, alarm?, digest?, reply?, freshness?);
    let settings = LayoutSettings { status, health, alarm, command: command_settings, digest, reply, freshness };
    let frames: Vec<_> = SENT.into_iter().zip(frames).collect();
    let laid_out: Vec<_> =
        frames.iter().copied().chain(command.map(|keys| (LayoutMessage::Command, keys.config()))).collect();
    let own = match &keys.dbc {
        Some(name) => {
            Some(read_dbc(&beside(config, name), read, &raw.faults, |faults, at, what| faults.add_at(at, what))?)
        }
        None => None,
    };
    // A missing cell model has already been reported. In that case, any capacity is good enough to find further faults
    // of the layout.
    let rated_capacity_ah = raw.rated_ah(model).unwrap_or(1.0);
    let base = own.as_ref().map_or(LayoutBase::BuiltIn { rated_capacity_ah }, LayoutBase::Own);
    let refuse = |fault: &SettingFault| {
        if let Some(frame) = keys_of(&laid_out, fault.message) {
            frame.place.fault(fault.key, &fault.what);
        }
    };
    let database = layout(base, &settings).map_err(|refused| refused.iter().for_each(refuse)).ok()?;
    let missing = |error: &String| keys.place.fault("dbc", error);
    let plan = OutputPlan::new(&database).map_err(|all| all.0.iter().for_each(missing)).ok()?;
    if keys.outlook && !plan.has_outlook() {
        keys.place.fault("outlook", "must be false: the DBC has no signal of energy, time or power");
    }
    let plan = if keys.outlook { plan } else { plan.without_outlook() };
    let buses = buses(raw, keys);
    check_ids(&frames, &plan, &buses, found);
    for sent in plan.messages().filter(|sent| sent.format != FrameFormat::Classic) {
        if let Some(frame) = keys_of(&frames, sent.message) {
            raw.check_fd(frame.place, &buses);
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
        while_asleep: keys.while_asleep,
        plan,
        buses,
    };
    Some((output, database))
}

/// The settings of a frame's message. If a key is faulty, reports it and returns `None`.
pub(crate) fn message_settings(keys: &FrameKeys<'_>) -> Option<MessageSettings> {
    let id = match keys.id {
        Some(id) => Some(configured_id(keys, id)?),
        None if keys.extended => {
            keys.place.fault("extended", "requires the key id");
            return None;
        }
        None => None,
    };
    let e2e = protection(keys)?;
    let secoc = authentication(keys)?;
    Some(MessageSettings { id, fd: keys.fd, brs: keys.brs, period_ms: keys.period_ms, e2e, secoc })
}

fn configured_id(keys: &FrameKeys<'_>, id: u32) -> Option<CanId> {
    let can_id = if keys.extended { CanId::extended(id) } else { CanId::standard(id) };
    if can_id.is_none() {
        keys.place.fault("id", "must be 0 to 0x7FF; a longer identifier requires extended = true");
    }
    can_id
}

fn protection(keys: &FrameKeys<'_>) -> Option<E2eSetting> {
    let profile = match keys.e2e {
        None if keys.data_id.is_some() && keys.secoc.is_none() => {
            keys.place.fault("data_id", "requires e2e or secoc");
            return None;
        }
        None => return Some(E2eSetting::AsBase),
        Some(E2eKey(None)) => return Some(E2eSetting::Off),
        Some(E2eKey(Some(profile))) => profile,
    };
    let Some(data_id) = keys.data_id else {
        let what = format!("must be 0 to {:#X} with e2e = \"{}\"", profile.max_data_id(), profile.name());
        keys.place.fault("data_id", &what);
        return None;
    };
    Some(E2eSetting::On(Protection { profile, data_id }))
}

/// The authentication of a frame; the outer `None` = a fault is reported.
fn authentication(keys: &FrameKeys<'_>) -> Option<Option<Authentication>> {
    let Some(profile) = keys.secoc else { return Some(None) };
    if keys.data_id.is_none() {
        keys.place.fault("data_id", format!("must be 0 to 0xFFFF with secoc = \"{}\"", profile.name()));
    }
    keys.data_id.map(|data_id| Some(Authentication { profile, data_id }))
}

/// Reports a SecOC profile other than "fd" for a sent frame. The other profiles have too few bits of freshness for a
/// sender that may restart.
fn check_sent_secoc(keys: &FrameKeys<'_>) {
    if keys.secoc.is_some_and(|profile| profile != secoc::Profile::Fd) {
        keys.place.fault("secoc", "must be \"fd\" for a frame that is sent");
    }
}

/// The settings of the freshness announcement; `None` = faults reported.
fn freshness_settings(keys: &FrameKeys<'_>, command: Option<&MessageSettings>) -> Option<MessageSettings> {
    let is_sent = command.is_some_and(|command| command.secoc.is_some());
    let unused = [
        ("e2e", keys.e2e.is_some()),
        ("secoc", keys.secoc.is_some()),
        ("period_ms", keys.period_ms.is_some()),
        ("data_id", keys.data_id.is_some() && !is_sent),
    ];
    let mut is_good = true;
    for (key, _) in unused.into_iter().filter(|(_, is_given)| *is_given) {
        is_good = false;
        let what = if key == "data_id" {
            "must not be given without commands.secoc: there is nothing to announce"
        } else {
            "must not be given: the announcement has a fixed authentication and period"
        };
        keys.place.fault(key, what);
    }
    let Some(data_id) = keys.data_id.filter(|_| is_sent) else {
        if is_sent {
            keys.place.fault("data_id", "must be 0 to 0xFFFF with commands.secoc");
        }
        return (is_good && !is_sent).then(MessageSettings::default);
    };
    let id = keys.id.and_then(|id| configured_id(keys, id));
    let secoc = Some(Authentication { profile: secoc::Profile::Announcement, data_id });
    let settings = MessageSettings { id, fd: keys.fd, brs: keys.brs, secoc, ..MessageSettings::default() };
    is_good.then_some(settings)
}

fn keys_of<'k, 'a>(frames: &'k [(LayoutMessage, FrameKeys<'a>)], message: LayoutMessage) -> Option<&'k FrameKeys<'a>> {
    frames.iter().find(|(which, _)| *which == message).map(|(_, keys)| keys)
}

/// Reports identifiers and data ids that two frames share, because receivers could mistake one frame for the other.
/// Also reports identifiers that an input uses on the same interface.
fn check_ids(
    frames: &[(LayoutMessage, FrameKeys<'_>)],
    plan: &OutputPlan,
    buses: &[BusIndex],
    found: &[ResolvedSignal<'_>],
) {
    let sent: Vec<_> = plan.messages().collect();
    for (index, message) in sent.iter().enumerate() {
        let Some(keys) = keys_of(frames, message.message) else { continue };
        let (one, id) = (message.message.name(), message.id);
        if let Some(other) = sent[..index].iter().find(|other| other.id == id) {
            let other = other.message.name();
            keys.place
                .fault("id", format!("must differ: the {one} and {other} frames would both have identifier {id}"));
        }
        check_no_input(keys.place, id, buses, found);
        let Some(data_id) = message.data_id() else { continue };
        if let Some(other) = sent[..index].iter().find(|other| other.data_id() == Some(data_id)) {
            let other = other.message.name();
            keys.place.fault(
                "data_id",
                format!("must differ: the {one} and {other} frames would both have data id {data_id:#X}"),
            );
        }
    }
}

fn buses(raw: &RawTables, keys: &Output) -> Vec<BusIndex> {
    let wanted = |name: &str| keys.interfaces.as_ref().is_none_or(|names| names.iter().any(|n| n == name));
    let indexed = (0..).zip(&raw.interfaces).filter(|(_, interface)| wanted(&interface.name));
    indexed.map(|(index, _)| BusIndex(index)).collect()
}
