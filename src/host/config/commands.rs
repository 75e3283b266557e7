//! Commands from the bus: `[commands]` to the plan that reads them and the guard that checks them.

use super::document::Faults;
use super::keys::Output;
use super::resolve::{Checks, check_no_input};
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::CheckConfig;
use crate::can::encode::CommandPlan;
use crate::can::guard::GuardConfig;
use crate::monitor::{CommandConfig, OutputConfig};

/// The plan that reads commands and the guard that checks them; `None` = commands are off, or faults are noted.
pub(super) fn commands(
    checks: &mut Checks<'_>,
    output: Option<&(OutputConfig, Database)>,
) -> Option<(CommandConfig, GuardConfig)> {
    let raw = checks.raw;
    let keys = raw.commands.as_ref().filter(|commands| commands.enabled)?;
    if !raw.is_written::<Output>() || raw.is_output_disabled() {
        keys.place.fault(
            checks.faults,
            "enabled",
            "must have a table [output] that is enabled: the outcome of a command is sent",
        );
    }
    let bus = raw.bus_of(keys.interface.as_deref())?;
    let (output, database) = output?;
    let note = |error: &String, faults: &mut Faults| keys.place.fault(faults, "enabled", error);
    let plan = CommandPlan::new(database).map_err(|all| all.0.iter().for_each(|e| note(e, checks.faults))).ok()?;
    let Some(protection) = plan.protection() else {
        keys.place.fault(checks.faults, "e2e", "must be \"1A\", \"1C\" or \"5\": commands are never taken unprotected");
        return None;
    };
    let id = plan.id();
    if output.buses.contains(&bus) && output.plan.ids().contains(&id) {
        keys.place.fault(checks.faults, "id", &format!("must not be that of a frame that is sent, {id}"));
    }
    check_no_input(&keys.place, id, &[bus], checks);
    if output.plan.messages().filter_map(|sent| sent.protection).any(|other| other.data_id == protection.data_id) {
        keys.place.fault(checks.faults, "data_id", "must differ from those of the frames that are sent");
    }
    let is_fd = database.messages.iter().any(|m| m.id == plan.id() && m.format != FrameFormat::Classic);
    if is_fd {
        raw.check_fd(&keys.place, &[bus], checks.faults);
    }
    let check = CheckConfig { max_delta_counter_init: keys.max_delta_counter, ..CheckConfig::new(protection) };
    let guard = GuardConfig { bus, id: plan.id(), check, cycle_time_s: None };
    Some((CommandConfig { bus, plan }, guard))
}
