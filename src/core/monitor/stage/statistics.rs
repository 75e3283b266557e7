//! Counts of the core's work for the status socket and its metrics.
//!
//! The counts are part of the stored state and continue after a restart. Other modules keep the counts of:
//! * readings ([`crate::sample::ReadingCounts`]),
//! * checks of protected messages ([`Monitor::protected`](super::Monitor)),
//! * floods ([`Monitor::dropped`](super::Monitor)),
//! * steps back in time ([`Monitor::time_backwards`](super::Monitor)).

use serde::{Deserialize, Serialize};

use super::intake::buses::CAN_ERR_BUSOFF;
use crate::alarm::{Change, Severity};
use crate::cell::StepResult;
use crate::monitor::message::{BusEvent, Event, EventKind, RecordKind};
use crate::quantity::BusIndex;

/// Adds to a count and saturates, because a stored count may have any value.
fn add(count: &mut u64, by: u64) {
    *count = count.saturating_add(by);
}

/// Counts since the first start.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Statistics {
    /// Counts per interface, in the order of the configuration. The last interfaces may be missing if they have had no
    /// input.
    pub buses: Vec<BusStatistics>,
    /// Voltage readings by effect.
    #[serde(flatten)]
    pub voltages: VoltageCounts,
    /// Number of times a filter was restarted from a voltage.
    pub filter_resets: u64,
    /// Number of times a cell's estimate became untrusted.
    pub trust_lost: u64,
    /// Number of periods without measurements: computer asleep, program not running, or gap in the log.
    pub gaps: u64,
    pub mode_changes: u64,
    /// Half-cycles and their results.
    #[serde(flatten)]
    pub learning: LearningCounts,
    /// Number of times an alarm was raised, by severity.
    pub alarms_raised: AlarmCounts,
    /// Executed commands, from the bus and from this computer.
    pub commands: u64,
    /// Number of rejected command frames.
    pub bad_commands: u64,
    pub packs_replaced: u64,
    /// Number of times a stored state was restored at a start.
    pub restores: u64,
    /// How often the files became unwritable.
    pub store_failures: u64,
}

/// Numbers of voltage readings by their effect on the estimates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct VoltageCounts {
    /// Readings that changed an estimate.
    #[serde(rename = "voltages_used")]
    pub used: u64,
    /// Readings outside the filter's innovation gate, which were ignored.
    #[serde(rename = "voltages_gated")]
    pub gated: u64,
    /// Readings that could not be compared with a prediction, because the current was unknown or the filter step
    /// failed.
    #[serde(rename = "voltages_without_current")]
    pub without_current: u64,
}

impl VoltageCounts {
    /// Sum of all counts.
    pub const fn total(&self) -> u64 {
        self.used + self.gated + self.without_current
    }
}

/// Numbers of half-cycles (charges and discharges) and of their results.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LearningCounts {
    /// Half-cycles, summed over the cells.
    pub half_cycles: u64,
    /// Updates of a capacity filter, summed over the cells.
    pub capacity_updates: u64,
    /// Updates of a capacity filter that used a measurement.
    pub capacity_measurements: u64,
    /// Number of recorded recharge periods, raw or normalised (see [`crate::health::recharge`]).
    pub recharge_periods: u64,
}

/// Counts of one interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct BusStatistics {
    /// Received frames.
    pub frames: u64,
    pub error_frames: u64,
    /// Error frames that report bus-off.
    pub bus_offs: u64,
}

impl BusStatistics {
    fn since(&self, before: &Self) -> Self {
        Self {
            frames: self.frames.saturating_sub(before.frames),
            error_frames: self.error_frames.saturating_sub(before.error_frames),
            bus_offs: self.bus_offs.saturating_sub(before.bus_offs),
        }
    }
}

/// Numbers of alarms by severity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct AlarmCounts {
    pub info: u64,
    pub warning: u64,
    pub severe: u64,
}

impl AlarmCounts {
    /// Count of one severity.
    pub const fn get(&self, severity: Severity) -> u64 {
        match severity {
            Severity::Info => self.info,
            Severity::Warning => self.warning,
            Severity::Severe => self.severe,
        }
    }

    fn add(&mut self, severity: Severity) {
        match severity {
            Severity::Info => add(&mut self.info, 1),
            Severity::Warning => add(&mut self.warning, 1),
            Severity::Severe => add(&mut self.severe, 1),
        }
    }
}

impl Statistics {
    /// Differences between these counts and the earlier counts `before`.
    pub fn since(&self, before: &Self) -> Self {
        let of = |count: fn(&Self) -> u64| count(self).saturating_sub(count(before));
        let buses = self.buses.iter().enumerate();
        Self {
            buses: buses.map(|(bus, now)| before.buses.get(bus).map_or(*now, |before| now.since(before))).collect(),
            voltages: VoltageCounts {
                used: of(|it| it.voltages.used),
                gated: of(|it| it.voltages.gated),
                without_current: of(|it| it.voltages.without_current),
            },
            filter_resets: of(|it| it.filter_resets),
            trust_lost: of(|it| it.trust_lost),
            gaps: of(|it| it.gaps),
            mode_changes: of(|it| it.mode_changes),
            learning: LearningCounts {
                half_cycles: of(|it| it.learning.half_cycles),
                capacity_updates: of(|it| it.learning.capacity_updates),
                capacity_measurements: of(|it| it.learning.capacity_measurements),
                recharge_periods: of(|it| it.learning.recharge_periods),
            },
            alarms_raised: AlarmCounts {
                info: of(|it| it.alarms_raised.info),
                warning: of(|it| it.alarms_raised.warning),
                severe: of(|it| it.alarms_raised.severe),
            },
            commands: of(|it| it.commands),
            bad_commands: of(|it| it.bad_commands),
            packs_replaced: of(|it| it.packs_replaced),
            restores: of(|it| it.restores),
            store_failures: of(|it| it.store_failures),
        }
    }

    pub(crate) fn note(&mut self, kind: &RecordKind, events: &[Event]) {
        match *kind {
            RecordKind::Frame { bus, .. } | RecordKind::SecuredFrame { bus, .. } => add(&mut self.bus(bus).frames, 1),
            RecordKind::Bus { bus, event: BusEvent::ErrorFrame { class } } => {
                let counts = self.bus(bus);
                add(&mut counts.error_frames, 1);
                add(&mut counts.bus_offs, u64::from(class & CAN_ERR_BUSOFF != 0));
            }
            _ => {}
        }
        self.note_events(events);
    }

    /// Counts events that were not caused by a record.
    pub(crate) fn note_events(&mut self, events: &[Event]) {
        events.iter().for_each(|event| self.note_event(&event.kind));
    }

    fn note_event(&mut self, kind: &EventKind) {
        match *kind {
            EventKind::FilterReset { .. } => add(&mut self.filter_resets, 1),
            EventKind::Trust { trusted: false, .. } => add(&mut self.trust_lost, 1),
            EventKind::Gap { .. } => add(&mut self.gaps, 1),
            EventKind::Mode { .. } => add(&mut self.mode_changes, 1),
            EventKind::HalfCycle { .. } => add(&mut self.learning.half_cycles, 1),
            EventKind::Capacity { measured_ah, .. } => {
                add(&mut self.learning.capacity_updates, 1);
                add(&mut self.learning.capacity_measurements, u64::from(measured_ah.is_some()));
            }
            EventKind::RechargePeriod { .. } => add(&mut self.learning.recharge_periods, 1),
            EventKind::Alarm { change: Change::Raised, severity, .. } => self.alarms_raised.add(severity),
            EventKind::Command { .. } => add(&mut self.commands, 1),
            EventKind::PackReplaced { .. } => add(&mut self.packs_replaced, 1),
            EventKind::Store { works: false } => add(&mut self.store_failures, 1),
            _ => {}
        }
    }

    pub(crate) fn note_voltages<'a>(&mut self, results: impl Iterator<Item = &'a StepResult>) {
        let (mut all, mut compared, mut used) = (0, 0, 0);
        for StepResult { update, .. } in results {
            all += 1;
            compared += u64::from(update.is_some());
            used += u64::from(update.is_some_and(|update| update.accepted));
        }
        add(&mut self.voltages.used, used);
        add(&mut self.voltages.gated, compared - used);
        add(&mut self.voltages.without_current, all - compared);
    }

    fn bus(&mut self, bus: BusIndex) -> &mut BusStatistics {
        if self.buses.len() <= bus.index() {
            self.buses.resize(bus.index() + 1, BusStatistics::default());
        }
        &mut self.buses[bus.index()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::CanId;
    use crate::can::Frame;

    #[test]
    fn frames_and_bus_offs_are_counted_per_interface() {
        let mut statistics = Statistics::default();
        let frame = Frame::classic(CanId::standard(0x123).expect("an id"), &[1]).expect("a frame");
        let bus = BusIndex(1);
        statistics.note(&RecordKind::Frame { bus, frame }, &[]);
        for class in [0x04, 0x40, 0x44] {
            statistics.note(&RecordKind::Bus { bus, event: BusEvent::ErrorFrame { class } }, &[]);
        }
        let counts = BusStatistics { frames: 1, error_frames: 3, bus_offs: 2 };
        assert_eq!(statistics.buses, [BusStatistics::default(), counts]);
    }
}
