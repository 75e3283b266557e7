//! Builds the core's guards from `[[input.protected]]`. A guard checks the end-to-end protection of one message.

use super::signals::ResolvedSignal;
use crate::can::dbc::{Message, Signal};
use crate::can::e2e::{CheckConfig, Protection};
use crate::can::guard::GuardConfig;
use crate::config::schema::RawTables;
use crate::config::schema::did_you_mean;
use crate::config::schema::keys::ProtectedInput;
use crate::quantity::{BusIndex, Channel};

/// Returns the guards of the protected messages, and reports faults. If a configured signal was not found
/// (`inputs_whole` is false), a missing message is not reported, because its name may be correct.
pub(crate) fn guards(raw: &RawTables, found: &[ResolvedSignal<'_>], inputs_whole: bool) -> Vec<GuardConfig> {
    let mut guards: Vec<(GuardConfig, &ProtectedInput)> = Vec::new();
    for keys in &raw.protected {
        check_profile(keys);
        let Some(bus) = raw.bus_of(keys.interface.as_deref()) else { continue };
        let inputs = found.iter().filter(|input| input.bus == bus && input.message.name == keys.message);
        let inputs: Vec<_> = inputs.collect();
        let Some(first) = inputs.first() else {
            if inputs_whole {
                let there = found.iter().filter(|input| input.bus == bus).map(|input| input.message.name.as_str());
                let mut names: Vec<&str> = there.collect();
                names.sort_unstable();
                names.dedup();
                let hint = did_you_mean(&keys.message, names.iter().copied());
                let names = if names.is_empty() { "there is none".to_owned() } else { names.join(", ") };
                let what = format!("must be a message with a configured signal on this interface ({names}){hint}");
                keys.place.fault("message", what);
            }
            continue;
        };
        if let Some(other) = inputs.iter().find(|input| input.message.id != first.message.id) {
            let what = format!(
                "must be one message, but is {} in {} and {} in {}",
                first.message.id, first.file, other.message.id, other.file
            );
            keys.place.fault("message", &what);
        }
        check_layout(keys, &inputs);
        let guard = guard(keys, first, bus);
        if let Some((_, twin)) = guards.iter().find(|(other, _)| (other.bus, other.id) == (guard.bus, guard.id)) {
            let line = twin.place.line_of("message").beside(keys.place.line_of("message"));
            keys.place.fault("message", format!("must be listed once, but is also in {line}"));
        }
        guards.push((guard, keys));
    }
    let guards: Vec<GuardConfig> = guards.into_iter().map(|(guard, _)| guard).collect();
    check_identity(raw, found, &guards);
    guards
}

/// If the message with the pack identity is not protected, reports a fault, unless `accept_unprotected` is set. A
/// forged identity would set aside all learned values.
fn check_identity(raw: &RawTables, found: &[ResolvedSignal<'_>], guards: &[GuardConfig]) {
    let Some(keys) = raw.pack_identity.as_ref().filter(|keys| !keys.accept_unprotected) else { return };
    let is_protected =
        |input: &ResolvedSignal<'_>| guards.iter().any(|guard| (guard.bus, guard.id) == (input.bus, input.message.id));
    let open = found.iter().find(|input| input.channel == Channel::PackIdentity && !is_protected(input));
    if let Some(input) = open {
        let what = format!(
            "must be in a message of [[input.protected]] if accept_unprotected is not true: forged frames of {} would set aside all learned values",
            input.message.name
        );
        keys.place.fault("signal", &what);
    }
}

fn guard(keys: &ProtectedInput, input: &ResolvedSignal<'_>, bus: BusIndex) -> GuardConfig {
    GuardConfig {
        bus,
        id: input.message.id,
        check: CheckConfig {
            protection: Protection { profile: keys.profile, data_id: keys.data_id },
            max_delta_counter_init: keys.max_delta_counter,
            max_no_new_or_repeated_data: keys.max_repeated,
            sync_counter_init: keys.sync_counter,
        },
        cycle_time_s: input.message.cycle_time_ms.map(|period_ms| f64::from(period_ms) / 1000.0),
    }
}

/// Reports keys that do not fit the profile.
fn check_profile(keys: &ProtectedInput) {
    let profile = keys.profile;
    if keys.data_id > profile.max_data_id() {
        let what = format!("must be 0 to {:#X} with profile \"{}\"", profile.max_data_id(), profile.name());
        keys.place.fault("data_id", &what);
    }
    if keys.max_delta_counter > profile.max_counter() {
        let what = format!("must be 0 to {} with profile \"{}\"", profile.max_counter(), profile.name());
        keys.place.fault("max_delta_counter", &what);
    }
}

/// Checks that the protection header fits into the message, and that no input and no multiplexor of an input overlaps
/// the header.
fn check_layout(keys: &ProtectedInput, inputs: &[&ResolvedSignal<'_>]) {
    let (profile, Some(first)) = (keys.profile, inputs.first()) else { return };
    let (shortest, longest) = (profile.header_bytes(), profile.max_bytes());
    let length = usize::from(first.message.len_bytes);
    if !(shortest..=longest).contains(&length) {
        let what = format!(
            "must have {shortest} to {longest} bytes with profile \"{}\", but has {length} in {}",
            profile.name(),
            first.file
        );
        keys.place.fault("message", &what);
    }
    let mut noted: Vec<&str> = Vec::new();
    for input in inputs {
        for signal in read_with(input.message, input.signal) {
            if signal.layout.touches(profile.header_mask()) && !noted.contains(&signal.name.as_str()) {
                noted.push(&signal.name);
                let what = format!(
                    "must not overlap {}, which profile \"{}\" uses: {}.{} does",
                    header_words(profile.header_mask()),
                    profile.name(),
                    input.message.name,
                    signal.name
                );
                keys.place.fault("profile", format!("inputs {what}"));
            }
        }
    }
}

/// Returns the multiplexors that decide whether a frame contains the signal, then the signal itself.
fn read_with<'m>(message: &'m Message, signal: &'m Signal) -> impl Iterator<Item = &'m Signal> {
    let selectors = signal.conditions.iter().filter_map(|condition| message.signals.get(condition.selector));
    selectors.chain([signal])
}

fn header_words(mask: [u8; 3]) -> &'static str {
    match mask {
        [0xFF, 0x0F, 0] => "byte 0 and the low half of byte 1",
        [0xFF, 0xFF, 0] => "bytes 0 and 1",
        _ => "bytes 0 to 2",
    }
}
