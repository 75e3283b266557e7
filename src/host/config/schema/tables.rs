//! Lists the tables of a configuration file, one line per table, and looks up their keys.

use super::keys::{
    Alarm, AnswerSignalKeys, Authentication, BalancingInput, Capacity, CellVoltageInput, Commands, ContactorInput,
    CurrentInput, CurrentLimits, CurrentSign, DiagnosticInput, Estimator, Input, Interface, J1939, Outlook, Output,
    OutputAlarm, OutputDigest, OutputFreshness, OutputHealth, OutputReply, OutputStatus, Pack, PackIdentityInput,
    PackModule, PackVoltageInput, Poll, ProtectedInput, Recharge, ReportedSocInput, ReportedSohInput, SignalSource,
    Store, SupplyVoltageInput, TemperatureInput, TemperatureLimits, Transition, Usable, Vehicle, VoltageLimits,
};
use super::section::tables;
use crate::cell::CellModel;
use crate::config::document::TablePlace;
use crate::quantity::{BusIndex, CellIndex, Channel, SensorIndex};

tables! {
    /// The tables of a file; `None` = the table is absent or faulty (the fault is reported).
    RawTables, SECTIONS {
        vehicle: one Vehicle,
        pack: one Pack,
        modules: many PackModule,
        interfaces: many Interface,
        input: one Input,
        diagnostics: many DiagnosticInput with AnswerSignalKeys,
        current: one CurrentInput,
        current_sign: optional CurrentSign,
        contactor: optional ContactorInput,
        cell_voltage: optional CellVoltageInput,
        balancing: optional BalancingInput,
        pack_voltage: optional PackVoltageInput,
        temperatures: many TemperatureInput,
        reported_soc: optional ReportedSocInput,
        reported_soh: optional ReportedSohInput,
        supply_voltage: optional SupplyVoltageInput,
        pack_identity: optional PackIdentityInput,
        protected: many ProtectedInput,
        current_limits: one CurrentLimits,
        voltage_limits: one VoltageLimits,
        temperature_limits: one TemperatureLimits,
        estimator: one Estimator,
        transition: one Transition,
        capacity: one Capacity,
        recharge: one Recharge,
        usable: optional Usable,
        outlook: one Outlook,
        alarms: many Alarm,
        j1939: optional J1939,
        poll: one Poll,
        output: optional Output,
        output_status: one OutputStatus,
        output_health: one OutputHealth,
        output_alarm: one OutputAlarm,
        output_digest: one OutputDigest,
        output_reply: one OutputReply,
        output_freshness: one OutputFreshness,
        commands: one Commands,
        authentication: one Authentication,
        store: one Store,
    }
}

impl RawTables {
    /// Whether `interfaces` contains every `[[interface]]` of the file. If not, interface names cannot be checked.
    pub(crate) fn has_all_interfaces(&self) -> bool {
        !self.broken && self.interfaces.len() == self.count::<Interface>()
    }

    /// Reports `text` at the table `place`, or at line 1 of the file if `place` is `None`.
    pub(crate) fn note(&self, place: Option<&TablePlace>, text: &str) {
        match place {
            Some(place) => self.faults.add_at(&place.at, text),
            None => self.faults.add(&self.file, 1, text),
        }
    }

    /// Rated capacity of one cell that is not in a `[[pack.module]]` (Ah): from `[pack]`, else from the cell model.
    pub(crate) fn rated_ah(&self, model: Option<&CellModel>) -> Option<f64> {
        let configured = self.pack.as_ref().and_then(|pack| pack.rated_capacity_ah);
        configured.or(model.map(|model| model.rated_capacity_ah))
    }

    /// Whether the pack's total voltage is configured, so that the pack is estimated as one cell.
    pub(crate) fn is_pack_total(&self) -> bool {
        self.is_written::<PackVoltageInput>()
    }

    pub(crate) fn is_output_disabled(&self) -> bool {
        self.output.as_ref().is_some_and(|output| !output.enabled)
    }

    /// The interface with this name, or the first interface if no name is given. If there is no such interface, returns
    /// `None`; another check reports this fault.
    pub(crate) fn bus_of(&self, interface: Option<&str>) -> Option<BusIndex> {
        let index = match interface {
            Some(name) => self.interfaces.iter().position(|interface| interface.name == name)?,
            None => 0,
        };
        u8::try_from(index).ok().map(BusIndex)
    }

    /// Returns the interface of a table that uses exactly one interface. If the name is unknown, or if no name is given
    /// although there are several interfaces, reports a fault and returns `None`. This fault is not reported if an
    /// `[[interface]]` is faulty or if there is no interface, because another check reports that.
    pub(crate) fn one_bus(&self, interface: Option<&str>, place: &TablePlace) -> Option<BusIndex> {
        let is_clear = interface.is_some() || self.distinct_interfaces().len() <= 1;
        let bus = self.bus_of(interface).filter(|_| is_clear);
        if bus.is_none() && self.has_all_interfaces() && !self.interfaces.is_empty() {
            place.fault("interface", format!("must be {}", self.interface_names()));
        }
        bus
    }

    /// Names of the interfaces, joined by "or" for fault messages.
    pub(crate) fn interface_names(&self) -> String {
        self.distinct_interfaces().join(" or ")
    }

    /// Names of the interfaces, each once. Another check reports duplicate names.
    fn distinct_interfaces(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for interface in &self.interfaces {
            if !names.contains(&interface.name.as_str()) {
                names.push(&interface.name);
            }
        }
        names
    }

    /// Reports a fault at the key `fd` of a frame's table for each of `buses` on which `fd = true` is not set.
    pub(crate) fn check_fd(&self, place: &TablePlace, buses: &[BusIndex]) {
        let interfaces = buses.iter().filter_map(|bus| self.interfaces.get(bus.index()));
        for interface in interfaces.filter(|interface| !interface.fd) {
            place.fault("fd", format!("requires fd = true on interface {}", interface.name));
        }
    }

    pub(crate) fn source(&self, channel: Channel) -> Option<SignalSource<'_>> {
        match channel {
            Channel::Current => self.current.as_ref().map(|keys| keys.config()),
            Channel::Temperature(sensor) => self.temperatures.get(usize::from(sensor.0)).map(|keys| keys.config()),
            Channel::PackVoltage => self.pack_voltage.as_ref().map(|keys| keys.config()),
            Channel::CellVoltage(_) => self.cell_voltage.as_ref().map(|keys| keys.config()),
            Channel::Balancing(_) => self.balancing.as_ref().map(|keys| keys.config()),
            Channel::ReportedSoc => self.reported_soc.as_ref().map(|keys| keys.config()),
            Channel::ReportedSoh => self.reported_soh.as_ref().map(|keys| keys.config()),
            Channel::SupplyVoltage => self.supply_voltage.as_ref().map(|keys| keys.config()),
            Channel::PackIdentity => self.pack_identity.as_ref().map(|keys| keys.config()),
            Channel::CurrentDirection => self.current_sign.as_ref().map(|keys| keys.config()),
            Channel::Contactor => self.contactor.as_ref().map(|keys| keys.config()),
        }
    }

    /// All configured signals. `[input.cell_voltage]` and `[input.balancing]` appear once, as channels of the first
    /// cell.
    pub(crate) fn sources(&self) -> impl Iterator<Item = (Channel, SignalSource<'_>)> {
        let sensors = (0..).take(self.temperatures.len()).map(|index| Channel::Temperature(SensorIndex(index)));
        let others = [
            Channel::PackVoltage,
            Channel::ReportedSoc,
            Channel::ReportedSoh,
            Channel::SupplyVoltage,
            Channel::PackIdentity,
            Channel::CurrentDirection,
            Channel::Contactor,
            Channel::CellVoltage(CellIndex(0)),
            Channel::Balancing(CellIndex(0)),
        ];
        let channels = [Channel::Current].into_iter().chain(sensors).chain(others);
        channels.filter_map(|channel| Some((channel, self.source(channel)?)))
    }
}
