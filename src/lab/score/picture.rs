//! Plots of a run: SOC and its error with their 95 % band over time, and a life over its discharges.

use std::path::{Path, PathBuf};

use super::life::{DischargeScore, LifeScore};
use super::soc::Sample;
use super::{Case, STD_OF_95, Start};
use crate::lab::plot::{self, Band, Colour, Line, Panel, PlotError};

/// Draws the run and gives the file's path.
pub(super) fn draw(
    folder: &Path,
    name: &str,
    case: &Case,
    samples: &[Sample],
    life: Option<&LifeScore>,
) -> Result<PathBuf, PlotError> {
    let title = format!("{name}, {}", describe(case, ", "));
    let mut panels = Vec::new();
    if !samples.is_empty() {
        panels.extend([soc_panel(&title, samples), error_panel(samples)]);
    }
    panels.extend(life.into_iter().flat_map(|life| life_panels(&title, &life.each)));
    let path = folder.join(format!("{}_{}.svg", name.replace('/', "_"), describe(case, "_").replace([' ', '%'], "")));
    plot::write(&path, &panels)?;
    Ok(path)
}

/// A case in words.
pub(super) fn describe(case: &Case, separator: &str) -> String {
    let mut words = vec![match case.start {
        Start::Full => "full".to_owned(),
        Start::Middle => "middle".to_owned(),
    }];
    words.extend(case.told_points.map(|points| format!("told {points:+}")));
    words.extend((case.capacity_error_percent != 0.0).then(|| format!("capacity {:+} %", case.capacity_error_percent)));
    words.extend((case.current_offset_a != 0.0).then(|| format!("current {:+} A", case.current_offset_a)));
    words.extend(case.seed.map(|seed| format!("windows {seed}")));
    words.join(separator)
}

fn line(label: &str, colour: Colour, points: impl Iterator<Item = (f64, f64)>) -> Line {
    Line { label: label.to_owned(), colour, points: points.collect() }
}

fn band(points: impl Iterator<Item = (f64, f64, f64)>) -> Vec<Band> {
    // (x, middle, half of the interval)
    let points = points.map(|(x, middle, half)| (x, middle - half, middle + half)).collect();
    vec![Band { label: "95 % interval".to_owned(), colour: Colour::SKY, points }]
}

fn soc_panel(title: &str, samples: &[Sample]) -> Panel {
    let over = |value: fn(&Sample) -> f64| samples.iter().map(move |s| (s.time_s / 3600.0, value(s)));
    Panel {
        title: title.to_owned(),
        x_label: "time since the start, h".to_owned(),
        y_label: "SOC, %".to_owned(),
        bands: band(samples.iter().map(|s| (s.time_s / 3600.0, 100.0 * s.soc, s.half_width_points()))),
        lines: vec![
            line("truth", Colour::BLACK, over(|s| 100.0 * s.truth)),
            line("estimate", Colour::ORANGE, over(|s| 100.0 * s.soc)),
        ],
        y_range: Some((-10.0, 110.0)),
    }
}

fn error_panel(samples: &[Sample]) -> Panel {
    // What came before settling would dwarf the rest: the axis follows the second half of the run.
    let later = &samples[samples.len() / 2..];
    let reach = later.iter().map(|s| s.error_points().abs().max(s.half_width_points())).fold(1.0, f64::max) * 1.5;
    let inside = move |value: f64| value.clamp(-reach, reach);
    Panel {
        title: String::new(),
        x_label: "time since the start, h".to_owned(),
        y_label: "SOC error, points".to_owned(),
        bands: band(samples.iter().map(|s| (s.time_s / 3600.0, 0.0, inside(s.half_width_points())))),
        lines: vec![line(
            "estimate - truth",
            Colour::ORANGE,
            samples.iter().map(|s| (s.time_s / 3600.0, inside(s.error_points()))),
        )],
        y_range: Some((-reach, reach)),
    }
}

fn life_panels(title: &str, each: &[DischargeScore]) -> [Panel; 3] {
    let number = |d: &DischargeScore| d.number as f64;
    let panel = |title: &str, y_label: &str, bands, lines| Panel {
        title: title.to_owned(),
        x_label: "discharge".to_owned(),
        y_label: y_label.to_owned(),
        bands,
        lines,
        y_range: None,
    };
    let usable = panel(
        title,
        "usable capacity, Ah",
        band(each.iter().map(|d| (number(d), d.usable_ah, STD_OF_95 * d.usable_std_ah))),
        vec![
            line("published", Colour::BLACK, each.iter().filter_map(|d| Some((number(d), d.truth_ah?)))),
            line("estimate", Colour::ORANGE, each.iter().map(|d| (number(d), d.usable_ah))),
        ],
    );
    let capacity = panel(
        "",
        "capacity, Ah",
        band(each.iter().map(|d| (number(d), d.capacity_ah, STD_OF_95 * d.capacity_std_ah))),
        vec![line("estimate", Colour::BLUE, each.iter().map(|d| (number(d), d.capacity_ah)))],
    );
    let resistance = panel(
        "",
        "resistance, times new",
        band(each.iter().map(|d| (number(d), d.resistance_ratio, STD_OF_95 * d.resistance_ratio_std))),
        vec![line("estimate", Colour::GREEN, each.iter().map(|d| (number(d), d.resistance_ratio)))],
    );
    [usable, capacity, resistance]
}
