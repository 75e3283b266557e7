//! Draws the report's pictures. Each picture comes with its file name.

use std::path::Path;

use super::context::PageContext;
use super::data::{Data, Origin};
use super::forecast::{self, Outlook};
use super::format::{alarm_text, length, moment};
use super::limits::thresholds;
use super::series::{self, CellStep};
use super::trace::TraceBin;
use crate::OF_95;
use crate::alarm::Rule;
use crate::chart::{
    self, Axis, Chart, Ink, Layer, Picture, PlotError, Point, Scale, Shape, Span, StateBand, StateBands,
};
use crate::{cell_fault_pictures, model_pictures};

/// If a report is made from a store, this text replaces the pictures that need samples.
pub(super) const NOT_STORED: &str =
    "unknown: the history contains learned values but no samples; a report of a replay shows this picture";

/// Writes every picture of the report into a folder as SVG. Returns the number of pictures.
///
/// # Errors
/// A file cannot be written.
pub fn write_plots(folder: &Path, data: &Data, context: &PageContext<'_>) -> Result<usize, PlotError> {
    let pictures = all(data, context);
    chart::write_each(folder, &pictures)?;
    Ok(pictures.len())
}

pub(super) fn all(data: &Data, context: &PageContext<'_>) -> Vec<(String, Picture)> {
    let outlook = forecast::outlook(data, context);
    let named = |name: &str, picture: Option<Picture>| picture.map(|picture| (name.to_owned(), picture));
    let of_model = context.model.iter().flat_map(model_pictures::all);
    let of_data = [
        named("soc", soc(data, context)),
        named("capacity", capacity(data, context, outlook.as_ref().ok())),
        named("usable_capacity", usable(data, context)),
        named("losses", losses(data)),
        named("recharge_period", recharge(data, context)),
        named("resistance", resistance(data, context)),
        named("temperature", temperature(data, context)),
        named("alarms", alarms(data)),
        named("innovation", innovation(data)),
        named("coverage", coverage(data)),
    ];
    let of_cells = context.diagnosis.into_iter().flat_map(cell_fault_pictures::all);
    of_data.into_iter().flatten().chain(of_cells).chain(of_model).collect()
}

struct TimeAxis {
    axis: Axis,
    zero_s: f64,
    unit_s: f64,
}

impl TimeAxis {
    fn of(data: &Data) -> Self {
        let (first_s, last_s) = data.ends_s().unwrap_or((0.0, 0.0));
        Self::between(data, first_s, last_s)
    }

    fn between(data: &Data, first_s: f64, last_s: f64) -> Self {
        if data.is_dated() {
            let axis = Axis { scale: Scale::Date, ..Axis::number("UTC") };
            return Self { axis: axis.within(first_s, last_s), zero_s: 0.0, unit_s: 1.0 };
        }
        let zero_s = data.ends_s().map_or(0.0, |ends| ends.0);
        let (unit_s, label) = match last_s - first_s {
            long if long > 4.0 * 86_400.0 => (86_400.0, "time since the start, days"),
            long if long > 4.0 * 3600.0 => (3600.0, "time since the start, h"),
            long if long > 600.0 => (60.0, "time since the start, min"),
            _ => (1.0, "time since the start, s"),
        };
        let axis = Axis::number(label).within((first_s - zero_s) / unit_s, (last_s - zero_s) / unit_s);
        Self { axis, zero_s, unit_s }
    }

    fn x(&self, time_s: f64) -> f64 {
        (time_s - self.zero_s) / self.unit_s
    }
}

fn chart(title: impl Into<String>, about: &str, x: Axis, y: impl Into<Axis>, layers: Vec<Layer>) -> Option<Picture> {
    Some(Picture::Chart(Chart { description: about.to_owned(), ..Chart::new(title, x, y, layers) }))
}

fn levels(data: &Data, context: &PageContext<'_>, rule: Rule) -> impl Iterator<Item = Layer> {
    thresholds(data, context, rule).into_iter().map(|(value, severity)| {
        let ink = ink_of(&severity);
        Layer::new(&format!("limit ({severity})"), ink, Shape::Level(value))
    })
}

fn ink_of(severity: &str) -> Ink {
    match severity {
        "severe" => Ink::Red,
        "warning" => Ink::Amber,
        _ => Ink::Grey,
    }
}

fn raised(data: &Data, clock: &TimeAxis, rule: Rule) -> Option<Layer> {
    let rows = data.alarms.iter().filter(|row| row.rule == rule.name() && row.change == "raised");
    let points: Vec<Point> = rows
        .map(|row| Point {
            x: clock.x(row.time_s),
            y: 0.0,
            tip: format!("{} {}: {}", moment(data, row.time_s), row.severity, alarm_text(row, "was")),
        })
        .collect();
    (!points.is_empty()).then(|| Layer::new("alarm raised", Ink::Red, Shape::Moments(points)))
}

fn range(
    bins: &[(f64, &TraceBin)],
    clock: &TimeAxis,
    pick: fn(&TraceBin) -> (f64, f64),
    factor: f64,
) -> Vec<(f64, f64, f64)> {
    let band = bins.iter().map(|(time_s, bin)| {
        let (low, high) = pick(bin);
        (clock.x(*time_s), factor * low, factor * high)
    });
    band.collect()
}

/// Returns the bins with data. A visible gap keeps one empty bin, which interrupts the line.
fn filled<'a>(bins: impl Iterator<Item = (f64, &'a TraceBin)>) -> Vec<(f64, &'a TraceBin)> {
    let all: Vec<(f64, &TraceBin)> = bins.collect();
    let width_s = all.windows(2).map(|pair| pair[1].0 - pair[0].0).fold(f64::INFINITY, f64::min).max(1.0);
    // A gap is visible if it is at least a hundredth of all bins, 100 s and 3 bins long. Shorter gaps may come from
    // slow sensors.
    let hole = (all.len() / 100).max((100.0 / width_s) as usize).max(3);
    let mut empty = 0;
    let wanted = all.into_iter().filter(|(_, bin)| {
        let is_filled = bin.soc.0 <= bin.soc.1;
        empty = if is_filled { 0 } else { empty + 1 };
        is_filled || empty == hole
    });
    wanted.collect()
}

fn zigzag(band: &[(f64, f64, f64)]) -> Vec<(f64, f64)> {
    band.iter().flat_map(|(x, low, high)| [(*x, *low), (*x, *high)]).collect()
}

fn soc(data: &Data, context: &PageContext<'_>) -> Option<Picture> {
    let life = data.trace.life.as_ref()?;
    let clock = TimeAxis::of(data);
    let bins = filled(life.iter());
    let words = if data.cells() > 1 { "estimate, lowest to highest cell" } else { "estimate" };
    let mut layers = vec![Layer::band("95 % interval", Ink::Blue, range(&bins, &clock, |bin| bin.soc_band, 100.0))];
    layers.extend(true_soc(context, &clock, data.ends_s()?));
    layers.push(Layer::line(words, Ink::Blue, zigzag(&range(&bins, &clock, |bin| bin.soc, 100.0))));
    let title = "State of charge over the whole record";
    let description = format!("Lowest and highest estimated SOC of every {:.0} s, in percent", life.width_s());
    chart(title, &description, clock.axis, Axis::number("SOC, %").within(-5.0, 105.0), layers)
}

/// Draws the worst cell with its 95 % interval, and the range over the cells of a pack.
fn worst(data: &Data, clock: &TimeAxis, steps: &[CellStep], ink: Ink, name: &str) -> Vec<Layer> {
    let interval =
        steps.iter().map(|s| (clock.x(s.time_s), s.worst.0 - OF_95 * s.worst.1, s.worst.0 + OF_95 * s.worst.1));
    let mut layers = vec![Layer::band("95 % interval", ink, interval)];
    if data.cells() > 1 {
        let range = steps.iter().map(|s| (clock.x(s.time_s), s.range.0, s.range.1));
        layers.push(Layer::band("all cells", Ink::Grey, range));
    }
    let name = if data.cells() > 1 { format!("{name} cell") } else { "estimate".to_owned() };
    layers.push(Layer::line(&name, ink, steps.iter().map(|s| (clock.x(s.time_s), s.worst.0))));
    layers
}

fn capacity(data: &Data, context: &PageContext<'_>, outlook: Option<&Outlook>) -> Option<Picture> {
    let steps = series::steps(data, series::capacity, false);
    let is_measured = data.learned.iter().any(|row| row.measured_ah.is_some());
    let (first_s, mut last_s) = data.ends_s().filter(|_| is_measured && !steps.is_empty())?;
    let fan = outlook.map_or(&[][..], |outlook| &outlook.fan);
    last_s = fan.iter().map(|point| point.time_s).fold(last_s, f64::max);
    let clock = TimeAxis::between(data, first_s, last_s);
    let mut layers = vec![];
    if data.cells() == 1 {
        let single = data.learned.iter().filter_map(|row| {
            let y = row.measured_ah?;
            let tip = format!("{}: this half-cycle alone {y:.3} Ah", moment(data, row.time_s));
            Some(Point { x: clock.x(row.time_s), y, tip })
        });
        layers.push(Layer::new("one half-cycle alone", Ink::Grey, Shape::Points(single.collect())));
    }
    layers.extend(worst(data, &clock, &steps, Ink::Blue, "weakest"));
    if !fan.is_empty() {
        let band = fan.iter().map(|p| (clock.x(p.time_s), p.low_ah, p.high_ah));
        layers.push(Layer::band("forecast, 5 to 95 %, and its median", Ink::Purple, band));
        let median = fan.iter().map(|p| (clock.x(p.time_s), p.median_ah)).collect();
        layers.push(Layer::new("", Ink::Purple, Shape::Dashed(median)));
    }
    // Reference capacities measured under load belong to the picture of the usable capacity. They are drawn here only
    // if the usable capacity is unknown.
    if !context.reference.is_loaded || series::steps(data, series::usable, false).is_empty() {
        layers.extend(references(data, &clock, context));
    }
    let limits: Vec<Layer> = levels(data, context, Rule::CapacityLow).collect();
    let end = forecast::end_of_life_ah(data, context).map(Shape::Level);
    // If a limit equals the end of life, only the limit is drawn.
    let end = end.filter(|end| limits.iter().all(|limit| limit.shape != *end));
    layers.extend(end.map(|end| Layer::new("end of life", Ink::Grey, end)));
    layers.extend(limits);
    layers.extend(raised(data, &clock, Rule::CapacityLow));
    let title = "Capacity between full and empty, over life";
    let description = "Learned capacity of the weakest cell with its 95 % interval, Ah";
    chart(title, description, clock.axis, within_reason(&steps, &layers, "capacity, Ah"), layers)
}

/// Returns an axis for the learned values with their intervals, the limits and the reference values. Capacities of
/// single half-cycles may lie outside, because they scatter widely.
fn within_reason(steps: &[CellStep], layers: &[Layer], label: &str) -> Axis {
    let mut low = steps.iter().map(|s| s.range.0.min(s.worst.0 - OF_95 * s.worst.1)).fold(f64::INFINITY, f64::min);
    let mut high = steps.iter().map(|s| s.range.1.max(s.worst.0 + OF_95 * s.worst.1)).fold(0.0, f64::max);
    for layer in layers {
        match &layer.shape {
            Shape::Level(y) => (low, high) = (low.min(*y), high.max(*y)),
            Shape::Points(points) if layer.ink == Ink::Plain => {
                (low, high) = points.iter().fold((low, high), |(low, high), p| (low.min(p.y), high.max(p.y)));
            }
            _ => {}
        }
    }
    let room = 0.08 * (high - low).max(1e-3);
    Axis::number(label).within((low - room).max(0.0), high + room)
}

fn references(data: &Data, clock: &TimeAxis, context: &PageContext<'_>) -> Option<Layer> {
    let capacities = &context.reference.capacities;
    let points = capacities.iter().map(|&(time_s, capacity_ah)| Point {
        x: clock.x(time_s),
        y: capacity_ah,
        tip: format!("{}: reference {capacity_ah:.3} Ah", moment(data, time_s)),
    });
    let points: Vec<Point> = points.collect();
    let words = match (context.reference.is_loaded, data.cells() > 1) {
        (true, _) => "measured (reference)",
        (false, true) => "true, weakest cell (reference)",
        (false, false) => "true (reference)",
    };
    (!points.is_empty()).then(|| Layer::new(words, Ink::Plain, Shape::Points(points)))
}

/// Draws the true SOC: one line, or two lines if the lowest and the highest cell differ.
fn true_soc(context: &PageContext<'_>, clock: &TimeAxis, (first_s, last_s): (f64, f64)) -> Vec<Layer> {
    let within = context.reference.socs.iter().filter(|row| row.0 >= first_s && row.0 <= last_s);
    let rows: Vec<(f64, f64, f64)> =
        within.map(|&(time_s, low, high)| (clock.x(time_s), 100.0 * low, 100.0 * high)).collect();
    let line = |pick: fn(&(f64, f64, f64)) -> f64| Shape::Line(rows.iter().map(|row| (row.0, pick(row))).collect());
    match rows.iter().any(|row| row.1 < row.2) {
        _ if rows.is_empty() => Vec::new(),
        false => vec![Layer::new("true (reference)", Ink::Plain, line(|row| row.1))],
        true => vec![
            Layer::new("true, lowest and highest cell (reference)", Ink::Plain, line(|row| row.1)),
            Layer::new("", Ink::Plain, line(|row| row.2)),
        ],
    }
}

fn usable(data: &Data, context: &PageContext<'_>) -> Option<Picture> {
    let steps = series::steps(data, series::usable, false);
    if steps.is_empty() {
        return None;
    }
    let clock = TimeAxis::of(data);
    let mut layers = worst(data, &clock, &steps, Ink::Orange, "weakest");
    if context.reference.is_loaded {
        layers.extend(references(data, &clock, context));
    }
    layers.extend(levels(data, context, Rule::UsableCapacityLow));
    layers.extend(raised(data, &clock, Rule::UsableCapacityLow));
    let load = context.config.and_then(|config| config.monitor.health.usable).map_or(String::new(), |usable| {
        format!(" at {} A, {} \u{b0}C, down to {} V", usable.current_a, usable.temperature_c, usable.cutoff_v)
    });
    let title = format!("Usable capacity{load}, over life");
    let description = "Charge that the weakest cell delivers under load, with its 95 % interval, Ah";
    chart(title, description, clock.axis, within_reason(&steps, &layers, "usable capacity, Ah"), layers)
}

fn losses(data: &Data) -> Option<Picture> {
    let modes: [(&str, Ink, series::ValueSelector); 3] = [
        ("lithium", Ink::Purple, series::lithium_lost),
        ("negative electrode", Ink::Blue, series::negative_lost),
        ("positive electrode", Ink::Orange, series::positive_lost),
    ];
    let clock = TimeAxis::of(data);
    let mut layers = Vec::new();
    for (name, ink, pick) in modes {
        let steps = series::steps(data, pick, true);
        let interval = |s: &CellStep| {
            let half_width = OF_95 * s.worst.1;
            (clock.x(s.time_s), (s.worst.0 - half_width).max(0.0), (s.worst.0 + half_width).min(100.0))
        };
        layers.push(Layer::band("", ink, steps.iter().map(interval)));
        layers.push(Layer::line(name, ink, steps.iter().map(|s| (clock.x(s.time_s), s.worst.0))));
        if steps.is_empty() {
            return None;
        }
    }
    let description =
        "Lithium and active material lost by the cell that has lost most, with their 95 % intervals, per cent";
    chart("Lithium and active material lost, over life", description, clock.axis, "lost, % of new", layers)
}

fn recharge(data: &Data, context: &PageContext<'_>) -> Option<Picture> {
    let clock = TimeAxis::of(data);
    let mut layers = Vec::new();
    let minutes = |seconds: f64| seconds / 60.0;
    let normalised = || data.recharges.iter().filter_map(|row| Some((clock.x(row.time_s), row.normalised_s?)));
    if normalised().count() > 0 {
        let band = normalised().map(|(x, (mean, std))| (x, minutes(mean - OF_95 * std), minutes(mean + OF_95 * std)));
        layers.push(Layer::band("95 % interval", Ink::Green, band));
        let line = normalised().map(|(x, (mean, _))| (x, minutes(mean)));
        layers.push(Layer::line("normalised to the reference charger", Ink::Green, line));
    }
    let point = |time_s: f64, seconds: f64| Point {
        x: clock.x(time_s),
        y: minutes(seconds),
        tip: format!("{}: {:.1} min", moment(data, time_s), minutes(seconds)),
    };
    let raw: Vec<Point> = data.recharges.iter().filter_map(|row| Some(point(row.time_s, row.raw_s?))).collect();
    if !raw.is_empty() {
        layers.push(Layer::new("as measured", Ink::Grey, Shape::Points(raw)));
    }
    let is_stored = data.source.origin == Origin::Store;
    if is_stored {
        let charges = data.halves.chunk_by(|a, b| a.time_s == b.time_s).filter_map(|rows| rows.first());
        let points: Vec<Point> =
            charges.filter(|row| row.is_charge).map(|row| point(row.time_s, row.duration_s)).collect();
        layers.extend((!points.is_empty()).then(|| Layer::new("a whole charge", Ink::Grey, Shape::Points(points))));
    }
    if layers.is_empty() {
        return None;
    }
    if !is_stored {
        let limits = levels(data, context, Rule::RechargePeriodLow).map(|mut layer| {
            if let Shape::Level(seconds) = &mut layer.shape {
                *seconds = minutes(*seconds);
            }
            layer
        });
        layers.extend(limits);
        layers.extend(raised(data, &clock, Rule::RechargePeriodLow));
    }
    let window = context.config.map(|config| &config.monitor.health.recharge);
    let window =
        window.map_or(String::new(), |w| format!(" from {:.0} to {:.0} % SOC", 100.0 * w.from_soc, 100.0 * w.to_soc));
    let title = if is_stored { "Duration of each charge".to_owned() } else { format!("Recharge period{window}") };
    let description = "Minutes a charge took, as measured and as the reference charger would take";
    chart(title, description, clock.axis, "minutes", layers)
}

fn resistance(data: &Data, context: &PageContext<'_>) -> Option<Picture> {
    let steps = series::steps(data, series::resistance, true);
    if steps.is_empty() {
        return None;
    }
    let clock = TimeAxis::of(data);
    let mut layers = worst(data, &clock, &steps, Ink::Purple, "highest");
    layers.extend(levels(data, context, Rule::ResistanceHigh));
    layers.extend(raised(data, &clock, Rule::ResistanceHigh));
    let description = "Resistance of the worst cell relative to a new one, with its 95 % interval";
    chart("Resistance over life", description, clock.axis, "resistance, times new", layers)
}

fn temperature(data: &Data, context: &PageContext<'_>) -> Option<Picture> {
    let clock = TimeAxis::of(data);
    let mut layers = Vec::new();
    if let Some(life) = &data.trace.life {
        let bins = filled(life.iter());
        let band = range(&bins, &clock, |bin| bin.temperature_c, 1.0);
        layers.push(Layer::line("lowest to highest", Ink::Orange, zigzag(&band)));
    }
    let means = series::temperatures(data);
    if !means.is_empty() && layers.is_empty() {
        let tip = |time_s: f64, c: f64| format!("{}: {c:.1} \u{b0}C", moment(data, time_s));
        let points = means.iter().map(|m| Point { x: clock.x(m.0), y: m.2, tip: tip(m.0, m.2) }).collect();
        layers.push(Layer::new("mean of a half-cycle, warmest cell", Ink::Orange, Shape::Points(points)));
    }
    if layers.is_empty() {
        return None;
    }
    layers.extend(levels(data, context, Rule::TemperatureHigh));
    layers.extend(raised(data, &clock, Rule::TemperatureHigh));
    let description = "Cell temperature, degrees C";
    chart("Temperature", description, clock.axis, "temperature, \u{b0}C", layers)
}

fn alarms(data: &Data) -> Option<Picture> {
    let (_, last_s) = data.ends_s().filter(|_| !data.alarms.is_empty())?;
    let clock = TimeAxis::of(data);
    let mut bands: Vec<StateBand> = Vec::new();
    let mut open: Vec<(usize, &super::data::AlarmRecord)> = Vec::new();
    for row in &data.alarms {
        let name = format!("{} ({})", row.rule, row.severity);
        let band = bands.iter().position(|band| band.name == name).unwrap_or_else(|| {
            bands.push(StateBand { name, spans: Vec::new() });
            bands.len() - 1
        });
        let known = open.iter().position(|(at, before)| *at == band && before.cell == row.cell);
        match (row.is_active, known) {
            (true, None) => open.push((band, row)),
            (false, Some(index)) => {
                let (band, from) = open.remove(index);
                bands[band].spans.push(span(data, &clock, from, row.time_s, "until"));
            }
            (true, Some(_)) | (false, None) => {}
        }
    }
    for (band, from) in open {
        bands[band].spans.push(span(data, &clock, from, last_s, "still raised at"));
    }
    for band in &mut bands {
        let longest = band.spans.iter().map(|span| clock.unit_s * (span.to - span.from)).fold(0.0, f64::max);
        let alarms =
            if band.spans.len() == 1 { "1 alarm".to_owned() } else { format!("{} alarms, at most", band.spans.len()) };
        band.name += &format!(": {alarms} {}", length(longest));
    }
    let keys = [(Ink::Red, "severe"), (Ink::Amber, "warning"), (Ink::Grey, "info")];
    Some(Picture::StateBands(StateBands {
        title: "Alarms".to_owned(),
        description: format!(
            "{} changes of alarms; each bar is an alarm from when it was raised until it ended",
            data.alarms.len()
        ),
        x: clock.axis,
        bands,
        keys: keys.map(|(ink, word)| (ink, word.to_owned())).to_vec(),
    }))
}

fn span(data: &Data, clock: &TimeAxis, from: &super::data::AlarmRecord, to_s: f64, end: &str) -> Span {
    Span {
        from: clock.x(from.time_s),
        to: clock.x(to_s),
        ink: ink_of(&from.severity),
        tip: format!("{}: {}; {end} {}", moment(data, from.time_s), alarm_text(from, "was"), moment(data, to_s)),
    }
}

fn innovation(data: &Data) -> Option<Picture> {
    let life = data.trace.life.as_ref()?;
    let clock = TimeAxis::of(data);
    let band = range(&filled(life.iter()), &clock, |bin| bin.innovation_v, 1e3);
    let layers = vec![Layer::line("lowest to highest", Ink::Grey, zigzag(&band))];
    let title = "Innovation: measured minus expected voltage";
    let description = "Lowest and highest innovation over the cells, mV";
    chart(title, description, clock.axis, "mV", layers)
}

fn coverage(data: &Data) -> Option<Picture> {
    let life = data.trace.life.as_ref()?;
    let clock = TimeAxis::of(data);
    let line = life.iter().filter_map(|(time_s, bin)| Some((clock.x(time_s), 100.0 * bin.health.coverage()?)));
    let line: Vec<(f64, f64)> = line.collect();
    // The axis starts at 80 % if all values are above 80 %.
    let lowest = if line.iter().all(|point| point.1 > 80.0) { 80.0 } else { 0.0 };
    let layers = vec![
        Layer::line("within their own 95 % interval", Ink::Blue, line),
        Layer::new("95 %", Ink::Grey, Shape::Level(95.0)),
    ];
    let title = "Coverage of the estimator's 95 % interval";
    let description = "Share of voltage readings within the 95 % interval the filter expected, percent";
    chart(title, description, clock.axis, Axis::number("readings, %").within(lowest, 102.0 - 0.02 * lowest), layers)
}

#[cfg(test)]
mod tests;
