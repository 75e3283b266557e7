//! One signal in another's place: by the units the DBC writes, and by how the values behave.

use super::super::plan::SignalPlan;
use super::super::report::{Finding, Topic};
use super::super::series::Series;
use super::{Judge, Kind, MAX_C_RATE, words};
use crate::quantity::Channel;

/// Temperatures a pack in use may have, degrees C.
const WARMTH_C: (f64, f64) = (-45.0, 95.0);

/// What a DBC's unit says.
pub(super) fn unit_of(text: &str) -> Option<(&'static str, f64, f64)> {
    let plain: String = text.chars().filter(char::is_ascii_alphanumeric).collect();
    Some(match plain.to_ascii_lowercase().as_str() {
        "a" | "amp" | "amps" | "ampere" => ("current", 1.0, 0.0),
        "ma" => ("current", 1e-3, 0.0),
        "v" | "volt" | "volts" => ("voltage", 1.0, 0.0),
        "mv" => ("voltage", 1e-3, 0.0),
        "uv" => ("voltage", 1e-6, 0.0),
        "c" | "degc" | "celsius" | "degcelsius" => ("temperature", 1.0, 0.0),
        "k" | "kelvin" | "degk" => ("temperature", 1.0, -273.15),
        "f" | "degf" | "fahrenheit" => ("temperature", 5.0 / 9.0, -160.0 / 9.0),
        _ => return None,
    })
}

fn kind_word(kind: Kind) -> &'static str {
    match kind {
        Kind::Current => "current",
        Kind::Voltage => "voltage",
        Kind::Temperature => "temperature",
        Kind::Reported => "reported value",
    }
}

/// A configured signal whose unit is of another kind.
fn misfits<'d>(judge: &Judge<'d>) -> Vec<(&'d SignalPlan, &'static str)> {
    let signals = judge.plan.signals.iter();
    let misfit = |signal: &'d SignalPlan| {
        let kind = Kind::of(signal.binding.channel);
        let (unit, _, _) = unit_of(&signal.unit)?;
        (kind != Kind::Reported && unit != kind_word(kind)).then_some((signal, unit))
    };
    signals.filter_map(misfit).collect()
}

pub(super) fn judge(judge: &mut Judge<'_>) {
    if !by_unit(judge) && !pack_voltage_as_current(judge) {
        by_values(judge);
    }
    odd_cells(judge);
}

fn by_unit(judge: &mut Judge<'_>) -> bool {
    let misfits = misfits(judge);
    let mut told: Vec<&str> = Vec::new();
    for (signal, unit) in &misfits {
        if told.contains(&signal.table.as_str()) {
            continue;
        }
        told.push(&signal.table);
        let kind = Kind::of(signal.binding.channel);
        judge.is_mixed_up |= kind != Kind::Temperature;
        let partner = misfits.iter().find(|(other, other_unit)| {
            kind_word(Kind::of(other.binding.channel)) == *unit && *other_unit == kind_word(kind)
        });
        let seen = format!("{} has the unit {:?} in the DBC", signal.name, signal.unit);
        let (title, wanted) = match partner {
            Some((other, _)) => (
                format!(
                    "{} and {} are exchanged",
                    words::channel(signal.binding.channel),
                    words::channel(other.binding.channel)
                ),
                format!("{:?}", other.name),
            ),
            None => (
                format!("{} is read from a {unit}", words::channel(signal.binding.channel)),
                format!("a signal that is a {}", kind_word(kind)),
            ),
        };
        let finding =
            Finding::error(Topic::Swapped, title).seen(seen).why(format!("a {} has no such unit", kind_word(kind)));
        judge.report.add(finding.change(&signal.table, "signal", wanted));
    }
    !misfits.is_empty()
}

/// A current that is N times a cell's voltage.
fn pack_voltage_as_current(judge: &mut Judge<'_>) -> bool {
    let (Some((signal, series)), Some(cell_v)) = (judge.current(), judge.cell_voltage()) else { return false };
    let (low, high) = judge.voltage_band();
    let (Some(middle), Some(from), Some(to)) =
        (series.values.median(), series.values.quantile(0.02), series.values.quantile(0.98))
    else {
        return false;
    };
    let cells = f64::from(judge.plan.cells);
    let is_like = cells >= 4.0
        && (low..=high).contains(&cell_v)
        && (middle.abs() / cells / cell_v - 1.0).abs() < 0.03
        && (to - from).abs() < 0.3 * middle.abs();
    if is_like {
        judge.is_mixed_up = true;
        let finding = Finding::error(Topic::Swapped, "pack current is read from the pack's voltage")
            .seen(format!(
                "{} reads {}, {} cells of {} V make as much",
                signal.name,
                words::number(middle.abs()),
                judge.plan.cells,
                words::number(cell_v)
            ))
            .why("a current changes and crosses zero; this is the sum of the cell voltages")
            .change(&signal.table, "signal", "the signal of the current");
        judge.report.add(finding);
    }
    is_like
}

/// How well a signal's values would do as something else.
struct Fit {
    voltage: bool,
    warmth: bool,
    current: bool,
}

fn fit(judge: &Judge<'_>, series: &Series, divisor: f64) -> Option<Fit> {
    let (low, high) = (series.values.quantile(0.02)?, series.values.quantile(0.98)?);
    // A voltage in a current's place has the current's sign.
    let (low, high) = if high <= 0.0 { (-high, -low) } else { (low, high) };
    let band = judge.voltage_band();
    let is_slow = series.changes.median().unwrap_or(0.0) < 1.0 && high - low < 40.0;
    Some(Fit {
        voltage: low / divisor >= band.0 && high / divisor <= band.1,
        warmth: is_slow && low >= WARMTH_C.0 && high <= WARMTH_C.1,
        current: low.abs().max(high.abs()) <= MAX_C_RATE * judge.pack_ah(),
    })
}

/// Current, voltage and temperature that stand alone and would do better in each other's places.
fn by_values(judge: &mut Judge<'_>) {
    let voltages = judge.of(Kind::Voltage);
    let (Some(current), [voltage]) = (judge.current(), voltages.as_slice()) else { return };
    let divisor = if judge.plan.is_pack_total { f64::from(judge.plan.cells.max(1)) } else { 1.0 };
    let (Some(c), Some(v)) = (fit(judge, current.1, divisor), fit(judge, voltage.1, divisor)) else { return };
    let temperatures = judge.of(Kind::Temperature);
    let warm = temperatures.iter().find(|(_, series)| series.count() > 0);
    let t = warm.and_then(|(_, series)| fit(judge, series, divisor));
    let pair = if !v.voltage && c.voltage && v.current {
        Some((current, *voltage))
    } else if let (false, Some(warm), Some(t)) = (v.voltage, warm, t.as_ref())
        && t.voltage
        && v.warmth
    {
        Some((*warm, *voltage))
    } else if let (true, Some(warm), Some(t)) = (v.voltage, warm, t.as_ref())
        && warm.1.jumps >= 3
        && t.current
        && c.warmth
        && current.1.jumps == 0
        && (5.0..=60.0).contains(&current.1.values.median().unwrap_or(0.0).abs())
    {
        Some((*warm, current))
    } else {
        None
    };
    if let Some((a, b)) = pair {
        exchanged(judge, a, b);
    }
}

fn exchanged(judge: &mut Judge<'_>, a: (&SignalPlan, &Series), b: (&SignalPlan, &Series)) {
    judge.is_mixed_up = true;
    let extent = |(signal, series): (&SignalPlan, &Series)| {
        let (low, high) = (series.extent.min, series.extent.max);
        format!("{} reads {} to {}", signal.name, words::number(low), words::number(high))
    };
    let channel = |(signal, _): (&SignalPlan, &Series)| words::channel(signal.binding.channel);
    let finding = Finding::error(Topic::Swapped, format!("{} and {} are exchanged", channel(a), channel(b)))
        .seen(format!("{}; {}", extent(a), extent(b)))
        .why("each would do as the other, and not as what it is configured for")
        .change(&a.0.table, "signal", format!("{:?}", b.0.name))
        .change(&b.0.table, "signal", format!("{:?}", a.0.name));
    judge.report.add(finding);
}

/// Cells and sensors whose value is unlike that of all the others.
fn odd_cells(judge: &mut Judge<'_>) {
    let voltages = judge.of(Kind::Voltage);
    let warmth: Vec<f64> = judge.of(Kind::Temperature).iter().filter_map(|(_, s)| s.values.median()).collect();
    let (Some(usual), Some(usual_c)) =
        (judge.cell_voltage(), super::super::link::median(warmth.iter().copied()).or(Some(f64::NAN)))
    else {
        return;
    };
    if voltages.len() >= 4 {
        for (signal, series) in &voltages {
            let Some(middle) = series.values.median() else { continue };
            let is_zero = series.extent.changes == 0 && middle.abs() < 0.05 * usual.abs();
            if is_zero || (middle - usual).abs() <= 0.12 * usual.abs() {
                continue;
            }
            let like = if (middle - usual_c).abs() < 8.0 && usual > 1.0 && usual < 6.0 {
                "; it reads like a temperature"
            } else {
                ""
            };
            let name = words::channel(signal.binding.channel);
            let finding = Finding::error(Topic::Cell, format!("{name} is unlike the other cells"))
                .seen(format!(
                    "{} reads {} V, the others {} V{like}",
                    signal.name,
                    words::number(middle),
                    words::number(usual)
                ))
                .why("cells in series do not differ by so much: another signal's bits, a broken wire, or a dead cell")
                .change(&signal.table, "signal", "a pattern that gives each cell its own signal")
                .advice("measure the cell; compare its place in the DBC with its makers'");
            judge.report.add(finding);
        }
    }
    odd_sensors(judge, usual_c);
}

fn odd_sensors(judge: &mut Judge<'_>, usual_c: f64) {
    let sensors = judge.of(Kind::Temperature);
    if sensors.len() < 4 {
        return;
    }
    for (signal, series) in sensors {
        let Some(middle) = series.values.median() else { continue };
        if (middle - usual_c).abs() <= 30.0 {
            continue;
        }
        let Channel::Temperature(sensor) = signal.binding.channel else { continue };
        let still = if series.extent.changes == 0 { " and never moves" } else { "" };
        let finding =
            Finding::warning(Topic::Cell, format!("temperature {} is unlike the other sensors", sensor.0 + 1))
                .seen(format!(
                    "{} reads {} degrees C{still}, the others {}",
                    signal.name,
                    words::number(middle),
                    words::number(usual_c)
                ))
                .why("one pack does not differ by so much: no sensor there, a broken wire, or another unit")
                .change(&signal.table, "signal", "a sensor that is there");
        judge.report.add(finding);
    }
}
