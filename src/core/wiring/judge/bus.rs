//! Checks interfaces, identifiers, error frames and end-to-end protection, and finds other nodes that send with the
//! daemon's identifiers.

use super::context::{Judge, error, find, note, warning};
use super::text::{count, number, seconds};
use crate::can::CanId;
use crate::can::e2e::{Profile, Protection};
use crate::can::guard::GuardConfig;
use crate::quantity::BusIndex;
use crate::wiring::observer::{BusStats, ProtectionStats};
use crate::wiring::plan::MessagePlan;
use crate::wiring::report::{Severity, Topic, WiringFinding};

pub(super) fn check(judge: &mut Judge<'_>) {
    for index in 0..judge.plan.interfaces.len() {
        interface(judge, index);
    }
    for index in 0..judge.plan.interfaces.len() {
        messages(judge, index);
    }
    conflicts(judge);
    protection(judge);
    traffic(judge);
}

fn bus_index(index: usize) -> BusIndex {
    BusIndex(u8::try_from(index).unwrap_or(u8::MAX))
}

fn interface_table(index: usize) -> String {
    format!("interface[{}]", index + 1)
}

fn messages_of<'d>(judge: &Judge<'d>, bus: BusIndex) -> Vec<&'d MessagePlan> {
    judge.plan.messages.iter().filter(|message| message.bus == bus).collect()
}

/// Finds the interface, other than `index`, that has received the most identifiers of `wanted`. Returns the interface
/// and the number of these identifiers.
fn best_other<'d>(judge: &Judge<'d>, index: usize, wanted: &[&MessagePlan]) -> Option<(&'d BusStats, usize)> {
    let others = judge.observed.buses.iter().enumerate().filter(|(other, _)| *other != index);
    let counted = others.map(|(_, bus)| (bus, wanted.iter().filter(|m| bus.ids.contains_key(&m.id)).count()));
    // If several interfaces have received the same number, returns the first of them.
    counted.filter(|(_, count)| *count > 0).rev().max_by_key(|(_, count)| *count)
}

fn interface(judge: &mut Judge<'_>, index: usize) {
    let (bus, wanted) = (&judge.observed.buses[index], messages_of(judge, bus_index(index)));
    if bus.error_frames > 0 {
        error_frames(judge, bus);
    }
    if bus.dropped > 0 {
        note(judge, Topic::Interface, format!("{}: frames were lost", bus.name))
            .seen(format!("{} lost before they were read", count(bus.dropped, "frame")))
            .advice("lost frames make periods appear too long; check the load of this computer");
    }
    if bus.frames > 0 || wanted.is_empty() {
        return;
    }
    judge.explained.extend(wanted.iter().map(|message| (message.bus, message.id)));
    if let Some((BusStats { name, .. }, found)) = best_other(judge, index, &wanted) {
        error(judge, Topic::Interface, format!("the pack is on {name}, not on {}", bus.name))
            .seen(format!("no frame on {}; {found} of {} configured messages on {name}", bus.name, wanted.len()))
            .why("the other bus has the identifiers of the DBC")
            .change(&interface_table(index), "name", format!("{name:?}"));
    } else if bus.error_frames == 0 {
        silent_interface(judge, bus, &interface_table(index));
    }
}

fn silent_interface(judge: &mut Judge<'_>, bus: &BusStats, table: &str) {
    let (state, advice) = match (bus.is_missing, bus.is_down) {
        (true, _) => ("does not exist", "create the interface, plug the adapter in, or configure another interface"),
        (_, true) => ("is down", "bring the interface up: ip link set NAME up type can bitrate RATE"),
        _ => (
            "is silent",
            "wake the vehicle; if it is awake, check the plug, the bit rate, and whether CAN_H and CAN_L are exchanged",
        ),
    };
    let busy = judge.observed.buses.iter().filter(|other| other.frames > 0).map(|other| other.name.as_str());
    let busy: Vec<&str> = busy.collect();
    let others = if busy.is_empty() {
        "no other interface received frames".to_owned()
    } else {
        format!("{} received frames, but none of this pack", busy.join(", "))
    };
    let span = seconds(judge.observed.seconds());
    error(judge, Topic::Interface, format!("{} {state}", bus.name))
        .seen(format!("no frame on {} in {span}; {others}", bus.name))
        .why("the configured signals are expected on this interface")
        .change(table, "name", "the interface that the pack is connected to")
        .advice(advice);
}

fn error_frames(judge: &mut Judge<'_>, bus: &BusStats) {
    let (name, classes) = (&bus.name, bus.error_classes);
    let share = bus.error_frames as f64 / (bus.frames + bus.error_frames) as f64;
    let hint = match classes {
        // Error classes of linux/can/error.h.
        _ if classes & 0x40 != 0 => "the controller went bus-off",
        _ if classes & 0x20 != 0 => "no node acknowledged the sent frames",
        _ => "received bits were invalid",
    };
    let (severity, what, why) = if bus.frames == 0 {
        (Severity::Error, "only error frames: wrong bit rate?", ", and no valid frame was received")
    } else if share > 0.01 {
        let why = "; valid frames are received, so the bit rate is right and the wiring is probably faulty";
        (Severity::Warning, "many error frames", why)
    } else {
        (Severity::Note, "some error frames", "")
    };
    let (errors, data) = (count(bus.error_frames, "error frame"), count(bus.frames, "data frame"));
    find(judge, severity, Topic::BitRate, format!("{name}: {what}"))
        .seen(format!("{errors} and {data}"))
        .why(format!("{hint}{why}"))
        .advice(
            "check the bit rate first (ip -details link show), then the termination (60 ohm between CAN_H and CAN_L) \
             and the plug",
        );
}

/// Finds messages that arrive as FD frames, with the other kind of identifier, or on another bus.
fn messages(judge: &mut Judge<'_>, index: usize) {
    let (bus, wanted) = (&judge.observed.buses[index], messages_of(judge, bus_index(index)));
    let is_fd = |message: &&&MessagePlan| bus.ids.get(&message.id).is_some_and(|stats| stats.fd > 0);
    let fd: Vec<&str> = wanted.iter().filter(is_fd).map(|message| message.name.as_str()).collect();
    if !judge.plan.interfaces[index].fd && !fd.is_empty() {
        error(judge, Topic::Fd, format!("{}: messages of the pack are CAN FD frames", bus.name))
            .seen(format!("received as FD frames: {}", fd.join(", ")))
            .why("if fd is false, the kernel does not deliver FD frames to the service")
            .change(&interface_table(index), "fd", "true");
    }
    if bus.frames == 0 {
        return;
    }
    for message in wanted.into_iter().filter(|message| !bus.ids.contains_key(&message.id)) {
        if other_kind(judge, bus, message).is_some() || on_other_bus(judge, message).is_some() {
            judge.explained.insert((message.bus, message.id));
        }
    }
}

fn other_kind(judge: &mut Judge<'_>, bus: &BusStats, message: &MessagePlan) -> Option<()> {
    let MessagePlan { id, name, .. } = message;
    let other = match *id {
        CanId::Standard(raw) => CanId::extended(u32::from(raw)),
        CanId::Extended(raw) => CanId::standard(raw),
    }?;
    let frames = count(bus.ids.get(&other)?.count, "frame");
    let (found, wanted) = match other {
        CanId::Standard(_) => ("an 11-bit", "a 29-bit"),
        CanId::Extended(_) => ("a 29-bit", "an 11-bit"),
    };
    let title = format!("{name} arrives with {found} identifier, but the DBC has {wanted} identifier");
    error(judge, Topic::IdKind, title)
        .seen(format!("{frames} of {other} on {}, none of {id}", bus.name))
        .why("an 11-bit and a 29-bit identifier of equal number are different; bit 31 in the DBC selects the kind")
        .advice(format!("in the DBC: BO_ {} {name}: ...", other.dbc_number()));
    Some(())
}

fn on_other_bus(judge: &mut Judge<'_>, message: &MessagePlan) -> Option<()> {
    let MessagePlan { bus, id, ref name, .. } = *message;
    let other = judge.other_bus(bus, id)?;
    let (frames, here) = (count(other.ids.get(&id)?.count, "frame"), judge.interface(bus));
    let signals = judge.plan.signals.iter().filter(|s| (s.binding.bus, s.binding.id) == (bus, id));
    let mut tables: Vec<&str> = signals.map(|signal| signal.table.as_str()).collect();
    tables.dedup();
    let finding = error(judge, Topic::Interface, format!("{name} is on {}, not on {here}", other.name))
        .seen(format!("{frames} of {id} on {}, none on {here}", other.name))
        .why("the other bus carries the identifier (possibly for another message: check the values)");
    for table in tables {
        finding.change(table, "interface", format!("{:?}", other.name));
    }
    Some(())
}

fn conflicts(judge: &mut Judge<'_>) {
    let buses = &judge.observed.buses;
    for output in &judge.plan.outputs {
        for bus in output.buses.iter().filter_map(|bus| buses.get(bus.index())) {
            let Some(stats) = bus.ids.get(&output.id) else { continue };
            let title = format!("another node sends with {}, the identifier of the {} frame", output.id, output.name);
            warning(judge, Topic::Conflict, title)
                .seen(format!("{} of {} on {}", count(stats.count, "frame"), output.id, bus.name))
                .why("if two nodes send the same identifier, their frames collide and receivers confuse them")
                .change(&output.table, "id", "an identifier that no other node uses")
                .advice("ignore this if packwatch itself was running at that time");
        }
    }
}

fn protection(judge: &mut Judge<'_>) {
    let plan = judge.plan;
    for (index, guard) in plan.guards.iter().enumerate() {
        let key = (guard.bus, guard.id);
        let Some(stats) = judge.observed.protected.get(&key) else { continue };
        let message = plan.messages.iter().find(|message| (message.bus, message.id) == key);
        let name = message.map_or("commands", |message| message.name.as_str());
        let all = stats.good + stats.bad;
        // After every start, the checks of a few frames fail.
        if all == 0 || stats.bad as f64 <= 0.05 * all as f64 {
            if stats.good > 0 {
                judge.fine(format!("{name}: {} of {all} frames pass their end-to-end check", stats.good));
            }
            continue;
        }
        let counts: Vec<String> = stats.counts.iter().map(|(status, count)| format!("{status} {count}")).collect();
        let finding = error(judge, Topic::Protection, format!("{name} fails its end-to-end check"));
        finding.seen(format!("{} of {all} frames fail: {}", stats.bad, counts.join(", ")));
        why_failing(finding, &format!("input.protected[{}]", index + 1), guard, stats);
    }
}

fn why_failing<'f>(
    finding: &'f mut WiringFinding,
    table: &str,
    guard: &GuardConfig,
    stats: &ProtectionStats,
) -> &'f mut WiringFinding {
    let Protection { profile, data_id } = guard.check.protection;
    let fits = |protection: Protection| stats.payloads.iter().all(|p| protection.verified_counter(p).is_some());
    let profiles = [Profile::P01A, Profile::P01C, Profile::P05];
    if fits(guard.check.protection) {
        return finding
            .why("the checksums are right, but the counters are not: frames are repeated, lost, or from two senders")
            .change(table, "max_delta_counter", "2")
            .advice("a gateway that repeats or drops frames of the message has the same effect");
    }
    let mut others = profiles.into_iter().filter(|other| *other != profile);
    if let Some(other) =
        others.find(|other| data_id <= other.max_data_id() && fits(Protection { profile: *other, data_id }))
    {
        let name = other.name();
        finding.why(format!("with profile {name}, every frame passes the check"));
        return finding.change(table, "profile", format!("{name:?}"));
    }
    let found = profiles.into_iter().find_map(|profile| {
        let id = (0..=profile.max_data_id()).find(|&data_id| fits(Protection { profile, data_id }))?;
        Some((profile, id))
    });
    match found {
        // An 8-bit checksum cannot determine the 16-bit data identifier, because 256 data identifiers fit.
        Some((Profile::P01A, id)) => finding
            .why(format!("the checksums fit profile 1A with another data identifier ({id:#X} and 255 others fit)"))
            .change(table, "data_id", "the number in the sender's documentation"),
        Some((profile, id)) => finding
            .why(format!("with profile {} and data identifier {id:#X}, every frame passes the check", profile.name()))
            .change(table, "profile", format!("{:?}", profile.name()))
            .change(table, "data_id", format!("{id:#X}")),
        None => finding
            .why("no known profile fits with any data identifier: the protection differs, or this is another message")
            .advice("ask the manufacturer of the sender, or remove the table"),
    }
}

fn traffic(judge: &mut Judge<'_>) {
    for bus in judge.observed.buses.iter().filter(|bus| bus.frames > 0) {
        let per_s = bus.frames as f64 / judge.observed.seconds().max(1e-3);
        let per_s = number(if per_s >= 10.0 { per_s.round() } else { (per_s * 100.0).round() / 100.0 });
        let (ids, errors) = (bus.ids.len() as u64, if bus.error_frames == 0 { ", no error frames" } else { "" });
        judge.fine(format!("{}: {per_s} frames a second with {}{errors}", bus.name, count(ids, "identifier")));
    }
}
