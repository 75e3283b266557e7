//! Describes for `packwatch check` which frames are received, checked, requested and sent.

use serde::Serialize;

use crate::can::dbc::FrameFormat;
use crate::can::e2e::Protection;
use crate::can::j1939::Lamp;
use crate::can::poll::{FOREIGN_SILENCE_NS, PollRequest};
use crate::can::secoc::Authentication;
use crate::can::uds::Controller;
use crate::config::checks::ResolvedSignal;
use crate::config::result::Config;
use crate::monitor::{AlarmCode, SupplyConfig};

/// A frame that is sent.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OutputUse {
    /// Name of the frame: `status`, `health`, `alarm`, `digest`, `reply` or `freshness`.
    pub frame: &'static str,
    /// Identifier in candump notation.
    pub id: String,
    /// Interfaces on which the frame is sent.
    pub interfaces: Vec<String>,
    /// Period, ms; `None` = the frame is sent only on events.
    pub period_ms: Option<f64>,
    /// Kind of the frame: `classic`, `FD` or `FD with bit rate switch`.
    pub kind: &'static str,
    /// End-to-end protection: `profile 1A, data id 0x123`, or `none`.
    pub protection: String,
    /// Authentication: `SecOC fd, data id 0x123`, or `none`.
    pub authentication: String,
}

fn authentication_words(Authentication { profile, data_id }: Authentication) -> String {
    format!("SecOC {}, data id {data_id:#X}", profile.name())
}

pub(crate) fn outputs(config: &Config) -> Vec<OutputUse> {
    let Some(output) = &config.monitor.output else { return Vec::new() };
    let names: Vec<String> = output.buses.iter().map(|bus| config.interface_name(*bus).to_owned()).collect();
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
        authentication: sent.secoc.map_or("none".to_owned(), authentication_words),
    });
    used.collect()
}
/// How commands of other ECUs are checked.
pub fn command_words(config: &Config) -> String {
    let Some(commands) = &config.monitor.commands else { return "commands of other ECUs are not executed".to_owned() };
    match (commands.plan.authentication(), &config.key) {
        (Some(secoc), Some(key)) => {
            format!("commands of other ECUs are authenticated, {}, key in {key}", authentication_words(secoc))
        }
        _ => "commands of other ECUs are unauthenticated: every node on the bus can send them".to_owned(),
    }
}

pub(crate) fn intake(config: &Config, found: &[ResolvedSignal<'_>]) -> Vec<String> {
    let monitor = &config.monitor;
    let rate = monitor.flood.max_frames_per_s;
    let mut words = vec![format!("at most {rate} frames a second of one identifier, a tenth of them at once")];
    if monitor.guards.is_empty() {
        words.push(
            "no end-to-end protection: a damaged, repeated or old frame cannot be distinguished from a good one"
                .to_owned(),
        );
    }
    words.push(command_words(config));
    for guard in &monitor.guards {
        let input = found.iter().find(|input| (input.bus, input.message.id) == (guard.bus, guard.id));
        let name = input.map_or("unauthenticated commands", |input| input.message.name.as_str());
        let interface = config.interface_name(guard.bus);
        let Protection { profile, data_id } = guard.check.protection;
        let missed = match guard.cycle_time_s {
            Some(period_s) => format!("a missing frame is counted every {} ms", period_s * 1000.0),
            None => "missing frames are not counted, because the DBC has no cycle time".to_owned(),
        };
        words.push(format!(
            "{name} ({} on {interface}): end-to-end protected, profile {}, data id {data_id:#06X}, allowed lost frames in a row: {}, {missed}",
            guard.id,
            profile.name(),
            guard.check.max_delta_counter_init,
        ));
    }
    words
}
pub(crate) fn polling(config: &Config) -> Vec<String> {
    let Some(poll) = &config.monitor.poll else { return Vec::new() };
    let mut words: Vec<String> = poll.requests.iter().map(|request| request_words(config, request)).collect();
    words.push(format!(
        "at most {} requests a second, one at a time; nothing else can be sent to a controller",
        poll.max_requests_per_s
    ));
    let low_supply = |supply: SupplyConfig| format!(", while the supply is below {} V or not known", supply.minimum_v);
    words.push(format!(
        "silent for {} s after another tester's request, while the bus sleeps{}, and on standby",
        FOREIGN_SILENCE_NS / 1_000_000_000,
        config.monitor.supply.map(low_supply).unwrap_or_default()
    ));
    if config.monitor.supply.is_none() {
        words.push("the vehicle's supply voltage is not monitored ([input.supply_voltage])".to_owned());
    }
    words
}

/// Describes a request: `can0: asks 7E4 for 22 01 01 every 1 s while driving, every 5 s while charging`.
fn request_words(config: &Config, request: &PollRequest) -> String {
    let Controller { bus, request: id, .. } = request.question.controller;
    let interface = config.interface_name(bus);
    let bytes: Vec<String> = request.question.request().iter().map(|byte| format!("{byte:02X}")).collect();
    let states = ["while driving", "while charging", "while parked and awake"];
    let period = |(every_s, state): (&Option<f64>, _)| every_s.map(|every_s| format!("every {every_s} s {state}"));
    let periods: Vec<String> = request.every_s.iter().zip(states).filter_map(period).collect();
    format!("{interface}: asks {id} for {} {}", bytes.join(" "), periods.join(", "))
}

/// Describes the J1939 node and its codes.
pub(crate) fn j1939(config: &Config) -> Vec<String> {
    let Some(j1939) = &config.monitor.j1939 else { return Vec::new() };
    let interface = config.interface_name(j1939.bus);
    let [dm1, dm2, ..] = j1939.node.sent_ids();
    let node = format!(
        "address {} ({0:02X}) on {interface}, NAME {}; DM1 {dm1} every second and on change, DM2 {dm2} on request",
        j1939.node.address, j1939.node.name
    );
    let alarms = j1939.alarms.iter().map(|AlarmCode { rule, severity, code, lamp }| {
        let lamp = match lamp {
            Lamp::None => "no lamp",
            Lamp::Protect => "protect lamp",
            Lamp::Amber => "amber lamp",
            Lamp::Red => "red lamp",
        };
        format!("{} {}: SPN {}, FMI {}, {lamp}", rule.name(), severity.name(), code.spn(), code.fmi())
    });
    std::iter::once(node).chain(alarms).collect()
}
