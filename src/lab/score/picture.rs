//! Plots a run: the SOC and its error over time with 95 % bands, or the usable capacity of a life over its discharges.

use std::path::{Path, PathBuf};

use super::Case;
use super::life::{DischargeScore, LifeScore};
use super::soc::SocSample;
use crate::OF_95;
use crate::chart::{self, Axis, Chart, Ink, Layer, Picture, PlotError};

/// Names, in a title, of the two errors of a case: of its capacity and of its current.
const WORDS: [&str; 2] = ["capacity", "current"];

pub(super) fn draw(
    folder: &Path,
    name: &str,
    case: &Case,
    samples: &[SocSample],
    life: Option<&LifeScore>,
) -> Result<PathBuf, PlotError> {
    let title = format!("{name}, {}", case.words(", ", WORDS));
    let mut panels = Vec::new();
    if !samples.is_empty() {
        panels.extend([soc_panel(&title, samples), error_panel(samples)]);
    }
    panels.extend(life.into_iter().flat_map(|life| life_panels(&title, &life.each)));
    let path =
        folder.join(format!("{}_{}.svg", name.replace('/', "_"), case.words("_", WORDS).replace([' ', '%'], "")));
    let pictures: Vec<Picture> = panels.into_iter().map(Picture::Chart).collect();
    chart::write_stack(&path, &pictures)?;
    Ok(path)
}

fn band(points: impl Iterator<Item = (f64, f64, f64)>) -> Layer {
    // Converts (x, middle, half-width) to (x, lower, upper).
    let points = points.map(|(x, middle, half)| (x, middle - half, middle + half));
    Layer::band("95 % interval", Ink::Orange, points)
}

fn soc_panel(title: &str, samples: &[SocSample]) -> Chart {
    let over = |value: fn(&SocSample) -> f64| samples.iter().map(move |s| (s.time_s / 3600.0, value(s)));
    let layers = vec![
        band(samples.iter().map(|s| (s.time_s / 3600.0, 100.0 * s.soc, s.half_width_points()))),
        Layer::line("truth", Ink::Plain, over(|s| 100.0 * s.truth)),
        Layer::line("estimate", Ink::Orange, over(|s| 100.0 * s.soc)),
    ];
    Chart::new(title.to_owned(), "time since the start, h", Axis::number("SOC, %").within(-10.0, 110.0), layers)
}

fn error_panel(samples: &[SocSample]) -> Chart {
    // Before the estimate has settled, its errors are much larger. The axis is therefore scaled to the second half of
    // the run.
    let later = &samples[samples.len() / 2..];
    let reach = later.iter().map(|s| s.error_points().abs().max(s.half_width_points())).fold(1.0, f64::max) * 1.5;
    let inside = move |value: f64| value.clamp(-reach, reach);
    let layers = vec![
        band(samples.iter().map(|s| (s.time_s / 3600.0, 0.0, inside(s.half_width_points())))),
        Layer::line(
            "estimate - truth",
            Ink::Orange,
            samples.iter().map(|s| (s.time_s / 3600.0, inside(s.error_points()))),
        ),
    ];
    Chart::new("", "time since the start, h", Axis::number("SOC error, points").within(-reach, reach), layers)
}

fn life_panels(title: &str, each: &[DischargeScore]) -> [Chart; 3] {
    let number = |d: &DischargeScore| d.number as f64;
    let panel = |title: &str, y_label: &str, layers| Chart::new(title.to_owned(), "discharge", y_label, layers);
    let usable = panel(
        title,
        "usable capacity, Ah",
        vec![
            band(each.iter().map(|d| (number(d), d.usable_ah, OF_95 * d.usable_std_ah))),
            Layer::line("published", Ink::Plain, each.iter().filter_map(|d| Some((number(d), d.truth_ah?)))),
            Layer::line("estimate", Ink::Orange, each.iter().map(|d| (number(d), d.usable_ah))),
        ],
    );
    let capacity = panel(
        "",
        "capacity, Ah",
        vec![
            band(each.iter().map(|d| (number(d), d.capacity_ah, OF_95 * d.capacity_std_ah))),
            Layer::line("estimate", Ink::Blue, each.iter().map(|d| (number(d), d.capacity_ah))),
        ],
    );
    let resistance = panel(
        "",
        "resistance, times new",
        vec![
            band(each.iter().map(|d| (number(d), d.resistance_ratio, OF_95 * d.resistance_ratio_std))),
            Layer::line("estimate", Ink::Green, each.iter().map(|d| (number(d), d.resistance_ratio))),
        ],
    );
    [usable, capacity, resistance]
}
