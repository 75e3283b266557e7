//! Sign of the current, resistance, open-circuit voltage, offset and noise: whether voltages follow the current as this cell's do.

use super::super::link::{Run, Slope};
use super::super::plan::SignalPlan;
use super::super::report::{Finding, Topic};
use super::places::unit_of;
use super::{Judge, Kind, words};
use crate::cell::CellModel;
use crate::quantity::Channel;

/// A slope is believed when it is this many standard deviations from zero ...
const SURE: f64 = 6.0;
/// ... and judged by its size when the current explains this share of the voltage's changes (noise in the current
/// makes it too small otherwise).
const EXPLAINED: f64 = 0.8;
/// Fewest steps to judge a single cell by.
const FEWEST_STEPS: usize = 4;
/// Smallest step that says anything, of the capacity.
const SMALLEST_STEP: f64 = 0.02;
/// A resistance this many times the model's is another unit, not another cell.
const UNIT_RATIO: f64 = 6.0;
/// A resistance this many times the model's is told.
const ODD_RATIO: f64 = 2.5;
/// Drift of runs, taken together, that says anything, V.
const LEAST_DRIFT_V: f64 = 0.004;

pub(super) fn judge(judge: &mut Judge<'_>) {
    if judge.doctor.frames == 0 || judge.is_mixed_up {
        return;
    }
    frozen(judge);
    let Some((signal, series)) = judge.current() else { return };
    if series.count() == 0 || judge.cell_voltage().is_none() {
        return;
    }
    let slope = judge.doctor.slope().map(|slope| scaled(judge, slope));
    let drift = drift(judge);
    let is_sure = slope.is_some_and(|slope| slope.certainty() >= 1.0 && slope.r2 >= 0.2);
    let table = signal.table.clone();
    if let Some(slope) = slope.filter(|_| is_sure) {
        if slope.ohm < 0.0 {
            inverted_by_steps(judge, &table, &slope);
        } else {
            judge.report.fine.push(format!(
                "the sign of the current is right: every ampere of discharge lowers a cell's voltage by {} mV",
                words::number(1000.0 * slope.ohm)
            ));
        }
        resistance(judge, &slope);
    } else if let Some(drift) = drift.filter(|drift| drift.is_opposite()) {
        inverted_by_drift(judge, &table, &drift);
    } else if drift.is_none_or(|drift| !drift.is_along()) {
        let has_moved = series.extent.range() * judge.current_factor > SMALLEST_STEP * judge.pack_ah();
        let hint = if has_moved {
            "too few steps of the current for the noise of the voltages; listen longer"
        } else {
            "the current hardly moved; drive or charge for a minute"
        };
        judge.report.unjudged.push(format!("sign of the current, resistance: {hint}"));
    } else {
        judge.report.fine.push("the voltage drifts the way the current says".to_owned());
    }
    if !judge.report.has(&[Topic::CurrentSign, Topic::Unit]) {
        model_fit(judge, drift);
        offset(judge);
        noise(judge);
        cells(judge);
        estimator(judge);
    }
}

/// Ohm per cell after the factors found: the pack's current shared by its strings.
fn scaled(judge: &Judge<'_>, slope: Slope) -> Slope {
    let by = judge.voltage_factor / judge.current_factor * f64::from(judge.plan.strings.max(1));
    let amperes = judge.current_factor;
    Slope { ohm: slope.ohm * by, std_ohm: slope.std_ohm * by, largest_a: slope.largest_a * amperes, ..slope }
}

/// The model's resistance for a step of about a second and for one that has settled, ohm.
fn model_ohm(judge: &Judge<'_>, model: &CellModel) -> (f64, f64) {
    let voltage_v = judge.cell_voltage().unwrap_or(f64::NAN) * judge.voltage_factor;
    let place = model.grid_position(model.soc_of_ocv(voltage_v, warmth_c(judge)).clamp(0.05, 0.95), warmth_c(judge));
    (model.r0_ohm(&place), model.settled_ohm(&place))
}

fn warmth_c(judge: &Judge<'_>) -> f64 {
    let sensors = judge.of(Kind::Temperature);
    let middle = super::super::link::median(sensors.iter().filter_map(|(_, series)| series.values.median()));
    middle.filter(|c| (-40.0..80.0).contains(c)).unwrap_or(judge.plan.ambient_c)
}

fn inverted_by_steps(judge: &mut Judge<'_>, table: &str, slope: &Slope) {
    let finding = Finding::error(Topic::CurrentSign, "the sign of the current is inverted")
        .seen(format!(
            "over {} steps of up to {} A the cells' voltage rises by {} mV per ampere of discharge ({} sigma, {} % of its changes explained)",
            slope.points,
            words::number(slope.largest_a),
            words::number(-1000.0 * slope.ohm),
            words::number(slope.t().abs().min(999.0).floor()),
            (100.0 * slope.r2).round()
        ))
        .why("a discharge lowers the voltage: what is read as discharge is charge");
    let finding = sign_change(judge, finding, table);
    judge.report.add(finding);
}

fn inverted_by_drift(judge: &mut Judge<'_>, table: &str, drift: &Drift) {
    let finding = Finding::error(Topic::CurrentSign, "the sign of the current is inverted")
        .seen(format!(
            "in {} of steady current the voltage drifted {} mV against the current ({} mV with it would fit the cell model)",
            words::seconds(drift.seconds),
            words::number(1000.0 * drift.against_v),
            words::number(1000.0 * drift.expected_v)
        ))
        .why("a discharge empties a cell and lowers its voltage; seen in steady runs only, so a little less sure than from steps");
    let finding = sign_change(judge, finding, table);
    judge.report.add(finding);
}

fn sign_change(judge: &Judge<'_>, finding: Finding, table: &str) -> Finding {
    if judge.plan.is_csv {
        return finding.advice(
            "the file's columns are the program's own: replay it with --csv-sign charge (or without, if it was given)",
        );
    }
    let is_charge = judge.current().is_some_and(|(signal, _)| signal.binding.scale < 0.0);
    finding.change(table, "positive", if is_charge { "\"discharge\"" } else { "\"charge\"" })
}

fn resistance(judge: &mut Judge<'_>, slope: &Slope) {
    let Some(model) = &judge.plan.model else { return };
    let (fast, settled) = model_ohm(judge, model);
    let ohm = slope.ohm.abs();
    let is_large = slope.largest_a >= SMALLEST_STEP * judge.pack_ah() || ohm > settled;
    if slope.r2 < EXPLAINED || !is_large {
        judge
            .report
            .unjudged
            .push("resistance: the steps of the current are small against the noise; drive for a minute".to_owned());
        return;
    }
    let milli = |ohm: f64| words::number(1000.0 * ohm);
    let seen = format!(
        "a cell's voltage moves {} mV per ampere over {} steps; the model says {} to {} at {} degrees C",
        milli(ohm),
        slope.points,
        milli(fast),
        milli(settled),
        words::number(warmth_c(judge))
    );
    let (ratio, way) = if ohm > settled { (ohm / settled, "higher") } else { (fast / ohm, "lower") };
    if ratio >= UNIT_RATIO {
        let middle = (fast * settled).sqrt();
        let factor = 10_f64.powf((ohm / middle).log10().round());
        return current_unit(judge, &seen, factor, ratio);
    }
    if ratio >= ODD_RATIO {
        let finding = Finding::warning(
            Topic::CellModel,
            format!("resistance {} times {way} than the cell model's", words::number(ratio)),
        )
        .seen(seen)
        .why(if way == "higher" {
            "another cell, an old or very cold one, or cells in parallel counted wrongly"
        } else {
            "another cell, or several in parallel behind one voltage tap"
        })
        .change("pack", "cell_model", "the model of the cell that is in the pack")
        .advice("the estimator learns a resistance of 0.3 to 3 times the model's by itself");
        judge.report.add(finding);
    } else if slope.ohm > 0.0 {
        judge.report.fine.push(format!("the resistance is of the right size: {seen}"));
    }
}

/// The factor of ten by which the current is off, as the steps say; `None` = they say nothing, or that it is right.
pub(super) fn factor_by_steps(judge: &Judge<'_>) -> Option<f64> {
    let model = judge.plan.model.as_ref()?;
    let slope = judge.doctor.slope().map(|slope| scaled(judge, slope))?;
    let (fast, settled) = model_ohm(judge, model);
    let factor = 10_f64.powf((slope.ohm.abs() / (fast * settled).sqrt()).log10().round());
    (slope.certainty() >= 1.0 && slope.r2 >= EXPLAINED && factor != 1.0).then_some(factor)
}

fn current_unit(judge: &mut Judge<'_>, seen: &str, factor: f64, ratio: f64) {
    let Some((signal, _)) = judge.current() else { return };
    judge.current_factor *= factor;
    let ratio = words::number(ratio);
    let why = format!("{ratio} times off: no cell ages or cools so far");
    let finding = slip_or_other_cell(judge, signal, factor, (0.05..20.0).contains(&factor));
    judge.report.add(finding.seen(seen.to_owned()).why(why));
}

/// A current that is off by `factor`: in its unit, or because the cell is another. The DBC's own unit decides what is
/// named first: where it says ampere and nothing is scaled, the reading is probably right.
pub(super) fn slip_or_other_cell(judge: &Judge<'_>, signal: &SignalPlan, factor: f64, is_warning: bool) -> Finding {
    let times = words::number(factor.max(1.0 / factor));
    let size = if factor < 1.0 { "larger" } else { "smaller" };
    let is_ampere = unit_of(&signal.unit).is_some_and(|(_, unit, _)| unit == 1.0) && signal.scale == 1.0;
    let finding = |topic, title| if is_warning { Finding::warning(topic, title) } else { Finding::error(topic, title) };
    let scale = words::toml(signal.scale * factor);
    if is_ampere {
        return finding(Topic::CellModel, format!("the cells are about {times} times {size} than the cell model's"))
            .change("pack", "cell_model", "the model of the cell that is in the pack")
            .advice(format!(
                "or {} is off by that factor (scale = {scale}), or pack.strings is not {}",
                signal.name, judge.plan.strings
            ));
    }
    let mark = if is_warning { "?" } else { "" };
    finding(Topic::Unit, format!("pack current: off by a factor of {times}{mark}"))
        .change(&signal.table, "scale", scale)
        .advice(format!(
            "or the cells are {times} times {size} than the cell model's, or pack.strings is not {}",
            judge.plan.strings
        ))
}

/// What steady runs say, taken together; per cell, positive = as the configured sign has it.
#[derive(Debug, Clone, Copy)]
struct Drift {
    seconds: f64,
    /// What the model says, summed, V.
    expected_v: f64,
    /// Against it, V.
    against_v: f64,
    /// Measured over expected, weighted by the expected.
    ratio: f64,
    sigma: f64,
}

impl Drift {
    fn is_opposite(&self) -> bool {
        (-6.0..-0.25).contains(&self.ratio) && self.sigma >= SURE && self.expected_v >= LEAST_DRIFT_V
    }

    fn is_along(&self) -> bool {
        self.ratio > 0.1 && self.sigma >= SURE
    }
}

fn drift(judge: &Judge<'_>) -> Option<Drift> {
    let model = judge.plan.model.as_ref()?;
    let (mut xx, mut xy, mut variance, mut seconds, mut expected_v) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for run in &judge.doctor.link.runs {
        let expected = expected_drift_v(judge, model, run);
        let (measured, std) = (run.drift_v * judge.voltage_factor, run.drift_std_v * judge.voltage_factor);
        xx += expected * expected;
        xy += expected * measured;
        variance += (expected * std.max(2e-4)).powi(2);
        seconds += run.seconds;
        expected_v += expected.abs();
    }
    (xx > 0.0).then(|| Drift {
        seconds,
        expected_v,
        against_v: (-xy / expected_v.max(1e-9)).abs(),
        ratio: xy / xx,
        sigma: xy.abs() / variance.sqrt(),
    })
}

fn expected_drift_v(judge: &Judge<'_>, model: &CellModel, run: &Run) -> f64 {
    let temperature_c = warmth_c(judge);
    let cell_a = run.current_a * judge.current_factor / f64::from(judge.plan.strings.max(1));
    let (_, settled) = model_ohm(judge, model);
    let soc = model.soc_of_ocv(run.voltage_v * judge.voltage_factor + cell_a * settled, temperature_c).clamp(0.0, 1.0);
    let moved = -cell_a * run.seconds / 3600.0 / judge.plan.capacity_ah;
    let end = model.grid_position((soc + moved).clamp(0.0, 1.0), temperature_c);
    model.ocv_v(&end) - model.ocv_v(&model.grid_position(soc, temperature_c))
}

/// Open-circuit voltage and its slope against the model's.
fn model_fit(judge: &mut Judge<'_>, drift: Option<Drift>) {
    let Some(model) = &judge.plan.model else { return };
    let temperature_c = warmth_c(judge);
    let ends = [0.0, 1.0].map(|soc| model.ocv_v(&model.grid_position(soc, temperature_c)));
    let rests: Vec<f64> = judge.doctor.link.rests.iter().map(|rest| rest.end_v).collect();
    let highest = rests.iter().copied().fold(f64::NAN, f64::max);
    let lowest = rests.iter().copied().fold(f64::NAN, f64::min);
    if highest > ends[1] + 0.06 || lowest < ends[0] - 0.06 {
        let off = if highest > ends[1] + 0.06 { highest } else { lowest };
        let finding = Finding::error(Topic::CellModel, "the resting voltage is not on the cell model's curve")
            .seen(format!(
                "{} V at rest; {} runs from {} to {} V",
                words::number(off),
                model.name,
                words::number(ends[0]),
                words::number(ends[1])
            ))
            .why("a rested cell shows its open-circuit voltage: this is another chemistry, or another number of cells")
            .change("pack", "cell_model", chemistry(off));
        judge.report.add(finding);
    } else if let Some(drift) =
        drift.filter(|drift| drift.expected_v > 0.03 && drift.sigma > 0.0 && (-0.05..0.15).contains(&drift.ratio))
    {
        let finding = Finding::warning(Topic::CellModel, "the voltage is much flatter than the cell model's")
            .seen(format!(
                "in {} of steady current it moved {} of the {} mV the model expects",
                words::seconds(drift.seconds),
                words::number(1000.0 * drift.expected_v * drift.ratio.max(0.0)),
                words::number(1000.0 * drift.expected_v)
            ))
            .why("so flat a curve is an iron-phosphate cell's (LFP), or the cells are much larger")
            .change("pack", "cell_model", "the model of the cell that is in the pack");
        judge.report.add(finding);
    } else if is_like_iron_phosphate(judge, model) {
        let finding =
            Finding::note(Topic::CellModel, "either the pack is nearly empty, or its cells are iron phosphate (LFP)")
                .seen(format!(
                    "the middle cell has {} V; by {} that is {} %",
                    words::number(judge.cell_voltage().unwrap_or(f64::NAN)),
                    model.name,
                    (100.0 * model.soc_of_ocv(judge.cell_voltage().unwrap_or(f64::NAN), temperature_c).clamp(0.0, 1.0))
                        .round()
                ))
                .why("iron-phosphate cells stay near 3.3 V from full to empty")
                .change("pack", "cell_model", "the model of the cell that is in the pack")
                .advice("compare with the SOC the vehicle shows");
        judge.report.add(finding);
    } else if rests.is_empty() {
        judge
            .report
            .unjudged
            .push("open-circuit voltage: the pack did not rest; leave it alone for a minute".to_owned());
    } else {
        let soc = model.soc_of_ocv(rests[rests.len() - 1], temperature_c);
        let last = words::number(rests[rests.len() - 1]);
        judge.report.fine.push(format!(
            "{last} V at rest: {} % by the cell model; compare with what the vehicle shows",
            (100.0 * soc.clamp(0.0, 1.0)).round()
        ));
    }
}

fn is_like_iron_phosphate(judge: &Judge<'_>, model: &CellModel) -> bool {
    let half = model.ocv_v(&model.grid_position(0.5, warmth_c(judge)));
    half > 3.5 && judge.cell_voltage().is_some_and(|v| (3.18..3.38).contains(&v))
}

fn chemistry(voltage_v: f64) -> &'static str {
    match voltage_v {
        v if v < 2.0 => "the model of the cell that is in the pack",
        v if v < 2.95 => "a model of a titanate cell (LTO), if it is one",
        v if v < 3.45 => "a model of an iron-phosphate cell (LFP), if it is one",
        _ => "a model of a nickel-rich or cobalt cell (NMC, NCA, LCO), if it is one",
    }
}

/// A current that stands near zero, and is not zero.
fn offset(judge: &mut Judge<'_>) {
    let rests = &judge.doctor.link.rests;
    let Some((signal, _)) = judge.current() else { return };
    let Some(longest) = rests.iter().max_by(|a, b| a.seconds.total_cmp(&b.seconds)) else { return };
    let (offset_a, dead_band_a) = (longest.current_a, judge.plan.dead_band_a);
    if offset_a.abs() <= dead_band_a {
        judge.report.fine.push(format!(
            "current at rest {} A, within the dead band of {} A",
            words::number(offset_a),
            words::number(dead_band_a)
        ));
        return;
    }
    // In the bus's own sign, on top of the offset that is configured.
    let proposed = signal.offset - offset_a * signal.binding.scale.signum();
    let finding = Finding::note(
        Topic::CurrentOffset,
        format!("the current stands at {} A while nothing seems to happen", words::number(offset_a)),
    )
    .seen(format!(
        "for {} at {} V; the pack counts as resting up to {} A",
        words::seconds(longest.seconds),
        words::number(longest.end_v),
        words::number(dead_band_a)
    ))
    .why("either something draws it, or the sensor is off by it")
    .change(&signal.table, "offset", words::toml(proposed))
    .advice("only when the contactors are open and the current must be zero; otherwise raise transition.dead_band_a");
    judge.report.add(finding);
}

fn noise(judge: &mut Judge<'_>) {
    let told_v = judge.plan.voltage_noise_v;
    let cells = if judge.plan.is_pack_total { f64::from(judge.plan.cells.max(1)) } else { 1.0 };
    let voltages = judge.of(Kind::Voltage);
    let Some(noise_v) = super::super::link::median(voltages.iter().filter_map(|(_, series)| series.noise())) else {
        return;
    };
    let noise_v = noise_v / cells;
    if told_v > 0.0 && noise_v > 4.0 * told_v {
        let finding = Finding::note(Topic::Noise, "voltages are rougher than the estimator is told")
            .seen(format!(
                "about {} mV from reading to reading, {} mV configured",
                words::number(1000.0 * noise_v),
                words::number(1000.0 * told_v)
            ))
            .why("noise that is not expected makes the estimate follow it")
            .change("estimator", "voltage_noise_v", words::toml((noise_v * 1e4).round() / 1e4));
        judge.report.add(finding);
    }
}

/// Signals that stand still while others move.
fn frozen(judge: &mut Judge<'_>) {
    const FEWEST: u64 = 20;
    let voltages = judge.of(Kind::Voltage);
    let moving = voltages.iter().filter(|(_, s)| s.count() >= FEWEST && 10 * s.extent.changes > s.count()).count();
    let still: Vec<_> = voltages
        .iter()
        .filter(|(_, s)| s.count() >= FEWEST && s.extent.changes == 0 && s.extent.last.abs() > 0.05)
        .collect();
    let swings = judge.current().map_or(0.0, |(_, s)| s.extent.range());
    let is_all = still.len() == voltages.len() && swings > 0.2 * judge.pack_ah();
    if !still.is_empty() && (moving > still.len() || is_all) {
        let channels: Vec<Channel> = still.iter().map(|(signal, _)| signal.binding.channel).collect();
        let (signal, series) = still[0];
        let finding = Finding::error(Topic::Frozen, format!("{} never moves", words::channels(&channels)))
            .seen(format!(
                "{} is {} in all of {}",
                signal.name,
                words::number(series.extent.last),
                words::count(series.count(), "reading")
            ))
            .why(if is_all { "the current moved, and a voltage must follow it" } else { "the other cells moved" })
            .change(&signal.table, "signal", "the signal that is measured, not a default or a copy")
            .advice("or its sender repeats an old value");
        judge.report.add(finding);
    }
    let Some((signal, series)) = judge.current() else { return };
    let noise_v = super::super::link::median(voltages.iter().filter_map(|(_, s)| s.noise())).unwrap_or(0.0);
    let cells = if judge.plan.is_pack_total { f64::from(judge.plan.cells.max(1)) } else { 1.0 };
    let step_v = judge.doctor.link.largest_voltage_step() * judge.voltage_factor;
    if series.count() >= FEWEST
        && series.extent.changes == 0
        && step_v > (10.0 * noise_v / cells * judge.voltage_factor).max(0.008)
    {
        let finding = Finding::error(Topic::Frozen, "the pack current never moves")
            .seen(format!(
                "{} is {} A in all of {}, while the cells step by up to {} mV",
                signal.name,
                words::number(series.extent.last),
                words::count(series.count(), "reading"),
                words::number(1000.0 * step_v)
            ))
            .why("only a current moves voltages so fast")
            .change(&signal.table, "signal", "the signal of the current that is measured");
        judge.report.add(finding);
    }
}

/// Cells whose voltage does not follow the current as the others do.
fn cells(judge: &mut Judge<'_>) {
    let Some(usual) =
        judge.doctor.slope().filter(|slope| slope.ohm > 0.0 && slope.certainty() >= 1.0 && slope.r2 >= EXPLAINED)
    else {
        return;
    };
    let count = if judge.plan.is_pack_total { 0 } else { usize::from(judge.plan.cells) };
    let mut odd: Vec<(usize, f64)> = Vec::new();
    for cell in 0..count.min(judge.of(Kind::Voltage).len()) {
        let Some(slope) = judge.doctor.slope_of(cell) else { continue };
        let ratio = slope.ohm / usual.ohm;
        let is_clear = (slope.ohm - usual.ohm).abs() > SURE * slope.std_ohm.max(usual.std_ohm);
        if is_clear && !(0.33..=3.0).contains(&ratio) && slope.points >= FEWEST_STEPS {
            odd.push((cell + 1, ratio));
        }
    }
    if count < 4 || odd.is_empty() || 4 * odd.len() > count || judge.report.has(&[Topic::Cell, Topic::Frozen]) {
        return;
    }
    let numbers: Vec<usize> = odd.iter().map(|(cell, _)| *cell).collect();
    let finding = Finding::warning(
        Topic::Cell,
        format!("cell {} follows the current unlike the others", words::ranges(&numbers)),
    )
    .seen(format!("cell {} by {} times what the middle cell does", odd[0].0, words::number(odd[0].1)))
    .why("a loose connection (more), another signal in its place or an old value repeated (less)")
    .advice("look at the connection of that cell and at its place in the DBC");
    judge.report.add(finding);
}

/// What the estimator made of it.
fn estimator(judge: &mut Judge<'_>) {
    const FEWEST: u64 = 200;
    let of = &judge.doctor.estimated;
    if of.estimates < FEWEST {
        return;
    }
    let refused = of.refused as f64 / of.estimates as f64;
    let bias_v = of.innovation_sum / of.estimates as f64;
    if refused > 0.1 && !judge.report.has(&[Topic::CellModel, Topic::Cell, Topic::Frozen, Topic::CellCount]) {
        let finding = Finding::warning(Topic::CellModel, "the estimator refuses many voltages")
            .seen(format!(
                "{} % of {} readings beyond its gate, {} mV off in the mean",
                (100.0 * refused).round(),
                of.estimates,
                words::number(1000.0 * bias_v)
            ))
            .why("what the model expects and what comes do not agree")
            .change("pack", "cell_model", "the model of the cell that is in the pack");
        judge.report.add(finding);
    } else {
        judge.report.fine.push(format!(
            "the estimator runs: {} % of its readings accepted, {} mV off in the mean",
            (100.0 * (1.0 - refused)).round(),
            words::number(1000.0 * bias_v)
        ));
    }
}
