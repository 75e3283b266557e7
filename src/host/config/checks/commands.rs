//! Turns `[commands]` into the plan that decodes commands from the bus, and the guard that checks these commands.

use super::signals::{ResolvedSignal, check_no_input};
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::CheckConfig;
use crate::can::encode::CommandPlan;
use crate::can::guard::GuardConfig;
use crate::config::schema::RawTables;
use crate::config::schema::keys::Output;
use crate::monitor::{CommandConfig, OutputConfig};

/// Returns the plan that decodes commands. If the commands have a checksum and a counter instead of an authenticator,
/// also returns the guard that checks them. If commands are disabled or a fault was reported, returns `None`.
pub(crate) fn commands(
    raw: &RawTables,
    found: &[ResolvedSignal<'_>],
    output: Option<&(OutputConfig, Database)>,
) -> Option<(CommandConfig, Option<GuardConfig>)> {
    let keys = raw.commands.as_ref().filter(|commands| commands.enabled)?;
    if !raw.is_written::<Output>() || raw.is_output_disabled() {
        keys.place.fault("enabled", "requires an enabled table [output]: every command is answered with a reply frame");
    }
    let bus = raw.one_bus(keys.interface.as_deref(), &keys.place)?;
    let (output, database) = output?;
    let note = |error: &String| keys.place.fault("enabled", error);
    let plan = CommandPlan::new(database).map_err(|all| all.0.iter().for_each(note)).ok()?;
    let secoc = plan.authentication();
    let Some(data_id) = secoc.map(|secoc| secoc.data_id).or(plan.protection().map(|protection| protection.data_id))
    else {
        let what = "must be \"1A\", \"1C\" or \"5\" if secoc is not given: unprotected commands are not accepted";
        keys.place.fault("e2e", what);
        return None;
    };
    if secoc.is_some() && plan.protection().is_some() {
        keys.place
            .fault("e2e", "must not be given together with secoc, which detects everything that a checksum detects");
    }
    if secoc.is_some() && output.plan.freshness().is_none() {
        keys.place.fault("secoc", "requires the message PACKWATCH_Freshness in output.dbc");
    }
    let id = plan.id();
    if output.buses.contains(&bus) && output.plan.ids().contains(&id) {
        keys.place.fault("id", format!("must not be the identifier of a sent frame, {id}"));
    }
    check_no_input(&keys.place, id, &[bus], found);
    if output.plan.messages().any(|sent| sent.data_id() == Some(data_id)) {
        keys.place.fault("data_id", "must differ from the data ids of the sent frames");
    }
    let is_fd = database.messages.iter().any(|m| m.id == plan.id() && m.format != FrameFormat::Classic);
    if is_fd {
        raw.check_fd(&keys.place, &[bus]);
    }
    let Some(protection) = plan.protection().filter(|_| secoc.is_none()) else {
        return Some((CommandConfig { bus, plan }, None));
    };
    let check = CheckConfig { max_delta_counter_init: keys.max_delta_counter, ..CheckConfig::new(protection) };
    let guard = GuardConfig { bus, id: plan.id(), check, cycle_time_s: None };
    Some((CommandConfig { bus, plan }, Some(guard)))
}
