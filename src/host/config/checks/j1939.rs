//! Builds the settings of the J1939 node from `[j1939]` and `[[alarm]]`: its NAME, and the trouble code of each alarm.
//!
//! The node's identifiers must differ from the identifiers of inputs and of `[output]`, and no two rules may share a
//! code.

use super::signals::ResolvedSignal;
use crate::alarm::{Direction, Rule, Severity};
use crate::can::j1939::{Lamp, MAX_ADDRESS, Name, NameFields, NodeConfig, TroubleCode};
use crate::config::schema::RawTables;
use crate::config::schema::keys::{Alarm, J1939};
use crate::monitor::{AlarmCode, J1939Config, OutputConfig};
use crate::quantity::BusIndex;

/// The node; `None` = not configured, disabled, or faults reported.
pub(crate) fn node(
    raw: &RawTables,
    found: &[ResolvedSignal<'_>],
    output: Option<&OutputConfig>,
) -> Option<J1939Config> {
    let Some(keys) = &raw.j1939 else {
        if !raw.broken && !raw.is_written::<J1939>() {
            for alarm in raw.alarms.iter().filter(|alarm| alarm.spn.is_some() || alarm.fmi.is_some()) {
                let key = if alarm.spn.is_some() { "spn" } else { "fmi" };
                alarm.place.fault(key, "requires a table [j1939]; without it nothing is sent on J1939");
            }
        }
        return None;
    };
    let alarms = codes(&raw.alarms);
    let bus = raw.one_bus(keys.interface.as_deref(), &keys.place);
    let node = NodeConfig { name: name(keys)?, address: address(keys)? };
    check_ids(keys, &node, bus?, output, found);
    // FMI 31 means "condition exists".
    let test_code = TroubleCode::new(keys.test_spn, 31, 0);
    let test_code = test_code.map_err(|error| keys.place.fault("test_spn", error)).ok()?;
    Some(J1939Config { bus: bus?, node, alarms: alarms?, test_code }).filter(|_| !raw.is_output_disabled())
}

fn address(keys: &J1939) -> Option<u8> {
    if keys.address > MAX_ADDRESS {
        keys.place.fault("address", format!("must be 0 to {MAX_ADDRESS}"));
        return None;
    }
    Some(keys.address)
}

fn name(keys: &J1939) -> Option<Name> {
    let fields = NameFields {
        arbitrary_address_capable: false,
        industry_group: keys.industry_group,
        vehicle_system_instance: keys.vehicle_system_instance,
        vehicle_system: keys.vehicle_system,
        function: keys.function,
        function_instance: keys.function_instance,
        ecu_instance: keys.ecu_instance,
        manufacturer_code: keys.manufacturer_code,
        identity_number: keys.identity_number,
    };
    Name::new(&fields).map_err(|error| keys.place.fault(error.field, error)).ok()
}

/// Returns the trouble code of every threshold; `None` = a code is faulty, or two rules share it (reported).
fn codes(alarms: &[Alarm]) -> Option<Vec<AlarmCode>> {
    let mut codes: Vec<(&Alarm, AlarmCode)> = Vec::new();
    let mut is_good = true;
    for alarm in alarms {
        for (key, severity, _) in alarm.thresholds() {
            let Some(own) = code(alarm, severity) else {
                is_good = false;
                continue;
            };
            let same = |(other, of): &&(&Alarm, AlarmCode)| other.rule != alarm.rule && of.code == own.code;
            if let Some((twin, _)) = codes.iter().find(same) {
                let line = twin.place.at.beside(alarm.place.line_of("spn"));
                let (path, fmi) = (&twin.place.path, own.code.fmi());
                let what =
                    format!("must be unique per rule, but {path} in {line} has the same code with FMI {fmi} ({key})");
                alarm.place.fault("spn", &what);
                is_good = false;
            }
            codes.push((alarm, own));
        }
    }
    is_good.then(|| codes.into_iter().map(|(_, code)| code).collect())
}

fn code(alarm: &Alarm, severity: Severity) -> Option<AlarmCode> {
    // `rule as u8` is the rule's number in alarm frames. The default SPN is 520192 plus this number. Unverified (from
    // memory of J1939-73): 520192 is the first number that manufacturers may assign.
    let spn = alarm.spn.unwrap_or(520_192 + u32::from(alarm.rule as u8));
    let fmi = alarm.fmi.unwrap_or_else(|| failure_mode(alarm.rule, severity));
    match TroubleCode::new(spn, fmi, 0) {
        Ok(code) => Some(AlarmCode { rule: alarm.rule, severity, code, lamp: lamp(severity) }),
        Err(error) => {
            alarm.place.fault("spn", error);
            None
        }
    }
}

/// The default failure mode identifier of an alarm, from J1939-73, appendix A.
fn failure_mode(rule: Rule, severity: Severity) -> u8 {
    match rule {
        // FMI 9: abnormal update rate. FMI 19: received network data in error. FMI 2: data erratic, intermittent or
        // incorrect. FMI 31: condition exists.
        Rule::InputMissing => 9,
        Rule::BusFault => 19,
        Rule::InputImplausible | Rule::BmsDisagrees | Rule::ChannelFaulty => 2,
        Rule::EstimateUntrusted | Rule::StoreFailed | Rule::ThermalEvent => 31,
        Rule::CapacityLow
        | Rule::UsableCapacityLow
        | Rule::RechargePeriodLow
        | Rule::ResistanceHigh
        | Rule::SocLow
        | Rule::TemperatureHigh
        | Rule::CellImbalance
        | Rule::RemainingLifeLow
        | Rule::CellLeak
        | Rule::ConnectionResistance => match (rule.spec().direction, severity) {
            // These FMIs mean that the data are valid but outside the normal range: least severe, moderately severe,
            // most severe.
            (Direction::Below, Severity::Info) => 17,
            (Direction::Below, Severity::Warning) => 18,
            (Direction::Below, Severity::Severe) => 1,
            (Direction::Above, Severity::Info) => 15,
            (Direction::Above, Severity::Warning) => 16,
            (Direction::Above, Severity::Severe) => 0,
        },
    }
}

/// The lamp of a severity. The malfunction lamp is not used because that lamp concerns emissions.
fn lamp(severity: Severity) -> Lamp {
    match severity {
        Severity::Info => Lamp::Protect,
        Severity::Warning => Lamp::Amber,
        Severity::Severe => Lamp::Red,
    }
}

/// Reports node identifiers that an input or a frame of `[output]` uses on the node's interface.
fn check_ids(
    keys: &J1939,
    node: &NodeConfig,
    bus: BusIndex,
    output: Option<&OutputConfig>,
    found: &[ResolvedSignal<'_>],
) {
    let sent = node.sent_ids();
    if let Some(input) = found.iter().find(|f| f.bus == bus && sent.contains(&f.message.id)) {
        let (name, id) = (&input.message.name, input.message.id);
        keys.place.fault("address", format!("must not be the source address of an input, but {name} has {id}"));
    }
    let output = output.filter(|output| output.buses.contains(&bus));
    if let Some(id) = output.and_then(|output| output.plan.ids().into_iter().find(|id| sent.contains(id))) {
        keys.place.fault("address", format!("must not be the source address of a frame of [output], {id}"));
    }
}
