//! Compares the values that the pack itself reports (state of charge and health) with the counted charge and with the
//! voltages. A wrong number of cells, chemistry, capacity or current contradicts these values.

use super::context::{EXPLAINED, Judge, error, find};
use super::electrical;
use super::ocv::{self, OcvEstimate};
use super::text::{number, percent, toml};
use crate::cell::{CellModel, Chemistry, Label};
use crate::filter::{ends, median};
use crate::quantity::Channel;
use crate::wiring::evidence::HIDDEN_SOC;
use crate::wiring::evidence::usage::{ChargeSlope, Moment};
use crate::wiring::plan::{SignalPlan, two_digits};
use crate::wiring::report::{Severity, Topic};

/// Minimum change of a reported state of charge that is compared with the counted charge.
const LEAST_RANGE: f64 = 0.05;
/// The voltage is compared with a reported state of charge at many times. The two contradict each other if they
/// disagree at more than this share of the times. They fit each other if they agree at no less than this share.
const MOST: f64 = 0.75;

/// Usual ratios of the counted to the configured capacity.
const USUAL: std::ops::RangeInclusive<f64> = 0.55..=1.3;

/// A reported state of charge: its signal, and its place in the record of the pack's use.
type Reported<'d> = (&'d SignalPlan, usize);

pub(super) fn check_charge(judge: &mut Judge<'_>) {
    if judge.is_mixed_up || judge.has(&[Topic::Unit, Topic::Layout, Topic::Swapped]) {
        return;
    }
    let Some((current, series)) = judge.current().filter(|(_, series)| series.count() > 0) else { return };
    let found = reported(judge, Channel::ReportedSoc).into_iter().find_map(|(signal, place)| {
        let slope = ChargeSlope::of(judge.observed.usage.moments(), place)?;
        (slope.range >= LEAST_RANGE && slope.distinct >= 5).then_some((signal, slope))
    });
    let pack_ah = judge.pack_ah();
    let is_explained =
        |slope: &ChargeSlope| slope.r2 >= EXPLAINED && USUAL.contains(&(slope.capacity_ah / pack_ah).abs());
    if let Some((signal, slope)) = found.filter(|(_, slope)| series.is_constant() && !is_explained(slope)) {
        return constant(judge, current, signal, slope);
    }
    let dead_a = judge.plan.pack.dead_band_a;
    let side = match (series.extent.min >= -dead_a, series.extent.max <= dead_a) {
        (true, false) => Some(("negative", true)),
        (false, true) => Some(("positive", false)),
        _ => None,
    };
    if let Some((side, is_rise)) = side.filter(|_| !electrical::is_inverted(judge)) {
        // If the pack was both charged and discharged, a current with only one sign has lost its sign. If the pack was
        // only charged or only discharged, the sign may be inverted instead, so no missing sign is reported.
        let has_both = |slope: ChargeSlope| slope.rise.min(slope.fall) >= LEAST_RANGE;
        let is_by_soc = found.is_some_and(|(_, slope)| slope.r2 < EXPLAINED && has_both(slope));
        if is_by_soc || ocv::moves_against(judge, true) && ocv::moves_against(judge, false) {
            let verb = if is_rise { "rise" } else { "fall" };
            let what = if is_by_soc { "reported SOC and the voltages" } else { "voltages" };
            return one_sided(judge, current, side, &format!("{what} {verb}"));
        }
    }
    let Some((signal, slope)) = found else { return too_much(judge, current) };
    let ratio = slope.capacity_ah / pack_ah;
    judge.is_capacity_confirmed = is_explained(&slope) && ratio > 0.0;
    if is_explained(&slope) && ratio < 0.0 && !electrical::is_inverted(judge) {
        judge.is_mixed_up = true;
        let seen = format!("{} rises with the configured discharge that {} counts", signal.name, current.name);
        return electrical::inverted(judge, current, seen, "a discharge lowers the state of charge");
    }
    let [counted, range] = [slope.charge_range_ah, 100.0 * slope.range].map(number);
    if slope.r2 < 0.3 {
        judge.is_mixed_up = true;
        error(judge, Topic::Swapped, "pack current: the reported SOC does not follow it")
            .seen(format!(
                "{} changes by up to {range} %, and {} counts up to {counted} Ah, without a relation between the two",
                signal.name, current.name
            ))
            .why("the charge that flows changes the state of charge: this signal is not the pack's current")
            .change(&current.table, "signal", "the signal of the measured current");
    } else if slope.r2 >= EXPLAINED && ratio > 0.0 && !USUAL.contains(&ratio) {
        size(judge, (signal, current), slope, ratio);
    }
}

/// Reports a counted charge that exceeds what a pack of the configured capacity can hold.
fn too_much(judge: &mut Judge<'_>, current: &SignalPlan) {
    let moments = judge.observed.usage.moments();
    let counted = |stretch: &[Moment]| {
        let (low, high) = ends(stretch.iter().map(|moment| moment.charge_ah));
        high - low
    };
    let largest_ah = moments.chunk_by(|a, b| a.stretch == b.stretch).map(counted).fold(0.0, f64::max);
    let pack_ah = judge.pack_ah();
    // The charge counted over a full discharge equals the capacity. In a long log, the offset of the current sensor
    // adds to it, so up to twice the capacity is accepted.
    if largest_ah <= 2.0 * pack_ah {
        return;
    }
    let [largest, pack] = [largest_ah, pack_ah].map(number);
    error(judge, Topic::Unit, "pack current: more charge flows than the pack holds")
        .seen(format!("{} counts {largest} Ah in one direction; the pack has {pack} Ah", current.name))
        .why("the signal is not the current, its scale or offset is wrong, or the configured capacity is too small")
        .change(&current.table, "signal", "the signal of the measured current");
}

/// Reports a constant current although the reported state of charge changes.
fn constant(judge: &mut Judge<'_>, current: &SignalPlan, signal: &SignalPlan, slope: ChargeSlope) {
    let value = judge.current().map_or_else(String::new, |(_, series)| number(series.extent.last));
    judge.is_mixed_up = true;
    error(judge, Topic::Frozen, "pack current: the value never changes, but the reported SOC does")
        .seen(format!(
            "{} is {value} in all readings, while {} changes by {} %",
            current.name,
            signal.name,
            number(100.0 * slope.range)
        ))
        .why("only a current changes the state of charge: this signal is a counter, a setting or a default")
        .change(&current.table, "signal", "the signal of the measured current");
}

/// Reports a current that has only one sign although the pack was charged and discharged.
fn one_sided(judge: &mut Judge<'_>, current: &SignalPlan, side: &str, movement: &str) {
    let series = judge.current().map(|(_, series)| (number(series.extent.min), number(series.extent.max)));
    let (low, high) = series.unwrap_or_default();
    judge.is_mixed_up = true;
    let title = format!("the current is never {side}, but the {movement}");
    error(judge, Topic::CurrentSign, title)
        .seen(format!("{} reads {low} to {high} A", current.name))
        .why("a pack that is charged and discharged has a current of both signs: this signal is only the size of the current")
        .advice("the sign is elsewhere in the message: a sign bit, a direction byte or a second signal");
}

/// Reports that the counted charge does not fit the configured capacity.
fn size(judge: &mut Judge<'_>, (signal, current): (&SignalPlan, &SignalPlan), slope: ChargeSlope, ratio: f64) {
    let strings = f64::from(judge.plan.pack.strings.max(1));
    let [measured, configured] = [slope.capacity_ah, judge.pack_ah()].map(number);
    judge.is_size_explained = true;
    let (cell_ah, scale) = (slope.capacity_ah / strings, current.scale / ratio);
    // The capacity of a used pack differs from its label, so a scale near 1 is probably 1.
    let scale = if (0.8..=1.25).contains(&scale) { 1.0 } else { two_digits(scale) };
    let seen = format!(
        "{} falls from 100 to 0 % over {measured} Ah counted from {}; {configured} Ah are configured",
        signal.name, current.name
    );
    let why = "a worn pack has at least half of its capacity, and a new one hardly more than the label says";
    if current.scale == 1.0 {
        let (key, text) = judge.plan.pack.capacity_change(cell_ah);
        // A dashboard may show 25 to 90 % of the capacity as 0 to 100 %.
        let may_be_dashboard = ratio < 1.0 && USUAL.contains(&(ratio / 0.65));
        let severity = if may_be_dashboard { Severity::Note } else { Severity::Error };
        let title = format!("the capacity is about {measured} Ah, {configured} Ah are configured");
        find(judge, severity, Topic::CellModel, title).seen(seen).why(why).change("pack", key, text).advice(format!(
            "another possible cause: {} is off by that factor (scale = {})",
            current.name,
            toml(scale)
        ));
    } else {
        let times = number(ratio.max(1.0 / ratio));
        error(judge, Topic::Unit, format!("pack current: off by a factor of {times}"))
            .seen(seen)
            .why(why)
            .change(&current.table, "scale", toml(scale))
            .advice(format!("another possible cause: the capacity is {measured} Ah"));
    }
}

/// The signals that report `channel` and have values, the configured ones first.
pub(super) fn reported<'d>(judge: &Judge<'d>, channel: Channel) -> Vec<Reported<'d>> {
    let witnesses = judge.observed.witnesses.iter().enumerate();
    let of_channel = witnesses.map(|(place, witness)| (judge.plan.witness(*witness), place));
    // If a value is always zero, this pack does not send it.
    let is_sent = |value: f64| value.is_finite() && value != 0.0;
    let is_heard = |place: usize| judge.observed.usage.moments().iter().any(|m| is_sent(m.reported[place]));
    of_channel.filter(|(signal, place)| signal.binding.channel == channel && is_heard(*place)).collect()
}

/// Finds exchanged states of charge and health, either by their names or because only the reported health follows the
/// charge.
pub(super) fn check_swapped(judge: &mut Judge<'_>) {
    let configured =
        |channel| judge.plan.signals.iter().enumerate().find(|(_, signal)| signal.binding.channel == channel);
    let (soc, soh) = (configured(Channel::ReportedSoc), configured(Channel::ReportedSoh));
    let says = |signal: Option<(usize, &SignalPlan)>, soc: bool| {
        signal.is_some_and(|(_, signal)| {
            let label = signal.label();
            (label.says_soc(), label.says_soh()) == (soc, !soc)
        })
    };
    let slope = |channel| {
        let place = reported(judge, channel).first()?.1;
        ChargeSlope::of(judge.observed.usage.moments(), place)
    };
    let is_by_charge = match (slope(Channel::ReportedSoc), slope(Channel::ReportedSoh)) {
        (Some(soc), Some(soh)) => {
            soc.range < 0.01 && soh.range >= LEAST_RANGE && soh.r2 >= 0.5 && soh.capacity_ah > 0.0
        }
        _ => false,
    };
    let (Some((_, first)), is_by_name) = (soc.or(soh), says(soc, false) || says(soh, true)) else { return };
    if !is_by_name && !is_by_charge {
        return;
    }
    let (title, second) = match (soc, soh) {
        (Some(_), Some((_, soh))) => ("reported SOC and reported SOH are exchanged", Some(soh)),
        (Some(_), None) => ("reported SOC is read from a state of health", None),
        _ => ("reported SOH is read from a state of charge", None),
    };
    let why = match is_by_name {
        true => "the names of the signals say so",
        false => "a state of charge follows the charge that flows; a state of health changes over months",
    };
    let names = second.map_or_else(|| first.name.clone(), |second| format!("{}; {}", first.name, second.name));
    let proposed = second.map_or_else(|| "the signal of that value".to_owned(), |second| format!("{:?}", second.name));
    judge.is_soc_wrong = true;
    let finding = error(judge, Topic::Swapped, title).seen(format!("configured in this order: {names}"));
    finding.why(why).change(&first.table, "signal", proposed);
    if let Some(second) = second {
        finding.change(&second.table, "signal", format!("{:?}", first.name));
    }
}

/// Compares the reported state of charge with the voltage. Reports a contradiction that a wrong number of cells or a
/// wrong chemistry explains.
pub(super) fn check_voltage(judge: &mut Judge<'_>) {
    let is_unclear = judge.is_mixed_up || judge.has(&[Topic::Layout, Topic::CellCount, Topic::CurrentSign]);
    let Some(model) = judge.plan.pack.model.as_ref().filter(|_| !is_unclear && !judge.is_soc_wrong) else { return };
    let estimates = ocv::estimates(judge);
    let socs = reported(judge, Channel::ReportedSoc);
    let Some(&(signal, place)) = socs.first() else { return };
    let with_soc = |estimate: &OcvEstimate| Some((*estimate, estimate.reported[place])).filter(|(_, s)| s.is_finite());
    let points: Vec<(OcvEstimate, f64)> = estimates.iter().filter_map(with_soc).collect();
    if points.len() < 5 || outside(judge, &points, model, 1.0) <= MOST {
        return;
    }
    let counts = cell_counts(judge, &points, model);
    let chemistry = fitting_chemistry(judge, &points);
    let soc = median(points.iter().map(|point| point.1)).unwrap_or(f64::NAN);
    let cell_v = median(points.iter().map(|point| point.0.voltage_v)).unwrap_or(f64::NAN);
    let by_model = model.soc_of_ocv(cell_v, judge.temperature_c()).clamp(0.0, 1.0);
    let of_total = match judge.plan.pack.is_total {
        true => {
            format!(" ({} V of {} cells)", number(cell_v * f64::from(judge.plan.pack.cells)), judge.plan.pack.cells)
        }
        false => String::new(),
    };
    let seen = format!(
        "{} says {} %; {} V per cell{of_total} is {} % according to {}",
        signal.name,
        percent(soc),
        number(cell_v),
        percent(by_model),
        model.name
    );
    contradiction(judge, seen, counts, chemistry);
}

fn contradiction(judge: &mut Judge<'_>, seen: String, counts: Option<(u16, u16)>, chemistry: Option<Chemistry>) {
    let counts = counts.map(|(low, high)| if low == high { low.to_string() } else { format!("{low} to {high}") });
    let (topic, title) = match (&counts, chemistry) {
        (Some(counts), None) => {
            (Topic::CellCount, format!("the number of cells contradicts the reported SOC: {counts} cells fit"))
        }
        (None, Some(chemistry)) => {
            let name = chemistry.name();
            (Topic::CellModel, format!("the chemistry contradicts the reported SOC: the cells are {name}"))
        }
        (Some(counts), Some(chemistry)) => (
            Topic::CellCount,
            format!(
                "the number of cells or the chemistry contradicts the reported SOC: {counts} cells fit, or {}",
                chemistry.name()
            ),
        ),
        // The controller may have lost count, so its state of charge may be wrong.
        (None, None) => return judge.unjudged(format!("reported SOC: it contradicts the voltage; {seen}")),
    };
    judge.is_model_wrong = true;
    let model = chemistry.map(|chemistry| judge.plan.pack.chemistry_change(chemistry));
    let finding = error(judge, topic, title)
        .seen(seen)
        .why("the voltage of a cell shows its state of charge, and the pack reports another one");
    if let Some(counts) = counts {
        let is_one = counts.parse::<u16>().is_ok();
        let text = if is_one { counts } else { format!("{counts}, the number in the pack's documentation") };
        finding.change("pack", "cells", text);
    }
    if let Some((key, text)) = model {
        finding.alternative("pack", key, text);
    }
}

/// Share of the moments whose voltage per cell, multiplied by `factor`, does not fit the reported state of charge.
fn outside(judge: &Judge<'_>, points: &[(OcvEstimate, f64)], model: &CellModel, factor: f64) -> f64 {
    let (temperature_c, dead_a) = (judge.temperature_c(), judge.plan.pack.dead_band_a);
    let ocv_v = |soc: f64| model.ocv_v(&model.grid_position(soc.clamp(0.0, 1.0), temperature_c));
    let is_outside = |(estimate, soc): &&(OcvEstimate, f64)| {
        // A dashboard hides a reserve, most of it below 0 %.
        let reserve = (0.25 * (1.0 - soc)).max(HIDDEN_SOC);
        let may_be_full = soc + reserve >= 1.0 && estimate.current_a <= dead_a;
        let (low_v, high_v) = (ocv_v(soc - HIDDEN_SOC), ocv_v(soc + reserve));
        // While a pack is full, the charger holds the voltage above the curve.
        let high_v = if may_be_full { high_v.max(model.voltage_max_v) } else { high_v };
        !(low_v - estimate.slack_v..=high_v + estimate.slack_v).contains(&(estimate.voltage_v * factor))
    };
    points.iter().filter(is_outside).count() as f64 / points.len().max(1) as f64
}

fn cell_counts(judge: &Judge<'_>, points: &[(OcvEstimate, f64)], model: &CellModel) -> Option<(u16, u16)> {
    let configured = judge.plan.pack.cells;
    if !judge.plan.pack.is_total {
        return None;
    }
    let fits = |cells: &u16| outside(judge, points, model, f64::from(configured) / f64::from(*cells)) <= 1.0 - MOST;
    // A number that is off by more than a factor of two gives an impossible voltage, which another check reports.
    let mut fitting = (configured / 2 + 1..configured.saturating_mul(2)).filter(fits);
    let first = fitting.next()?;
    Some((first, fitting.next_back().unwrap_or(first)))
}

/// The first other chemistry that agrees with the reported state of charge.
fn fitting_chemistry(judge: &Judge<'_>, points: &[(OcvEstimate, f64)]) -> Option<Chemistry> {
    let rated_ah = judge.plan.pack.capacity_ah;
    let order = [Chemistry::NmcGraphite, Chemistry::LfpGraphite, Chemistry::LmoGraphite, Chemistry::LcoGraphite];
    let own = judge.plan.pack.label.map(|label| label.chemistry);
    let mut others = order.into_iter().filter(|chemistry| Some(*chemistry) != own);
    others.find(|chemistry| {
        let model = Label::usual(*chemistry, rated_ah).model();
        model.is_some_and(|model| outside(judge, points, &model, 1.0) <= 1.0 - MOST)
    })
}
