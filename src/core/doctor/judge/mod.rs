//! Everything seen to a report: causes first, so that what follows from a cause found is not told as another.
//!
//! Each part looks at one thing: `bus` (interfaces, identifiers, protection), `presence` (silent signals, number of
//! cells), `values` (units, byte order), `places` (one signal in another's place), `electrical` (sign, resistance, open
//! circuit), `timing`. A factor found in `values` is applied before `electrical` looks.

mod bus;
mod electrical;
mod places;
mod presence;
mod timing;
mod values;
pub(super) mod words;

use std::collections::BTreeSet;

use super::plan::{Plan, SignalPlan};
use super::report::Report;
use super::series::Series;
use super::watch::Doctor;
use crate::can::CanId;
use crate::quantity::{BusIndex, Channel};

/// Seconds of a record below which little can be said.
const SHORT_S: f64 = 5.0;
/// A pack's current stays below this many times its capacity.
const MAX_C_RATE: f64 = 30.0;

/// The judgement in the making.
pub(super) struct Judge<'d> {
    doctor: &'d Doctor,
    plan: &'d Plan,
    report: Report,
    /// Messages whose absence is explained.
    explained: BTreeSet<(BusIndex, CanId)>,
    /// What voltages and currents must be multiplied with to be in our units, as found.
    voltage_factor: f64,
    current_factor: f64,
    /// Nothing can be said about how voltages follow the current: one of them is not what it is called.
    is_mixed_up: bool,
}

/// Judges all that was seen.
pub(super) fn judge(doctor: &Doctor) -> Report {
    let report = Report { seconds: doctor.seconds(), frames: doctor.frames, ..Report::default() };
    let plan = &doctor.plan;
    let mut judge = Judge {
        doctor,
        plan,
        report,
        explained: BTreeSet::new(),
        voltage_factor: 1.0,
        current_factor: 1.0,
        is_mixed_up: false,
    };
    bus::judge(&mut judge);
    presence::judge(&mut judge);
    places::judge(&mut judge);
    values::judge(&mut judge);
    values::refused(&mut judge);
    electrical::judge(&mut judge);
    timing::judge(&mut judge);
    if doctor.frames > 0 && doctor.awake_s < SHORT_S {
        judge.report.unjudged.push(format!(
            "frames came for only {}: listen longer for anything about periods and the cells",
            words::seconds(doctor.awake_s)
        ));
    }
    judge.report
}

/// The age from which a reading of the channel is stale, s.
pub(super) fn max_age_s(plan: &Plan, channel: Channel) -> f64 {
    match channel {
        Channel::Current => plan.ages.current_s,
        Channel::PackVoltage | Channel::CellVoltage(_) => plan.ages.voltage_s,
        Channel::Temperature(_) => plan.ages.temperature_s,
        Channel::ReportedSoc | Channel::ReportedSoh | Channel::PackIdentity => f64::INFINITY,
    }
}

/// What a signal is for, as far as the judgement goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    Current,
    Voltage,
    Temperature,
    Reported,
}

impl Kind {
    fn of(channel: Channel) -> Self {
        match channel {
            Channel::Current => Self::Current,
            Channel::PackVoltage | Channel::CellVoltage(_) => Self::Voltage,
            Channel::Temperature(_) => Self::Temperature,
            Channel::ReportedSoc | Channel::ReportedSoh | Channel::PackIdentity => Self::Reported,
        }
    }
}

impl<'d> Judge<'d> {
    /// Signals of a kind with what was seen of them.
    fn of(&self, kind: Kind) -> Vec<(&'d SignalPlan, &'d Series)> {
        let all = self.plan.signals.iter().zip(&self.doctor.series);
        all.filter(|(signal, _)| Kind::of(signal.binding.channel) == kind).collect()
    }

    fn current(&self) -> Option<(&'d SignalPlan, &'d Series)> {
        self.of(Kind::Current).first().copied()
    }

    /// Smallest and largest voltage the middle cell may show, V.
    fn voltage_band(&self) -> (f64, f64) {
        match &self.plan.model {
            // The middle one over the time heard: a short peak does not move it.
            Some(model) => (model.voltage_min_v - 0.15, model.voltage_max_v + 0.08),
            None => (1.2, 4.6),
        }
    }

    /// Charge of the whole pack, Ah.
    fn pack_ah(&self) -> f64 {
        self.plan.capacity_ah * f64::from(self.plan.strings.max(1))
    }

    /// The middle of the cells' middle voltages as configured, V per cell; `None` = no reading.
    fn cell_voltage(&self) -> Option<f64> {
        let divisor = if self.plan.is_pack_total { f64::from(self.plan.cells.max(1)) } else { 1.0 };
        let medians = self.of(Kind::Voltage).into_iter().filter_map(|(_, series)| series.values.median());
        super::link::median(medians).map(|v| v / divisor)
    }

    fn interface(&self, bus: BusIndex) -> &'d str {
        self.doctor.buses.get(bus.index()).map_or("unknown", |bus| bus.name.as_str())
    }
}
