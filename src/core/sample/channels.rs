//! Lists the channels in use. For each channel, selects the configured [`Limits`] and the clock that decides whether
//! the reading is stuck.

use super::charge::ChargeTotals;
use super::config::{Limits, SampleConfig, VoltageSource};
use crate::quantity::{CellIndex, Channel, SensorIndex};

pub(super) fn limits(config: &SampleConfig, channel: Channel) -> &Limits {
    match channel {
        Channel::Current => &config.current,
        Channel::Temperature(_) => &config.temperature,
        Channel::PackVoltage
        | Channel::CellVoltage(_)
        | Channel::SupplyVoltage
        | Channel::Balancing(_)
        | Channel::PackIdentity => &config.voltage,
        Channel::CurrentDirection => config.direction.as_ref().unwrap_or(&config.current),
        Channel::Contactor => config.contactor.as_ref().map_or(&config.voltage, |contactor| &contactor.limits),
        Channel::ReportedSoc => config.reported_soc.as_ref().unwrap_or(&config.voltage),
        Channel::ReportedSoh => config.reported_soh.as_ref().unwrap_or(&config.voltage),
    }
}

/// Every channel in use, in the order of the signals.
pub(super) fn channels(config: &SampleConfig, sensors: usize) -> Vec<Channel> {
    let narrow = |index: usize| u16::try_from(index).unwrap_or(u16::MAX);
    let mut channels = vec![Channel::Current];
    channels.extend((0..sensors).map(|sensor| Channel::Temperature(SensorIndex(narrow(sensor)))));
    match config.voltage_source {
        VoltageSource::Cells => channels.extend((0..config.cells).map(|cell| Channel::CellVoltage(CellIndex(cell)))),
        VoltageSource::PackTotal { .. } => channels.push(Channel::PackVoltage),
    }
    channels.extend(config.reported_soc.map(|_| Channel::ReportedSoc));
    channels.extend(config.reported_soh.map(|_| Channel::ReportedSoh));
    channels.extend(config.direction.map(|_| Channel::CurrentDirection));
    channels.extend(config.contactor.as_ref().map(|_| Channel::Contactor));
    channels
}

/// Cumulative time (s) in which the signal should have changed. If the reading stays the same for too long by this
/// clock, it is stuck. For a voltage, only discharge counts, because a charger may hold the voltage constant.
/// Temperature and current should change whenever current flows.
pub(super) fn should_move_s(channel: Channel, totals: &ChargeTotals) -> f64 {
    match channel {
        Channel::Current | Channel::Temperature(_) => totals.flowing_s,
        Channel::PackVoltage | Channel::CellVoltage(_) => totals.discharging_s,
        // No stuck check.
        Channel::ReportedSoc
        | Channel::ReportedSoh
        | Channel::SupplyVoltage
        | Channel::Balancing(_)
        | Channel::PackIdentity
        | Channel::CurrentDirection
        | Channel::Contactor => 0.0,
    }
}
