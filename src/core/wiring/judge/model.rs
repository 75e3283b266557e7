//! Checks the open-circuit voltage (against the cell model), the current's offset, the noise of the voltages, and the
//! results of the estimator.

use super::context::{Judge, error, note, warning};
use super::drift::Drift;
use super::ocv::{self, OcvEstimate};
use super::reported::reported;
use super::text::{milli, number, percent, seconds, toml};
use crate::cell::{CellModel, Chemistry};
use crate::filter::{ends, median};
use crate::quantity::Channel;
use crate::wiring::evidence::Series;
use crate::wiring::plan::Kind;
use crate::wiring::report::Topic;

pub(super) fn check(judge: &mut Judge<'_>, drift: Option<Drift>) {
    if let Some(model) = &judge.plan.pack.model {
        open_circuit(judge, model, drift);
    }
    offset(judge);
    noise(judge);
}

fn open_circuit(judge: &mut Judge<'_>, model: &CellModel, drift: Option<Drift>) {
    let temperature_c = judge.temperature_c();
    let [empty_v, full_v] = [0.0, 1.0].map(|soc| ocv_v(model, soc, temperature_c));
    let mut rests = judge.observed.fast_response().rests.iter().map(|rest| rest.end_v);
    // Without rests, use the voltage under load, corrected for the current.
    let loaded = ocv::estimates(judge);
    let loaded_v = median(loaded.iter().map(|estimate| estimate.voltage_v)).filter(|_| loaded.len() >= 5);
    let (lowest, highest) = match ends(rests.clone()) {
        (low, high) if low <= high => (low, high),
        _ => (loaded_v.unwrap_or(f64::NAN), loaded_v.unwrap_or(f64::NAN)),
    };
    let per_cent = |voltage_v: f64| percent(model.soc_of_ocv(voltage_v, temperature_c).clamp(0.0, 1.0));
    // A flat curve does not show the state of charge, so it cannot predict a drift.
    let is_model_flat = ocv_v(model, 0.8, temperature_c) - ocv_v(model, 0.3, temperature_c) < FLAT_V;
    let is_flat = |drift: &Drift| {
        !is_model_flat && drift.expected_v > 0.03 && drift.sigma > 0.0 && (-0.05..0.15).contains(&drift.ratio)
    };
    let pack = &judge.plan.pack;
    let cell_v = judge.cell_voltage();
    let limit_v = if is_held_full(judge, &loaded, full_v) { full_v.max(model.voltage_max_v) } else { full_v } + 0.06;
    if highest > limit_v || lowest < empty_v - 0.06 {
        let off_v = if highest > limit_v { highest } else { lowest };
        let (off, low, high) = (number(off_v), number(empty_v), number(full_v));
        let (key, text) = chemistry(judge, off_v);
        error(judge, Topic::CellModel, "the resting voltage is not on the cell model's curve")
            .seen(format!("{off} V at rest; the curve of {} runs from {low} to {high} V", model.name))
            .why("a rested cell shows its open-circuit voltage: the chemistry or the number of cells is wrong")
            .change("pack", key, text);
    } else if let Some(drift) = drift.filter(is_flat) {
        let (span, expected) = (seconds(drift.seconds), milli(drift.expected_v));
        let moved = milli(drift.expected_v * drift.ratio.max(0.0));
        let is_lfp = cell_v.is_some_and(|v| LFP_V.contains(&v));
        let lfp = pack.chemistry_change(Chemistry::LfpGraphite);
        let (key, text) = if is_lfp { lfp } else { pack.capacity_change(pack.capacity_ah / drift.ratio.max(0.1)) };
        warning(judge, Topic::CellModel, "the voltage changes much less than in the cell model")
            .seen(format!("in {span} of steady current, it changed by {moved} mV; the model expects {expected} mV"))
            .why("the cells are iron phosphate (LFP), which has a flat curve, or much larger than the cell model says")
            .change("pack", key, text);
    } else if let Some(cell_v) = judge.cell_voltage().filter(|v| is_like_iron_phosphate(judge, model, *v)) {
        let (voltage, soc) = (number(cell_v), per_cent(cell_v));
        let title = "either the pack is nearly empty, or its cells are iron phosphate (LFP)";
        let (key, text) = pack.chemistry_change(Chemistry::LfpGraphite);
        note(judge, Topic::CellModel, title)
            .seen(format!("the median cell has {voltage} V; according to {}, that is {soc} %", model.name))
            .why("iron-phosphate cells stay near 3.3 V from full to empty")
            .change("pack", key, text)
            .advice("compare with the SOC that the vehicle shows");
    } else if let Some(last_v) = rests.next_back() {
        let (voltage, soc) = (number(last_v), per_cent(last_v));
        let text = format!("{voltage} V at rest: {soc} % according to the cell model");
        judge.fine(format!("{text}; compare with the SOC that the vehicle shows"));
    } else {
        judge.unjudged("open-circuit voltage: the pack did not rest; leave it without load for a minute");
    }
}

/// Whether the voltage is above the model's curve only because a charger holds it there. True if the pack is hardly
/// discharged at these voltages, and reports that it is full. If the pack reports no state of charge, the first voltage
/// of the record must not be above the curve, so that the voltage was raised by a charge within the record.
fn is_held_full(judge: &Judge<'_>, estimates: &[OcvEstimate], full_v: f64) -> bool {
    let is_above = |estimate: &&OcvEstimate| estimate.voltage_v - estimate.slack_v > full_v;
    let above: Vec<&OcvEstimate> = estimates.iter().filter(is_above).collect();
    let discharged = above.iter().filter(|estimate| estimate.current_a > judge.plan.pack.dead_band_a).count();
    let is_charged = estimates.first().is_some_and(|first| !is_above(&first));
    let place = reported(judge, Channel::ReportedSoc).first().map(|(_, place)| *place);
    let soc = place.and_then(|place| median(above.iter().map(|e| e.reported[place]).filter(|soc| soc.is_finite())));
    10 * discharged <= above.len() && soc.map_or(is_charged, |soc| soc >= 0.9)
}

/// If the voltage rises by less than this from 30 to 80 % (V), the curve is flat. LFP rises by 0.06 V, other
/// chemistries by at least 0.3 V.
const FLAT_V: f64 = 0.15;

fn ocv_v(model: &CellModel, soc: f64, temperature_c: f64) -> f64 {
    model.ocv_v(&model.grid_position(soc, temperature_c))
}

/// Voltages of an iron-phosphate cell at rest, except near empty and full (V).
const LFP_V: std::ops::Range<f64> = 3.18..3.38;

fn is_like_iron_phosphate(judge: &Judge<'_>, model: &CellModel, cell_v: f64) -> bool {
    ocv_v(model, 0.5, judge.temperature_c()) > 3.5 && LFP_V.contains(&cell_v)
}

/// Configuration key and proposed value for the chemistry that a resting voltage suggests.
fn chemistry(judge: &Judge<'_>, voltage_v: f64) -> (&'static str, String) {
    let pack = &judge.plan.pack;
    match voltage_v {
        v if v < 2.0 => ("cell_model", "the model of the installed cell".to_owned()),
        v if v < 2.95 => ("cell_model", "a model of a titanate cell (LTO), if it is one".to_owned()),
        v if v < 3.45 => pack.chemistry_change(Chemistry::LfpGraphite),
        _ => pack.chemistry_change(Chemistry::NmcGraphite),
    }
}

/// Reports a steady current that is near zero but outside the dead band.
fn offset(judge: &mut Judge<'_>) {
    let rests = &judge.observed.fast_response().rests;
    let Some((signal, _)) = judge.current() else { return };
    let Some(longest) = rests.iter().max_by(|a, b| a.seconds.total_cmp(&b.seconds)) else { return };
    let (offset_a, dead_band_a) = (longest.current_a, judge.plan.pack.dead_band_a);
    let (offset, band) = (number(offset_a), number(dead_band_a));
    if offset_a.abs() <= dead_band_a {
        return judge.fine(format!("current at rest {offset} A, within the dead band of {band} A"));
    }
    // The proposed offset has the sign convention of the bus and includes the configured offset.
    let proposed = signal.offset - offset_a * signal.binding.scale.signum();
    let (span, voltage) = (seconds(longest.seconds), number(longest.end_v));
    let title = format!("the current stays at {offset} A while the voltage rests");
    note(judge, Topic::CurrentOffset, title)
        .seen(format!("for {span} at {voltage} V; the pack counts as resting up to {band} A"))
        .why("either a load draws this current, or it is the sensor's offset")
        .change(&signal.table, "offset", toml(proposed))
        .advice("change the offset only if the contactors are open; otherwise raise transition.dead_band_a");
}

fn noise(judge: &mut Judge<'_>) {
    let configured_v = judge.plan.pack.voltage_noise_v;
    let Some(noise_v) = judge.median_of(Kind::Voltage, Series::noise).map(|v| v / judge.cells_per_reading()) else {
        return;
    };
    if configured_v > 0.0 && noise_v > 4.0 * configured_v {
        let (measured, configured) = (milli(noise_v), milli(configured_v));
        note(judge, Topic::Noise, "voltages are noisier than configured")
            .seen(format!("about {measured} mV from reading to reading, {configured} mV configured"))
            .why("the estimator trusts such readings too much")
            .change("estimator", "voltage_noise_v", toml((noise_v * 1e4).round() / 1e4));
    }
}

/// Checks the share of voltages that the estimator rejected.
pub(super) fn check_estimator(judge: &mut Judge<'_>) {
    const FEWEST: u64 = 200;
    let stats = &judge.observed.estimator;
    if stats.estimates < FEWEST {
        return;
    }
    let rejected = stats.rejected as f64 / stats.estimates as f64;
    let bias = milli(stats.innovation_sum / stats.estimates as f64);
    if rejected > 0.1 && !judge.has(&[Topic::CellModel, Topic::Cell, Topic::Frozen, Topic::CellCount]) {
        let share = percent(rejected);
        let (key, text) = judge.plan.pack.model_change();
        warning(judge, Topic::CellModel, "the estimator rejects many voltages")
            .seen(format!("{share} % of {} readings are beyond its gate; mean deviation {bias} mV", stats.estimates))
            .why("the voltages of the model and the measured voltages disagree")
            .change("pack", key, text);
    } else {
        let share = percent(1.0 - rejected);
        judge.fine(format!("the estimator runs: {share} % of its readings accepted, mean deviation {bias} mV"));
    }
}
