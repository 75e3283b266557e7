//! Finds missing stretches: times without any frame (holes of the log), and times in which one input is missing while
//! other frames arrive.

use super::context::{Judge, find};
use super::text::{channel, count, number, percent, seconds};
use crate::quantity::{Channel, Timestamp};
use crate::wiring::evidence::HIDDEN_SOC;
use crate::wiring::evidence::usage::Moment;
use crate::wiring::observer::Hole;
use crate::wiring::plan::{Kind, SignalPlan};
use crate::wiring::report::{Severity, Topic};

/// If a log has more holes than this, it consists of many trips and its holes are pauses.
const FEW: usize = 3;

pub(super) fn check(judge: &mut Judge<'_>) {
    of_log(judge);
    of_inputs(judge);
}

/// Reports the longest hole of the log. The finding is a warning only if the pack was in use, because the buses of a
/// parked car sleep.
fn of_log(judge: &mut Judge<'_>) {
    let observed = judge.observed;
    let longest = observed.holes.iter().max_by(|a, b| a.seconds().total_cmp(&b.seconds()));
    let (Some(hole), Some(first)) = (longest, observed.first) else { return };
    let in_use = used_hole(judge).filter(|_| observed.hole_count <= FEW);
    let (hole, severity) = in_use.as_ref().map_or((hole, Severity::Note), |(hole, _)| (hole, Severity::Warning));
    let span = span(first, hole.from, hole.seconds());
    let holes = count(observed.hole_count as u64, "hole");
    let title = format!("a stretch of {} is missing in the log", seconds(hole.seconds()));
    let why = match &in_use {
        Some((_, why)) => format!("the pack was in use: {why}; the charge that flowed in this time is unknown"),
        None => {
            "the buses slept, or the log was interrupted; the charge that flowed in this time is unknown".to_owned()
        }
    };
    find(judge, severity, Topic::Missing, title).seen(format!("no frames {span}; {holes} of more than 30 s")).why(why);
}

fn used_hole<'d>(judge: &Judge<'d>) -> Option<(&'d Hole, String)> {
    let use_of = |hole: &'d Hole| Some((hole, use_in(judge, hole)?));
    let used = judge.observed.holes.iter().filter_map(use_of);
    used.max_by(|a, b| a.0.seconds().total_cmp(&b.0.seconds()))
}

/// Describes the readings around a hole that show that the pack was in use; `None` if no reading shows this.
fn use_in(judge: &Judge<'_>, hole: &Hole) -> Option<String> {
    let moments = judge.observed.usage.moments();
    let before = moments.iter().rfind(|moment| moment.time <= hole.from)?;
    use_between(judge, before, &moments[moments.partition_point(|moment| moment.time < hole.to)..])
}

/// Like [`use_in`], but takes the last moment before a missing stretch and the moments after it. Small changes do not
/// count, because a parked pack feeds small loads and its controller corrects the state of charge by some per cent.
fn use_between(judge: &Judge<'_>, before: &Moment, after: &[Moment]) -> Option<String> {
    /// Minimum mean current that shows use, in multiples of the capacity per hour.
    const LEAST_RATE: f64 = 0.1;
    let hours = after.first()?.time.since(before.time) / 3600.0;
    let socs = judge.observed.witnesses.iter().enumerate();
    let mut socs = socs.filter(|(_, w)| judge.plan.witness(**w).binding.channel == Channel::ReportedSoc);
    let change = socs.find_map(|(place, _)| {
        // The first reported value may arrive some time after the hole.
        let to = after.iter().map(|moment| moment.reported[place]).find(|value| value.is_finite())?;
        let from = before.reported[place];
        ((to - from).abs() > HIDDEN_SOC.min((LEAST_RATE * hours).max(0.02))).then_some((from, to))
    });
    let (least_a, after_a) = (LEAST_RATE * judge.pack_ah(), after.first()?.current_a);
    if let Some((from, to)) = change {
        Some(format!("the reported SOC is {} % before and {} % after it", percent(from), percent(to)))
    } else if before.current_a.abs() > least_a && after_a.abs() > least_a {
        let [from, to] = [before.current_a, after_a].map(number);
        Some(format!("the current is {from} A before and {to} A after it"))
    } else {
        None
    }
}

/// Reports for each kind of input the longest stretch in which it is missing while other frames arrive. If several
/// kinds are missing at the same time, they are one finding, because their sender slept.
fn of_inputs(judge: &mut Judge<'_>) {
    let mut found: Vec<MissingInput<'_>> = Vec::new();
    for kind in [Kind::Current, Kind::Voltage, Kind::Temperature, Kind::Reported] {
        let Some(next) = missing_input(judge, kind) else { continue };
        let is_same = |other: &&mut MissingInput<'_>| {
            let overlap_s = next.hole.to.min(other.hole.to).since(next.hole.from.max(other.hole.from));
            overlap_s > 0.8 * next.hole.seconds().max(other.hole.seconds())
        };
        match found.iter_mut().find(is_same) {
            Some(other) => {
                other.names.extend(next.names);
                other.kinds.extend(next.kinds);
            }
            None => found.push(next),
        }
    }
    found.into_iter().for_each(|missing| report(judge, missing));
}

/// A stretch in which inputs are missing. `signal` and `period_s` belong to the first of these inputs.
struct MissingInput<'d> {
    names: Vec<String>,
    kinds: Vec<Kind>,
    signal: &'d SignalPlan,
    period_s: f64,
    hole: Hole,
}

fn missing_input<'d>(judge: &Judge<'d>, kind: Kind) -> Option<MissingInput<'d>> {
    let all = judge.signals(kind);
    let missing: Vec<_> =
        all.iter().filter_map(|(signal, series)| Some((signal, series, series.longest_missing?))).collect();
    let (signal, series, (from, length_s)) = missing.iter().max_by(|a, b| a.2.1.total_cmp(&b.2.1))?;
    let name = match (kind, missing.len()) {
        (Kind::Voltage, n) if n > 1 => format!("{n} voltages"),
        (Kind::Temperature, n) if n > 1 => format!("{n} temperatures"),
        _ => channel(signal.binding.channel),
    };
    let hole = Hole { from: *from, to: from.plus_secs(*length_s) };
    Some(MissingInput {
        names: vec![name],
        kinds: vec![kind],
        signal,
        period_s: series.period_s().unwrap_or(0.0),
        hole,
    })
}

fn report(judge: &mut Judge<'_>, MissingInput { names, kinds, signal, period_s, hole }: MissingInput<'_>) {
    let Some(first) = judge.observed.first else { return };
    // If current and voltages are missing together and the pack was not in use, the pack slept.
    let is_all = kinds.contains(&Kind::Current) && kinds.contains(&Kind::Voltage);
    let is_asleep = is_all && use_in(judge, &hole).is_none();
    let is_minor = is_asleep || Kind::of(signal.binding.channel) == Kind::Reported;
    let severity = if is_minor { Severity::Note } else { Severity::Warning };
    let why = match is_asleep {
        true => "the pack's controller slept while other nodes were awake",
        false => "the sender, a gateway or the logger left it out; estimates do not know this time",
    };
    let (gap, period, names) = (seconds(hole.seconds()), seconds(period_s), names.join(", "));
    let span = span(first, hole.from, hole.seconds());
    find(judge, severity, Topic::Missing, format!("{names}: no reading for {gap} while other frames arrive"))
        .seen(format!("{} arrives every {period}, but not {span}", signal.name))
        .why(why);
}

pub(super) fn span(first: Timestamp, from: Timestamp, length_s: f64) -> String {
    let start_s = from.since(first);
    format!("from {} to {} after the first frame", seconds(start_s), seconds(start_s + length_s))
}
