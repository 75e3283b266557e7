//! Checks the sign and unit of the current, and the resistance of the cells. The checks compare the measured response
//! of the voltages to the current with the cell model.

use super::context::{EXPLAINED, Judge, error, find, warning};
use super::drift::Drift;
use super::text::{milli, number, percent, seconds, toml};
use super::unit::unit_of;
use super::{frozen, model};
use crate::wiring::evidence::Slope;
use crate::wiring::plan::SignalPlan;
use crate::wiring::report::{Severity, Topic, WiringFinding};

/// Smallest step of the current that is judged, as a fraction of the capacity per hour.
const SMALLEST_STEP: f64 = 0.02;
/// The resistance is reported if it is larger or smaller than the model's resistance by at least this factor.
const ODD_RATIO: f64 = 2.5;

pub(super) fn check(judge: &mut Judge<'_>) {
    if judge.observed.frames == 0 || judge.is_mixed_up {
        return;
    }
    frozen::check(judge);
    let Some((signal, series)) = judge.current() else { return };
    if series.count() == 0 || judge.cell_voltage().is_none() {
        return;
    }
    let drift = Drift::of(judge);
    // A charger that lowers the current as the voltage rises looks like an inverted sign.
    let is_possible = |slope: &Slope| slope.ohm > 0.0 || !judge.is_capacity_confirmed;
    let slope = cell_slope(judge).filter(|slope| slope.certainty() >= 1.0 && slope.r2 >= 0.2 && is_possible(slope));
    if let Some(slope) = slope {
        if slope.ohm < 0.0 {
            let why = "a discharge lowers the voltage, but here the voltage rises with the configured discharge";
            inverted(judge, signal, risen_by_steps(&slope), why);
        } else {
            let drop = milli(slope.ohm);
            judge.fine(format!(
                "the sign of the current is right: every ampere of discharge lowers a cell's voltage by {drop} mV"
            ));
        }
        if !judge.is_size_explained && !judge.is_model_wrong {
            resistance(judge, &slope);
        }
    } else if judge.is_capacity_confirmed {
        judge.fine("the sign of the current is right: the reported SOC follows it".to_owned());
    } else if let Some(drift) = drift.filter(Drift::is_opposite) {
        let why = "a discharge lowers the voltage (judged from steady current, which is less certain than steps)";
        inverted(judge, signal, drifted_against(&drift), why);
    } else if drift.is_some_and(|drift| drift.is_along()) {
        judge.fine("the sign of the current is right: the voltage drifts in the expected direction".to_owned());
    } else if series.extent.range() * judge.current_factor > SMALLEST_STEP * judge.pack_ah() {
        judge.unjudged("sign of the current, resistance: too few current steps for this voltage noise; listen longer");
    } else {
        judge.unjudged("sign of the current, resistance: the current hardly changed; drive or charge for a minute");
    }
    if !judge.has(&[Topic::CurrentSign, Topic::Unit]) && !judge.is_model_wrong {
        model::check(judge, drift);
        frozen::check_response(judge);
        model::check_estimator(judge);
    }
}

/// Whether steps show that the configured sign of the current is wrong.
pub(super) fn is_inverted(judge: &Judge<'_>) -> bool {
    cell_slope(judge).is_some_and(|slope| slope.certainty() >= 1.0 && slope.r2 >= 0.2 && slope.ohm < 0.0)
}

/// Slope of the voltage against the current, in ohm per cell. It is corrected for wrong units that `doctor` has found,
/// and for parallel strings.
fn cell_slope(judge: &Judge<'_>) -> Option<Slope> {
    let slope = judge.observed.slope()?;
    let by = judge.voltage_factor / judge.current_factor * f64::from(judge.plan.pack.strings.max(1));
    let largest_a = slope.largest_a * judge.current_factor;
    Some(Slope { ohm: slope.ohm * by, std_ohm: slope.std_ohm * by, largest_a, ..slope })
}

fn risen_by_steps(slope: &Slope) -> String {
    let (steps, largest, rise) = (slope.points, number(slope.largest_a), milli(-slope.ohm));
    let (sigma, explained) = (number(slope.t().abs().min(999.0).floor()), percent(slope.r2));
    format!(
        "over {steps} steps of up to {largest} A, the cells' voltage rises by {rise} mV per ampere of discharge \
         ({sigma} sigma; the current explains {explained} % of the changes)"
    )
}

fn drifted_against(drift: &Drift) -> String {
    let (span, against, expected) = (seconds(drift.seconds), milli(drift.against_v), milli(drift.expected_v));
    format!(
        "in {span} of steady current, the voltage drifted by {against} mV in the wrong direction (the cell model \
         expects {expected} mV in the other direction)"
    )
}

pub(super) fn inverted(judge: &mut Judge<'_>, signal: &SignalPlan, seen: String, why: &str) {
    let is_csv = judge.plan.is_csv;
    let finding = error(judge, Topic::CurrentSign, "the sign of the current is inverted").seen(seen).why(why);
    if is_csv {
        finding.advice(
            "the file's columns are in packwatch's units: replay it with --csv-sign charge, or without it if it was given",
        );
    } else {
        let is_charge = signal.binding.scale < 0.0;
        finding.change(&signal.table, "positive", if is_charge { "\"discharge\"" } else { "\"charge\"" });
    }
}

fn resistance(judge: &mut Judge<'_>, slope: &Slope) {
    let Some(model) = &judge.plan.pack.model else { return };
    let (fast, slow) = judge.model_ohm(model, judge.observed.slope_block_s());
    let ohm = slope.ohm.abs();
    let is_large = slope.largest_a >= SMALLEST_STEP * judge.pack_ah() || ohm > slow;
    if slope.r2 < EXPLAINED || !is_large {
        judge.unjudged("resistance: the steps of the current are small against the noise; drive for a minute");
        return;
    }
    let (measured, from, to, points) = (milli(ohm), milli(fast), milli(slow), slope.points);
    let seen = format!(
        "a cell's voltage changes by {measured} mV per ampere over {points} steps; the model says {from} to {to} at {} \
         degrees C",
        number(judge.temperature_c())
    );
    let (ratio, direction, why) = if ohm > slow {
        let why = "the cell is of another type, aged or very cold, or the number of parallel cells is wrong";
        (ohm / slow, "higher", why)
    } else {
        (fast / ohm, "lower", "the cell is of another type, or parallel cells share one voltage tap")
    };
    let pack = &judge.plan.pack;
    let configured = pack.strings;
    let strings = likely_strings(configured, ohm, (fast, slow));
    // Only a wrong unit or the model of another cell explains such a ratio.
    if ratio >= 6.0 {
        current_unit(judge, seen, power_of_ten(ohm / (fast * slow).sqrt()), ratio);
    } else if ohm < fast && pack.label.is_some() && judge.is_capacity_confirmed {
        judge.fine(format!("the cells are made for high power, and the reported SOC confirms their capacity: {seen}"));
    } else if ratio >= ODD_RATIO || ratio >= 2.0 && strings.is_some_and(|n| n < configured) {
        // If the model is derived from a label (chemistry and capacity), its resistance is proportional to 1 /
        // capacity.
        let (key, text) = pack.capacity_change(pack.capacity_ah * (fast * slow).sqrt() / ohm);
        let is_label = pack.label.is_some();
        let title = format!("the resistance is {} times {direction} than in the cell model", number(ratio));
        let finding = warning(judge, Topic::CellModel, title).seen(seen).why(why);
        if let Some(strings) = strings.filter(|_| !is_label) {
            finding.change("pack", "strings", strings.to_string());
        }
        finding
            .alternative("pack", key, text)
            .advice("the estimator itself learns a resistance of 0.3 to 3 times the model's");
    } else if slope.ohm > 0.0 {
        judge.fine(format!("the resistance is plausible: {seen}"));
    }
}

/// A different number of parallel strings that would explain the resistance.
fn likely_strings(configured: u16, ohm: f64, (fast, slow): (f64, f64)) -> Option<u16> {
    let by_string = ohm / f64::from(configured);
    // If the number exceeds `u16`, the cast saturates. The caller ignores such a number, because the ratio of the
    // resistances is then too large.
    let strings = (((fast * slow).sqrt() / by_string).round() as u16).max(1);
    // A cell's resistance usually differs from its model's resistance by a factor of less than 1.3.
    let is_like = (fast / 1.3..=slow * 1.3).contains(&(by_string * f64::from(strings)));
    (is_like && strings != configured).then_some(strings)
}

fn power_of_ten(ratio: f64) -> f64 {
    10_f64.powf(ratio.log10().round())
}

/// The power of ten that corrects the current, judged from its steps; `None` if it is unknown or 1.
pub(super) fn factor_by_steps(judge: &Judge<'_>) -> Option<f64> {
    let slope = cell_slope(judge)?;
    let (fast, slow) = judge.model_ohm(judge.plan.pack.model.as_ref()?, judge.observed.slope_block_s());
    let factor = power_of_ten(slope.ohm.abs() / (fast * slow).sqrt());
    (slope.certainty() >= 1.0 && slope.r2 >= EXPLAINED && factor != 1.0).then_some(factor)
}

fn current_unit(judge: &mut Judge<'_>, seen: String, factor: f64, ratio: f64) {
    let Some((signal, _)) = judge.current() else { return };
    judge.current_factor *= factor;
    let severity = if (0.05..20.0).contains(&factor) { Severity::Warning } else { Severity::Error };
    let why = format!("the resistance is off by a factor of {}, too much for ageing or cold", number(ratio));
    wrong_unit_or_cell(judge, signal, factor, severity).seen(seen).why(why);
}

/// Reports that the current fits the cell model only if it is multiplied by `factor`. Either the unit of the current or
/// the configured cell model is wrong. If the DBC states ampere and the configuration does not scale the signal, the
/// unit is probably right. In that case, the finding names the cell model first.
pub(super) fn wrong_unit_or_cell<'j>(
    judge: &'j mut Judge<'_>,
    signal: &SignalPlan,
    factor: f64,
    severity: Severity,
) -> &'j mut WiringFinding {
    let times = number(factor.max(1.0 / factor));
    let size = if factor < 1.0 { "larger" } else { "smaller" };
    let is_ampere = unit_of(&signal.unit).is_some_and(|(_, unit, _)| unit == 1.0) && signal.scale == 1.0;
    let (scale, strings) = (toml(signal.scale * factor), judge.plan.pack.strings);
    if is_ampere {
        let title = format!("the cells are about {times} times {size} than in the cell model");
        let (key, text) = judge.plan.pack.capacity_change(judge.plan.pack.capacity_ah / factor);
        return find(judge, severity, Topic::CellModel, title).change("pack", key, text).advice(format!(
            "other possible causes: {} is off by that factor (scale = {scale}), or pack.strings is not {strings}",
            signal.name
        ));
    }
    let mark = if severity == Severity::Warning { "?" } else { "" };
    find(judge, severity, Topic::Unit, format!("pack current: off by a factor of {times}{mark}"))
        .change(&signal.table, "scale", scale)
        .advice(format!(
            "other possible causes: the cells are {times} times {size} than in the cell model, or pack.strings is not {strings}"
        ))
}
