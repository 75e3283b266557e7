//! Compares signals that are not configured with configured signals. The pack's voltage is compared with the sum of
//! the cell voltages. A second state of charge is compared with the configured one.

use super::context::{Judge, SignalSeries, find, warning};
use super::text::number;
use crate::quantity::Channel;
use crate::wiring::evidence::HIDDEN_SOC;
use crate::wiring::plan::Kind;
use crate::wiring::report::{Severity, Topic};

/// Because of sensor errors, the sum of the cell voltages can differ from the pack's voltage by at most this fraction.
const SUM_TOLERANCE: f64 = 0.03;
/// Maximum difference between two states of charge that agree.
const AGREEMENT: f64 = 0.03;

pub(super) fn check(judge: &mut Judge<'_>) {
    let is_clear = !judge.has(&[Topic::Unit, Topic::Layout, Topic::Swapped, Topic::Silent, Topic::CellCount]);
    pack_voltage(judge, is_clear);
    states_of_charge(judge);
}

/// The unconfigured signals that probably carry `channel`, each with the median of its values.
fn unconfigured<'d>(judge: &Judge<'d>, channel: Channel) -> Vec<(SignalSeries<'d>, f64)> {
    let all = judge.plan.unconfigured.iter().zip(&judge.observed.unconfigured);
    let wanted = all.filter(|(signal, _)| signal.binding.channel == channel);
    wanted.filter_map(|signal| Some((signal, signal.1.values.median()?))).collect()
}

/// Checks the pack's voltage. `is_clear`: whether all cells are read correctly. If not, only a wrong decimal place is
/// reported.
fn pack_voltage(judge: &mut Judge<'_>, is_clear: bool) {
    let medians_v = judge.signals(Kind::Voltage).into_iter().map(|(_, series)| series.values.median());
    let Some(medians_v) = medians_v.collect::<Option<Vec<f64>>>().filter(|_| !judge.plan.pack.is_total) else { return };
    let sum_v: f64 = medians_v.iter().sum();
    if sum_v <= 0.0 {
        return;
    }
    let candidates = unconfigured(judge, Channel::PackVoltage).into_iter();
    // Ratios outside this range belong to voltages of an auxiliary battery, or to a DC link behind open contactors.
    let candidates = candidates.filter(|(_, pack_v)| (0.2..20.0).contains(&(pack_v / sum_v)));
    let off = |pack_v: f64| (pack_v / sum_v).ln().abs();
    let Some(((signal, _), pack_v)) = candidates.min_by(|a, b| off(a.1).total_cmp(&off(b.1))) else { return };
    let (cells, sum, pack) = (judge.plan.pack.cells, number(sum_v), number(pack_v));
    if is_clear && (pack_v / sum_v - 1.0).abs() <= SUM_TOLERANCE {
        return judge.fine(format!("the {cells} cells add up to {sum} V; {} is {pack} V", signal.name));
    }
    let power = (pack_v / sum_v).log10().round();
    let tolerance = if is_clear { SUM_TOLERANCE } else { 0.2 };
    if power != 0.0 && ((pack_v / sum_v) / 10.0_f64.powf(power) - 1.0).abs() <= tolerance {
        let times = number(10.0_f64.powf(power));
        warning(judge, Topic::PackVoltage, format!("{} is off by a factor of {times}", signal.name))
            .seen(format!("the medians of {cells} cells add up to {sum} V; {} is {pack} V", signal.name))
            .why("the voltages of cells in series add up; a power of ten is a wrong decimal place in the definition")
            .advice(format!("in the definition of {}, divide the factor by {times}", signal.name));
        return;
    }
    if !is_clear {
        return;
    }
    let counted = (f64::from(cells) * pack_v / sum_v).round();
    let finding = warning(judge, Topic::PackVoltage, "the cells do not add up to the pack's voltage")
        .seen(format!("the medians of {cells} cells add up to {sum} V; {} is {pack} V", signal.name))
        .why("the voltages of cells in series add up")
        .advice("other possible causes: a cell's signal, its factor, or the factor of the pack's voltage in the DBC is wrong");
    if counted >= 1.0 && counted != f64::from(cells) {
        finding.change("pack", "cells", format!("{counted} cells would have that voltage"));
    }
}

fn states_of_charge(judge: &mut Judge<'_>) {
    let configured = judge.plan.signals.iter().zip(&judge.observed.series);
    let mut configured = configured.filter(|(signal, _)| signal.binding.channel == Channel::ReportedSoc);
    let Some((own, own_soc)) = configured.find_map(|(signal, series)| Some((signal, series.values.median()?))) else {
        return;
    };
    let others = unconfigured(judge, Channel::ReportedSoc);
    let is_confirmed = others.iter().any(|(_, soc)| (soc - own_soc).abs() <= AGREEMENT);
    for ((signal, _), soc) in others {
        let difference = (soc - own_soc).abs();
        let [own_percent, percent] = [own_soc, soc].map(|soc| number((1000.0 * soc).round() / 10.0));
        if difference <= AGREEMENT {
            judge.fine(format!("{} and {} agree: {own_percent} and {percent} %", own.name, signal.name));
            continue;
        }
        // A smaller difference is normal, because a dashboard's state of charge hides a reserve at both ends.
        let is_odd = difference > HIDDEN_SOC && !is_confirmed;
        let severity = if is_odd { Severity::Warning } else { Severity::Note };
        find(judge, severity, Topic::ReportedSoc, format!("{} and {} disagree", own.name, signal.name))
            .seen(format!("the configured state of charge is {own_percent} %, the other is {percent} %"))
            .why("a dashboard may hide a reserve at both ends; otherwise, one of the two is not the state of charge")
            .change(&own.table, "signal", format!("{:?}, if that is the pack's own", signal.name));
    }
}
