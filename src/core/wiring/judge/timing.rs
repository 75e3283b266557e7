//! Compares the periods of signals with the age at which readings become stale, and with the DBC's cycle times.

use super::context::{Judge, SignalSeries, find, warning};
use super::text::{count, percent, seconds, toml};
use crate::filter::median;
use crate::wiring::plan::Kind;
use crate::wiring::report::{Severity, Topic};

pub(super) fn check(judge: &mut Judge<'_>) {
    for (kind, table, what) in [
        (Kind::Current, "limits.current", "pack current"),
        (Kind::Voltage, "limits.voltage", "voltages"),
        (Kind::Temperature, "limits.temperature", "temperatures"),
    ] {
        if let Some((slowest, period_s)) = slowest(&judge.signals(kind)) {
            stale(judge, (table, what), slowest, period_s);
        }
    }
    lost(judge);
    cycle_times(judge);
}

/// Finds messages that lose frames. The gaps between their readings are multiples of the message's cycle.
fn lost(judge: &mut Judge<'_>) {
    for message in &judge.plan.messages {
        let signals = judge.plan.signals.iter().zip(&judge.observed.series);
        let of_message = signals.filter(|(s, _)| (s.binding.bus, s.binding.id) == (message.bus, message.id));
        let losses: Vec<(f64, f64)> = of_message.filter_map(|(_, series)| series.loss.share()).collect();
        // Single lost frames are normal on every bus.
        let Some(share) = median(losses.iter().map(|(share, _)| *share)).filter(|share| *share >= 0.03) else {
            continue;
        };
        let cycle_s = losses.iter().map(|(_, cycle_s)| *cycle_s).fold(f64::INFINITY, f64::min);
        let (name, one_in) = (&message.name, (1.0 / share).round());
        let title = format!("{name}: one frame in {one_in} is missing");
        warning(judge, Topic::Period, title)
            .seen(format!(
                "its signals arrive every {} or after a multiple of that time; {} % of the readings are missing",
                seconds(cycle_s),
                percent(share)
            ))
            .why("a gateway or this computer is overloaded, or a second node sends the identifier")
            .advice("compare with candump on the bus itself, and look at the interface's counters: ip -details -statistics link show");
    }
}

/// The signal with the longest period, and this period (s). If several signals have the same period, returns the signal
/// with the longest gap.
fn slowest<'d>(all: &[SignalSeries<'d>]) -> Option<(SignalSeries<'d>, f64)> {
    let timed = all.iter().filter_map(|signal| Some((*signal, signal.1.period_s()?)));
    timed.max_by(|a, b| {
        (a.1, a.0.1.longest_gap_s).partial_cmp(&(b.1, b.0.1.longest_gap_s)).unwrap_or(std::cmp::Ordering::Equal)
    })
}

fn stale(judge: &mut Judge<'_>, (table, what): (&str, &str), (signal, series): SignalSeries<'_>, period_s: f64) {
    let limit_s = judge.plan.max_age_s(signal.binding.channel);
    let share = series.stale_gaps as f64 / series.count().max(1) as f64;
    let proposed_s = 5.0 * period_s;
    let (severity, title, why, proposed_s) = if period_s > limit_s {
        let why = "the estimator ignores readings older than max_age_s, so estimates coast or stop";
        (Severity::Error, format!("{what}: stale before the next reading arrives"), why, proposed_s)
    } else if 2.0 * period_s > limit_s {
        let why = "every bus loses single frames";
        (Severity::Warning, format!("{what}: stale after one lost frame"), why, proposed_s)
    } else if series.stale_gaps > 0 && share > 1e-3 {
        let title = format!("{what}: stale {}", count(series.stale_gaps, "time"));
        let why = "the sender's period is uneven, or frames are lost";
        (Severity::Warning, title, why, 1.5 * series.longest_gap_s)
    } else {
        return;
    };
    let (period, gap, limit) = (seconds(period_s), seconds(series.longest_gap_s), seconds(limit_s));
    find(judge, severity, Topic::Period, title)
        .seen(format!("{} arrives every {period}, longest gap {gap}; stale after {limit}", signal.name))
        .why(why)
        .change(table, "max_age_s", toml(round_up(proposed_s)));
}

/// Rounds up to two significant digits.
fn round_up(value: f64) -> f64 {
    let step = 10_f64.powf(value.log10().floor() - 1.0);
    (value / step - 1e-9).ceil() * step
}

/// Finds messages that arrive less often than the DBC states.
fn cycle_times(judge: &mut Judge<'_>) {
    for message in &judge.plan.messages {
        let Some(stats) = judge.bus(message.bus).and_then(|bus| bus.ids.get(&message.id)) else { continue };
        // The pages of a multiplexed message may come in bursts of any length.
        let Some(cycle_s) = message.cycle_time_s.filter(|_| message.pages <= 1) else { continue };
        let (span_s, awake_s) = (stats.last.since(stats.first), judge.observed.awake_s);
        let span_s = if awake_s + 1.0 < span_s { awake_s } else { span_s };
        // Leave out the time in which the sender slept while the bus was awake.
        let signals = judge.plan.signals.iter().zip(&judge.observed.series);
        let of_message = signals.filter(|(s, _)| (s.binding.bus, s.binding.id) == (message.bus, message.id));
        let span_s = span_s - of_message.map(|(_, series)| series.missing_s).fold(0.0, f64::max);
        let period_s = span_s / (stats.count.max(2) - 1) as f64;
        if stats.count < 10 || period_s < 2.0 * cycle_s {
            continue;
        }
        let (period, span, cycle) = (seconds(period_s), seconds(span_s), seconds(cycle_s));
        warning(judge, Topic::Period, format!("{} arrives less often than the DBC states", message.name))
            .seen(format!("every {period} ({} frames in {span}), GenMsgCycleTime is {cycle}", stats.count))
            .why("frames are lost, a gateway drops some of them, or the DBC belongs to another version of the sender")
            .advice("if this period is intended, correct GenMsgCycleTime in the DBC");
    }
}
