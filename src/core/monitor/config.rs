//! Checked configuration of a [`Monitor`](super::Monitor), and comparisons between two configurations.
//!
//! Each stage keeps its own settings. The monitor keeps the complete configuration only to compare it with a new one.

use crate::alarm::{Rule, RuleConfig, Severity};
use crate::can::CanId;
use crate::can::decode::{Binding, InputMap};
use crate::can::encode::{CommandPlan, LayoutMessage, OutputPlan};
use crate::can::flood::FloodConfig;
use crate::can::guard::GuardConfig;
use crate::can::j1939::{Lamp, Node, NodeConfig, TroubleCode};
use crate::can::poll::PollConfig;
use crate::can::secoc::Authentication;
use crate::can::uds::{self, Answer};
use crate::cell::{CellModel, CellModule, EstimatorConfig, FleetPrior, Label};
use crate::cell_faults::BalancingConfig;
use crate::health::{CapacityMethod, HealthConfig};
use crate::quantity::{BusIndex, CellIndex};
use crate::sample::SampleConfig;

/// Checked settings of all stages.
#[derive(Debug, Clone)]
pub struct MonitorConfig {
    /// Number of interfaces.
    pub interfaces: usize,
    /// Meaning of the input frames.
    pub input: InputMap,
    /// Diagnostic answers that are decoded.
    pub answers: Vec<Answer>,
    /// Diagnostic requests to send; `None` = the daemon sends no requests.
    pub poll: Option<PollConfig>,
    pub supply: Option<SupplyConfig>,
    /// Input messages with end-to-end protection.
    pub guards: Vec<GuardConfig>,
    /// Known cycle times of input messages (s).
    pub cycle_times_s: Vec<(BusIndex, CanId, f64)>,
    /// Number of consecutive readings that must agree before another pack identity counts.
    pub identity_readings: u32,
    /// Limits on the number of frames of one identifier.
    pub flood: FloodConfig,
    /// Duration of silence on all inputs (s) after which the buses count as asleep if no current flows; `None` = never.
    pub asleep_after_s: Option<f64>,
    pub sample: SampleConfig,
    pub model: CellModel,
    /// Modules of cells of another kind, with their own models.
    pub modules: Vec<CellModule>,
    /// Label of the cells, the starting point for learning their model; `None` = the model comes from a model file.
    pub label: Option<Label>,
    /// What other vehicles have learned about cells of this label.
    pub fleet: Option<FleetPrior>,
    /// Whether the BMS discharges fuller cells after a charge (passive balancing).
    pub is_balanced: bool,
    /// Meaning of the balancing bits in `input`; `None` = `input` has no balancing bits.
    pub balancing: Option<BalancingConfig>,
    pub estimator: EstimatorConfig,
    /// Settings of the learning stage, which learns at changes between charge and discharge.
    pub health: HealthConfig,
    pub rules: Vec<RuleConfig>,
    /// Frames to send; `None` = the daemon only listens.
    pub output: Option<OutputConfig>,
    /// Commands accepted from the bus; `None` = no commands are accepted.
    pub commands: Option<CommandConfig>,
    /// The J1939 node; `None` = not configured.
    pub j1939: Option<J1939Config>,
}

/// Supply voltage required before diagnostic requests are sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SupplyConfig {
    /// Minimum voltage (V).
    pub minimum_v: f64,
    /// Age above which a reading is ignored (s).
    pub max_age_s: f64,
}

/// Commands from the bus.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandConfig {
    /// Interface of the command frames.
    pub bus: BusIndex,
    /// Layout of the command frames. The command gate checks authenticated frames; a guard checks protected frames.
    pub plan: CommandPlan,
}

/// Frames that the daemon sends.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputConfig {
    /// Layouts and identifiers.
    pub plan: OutputPlan,
    /// Interfaces on which the frames are sent.
    pub buses: Vec<BusIndex>,
    /// Period of the status frame (s).
    pub status_period_s: f64,
    /// Period of the health frame with all its pages (s).
    pub health_period_s: f64,
    /// Period of the alarm frames (s). Each raised alarm is sent once per period if the limit on the rate of alarm
    /// frames allows it.
    pub alarm_period_s: f64,
    /// Period of the digest with all its pages (s).
    pub digest_period_s: f64,
    /// Whether cyclic frames are sent while the buses sleep. Such frames keep other nodes awake.
    pub while_asleep: bool,
}

/// Configuration of the J1939 node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct J1939Config {
    /// Interface of the node.
    pub bus: BusIndex,
    /// Name and addresses of the node.
    pub node: NodeConfig,
    /// Trouble code of each threshold of each rule.
    pub alarms: Vec<AlarmCode>,
    /// Trouble code that is active while a test runs.
    pub test_code: TroubleCode,
}

/// Trouble code of the alarms of one threshold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AlarmCode {
    pub rule: Rule,
    pub severity: Severity,
    /// The trouble code; its occurrence count is 0.
    pub code: TroubleCode,
    /// The lamp that the trouble code lights.
    pub lamp: Lamp,
}

/// Effects of a new configuration.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Reconfigured {
    /// Names of the changed tables, as written in the configuration file.
    pub changed: Vec<&'static str>,
    /// Number of pending, raised or past alarms that ended because the new configuration has no threshold for them.
    pub alarms_ended: usize,
}

/// A setting that cannot be changed while the program runs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key}: {found}, running with {allowed}: needs a restart")]
pub struct ReconfigureError {
    /// The key or its table.
    pub key: &'static str,
    /// Value in the new configuration.
    pub found: String,
    /// Value in the running configuration.
    pub allowed: String,
}

impl MonitorConfig {
    /// Whether the daemon must receive every frame of an interface. This is necessary if the daemon sends requests on
    /// the interface, because it sends them only while the bus is awake.
    pub fn wants_all(&self, bus: BusIndex) -> bool {
        self.poll.as_ref().is_some_and(|poll| poll.requests.iter().any(|it| it.question.controller.bus == bus))
    }

    /// The configured model of a cell.
    pub fn model_of(&self, cell: CellIndex) -> &CellModel {
        let module = self.modules.iter().find(|module| module.cells.contains(&cell));
        module.map_or(&self.model, |module| &module.model)
    }

    /// Whether a cell is not in a module of another kind.
    pub fn is_own(&self, cell: CellIndex) -> bool {
        !self.modules.iter().any(|module| module.cells.contains(&cell))
    }

    /// Number of cells that are not in a module of another kind.
    pub fn own_cells(&self) -> u32 {
        let in_modules: usize = self.modules.iter().map(|module| module.cells.len()).sum();
        u32::from(self.sample.cells).saturating_sub(u32::try_from(in_modules).unwrap_or(u32::MAX))
    }

    /// Identifiers to receive on an interface, ascending. The identifiers of the daemon's own frames are included,
    /// because another node may also use these identifiers.
    pub fn wanted_ids(&self, bus: BusIndex) -> Vec<CanId> {
        let mut ids = self.listened_ids(bus);
        ids.extend(self.own_ids().filter(|(other, _)| *other == bus).map(|(_, id)| id));
        ids.sort_unstable();
        ids.dedup();
        ids
    }

    /// Identifiers of the frames of `[output]`, each paired with each output interface.
    pub(crate) fn own_ids(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        let of = |output: &OutputConfig| {
            let ids = output.plan.ids();
            output.buses.clone().into_iter().flat_map(move |bus| ids.clone().into_iter().map(move |id| (bus, id)))
        };
        self.output.iter().flat_map(of)
    }

    /// Unprotected input messages, each with the cycle time (s) of its frames if this time is known. For a multiplexed
    /// message, the cycle time counts as unknown, because the stated time may be the period of each page (multiplexer
    /// value).
    pub(crate) fn unprotected(&self) -> impl Iterator<Item = (BusIndex, CanId, Option<f64>)> + '_ {
        let is_protected = |bus, id| self.guards.iter().any(|guard| (guard.bus, guard.id) == (bus, id));
        let cycle_s = |bus, id| self.cycle_times_s.iter().find(|of| (of.0, of.1) == (bus, id)).map(|of| of.2);
        let has_pages = |bus, id| {
            let of_message = |binding: &&Binding| (binding.bus, binding.id) == (bus, id);
            self.input.bindings().iter().filter(of_message).any(|binding| !binding.mux.is_empty())
        };
        let messages = self.input.messages().filter(move |(bus, id, _)| !is_protected(*bus, *id));
        messages.map(move |(bus, id, _)| (bus, id, cycle_s(bus, id).filter(|_| !has_pages(bus, id))))
    }

    /// Identifiers whose frames are decoded on an interface, ascending.
    pub fn listened_ids(&self, bus: BusIndex) -> Vec<CanId> {
        let mut ids = self.input.ids(bus);
        ids.extend(uds::wanted(&self.answers).into_iter().filter(|(other, _)| *other == bus).map(|(_, id)| id));
        ids.extend(self.commands.iter().filter(|commands| commands.bus == bus).map(|commands| commands.plan.id()));
        ids.sort_unstable();
        ids.dedup();
        ids
    }

    /// Patterns of further identifiers (extended, 29 bits) to receive on an interface: identifier and mask.
    pub fn wanted_patterns(&self, bus: BusIndex) -> Vec<(u32, u32)> {
        let node = self.j1939.iter().filter(|j1939| j1939.bus == bus);
        let of_node = node.flat_map(|j1939| Node::new(&j1939.node).wanted());
        of_node.chain(self.input.groups().patterns(bus)).collect()
    }

    /// Authentications of the command frame and of all sent frames.
    pub fn authentications(&self) -> Vec<(LayoutMessage, Authentication)> {
        let sent = self.output.iter().flat_map(|output| output.plan.messages());
        let sent = sent.filter_map(|sent| Some((sent.message, sent.secoc?)));
        let command = self.commands.as_ref().and_then(|commands| commands.plan.authentication());
        command.map(|secoc| (LayoutMessage::Command, secoc)).into_iter().chain(sent).collect()
    }

    pub(crate) fn check_fits(&self, new: &Self) -> Result<(), ReconfigureError> {
        let (old_sample, new_sample) = (&self.sample, &new.sample);
        let counts = [
            ("[[interface]]", new.interfaces, self.interfaces),
            ("pack.cells", usize::from(new_sample.cells), usize::from(old_sample.cells)),
            ("pack.strings", usize::from(new_sample.strings), usize::from(old_sample.strings)),
            ("pack.cell_model: branches", new.model.branches.len(), self.model.branches.len()),
        ];
        if let Some((key, found, allowed)) = counts.into_iter().find(|(_, found, allowed)| found != allowed) {
            return Err(ReconfigureError { key, found: found.to_string(), allowed: allowed.to_string() });
        }
        // The rated capacity may change: it scales published values and sets some limits, but the learned values stay
        // valid.
        let same_model = CellModel { rated_capacity_ah: self.model.rated_capacity_ah, ..new.model.clone() };
        let reported = |sample: &SampleConfig| (sample.reported_soc.is_some(), sample.reported_soh.is_some());
        let is_nominal = |config: &Self| matches!(config.health.capacity.method, CapacityMethod::Nominal { .. });
        let buses = || (0..=u8::MAX).map(BusIndex).take(self.interfaces);
        let modules = self.modules.iter().zip(&new.modules);
        let same_modules = self.modules.len() == new.modules.len()
            && modules
                .map(|(old, new)| (&old.cells, &old.model, &new.cells, &new.model))
                .all(|(cells, model, new_cells, new_model)| cells == new_cells && model == new_model);
        let same = [
            ("[input.cell_voltage] or [input.pack_voltage]", old_sample.voltage_source == new_sample.voltage_source),
            ("[[input.temperature]]", old_sample.sensor_of_cell == new_sample.sensor_of_cell),
            ("[input.reported_soc] and [input.reported_soh]", reported(old_sample) == reported(new_sample)),
            ("[input.contactor]", old_sample.contactor.is_some() == new_sample.contactor.is_some()),
            ("input.current.sign", old_sample.direction.is_some() == new_sample.direction.is_some()),
            ("[input]", self.input == new.input && self.answers == new.answers),
            ("[commands]", buses().all(|bus| self.listened_ids(bus) == new.listened_ids(bus))),
            ("[commands] and [output]: secoc", self.authentications() == new.authentications()),
            ("[poll]", self.poll == new.poll && self.supply == new.supply),
            ("[j1939]", buses().all(|bus| self.wanted_patterns(bus) == new.wanted_patterns(bus))),
            ("pack.cell_model", self.model == same_model),
            ("[[pack.module]]", same_modules),
            ("pack.learn_model", self.label.is_some() == new.label.is_some()),
            ("estimator.capacity_state", self.estimator.capacity_state == new.estimator.capacity_state),
            ("capacity.method", is_nominal(self) == is_nominal(new)),
        ];
        match same.into_iter().find(|(_, same)| !same) {
            None => Ok(()),
            Some((key, _)) => Err(ReconfigureError {
                key,
                found: "changed frames, signals or tables".to_owned(),
                allowed: "the original ones".to_owned(),
            }),
        }
    }

    /// Whether all settings that affect estimates are equal in `self` and `new`.
    pub(crate) fn estimates_as(&self, new: &Self) -> bool {
        self.model == new.model
            && self.modules == new.modules
            && self.estimator == new.estimator
            && self.health.usable == new.health.usable
            && self.sample.ambient_c == new.sample.ambient_c
    }

    pub(crate) fn changed_tables(&self, new: &Self) -> Vec<&'static str> {
        let (old_sample, new_sample) = (&self.sample, &new.sample);
        let limits = |sample: &SampleConfig| {
            (sample.current, sample.voltage, sample.temperature, sample.reported_soc, sample.reported_soh)
        };
        let capacity = |config: &Self| (config.health.capacity, config.health.end_of_life_ah);
        let same = [
            (
                "[pack]",
                self.model == new.model
                    && self.fleet == new.fleet
                    && self.is_balanced == new.is_balanced
                    && old_sample.ambient_c == new_sample.ambient_c,
            ),
            (
                "[input]",
                self.flood == new.flood
                    && self.guards == new.guards
                    && self.cycle_times_s == new.cycle_times_s
                    && self.asleep_after_s == new.asleep_after_s
                    && self.balancing == new.balancing
                    && old_sample.contactor == new_sample.contactor,
            ),
            ("[limits]", limits(old_sample) == limits(new_sample)),
            ("[estimator]", self.estimator == new.estimator),
            ("[transition]", self.health.transition == new.health.transition),
            ("[capacity]", capacity(self) == capacity(new)),
            ("[recharge]", self.health.recharge == new.health.recharge),
            ("[usable]", self.health.usable == new.health.usable),
            ("[outlook]", self.health.outlook == new.health.outlook),
            ("[[alarm]]", self.rules == new.rules),
            ("[output]", self.output == new.output),
            ("[commands]", self.commands == new.commands),
            ("[j1939]", self.j1939 == new.j1939),
        ];
        same.into_iter().filter(|(_, same)| !same).map(|(table, _)| table).collect()
    }
}
