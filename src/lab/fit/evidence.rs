//! Writes notes on quantities that the logs do not determine. The fit keeps the initial model's values for these
//! quantities.
//!
//! A stretch is a part of a log without gaps.

use crate::filter::{ends, median};
use crate::ident::MeasuredPart;
use crate::ident::record::Record;

#[derive(Debug, Clone, Copy)]
pub(super) struct Capacity {
    pub(super) mean_ah: f64,
    pub(super) std_ah: f64,
}

pub(super) fn notes(parts: &[&MeasuredPart], records: &[Record], before: Capacity, after: Capacity) -> Vec<String> {
    let mut notes = Vec::new();
    // The logs do not show the capacity if over 70 % of its relative standard deviation remains after the fit.
    let is_unshown = after.std_ah / after.mean_ah > 0.7 * before.std_ah / before.mean_ah;
    if is_unshown {
        notes.push(
            "the logs do not show the capacity: it stays near the value in the model that the fit started from"
                .to_owned(),
        );
    }
    let span = records.iter().map(span).fold(0.0, f64::max);
    if span < 0.3 {
        notes.push(format!(
            "no log moves more than {:.0} % of the charge: the curve outside this range is that of the model the fit started from",
            100.0 * span
        ));
    }
    // A current below C/50 (discharge in 50 h) counts as rest.
    let rest_a = after.mean_ah / 50.0;
    let (mut rest_s, mut moved) = (0.0, [0.0; 2]);
    for row in records.iter().flat_map(|record| &record.rows) {
        rest_s += if row.mean_current_a.abs() < rest_a { row.dt_s } else { 0.0 };
        let soc = row.mean_current_a * row.dt_s / 3600.0 / after.mean_ah;
        moved[usize::from(soc < 0.0)] += soc.abs();
    }
    if rest_s < 300.0 {
        notes.push(
            "no rest in the logs: the curve and slow resistances are separated only by their typical sizes".to_owned(),
        );
    }
    for (moved, direction) in moved.iter().zip(["discharge", "charge"]) {
        if *moved < 0.02 {
            notes.push(format!("no {direction} in the logs: its voltages are extrapolated"));
        }
    }
    let (low_c, high_c) = ends(parts.iter().flat_map(|part| &part.temperature_c).copied());
    if high_c - low_c < 1e-6 {
        let what =
            "no temperature in the logs, or a constant one: its effect on the resistances is that of typical cells";
        notes.push(what.to_owned());
    }
    let intervals_s = parts.iter().flat_map(|part| part.time_s.windows(2).map(|pair| pair[1] - pair[0]));
    let interval_s = median(intervals_s).unwrap_or(0.0);
    if interval_s > 3.0 {
        notes.push(format!(
            "readings every {interval_s:.0} s: the series resistance cannot be separated from the fastest branch"
        ));
    }
    let step_v = step_v(parts);
    if step_v > 0.01 {
        notes.push(format!("voltages in steps of {:.0} mV: curve and resistances are less accurate", 1e3 * step_v));
    }
    notes
}

fn span(record: &Record) -> f64 {
    let (low, high) = record.judged_ends();
    (high - low).max(0.0)
}

/// Returns the resolution of the voltage: the smallest difference between consecutive unequal readings (V).
fn step_v(parts: &[&MeasuredPart]) -> f64 {
    let of_part = |part: &&MeasuredPart| {
        let pairs = part.voltage_v.windows(2).take(2000).map(|pair| (pair[1] - pair[0]).abs());
        pairs.filter(|step_v| *step_v > 1e-6).fold(f64::INFINITY, f64::min)
    };
    let least_v = parts.iter().map(of_part).fold(f64::INFINITY, f64::min);
    if least_v.is_finite() { least_v } else { 0.0 }
}
