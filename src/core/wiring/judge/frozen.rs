//! Finds signals that never change while other signals change, cells whose voltage responds differently to the
//! current, and cells with the same voltage.

use super::context::{EXPLAINED, Judge, SignalSeries, error, warning};
use super::holes::span;
use super::reported::reported;
use super::text::{channels, count, milli, number, percent, ranges};
use crate::filter::ends;
use crate::quantity::Channel;
use crate::wiring::evidence::usage::Moment;
use crate::wiring::evidence::{HIDDEN_SOC, Series, Slope};
use crate::wiring::plan::{Kind, SignalPlan};
use crate::wiring::report::Topic;

/// Minimum number of readings for judging a signal.
const FEWEST_READINGS: u64 = 20;

pub(super) fn check(judge: &mut Judge<'_>) {
    voltages(judge);
    if let Some(current) = judge.current() {
        pack_current(judge, current);
    }
}

fn voltages(judge: &mut Judge<'_>) {
    let voltages = judge.signals(Kind::Voltage);
    let judged = || voltages.iter().filter(|(_, series)| series.count() >= FEWEST_READINGS);
    let moving = judged().filter(|(_, s)| 10 * s.extent.changes > s.count()).count();
    let still: Vec<_> = judged().filter(|(_, s)| s.extent.changes == 0 && s.extent.last.abs() > 0.05).collect();
    let swing_a = judge.current().map_or(0.0, |(_, series)| series.extent.range());
    let is_all = still.len() == voltages.len() && swing_a > 0.2 * judge.pack_ah();
    if still.is_empty() || moving <= still.len() && !is_all {
        return;
    }
    let (signal, series) = still[0];
    let list: Vec<Channel> = still.iter().map(|(signal, _)| signal.binding.channel).collect();
    let (value, readings) = (number(series.extent.last), count(series.count(), "reading"));
    let why = if is_all { "the current changed, and a voltage must follow it" } else { "the other voltages changed" };
    error(judge, Topic::Frozen, format!("{}: the value never changes", channels(&list)))
        .seen(format!("{} is {value} in all {readings}", signal.name))
        .why(why)
        .change(&signal.table, "signal", "the measured signal, not a default or a copy")
        .advice("another possible cause: the sender repeats an old value");
}

/// Finds a current that never changes, or hardly changes, although the voltages step as under a load.
fn pack_current(judge: &mut Judge<'_>, (signal, series): SignalSeries<'_>) {
    let noise_v = judge.median_of(Kind::Voltage, Series::noise).unwrap_or(0.0);
    let is_still = series.extent.changes == 0;
    let steps = judge.observed.fast_response();
    let step_v =
        if is_still { steps.largest_voltage_step() } else { steps.large_voltage_step() } * judge.voltage_factor;
    let is_step = step_v > (10.0 * noise_v / judge.cells_per_reading() * judge.voltage_factor).max(0.008);
    let swing_a = series.values.bulk().map_or(0.0, |(low, high)| high - low) * judge.current_factor;
    let model_ohm = judge.plan.pack.model.as_ref().map_or(0.0, |model| judge.model_ohm(model, 1.0).1);
    // Cold and age may raise the resistance, but not tenfold.
    let explained_v = 10.0 * swing_a * model_ohm / f64::from(judge.plan.pack.strings.max(1));
    let is_related = judge.observed.slope().is_some_and(|slope| slope.certainty() >= 1.0 && slope.r2 >= 0.2);
    let is_dead = model_ohm > 0.0 && step_v > explained_v && !is_related;
    if series.count() < FEWEST_READINGS || !is_step || !(is_still || is_dead) {
        return;
    }
    let step = milli(step_v);
    let (title, value) = match is_still {
        true => ("pack current: the value never changes", format!("is {} A", number(series.extent.last))),
        false => {
            let (low, high) = (number(series.extent.min), number(series.extent.max));
            ("pack current: it hardly changes while the voltages step", format!("stays within {low} to {high} A"))
        }
    };
    let readings = count(series.count(), "reading");
    error(judge, Topic::Frozen, title)
        .seen(format!("{} {value} in all {readings}, while the voltages step by up to {step} mV", signal.name))
        .why("only a change of the current changes voltages this fast")
        .change(&signal.table, "signal", "the signal of the measured current");
}

/// Finds the longest stretch in which the current stays at one value near zero while the voltages step or the reported
/// state of charge changes.
pub(super) fn check_stopped(judge: &mut Judge<'_>) {
    let (Some((signal, series)), Some(first)) = (judge.current(), judge.observed.first) else { return };
    let noise_v = judge.median_of(Kind::Voltage, Series::noise).unwrap_or(0.0) / judge.cells_per_reading();
    let least_v = (10.0 * noise_v * judge.voltage_factor).max(0.008);
    let place = reported(judge, Channel::ReportedSoc).first().map(|(_, place)| *place);
    let is_still = |a: &Moment, b: &Moment| a.stretch == b.stretch && a.current_a == b.current_a;
    let runs = judge.observed.usage.moments().chunk_by(is_still);
    let resting = runs.filter(|run| run[0].current_a.abs() <= judge.plan.pack.dead_band_a);
    let moving = resting.filter_map(|run| Some((run, movement(run, place, least_v / judge.voltage_factor)?)));
    let length_s = |run: &[Moment]| run[run.len() - 1].time.since(run[0].time);
    let longest = moving.max_by(|a, b| length_s(a.0).total_cmp(&length_s(b.0)));
    let Some((run, movement)) = longest.filter(|_| !series.is_constant() && !judge.is_mixed_up) else { return };
    judge.is_mixed_up = true;
    let (value, stretch) = (number(run[0].current_a), span(first, run[0].time, length_s(run)));
    error(judge, Topic::Frozen, "pack current: it stops while the pack is in use")
        .seen(format!("{} is {value} A in every reading {stretch}, while {movement}", signal.name))
        .why("only a current changes the voltages this fast, or the state of charge this much")
        .advice("the sensor or its sender fails in this time; estimates do not know the charge that flows");
}

/// Describes how the voltages or the reported state of charge (at `place`) show that a current flows; `None` if they do
/// not. Two kinds of change do not show a current. A resting voltage relaxes in one direction. A controller corrects
/// its state of charge in one jump, or by less than [`HIDDEN_SOC`].
fn movement(run: &[Moment], place: Option<usize>, least_v: f64) -> Option<String> {
    let steps = |sign: f64| run.windows(2).filter(|p| sign * (p[1].voltage_v - p[0].voltage_v) > least_v).count();
    let socs: Vec<f64> = place.map_or_else(Vec::new, |at| run.iter().map(|moment| moment.reported[at]).collect());
    let (low, high) = ends(socs.iter().copied());
    let largest = socs.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
    if high - low > HIDDEN_SOC && largest < 0.5 * (high - low) {
        return Some(format!("the reported SOC moves between {} and {} %", percent(low), percent(high)));
    }
    // One wrong reading makes a step in each direction.
    let (up, down) = (steps(1.0), steps(-1.0));
    (up.min(down) >= 3).then(|| format!("the voltage of a cell makes {} steps above {} mV", up + down, milli(least_v)))
}

/// Finds cells whose signals show the voltage of another cell, by comparing bits and values of the signals.
pub(super) fn check_equal(judge: &mut Judge<'_>) {
    let voltages = judge.signals(Kind::Voltage);
    let mut reported: Vec<Channel> = Vec::new();
    for (index, (signal, _)) in voltages.iter().enumerate() {
        let same_bits = |other: &&SignalPlan| signal.shares_bits(other);
        let Some(other) = voltages[..index].iter().map(|(other, _)| *other).find(same_bits) else { continue };
        let pair = [other.binding.channel, signal.binding.channel];
        reported.extend(pair);
        error(judge, Topic::Swapped, format!("{} read the same bits", channels(&pair)))
            .seen(format!("{} and {} share bits of one message in the DBC", other.name, signal.name))
            .why("each cell has its own voltage")
            .change(&signal.table, "signal", "a pattern that gives each cell its own signal")
            .advice("compare the start bits in the DBC with the sender's documentation");
    }
    // With a coarse resolution, the voltages of different cells are often equal, so they are not compared.
    let step_v = |(signal, _): &SignalSeries<'_>| (signal.layout.factor * signal.scale).abs() * judge.voltage_factor;
    if voltages.iter().any(|voltage| step_v(voltage) > 0.005) {
        return;
    }
    // Only blocks of readings in which the voltages changed are counted, because the voltages of similar cells may be
    // equal for a while.
    let [fast, slow] = judge.observed.responses().each_ref().map(|response| response.equal_cells.groups(25));
    for (cells, blocks) in if fast.is_empty() { slow } else { fast } {
        let is_member = |(signal, _): &&SignalSeries<'_>| matches!(signal.binding.channel, Channel::CellVoltage(cell) if cells.contains(&cell.index()));
        let members: Vec<_> = voltages.iter().filter(is_member).collect();
        let list: Vec<Channel> = members.iter().map(|(signal, _)| signal.binding.channel).collect();
        let [first, second, ..] = members[..] else { continue };
        if list.iter().all(|channel| reported.contains(channel)) {
            continue;
        }
        error(judge, Topic::Swapped, format!("{} always have the same voltage", channels(&list)))
            .seen(format!("{} and {} changed {blocks} times, each time to the same value", first.0.name, second.0.name))
            .why("two cells in series differ at least in the last digit: both signals show the same cell")
            .change(&first.0.table, "signal", "a pattern that gives each cell its own signal")
            .advice("compare the signals in the DBC, and the sender's list of cells");
    }
}

pub(super) fn check_response(judge: &mut Judge<'_>) {
    let is_clear = |slope: &Slope| slope.ohm > 0.0 && slope.certainty() >= 1.0 && slope.r2 >= EXPLAINED;
    let Some(common) = judge.observed.slope().filter(is_clear) else { return };
    let cells = if judge.plan.pack.is_total { 0 } else { usize::from(judge.plan.pack.cells) };
    let odd = (0..cells.min(judge.signals(Kind::Voltage).len())).filter_map(|cell| {
        let slope = judge.observed.slope_of(cell)?;
        let ratio = slope.ohm / common.ohm;
        let is_sure = (slope.ohm - common.ohm).abs() > 6.0 * slope.std_ohm.max(common.std_ohm);
        (is_sure && !(0.33..=3.0).contains(&ratio) && slope.points >= 4).then_some((cell + 1, ratio))
    });
    let odd: Vec<(usize, f64)> = odd.collect();
    if cells < 4 || odd.is_empty() || 4 * odd.len() > cells || judge.has(&[Topic::Cell, Topic::Frozen]) {
        return;
    }
    let numbers: Vec<usize> = odd.iter().map(|(cell, _)| *cell).collect();
    let (first, ratio) = (odd[0].0, number(odd[0].1));
    let title = format!("cell {}: the voltage follows the current unlike the other cells", ranges(&numbers));
    warning(judge, Topic::Cell, title)
        .seen(format!("the voltage of cell {first} changes {ratio} times as much as the median cell's"))
        .why("a larger change means a loose connection; a smaller one means a wrong signal or a repeated old value")
        .advice("check the connection of that cell and its signal in the DBC");
}
