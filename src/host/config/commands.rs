//! Commands from the bus: `[commands]` to the plan that reads them and the guard that checks them.

use super::convert::Raw;
use super::document::Faults;
use super::keys::Commands;
use super::resolve::{Resolved, bus_of};
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::CheckConfig;
use crate::can::encode::CommandPlan;
use crate::can::guard::GuardConfig;
use crate::monitor::{CommandConfig, OutputConfig};

/// What reads commands, and what checks them; `None` = none are obeyed, or faults are noted.
pub(super) fn commands(
    raw: &Raw,
    output: Option<&(OutputConfig, Database)>,
    found: &[Resolved<'_>],
    faults: &mut Faults,
) -> Option<(CommandConfig, GuardConfig)> {
    let keys = raw.commands.as_ref().filter(|commands| commands.enabled)?;
    if !raw.output_written || raw.output.as_ref().is_some_and(|output| !output.enabled) {
        keys.place.fault(
            faults,
            "enabled",
            "must have a table [output] that is enabled: what became of a command is sent",
        );
    }
    let bus = bus_of(raw, keys.interface.as_deref())?;
    let (output, database) = output?;
    let note = |error: &String, faults: &mut Faults| keys.place.fault(faults, "enabled", error);
    let plan = CommandPlan::new(database).map_err(|all| all.0.iter().for_each(|e| note(e, faults))).ok()?;
    let Some(protection) = plan.protection() else {
        keys.place.fault(faults, "e2e", "must be \"1A\", \"1C\" or \"5\": commands are never taken unprotected");
        return None;
    };
    check_id(keys, &plan, bus, output, found, faults);
    if output.plan.protections().iter().flatten().any(|other| other.data_id == protection.data_id) {
        keys.place.fault(faults, "data_id", "must differ from those of the frames that are sent");
    }
    let is_fd = database.messages.iter().any(|m| m.id == plan.id() && m.format != FrameFormat::Classic);
    if let Some(interface) = raw.interfaces.get(bus.index()).filter(|interface| is_fd && !interface.fd) {
        keys.place.fault(faults, "fd", &format!("must have fd = true on interface {} too", interface.name));
    }
    let check = CheckConfig {
        max_delta_counter_init: u8::try_from(keys.max_delta_counter).unwrap_or(u8::MAX),
        ..CheckConfig::new(protection)
    };
    let guard = GuardConfig { bus, id: plan.id(), check, cycle_time_s: None };
    Some((CommandConfig { bus, plan }, guard))
}

/// The identifier is nobody else's on its interface.
fn check_id(
    keys: &Commands,
    plan: &CommandPlan,
    bus: crate::quantity::BusIndex,
    output: &OutputConfig,
    found: &[Resolved<'_>],
    faults: &mut Faults,
) {
    let id = plan.id();
    if output.buses.contains(&bus) && output.plan.ids().contains(&id) {
        keys.place.fault(faults, "id", &format!("must not be that of a frame that is sent, {id}"));
    }
    if let Some(input) = found.iter().find(|input| input.bus == bus && input.message.id == id) {
        let what = format!("must not be the identifier of an input, {} has {id}", input.message.name);
        keys.place.fault(faults, "id", &what);
    }
}
