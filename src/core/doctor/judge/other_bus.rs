//! The current's message on another interface: which of the two the voltages follow.

use super::context::{EXPLAINED, Judge, error, warning};
use super::words::number;
use crate::doctor::other_current::OtherCurrent;
use crate::doctor::plan::SignalPlan;
use crate::doctor::report::Topic;
use crate::doctor::response::Slope;
use crate::doctor::series::Series;
use crate::quantity::{BusIndex, Channel};

pub(super) fn check(judge: &mut Judge<'_>) {
    let Some((signal, series)) = judge.current().filter(|(_, series)| series.count() > 0) else { return };
    let others = judge.doctor.other_currents.iter().filter(|(_, other)| other.series.count() > 0);
    let here = judge.doctor.slope();
    for (bus, other) in others {
        match (here.is_some_and(|slope| is_clear(&slope)), other.slope().filter(is_clear)) {
            (false, Some(there)) => followed(judge, signal, (*bus, &there), here),
            (false, None) if !is_alike(series, &other.series) => undecided(judge, signal, (*bus, other)),
            (true, _) | (false, None) => {}
        }
    }
}

/// Whether voltages follow a current.
fn is_clear(slope: &Slope) -> bool {
    slope.certainty() >= 1.0 && slope.r2 >= EXPLAINED
}

/// Whether a gateway repeats the message: then both have the same extent.
fn is_alike(a: &Series, b: &Series) -> bool {
    let (a, b) = (&a.extent, &b.extent);
    let tolerance = 0.02 * a.range().max(b.range()) + 1e-9;
    [a.min - b.min, a.max - b.max, a.mean() - b.mean()].into_iter().all(|difference| difference.abs() <= tolerance)
}

fn followed(judge: &mut Judge<'_>, signal: &SignalPlan, (bus, there): (BusIndex, &Slope), here: Option<Slope>) {
    judge.is_mixed_up = true;
    let (configured, other) = (judge.interface(signal.binding.bus), judge.interface(bus));
    let share = |slope: &Slope| number((100.0 * slope.r2).round());
    let (explained, unexplained) = (share(there), here.as_ref().map_or("0".to_owned(), share));
    error(judge, Topic::Interface, format!("the pack's current is on {other}, not on {configured}"))
        .seen(format!(
            "{} ({}) comes on both: the one on {other} explains {explained} % of the voltages' steps, the one on \
             {configured} {unexplained} %",
            signal.message, signal.binding.id
        ))
        .why("the voltages of a pack follow its current; the same identifier on the other bus is another message")
        .change(&signal.table, "interface", format!("{other:?}"));
}

/// The voltages follow neither, or nothing moved.
fn undecided(judge: &mut Judge<'_>, signal: &SignalPlan, (bus, other): (BusIndex, &OtherCurrent)) {
    let (configured, name) = (judge.interface(signal.binding.bus), judge.interface(bus));
    let (message, id) = (&signal.message, signal.binding.id);
    let is_voltage = |s: &&SignalPlan| {
        matches!(s.binding.channel, Channel::CellVoltage(_) | Channel::PackVoltage) && s.binding.bus == bus
    };
    let (low, high) = (number(other.series.extent.min), number(other.series.extent.max));
    if judge.plan.signals.iter().any(|s| is_voltage(&s)) {
        warning(judge, Topic::Interface, format!("the current is read from {configured}, the voltages from {name}"))
            .seen(format!("{message} ({id}) is on {name} too, with other values: {low} to {high} A"))
            .why("a pack usually sends both on one bus")
            .change(&signal.table, "interface", format!("{name:?}"))
            .advice("drive or charge for a minute while listening: the voltages then show which current is the pack's");
    } else {
        judge.unjudged(format!(
            "{message} ({id}) is on {name} too, with other values ({low} to {high} A): which one is the pack's current shows \
             only under load; drive or charge for a minute"
        ));
    }
}
