//! Interfaces, identifiers, error frames, foreign senders, end-to-end checks.

use super::super::report::{Finding, Topic};
use super::super::watch::{Bus, Checked};
use super::{Judge, words};
use crate::can::CanId;
use crate::can::e2e::{Profile, Protection};
use crate::can::guard::GuardConfig;
use crate::quantity::BusIndex;

/// Error classes of linux/can/error.h.
const CLASS_ACK: u32 = 0x20;
const CLASS_BUS_OFF: u32 = 0x40;
/// Share of error frames above which the wiring must be looked at.
const MANY_ERRORS: f64 = 0.01;
/// Share of frames that may fail their check before it is a finding: some are lost at every start.
const FAILING: f64 = 0.05;

pub(super) fn judge(judge: &mut Judge<'_>) {
    for index in 0..judge.plan.interfaces.len() {
        interface(judge, index);
    }
    messages(judge);
    conflicts(judge);
    protection(judge);
    traffic(judge);
}

fn number(index: usize) -> BusIndex {
    BusIndex(u8::try_from(index).unwrap_or(u8::MAX))
}

/// Interfaces that carry identifiers that are wanted on `bus`, with how many.
fn elsewhere(judge: &Judge<'_>, bus: BusIndex) -> Vec<(usize, usize)> {
    let wanted: Vec<CanId> = judge.plan.messages.iter().filter(|m| m.bus == bus).map(|m| m.id).collect();
    let others = judge.doctor.buses.iter().enumerate().filter(|(index, _)| *index != bus.index());
    let counted = others.map(|(index, other)| (index, wanted.iter().filter(|id| other.ids.contains_key(id)).count()));
    let mut found: Vec<_> = counted.filter(|(_, count)| *count > 0).collect();
    found.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    found
}

fn interface(judge: &mut Judge<'_>, index: usize) {
    let (bus, number) = (&judge.doctor.buses[index], number(index));
    let is_used = judge.plan.messages.iter().any(|message| message.bus == number);
    if bus.error_frames > 0 {
        error_frames(judge, bus);
    }
    if bus.dropped > 0 {
        let seen = format!("{} lost before they were read", words::count(bus.dropped, "frame"));
        let note = Finding::note(Topic::Interface, format!("{}: frames were lost", bus.name)).seen(seen);
        judge.report.add(note.advice("periods are judged too long; check the load of this computer"));
    }
    if bus.frames > 0 || !is_used {
        return;
    }
    for message in judge.plan.messages.iter().filter(|message| message.bus == number) {
        judge.explained.insert((number, message.id));
    }
    let table = format!("interface[{}]", index + 1);
    let others = elsewhere(judge, number);
    if let Some(&(other, count)) = others.first() {
        let name = &judge.doctor.buses[other].name;
        let all = judge.plan.messages.iter().filter(|message| message.bus == number).count();
        let finding = Finding::error(Topic::Interface, format!("the pack is on {name}, not on {}", bus.name))
            .seen(format!("no frame on {}; {count} of {all} configured messages came on {name}", bus.name))
            .why("the identifiers of the DBC are there, on the other bus")
            .change(&table, "name", format!("{name:?}"));
        return judge.report.add(finding);
    }
    if bus.error_frames > 0 {
        return; // told as a wrong bit rate
    }
    let (what, advice) = match (bus.is_missing, bus.is_down) {
        (true, _) => ("does not exist", "create it, plug the adapter in, or name another"),
        (_, true) => ("is down", "bring it up: ip link set NAME up type can bitrate RATE"),
        _ => (
            "is silent",
            "is the vehicle awake? then check the plug, the bit rate, and that CAN_H and CAN_L are not exchanged",
        ),
    };
    let heard: Vec<String> = judge.doctor.buses.iter().filter(|b| b.frames > 0).map(|b| b.name.clone()).collect();
    let heard = if heard.is_empty() {
        "no other interface had any".to_owned()
    } else {
        format!("{} had some, none of them ours", heard.join(", "))
    };
    let finding = Finding::error(Topic::Interface, format!("{} {what}", bus.name))
        .seen(format!("no frame on {} in {}; {heard}", bus.name, words::seconds(judge.doctor.seconds())))
        .why("the configured signals are expected there")
        .change(&table, "name", "the interface the pack is on")
        .advice(advice);
    judge.report.add(finding);
}

fn error_frames(judge: &mut Judge<'_>, bus: &Bus) {
    let share = bus.error_frames as f64 / (bus.frames + bus.error_frames) as f64;
    let seen =
        format!("{} and {}", words::count(bus.error_frames, "error frame"), words::count(bus.frames, "data frame"));
    let hint = match bus.error_classes {
        classes if classes & CLASS_BUS_OFF != 0 => "the controller went bus-off",
        classes if classes & CLASS_ACK != 0 => "nobody acknowledged what was sent",
        _ => "bits were not what they should be",
    };
    let advice = "check the bit rate first (ip -details link show), then the termination (60 ohm between CAN_H and CAN_L) and the plug";
    let finding = if bus.frames == 0 {
        Finding::error(Topic::BitRate, format!("{}: error frames and nothing else: wrong bit rate?", bus.name))
            .why(format!("{hint}, and no frame was ever understood"))
    } else if share > MANY_ERRORS {
        Finding::warning(Topic::BitRate, format!("{}: many error frames", bus.name))
            .why(format!("{hint}; frames do come, so the bit rate is right, and the wiring is not"))
    } else {
        Finding::note(Topic::BitRate, format!("{}: some error frames", bus.name)).why(hint)
    };
    judge.report.add(finding.seen(seen).advice(advice));
}

/// Messages that came in another form or on another bus.
fn messages(judge: &mut Judge<'_>) {
    let plan = judge.plan;
    for (index, configured) in plan.interfaces.iter().enumerate() {
        let (bus, number) = (&judge.doctor.buses[index], number(index));
        let ours: Vec<_> = plan.messages.iter().filter(|message| message.bus == number).collect();
        let fd: Vec<_> = ours.iter().filter(|m| bus.ids.get(&m.id).is_some_and(|seen| seen.fd > 0)).collect();
        if !configured.fd && !fd.is_empty() {
            let names: Vec<&str> = fd.iter().map(|message| message.name.as_str()).collect();
            let finding = Finding::error(Topic::Fd, format!("{}: messages of the pack are CAN FD frames", bus.name))
                .seen(format!("{} came as FD frames", names.join(", ")))
                .why("with fd = false the kernel does not hand them to the service")
                .change(&format!("interface[{}]", index + 1), "fd", "true");
            judge.report.add(finding);
        }
        let absent: Vec<_> = ours.into_iter().filter(|message| !bus.ids.contains_key(&message.id)).collect();
        if bus.frames == 0 || absent.is_empty() {
            continue;
        }
        for message in absent {
            if let Some(finding) = other_kind(bus, message.id, &message.name)
                .or_else(|| other_bus(judge, number, message.id, &message.name))
            {
                judge.explained.insert((number, message.id));
                judge.report.add(finding);
            }
        }
    }
}

fn other_kind(bus: &Bus, id: CanId, name: &str) -> Option<Finding> {
    let twin = match id {
        CanId::Standard(raw) => CanId::extended(u32::from(raw)),
        CanId::Extended(raw) => CanId::standard(raw),
    }?;
    let seen = bus.ids.get(&twin)?;
    let words = |id: CanId| if matches!(id, CanId::Standard(_)) { "an 11-bit" } else { "a 29-bit" };
    let line = match twin {
        CanId::Standard(raw) => u64::from(raw),
        CanId::Extended(raw) => u64::from(raw) | 0x8000_0000,
    };
    Some(
        Finding::error(
            Topic::IdKind,
            format!("{name} comes with {} identifier, the DBC says {} one", words(twin), words(id)),
        )
        .seen(format!("{} of {twin} on {}, none of {id}", words::count(seen.count, "frame"), bus.name))
        .why("both kinds may have the same number and are different messages; bit 31 in the DBC tells them apart")
        .advice(format!("in the DBC: BO_ {line} {name}: ...")),
    )
}

fn other_bus(judge: &Judge<'_>, bus: BusIndex, id: CanId, name: &str) -> Option<Finding> {
    let buses = judge.doctor.buses.iter().enumerate();
    let (_, other) = buses.filter(|(index, _)| *index != bus.index()).find(|(_, other)| other.ids.contains_key(&id))?;
    let seen = other.ids.get(&id)?;
    let mut finding = Finding::error(
        Topic::Interface,
        format!("{name} is on {}, not on {}", other.name, judge.interface(bus)),
    )
    .seen(format!("{} of {id} on {}, none on {}", words::count(seen.count, "frame"), other.name, judge.interface(bus)))
    .why("the identifier is there, on the other bus (which may use it for a message of its own: look at the values)");
    let mut tables: Vec<&str> = judge
        .plan
        .signals
        .iter()
        .filter(|s| s.binding.bus == bus && s.binding.id == id)
        .map(|s| s.table.as_str())
        .collect();
    tables.dedup();
    for table in tables {
        finding = finding.change(table, "interface", format!("{:?}", other.name));
    }
    Some(finding)
}

/// Somebody sends what only we should send.
fn conflicts(judge: &mut Judge<'_>) {
    let plan = judge.plan;
    for output in &plan.outputs {
        for bus in &output.buses {
            let Some(seen) = judge.doctor.buses.get(bus.index()).and_then(|of| of.ids.get(&output.id)) else {
                continue;
            };
            let name = judge.interface(*bus);
            let finding = Finding::warning(
                Topic::Conflict,
                format!("somebody sends under {}, our {} frame", output.id, output.name),
            )
            .seen(format!("{} of {} on {name}", words::count(seen.count, "frame"), output.id))
            .why("two senders of one identifier destroy each other's frames, and receivers take one for the other")
            .change(&output.table, "id", "an identifier nobody else uses")
            .advice("nothing is wrong when packwatch itself was running while this was heard");
            judge.report.add(finding);
        }
    }
}

fn protection(judge: &mut Judge<'_>) {
    let plan = judge.plan;
    for (index, guard) in plan.guards.iter().enumerate() {
        let Some(checked) = judge.doctor.checked.get(&(guard.bus, guard.id)) else { continue };
        let name = plan
            .messages
            .iter()
            .find(|m| (m.bus, m.id) == (guard.bus, guard.id))
            .map_or("commands", |m| m.name.as_str());
        let all = checked.good + checked.bad;
        if all == 0 || checked.bad as f64 <= FAILING * all as f64 {
            if checked.good > 0 {
                judge.report.fine.push(format!("{name}: {} of {all} frames pass their end-to-end check", checked.good));
            }
            continue;
        }
        let counts: Vec<String> = checked.counts.iter().map(|(name, count)| format!("{name} {count}")).collect();
        let finding = Finding::error(Topic::Protection, format!("{name} fails its end-to-end check")).seen(format!(
            "{} of {all} frames fail: {}",
            checked.bad,
            counts.join(", ")
        ));
        let finding = why_failing(finding, &format!("input.protected[{}]", index + 1), guard, checked);
        judge.report.add(finding);
    }
}

fn why_failing(finding: Finding, table: &str, guard: &GuardConfig, checked: &Checked) -> Finding {
    let Protection { profile, data_id } = guard.check.protection;
    let fits = |protection: Protection| checked.payloads.iter().all(|p| protection.verified_counter(p).is_some());
    let profiles = [Profile::P01A, Profile::P01C, Profile::P05];
    if fits(guard.check.protection) {
        return finding
            .why("the checksums are right, the counters are not: frames are repeated, lost, or sent by two")
            .change(table, "max_delta_counter", "2")
            .advice("a gateway that repeats or thins out the message makes this too");
    }
    let other = profiles
        .into_iter()
        .filter(|other| *other != profile)
        .find(|other| data_id <= other.max_data_id() && fits(Protection { profile: *other, data_id }));
    if let Some(other) = other {
        return finding.why(format!("with profile {} every frame is right", other.name())).change(
            table,
            "profile",
            format!("{:?}", other.name()),
        );
    }
    let found = profiles.into_iter().find_map(|profile| {
        let id = (0..=profile.max_data_id()).find(|&data_id| fits(Protection { profile, data_id }))?;
        Some((profile, id))
    });
    match found {
        // Its eight bits cannot tell 256 identifiers apart.
        Some((Profile::P01A, id)) => finding
            .why(format!("the checksum is that of profile 1A with another data identifier ({id:#X} and 255 others give it)"))
            .change(table, "data_id", "as the sender's makers say"),
        Some((profile, id)) => finding
            .why(format!("with profile {} and data identifier {id:#X} every frame is right", profile.name()))
            .change(table, "profile", format!("{:?}", profile.name()))
            .change(table, "data_id", format!("{id:#X}")),
        None => finding
            .why("no profile and no data identifier fits: the message is not protected in this way, or is another message")
            .advice("ask the sender's makers, or take the table away"),
    }
}

/// What else goes on, for the record.
fn traffic(judge: &mut Judge<'_>) {
    for bus in judge.doctor.buses.iter().filter(|bus| bus.frames > 0) {
        let per_s = bus.frames as f64 / judge.doctor.seconds().max(1e-3);
        judge.report.fine.push(format!(
            "{}: {} frames a second under {}{}",
            bus.name,
            words::number(if per_s >= 10.0 { per_s.round() } else { (per_s * 100.0).round() / 100.0 }),
            words::count(bus.ids.len() as u64, "identifier"),
            if bus.error_frames == 0 { ", no error frames" } else { "" },
        ));
    }
}
