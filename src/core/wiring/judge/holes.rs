//! Names missing stretches: holes of the whole log, and stretches in which one input is missing while others arrive.

use super::context::{Judge, find};
use super::text::{channel, count, number, percent, seconds};
use crate::quantity::{Channel, Timestamp};
use crate::wiring::evidence::Series;
use crate::wiring::evidence::usage::Moment;
use crate::wiring::observer::Hole;
use crate::wiring::plan::Kind;
use crate::wiring::report::{Severity, Topic};

/// Shortest missing stretch of an input that is reported (s), and its shortest length in periods of the input.
const LEAST_S: f64 = 60.0;
const LEAST_PERIODS: f64 = 20.0;
/// A log with more holes than this consists of many trips: its holes are pauses.
const FEW: usize = 3;

pub(super) fn check(judge: &mut Judge<'_>) {
    of_log(judge);
    for kind in [Kind::Current, Kind::Voltage, Kind::Temperature, Kind::Reported] {
        of_input(judge, kind);
    }
}

/// Reports the holes of the log. Only a hole in which the pack was in use is a warning: a parked car's buses sleep.
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

/// The longest hole in which the pack was in use, and how the readings around the hole show this.
fn used_hole<'d>(judge: &Judge<'d>) -> Option<(&'d Hole, String)> {
    let moments = judge.observed.usage.moments();
    let use_of = |hole: &'d Hole| {
        let before = moments.iter().rfind(|moment| moment.time <= hole.from)?;
        let after = &moments[moments.partition_point(|moment| moment.time < hole.to)..];
        Some((hole, use_between(judge, before, after)?))
    };
    let used = judge.observed.holes.iter().filter_map(use_of);
    used.max_by(|a, b| a.0.seconds().total_cmp(&b.0.seconds()))
}

fn use_between(judge: &Judge<'_>, before: &Moment, after: &[Moment]) -> Option<String> {
    /// A reported state of charge that changes by more than this shows that charge flowed.
    const LEAST_CHANGE: f64 = 0.02;
    let socs = judge.observed.witnesses.iter().enumerate();
    let mut socs = socs.filter(|(_, w)| judge.plan.witness(**w).binding.channel == Channel::ReportedSoc);
    let change = socs.find_map(|(place, _)| {
        // The first reported value may arrive some time after the hole.
        let to = after.iter().map(|moment| moment.reported[place]).find(|value| value.is_finite())?;
        let from = before.reported[place];
        ((to - from).abs() > LEAST_CHANGE).then_some((from, to))
    });
    let (dead_a, after_a) = (judge.plan.pack.dead_band_a, after.first()?.current_a);
    if let Some((from, to)) = change {
        Some(format!("the reported SOC is {} % before and {} % after it", percent(from), percent(to)))
    } else if before.current_a.abs() > dead_a && after_a.abs() > dead_a {
        let [from, to] = [before.current_a, after_a].map(number);
        Some(format!("the current is {from} A before and {to} A after it"))
    } else {
        None
    }
}

/// Reports the longest stretch in which an input of a kind is missing while other frames arrive.
fn of_input(judge: &mut Judge<'_>, kind: Kind) {
    let least_s = |series: &Series| LEAST_S.max(LEAST_PERIODS * series.period_s().unwrap_or(f64::INFINITY));
    let all = judge.signals(kind);
    let missing = all.iter().filter(|(_, series)| series.longest_gap_s > least_s(series));
    let longest = missing.clone().max_by(|a, b| a.1.longest_gap_s.total_cmp(&b.1.longest_gap_s));
    let (Some((signal, series)), Some(first)) = (longest, judge.observed.first) else { return };
    let Some(from) = series.longest_gap_from else { return };
    let name = match (kind, missing.count()) {
        (Kind::Voltage, n) if n > 1 => format!("{n} voltages"),
        (Kind::Temperature, n) if n > 1 => format!("{n} temperatures"),
        _ => channel(signal.binding.channel),
    };
    let severity = if kind == Kind::Reported { Severity::Note } else { Severity::Warning };
    let (gap, period) = (seconds(series.longest_gap_s), seconds(series.period_s().unwrap_or(0.0)));
    let span = span(first, from, series.longest_gap_s);
    find(judge, severity, Topic::Missing, format!("{name}: no reading for {gap} while other frames arrive"))
        .seen(format!("{} arrives every {period}, but not {span}", signal.name))
        .why("the sender, a gateway or the logger left it out; estimates do not know this time");
}

/// Describes a stretch by its times after the first frame.
fn span(first: Timestamp, from: Timestamp, length_s: f64) -> String {
    let start_s = from.since(first);
    format!("from {} to {} after the first frame", seconds(start_s), seconds(start_s + length_s))
}
