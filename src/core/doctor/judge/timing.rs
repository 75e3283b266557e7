//! Periods: against the age from which readings are stale, and against what the DBC says.

use super::super::plan::SignalPlan;
use super::super::report::{Finding, Topic};
use super::super::series::Series;
use super::{Judge, Kind, max_age_s, words};

/// A period this many times the DBC's is another one.
const SLOWER: f64 = 2.0;
/// The age limit should leave room for so many periods: a frame lost now and then is no fault.
const ROOM: f64 = 2.0;
/// Proposed age in periods.
const PROPOSED: f64 = 5.0;
/// Share of gaps above the limit that are told.
const STALE_SHARE: f64 = 1e-3;

pub(super) fn judge(judge: &mut Judge<'_>) {
    for (kind, table, what) in [
        (Kind::Current, "limits.current", "pack current"),
        (Kind::Voltage, "limits.voltage", "voltages"),
        (Kind::Temperature, "limits.temperature", "temperatures"),
    ] {
        let all = judge.of(kind);
        if let Some((worst, period_s)) = slowest(&all) {
            stale(judge, (table, what), worst, period_s);
        }
    }
    cycle_times(judge);
}

type Seen<'d> = (&'d SignalPlan, &'d Series);

fn slowest<'d>(all: &[Seen<'d>]) -> Option<(Seen<'d>, f64)> {
    let timed = all.iter().filter_map(|seen| Some((*seen, seen.1.period_s()?)));
    timed.max_by(|a, b| {
        (a.1, a.0.1.longest_gap_s).partial_cmp(&(b.1, b.0.1.longest_gap_s)).unwrap_or(std::cmp::Ordering::Equal)
    })
}

fn stale(judge: &mut Judge<'_>, (table, what): (&str, &str), (signal, series): Seen<'_>, period_s: f64) {
    let limit_s = max_age_s(judge.plan, signal.binding.channel);
    let proposed = words::toml(round_up(PROPOSED * period_s));
    let seen = format!(
        "{} comes every {}, at the longest after {}; stale after {}",
        signal.name,
        words::seconds(period_s),
        words::seconds(series.longest_gap_s),
        words::seconds(limit_s)
    );
    if period_s > limit_s {
        let finding = Finding::error(Topic::Period, format!("{what} are stale before the next reading comes"))
            .seen(seen)
            .why("a reading older than max_age_s is not used: estimates coast or stop")
            .change(table, "max_age_s", proposed);
        return judge.report.add(finding);
    }
    let share = series.stale_gaps as f64 / series.count().max(1) as f64;
    if ROOM * period_s > limit_s {
        let finding = Finding::warning(Topic::Period, format!("{what}: one lost frame makes them stale"))
            .seen(seen)
            .why("frames are lost now and then on every bus")
            .change(table, "max_age_s", proposed);
        judge.report.add(finding);
    } else if series.stale_gaps > 0 && share > STALE_SHARE {
        let longest_s = words::toml(round_up(1.5 * series.longest_gap_s));
        let finding =
            Finding::warning(Topic::Period, format!("{what} were stale {}", words::count(series.stale_gaps, "time")))
                .seen(seen)
                .why("the sender is uneven, or frames are lost on the way")
                .change(table, "max_age_s", longest_s);
        judge.report.add(finding);
    }
}

/// To two digits, upwards.
fn round_up(value: f64) -> f64 {
    let step = 10_f64.powf(value.log10().floor() - 1.0);
    (value / step - 1e-9).ceil() * step
}

/// Messages slower than the DBC says.
fn cycle_times(judge: &mut Judge<'_>) {
    let plan = judge.plan;
    for message in &plan.messages {
        let Some(seen) = judge.doctor.buses.get(message.bus.index()).and_then(|bus| bus.ids.get(&message.id)) else {
            continue;
        };
        // The pages of a multiplexed message may come in bursts, and how many there are is the sender's affair.
        let Some(cycle_s) = message.cycle_time_s.filter(|_| message.pages <= 1) else { continue };
        // Over all its pages: the frames of a multiplexed message may come in bursts.
        let asleep = judge.doctor.awake_s + 1.0 < seen.last.since(seen.first);
        let span_s = if asleep { judge.doctor.awake_s } else { seen.last.since(seen.first) };
        let period_s = span_s / (seen.count.max(2) - 1) as f64;
        if seen.count < 10 || period_s < SLOWER * cycle_s {
            continue;
        }
        let finding = Finding::warning(Topic::Period, format!("{} comes more seldom than the DBC says", message.name))
            .seen(format!(
                "every {} ({} frames in {}), GenMsgCycleTime is {}",
                words::seconds(period_s),
                seen.count,
                words::seconds(span_s),
                words::seconds(cycle_s)
            ))
            .why("frames are lost, a gateway thins them out, or the DBC is of another version")
            .advice("when this is as it should be, correct GenMsgCycleTime in the DBC");
        judge.report.add(finding);
    }
}
