//! If the message with the pack current appears on two interfaces, decides which of the two currents the voltages
//! follow.

use super::context::{EXPLAINED, Judge, error, warning};
use super::text::number;
use crate::quantity::BusIndex;
use crate::wiring::evidence::{Series, Slope};
use crate::wiring::other_current::OtherCurrent;
use crate::wiring::plan::{Kind, SignalPlan};
use crate::wiring::report::Topic;

pub(super) fn check(judge: &mut Judge<'_>) {
    let Some((signal, series)) = judge.current().filter(|(_, series)| series.count() > 0) else { return };
    let others = judge.observed.other_currents.iter().filter(|(_, other)| other.series.count() > 0);
    let here = judge.observed.slope();
    for (bus, other) in others {
        let there = other.slope().filter(is_clear);
        match (here.is_some_and(|slope| is_clear(&slope)), there) {
            (false, Some(there)) => followed(judge, signal, (*bus, &there), here),
            _ if is_alike(series, &other.series) => {}
            // If two packs are on two buses, the voltages may follow both currents.
            (true, Some(_)) if has_voltages(judge, *bus) => two_buses(judge, signal, (*bus, other)),
            (true, _) => {}
            (false, None) if has_voltages(judge, *bus) => two_buses(judge, signal, (*bus, other)),
            (false, None) => undecided(judge, signal, (*bus, other)),
        }
    }
}

fn has_voltages(judge: &Judge<'_>, bus: BusIndex) -> bool {
    judge.signals(Kind::Voltage).iter().any(|(signal, _)| signal.binding.bus == bus)
}

fn is_clear(slope: &Slope) -> bool {
    slope.certainty() >= 1.0 && slope.r2 >= EXPLAINED
}

/// Whether the two series have the same extent. If so, a gateway probably repeats the message on the second interface.
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
            "{} ({}) arrives on both: the message on {other} explains {explained} % of the voltages' steps, the \
             message on {configured} explains {unexplained} %",
            signal.message, signal.binding.id
        ))
        .why("the voltages of a pack follow its current; the same identifier on the other bus is another message")
        .change(&signal.table, "interface", format!("{other:?}"));
}

/// Reports that the current is read from one interface and the voltages from another, while both interfaces carry the
/// message with the pack current.
fn two_buses(judge: &mut Judge<'_>, signal: &SignalPlan, (bus, other): (BusIndex, &OtherCurrent)) {
    let (configured, name) = (judge.interface(signal.binding.bus), judge.interface(bus));
    let (low, high) = (number(other.series.extent.min), number(other.series.extent.max));
    warning(judge, Topic::Interface, format!("the current is read from {configured}, the voltages from {name}"))
        .seen(format!(
            "{} ({}) also arrives on {name}, with other values: {low} to {high} A",
            signal.message, signal.binding.id
        ))
        .why("a pack usually sends both on one bus; the configured current may belong to another pack")
        .change(&signal.table, "interface", format!("{name:?}"))
        .advice("listen under load, and compare the resistance and the charge with those of the pack");
}

/// Reports that the voltages follow neither current, or that the currents did not change.
fn undecided(judge: &mut Judge<'_>, signal: &SignalPlan, (bus, other): (BusIndex, &OtherCurrent)) {
    let (low, high) = (number(other.series.extent.min), number(other.series.extent.max));
    judge.unjudged(format!(
        "{} ({}) also arrives on {}, with other values ({low} to {high} A): only a load shows which of the two is the \
         pack's current; drive or charge for a minute",
        signal.message,
        signal.binding.id,
        judge.interface(bus)
    ));
}
