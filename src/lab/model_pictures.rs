//! Draws a cell model: the open-circuit curve and its slope, the resistances over SOC and over temperature, and the SOC
//! error.
//!
//! Bands are 95 % intervals ([`ModelBands`]). If a model does not state the error of its curve, the curve has no band,
//! and the description of the picture says so. A line is dashed outside the measured range and where its value is only
//! a prior.

use crate::cell::model_bands::CURVE_C;
use crate::cell::{CellModel, ModelBands};
use crate::chart::{Axis, Chart, Ink, Layer, Picture, Shape};
use crate::config::cell_model::{KnownBy, SourcedModel};

const POINTS: u32 = 200;
/// Largest temperature range that is drawn, degrees Celsius. The axis ends earlier if the tables do.
const SHOWN_C: (f64, f64) = (-20.0, 50.0);
/// Temperature of the line for a cold cell, degrees Celsius.
const COLD_C: f64 = 0.0;
/// The height of the y axis is chosen for the curve above this SOC (percent). Below it, slope and resistance rise
/// steeply and may leave the picture.
const STEEP_PERCENT: f64 = 12.0;

/// Returns all pictures with their file names.
pub fn all(sourced: &SourcedModel) -> Vec<(String, Picture)> {
    let pictures = [
        ("model_curve", Some(curve(sourced))),
        ("model_slope", Some(slope(sourced))),
        ("model_resistance", Some(resistance_over_soc(sourced))),
        ("model_temperature", resistance_over_temperature(sourced)),
        ("model_soc_error", soc_error(&sourced.model)),
    ];
    pictures.into_iter().filter_map(|(name, picture)| Some((name.to_owned(), picture?))).collect()
}

fn along(low: f64, high: f64) -> impl Iterator<Item = f64> + Clone {
    (0..=POINTS).map(move |k| low + (high - low) * f64::from(k) / f64::from(POINTS))
}

/// Creates a y axis from 0 to the highest point above [`STEEP_PERCENT`], with 10 % of headroom.
fn from_0(label: &str, layers: &[Layer]) -> Axis {
    let highest = layers.iter().flat_map(|layer| match &layer.shape {
        Shape::Line(points) | Shape::Dashed(points) => points.clone(),
        Shape::Band(points) => points.iter().map(|(x, _, high)| (*x, *high)).collect(),
        _ => Vec::new(),
    });
    let highest = highest.filter(|(x, y)| *x >= STEEP_PERCENT && y.is_finite()).map(|(_, y)| y).fold(0.0, f64::max);
    Axis::number(label).within(0.0, 1.1 * highest)
}

fn chart(title: String, description: &str, x: Axis, y: impl Into<Axis>, layers: Vec<Layer>) -> Picture {
    Picture::Chart(Chart { description: description.to_owned(), ..Chart::new(title, x, y, layers) })
}

fn soc_axis() -> Axis {
    Axis::number("SOC, %").within(0.0, 100.0)
}

/// Draws a line that is dashed where nothing was measured. The solid and the dashed part share the point where they
/// meet.
fn line(label: &str, ink: Ink, points: &[(f64, f64)], is_measured: impl Fn(f64) -> bool) -> Vec<Layer> {
    let part = |wanted: bool| -> Vec<(f64, f64)> {
        let near = |k: usize| {
            let around = k.saturating_sub(usize::from(!wanted))..(k + 1 + usize::from(!wanted)).min(points.len());
            points[around].iter().any(|(x, _)| is_measured(*x) == wanted)
        };
        let hidden = |k: usize, (x, y): (f64, f64)| if near(k) { (x, y) } else { (x, f64::NAN) };
        points.iter().enumerate().map(|(k, point)| hidden(k, *point)).collect()
    };
    let (solid, dashed) = (part(true), part(false));
    let has = |points: &[(f64, f64)]| points.iter().any(|(_, y)| y.is_finite());
    let mut layers = Vec::new();
    if has(&solid) {
        layers.push(Layer::new(label, ink, Shape::Line(solid)));
    }
    if has(&dashed) {
        let label = if layers.is_empty() { label.to_owned() } else { format!("{label}, not measured") };
        layers.push(Layer::new(&label, ink, Shape::Dashed(dashed)));
    }
    layers
}

fn is_known(known_by: KnownBy) -> bool {
    matches!(known_by, KnownBy::Measured | KnownBy::NotStated)
}

fn curve(sourced: &SourcedModel) -> Picture {
    let bands = ModelBands::new(&sourced.model);
    let band = along(0.0, 1.0).filter_map(|soc| {
        let (v, half_v) = (bands.ocv_v(soc), crate::OF_95 * bands.curve_std_v(soc)?);
        Some((100.0 * soc, v - half_v, v + half_v))
    });
    let band: Vec<_> = band.collect();
    let about = if band.is_empty() {
        "Open-circuit voltage; the model states no error"
    } else {
        "Open-circuit voltage with its 95 % interval"
    };
    let points: Vec<_> = along(0.0, 1.0).map(|soc| (100.0 * soc, bands.ocv_v(soc))).collect();
    let mut layers = Vec::new();
    if !band.is_empty() {
        layers.push(Layer::band("95 % interval", Ink::Blue, band));
    }
    layers.extend(line("curve", Ink::Blue, &points, |soc| is_known(sourced.curve_known_by(0.01 * soc))));
    chart(format!("{}: open-circuit voltage at 25 \u{b0}C", sourced.model.name), about, soc_axis(), "V", layers)
}

fn slope(sourced: &SourcedModel) -> Picture {
    let bands = ModelBands::new(&sourced.model);
    let points: Vec<_> = along(0.0, 1.0).map(|soc| (100.0 * soc, 10.0 * bands.slope_v(soc))).collect();
    let layers = line("", Ink::Blue, &points, |soc| is_known(sourced.curve_known_by(0.01 * soc)));
    let title = "Slope of the curve: how much of the SOC a voltage shows".to_owned();
    chart(
        title,
        "Slope of the open-circuit voltage, mV per percent of SOC",
        soc_axis(),
        from_0("mV per %", &layers),
        layers,
    )
}

/// Draws the steady-state resistance (milliohm) over `x`, with its 95 % interval. `place` converts `x` to (SOC,
/// temperature).
fn resistance_layers(
    sourced: &SourcedModel,
    (label, ink): (&str, Ink),
    xs: impl Iterator<Item = f64> + Clone,
    place: impl Fn(f64) -> (f64, f64),
) -> Vec<Layer> {
    let (model, bands) = (&sourced.model, ModelBands::new(&sourced.model));
    let milliohm = |x: f64| {
        let (soc, temperature_c) = place(x);
        1e3 * model.settled_ohm(&model.grid_position(soc, temperature_c))
    };
    let band = xs.clone().map(|x| {
        let (soc, temperature_c) = place(x);
        let factor = (crate::OF_95 * bands.resistance(soc, temperature_c).std()).exp();
        (x, milliohm(x) / factor, milliohm(x) * factor)
    });
    let points: Vec<_> = xs.map(|x| (x, milliohm(x))).collect();
    let mut layers = vec![Layer::band(&format!("{label}, 95 % interval"), ink, band)];
    layers.extend(line(label, ink, &points, |x| is_known(sourced.resistances_known_by(place(x).1))));
    layers
}

fn resistance_over_soc(sourced: &SourcedModel) -> Picture {
    let soc = || along(0.0, 100.0);
    let warm = resistance_layers(sourced, ("25 \u{b0}C", Ink::Blue), soc(), |x| (0.01 * x, CURVE_C));
    let has_cold = ends_c(&sourced.model).is_some_and(|(low, high)| low <= COLD_C && COLD_C <= high);
    let cold = has_cold.then(|| resistance_layers(sourced, ("0 \u{b0}C", Ink::Purple), soc(), |x| (0.01 * x, COLD_C)));
    let layers: Vec<Layer> = cold.into_iter().flatten().chain(warm).collect();
    let title = "Resistance once settled, over SOC".to_owned();
    chart(title, "Settled resistance, milliohm, over SOC", soc_axis(), from_0("m\u{3a9}", &layers), layers)
}

fn ends_c(model: &CellModel) -> Option<(f64, f64)> {
    match model.temperature_c[..] {
        [low, .., high] => Some((low, high)),
        _ => None,
    }
}

fn resistance_over_temperature(sourced: &SourcedModel) -> Option<Picture> {
    let (low, high) = ends_c(&sourced.model)?;
    let (low, high) = (low.max(SHOWN_C.0), high.min(SHOWN_C.1));
    if low >= high {
        return None;
    }
    let of_soc = |(soc, ink): (f64, Ink)| {
        resistance_layers(sourced, (&format!("SOC {:.0} %", 100.0 * soc), ink), along(low, high), move |t| (soc, t))
    };
    let layers = [(0.5, Ink::Blue), (0.2, Ink::Orange)].into_iter().rev().flat_map(of_soc).collect();
    let axis = Axis::number("temperature, \u{b0}C").within(low, high);
    let title = "Resistance once settled, over temperature".to_owned();
    Some(chart(title, "Settled resistance, milliohm, over temperature", axis, "m\u{3a9}", layers))
}

fn soc_error(model: &CellModel) -> Option<Picture> {
    let bands = ModelBands::new(model);
    let line = |of: &dyn Fn(f64) -> Option<f64>| {
        along(0.0, 1.0).filter_map(|soc| Some((100.0 * soc, 100.0 * of(soc)?))).collect::<Vec<_>>()
    };
    let (rest, load) = (line(&|soc| bands.rest_soc_std(soc)), line(&|soc| bands.load_soc_std(soc, CURVE_C)));
    if rest.is_empty() || load.is_empty() {
        return None;
    }
    let layers = vec![Layer::line("under load, C/2", Ink::Orange, load), Layer::line("at rest", Ink::Blue, rest)];
    let title = "Error of the SOC from one voltage, standard deviation at 25 \u{b0}C".to_owned();
    Some(chart(title, "Error of the SOC caused by the error of the model, points", soc_axis(), "points", layers))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::{Chemistry, Label};
    use crate::chart::Size;
    use crate::config::of_label;

    fn prior() -> SourcedModel {
        of_label(&Label::usual(Chemistry::NcaGraphite, 2.9)).expect("a model")
    }

    #[test]
    fn pictures_of_a_label_have_bands_and_finite_numbers() {
        let pictures = all(&prior());
        assert_eq!(pictures.len(), 5);
        for (name, picture) in pictures {
            let (text, height) = picture.draw(Size::WIDE);
            assert!(height > 100.0 && !text.contains("NaN") && !text.contains("inf"), "{name}");
            let has_band = text.contains("95 % interval");
            assert_eq!(has_band, !["model_slope", "model_soc_error"].contains(&name.as_str()), "{name}");
        }
    }

    #[test]
    fn unmeasured_parts_of_a_line_are_dashed() {
        let points: Vec<(f64, f64)> = (0..10).map(|x| (f64::from(x), 1.0)).collect();
        let shapes = |is_measured: fn(f64) -> bool| {
            let of = |layer: Layer| match layer.shape {
                Shape::Line(points) => ('-', points.iter().filter(|p| p.1.is_finite()).count()),
                Shape::Dashed(points) => ('.', points.iter().filter(|p| p.1.is_finite()).count()),
                other => panic!("{other:?}"),
            };
            line("", Ink::Blue, &points, is_measured).into_iter().map(of).collect::<Vec<_>>()
        };
        assert_eq!(shapes(|_| true), [('-', 10)]);
        assert_eq!(shapes(|_| false), [('.', 10)]);
        // Points 4 to 9 were measured. The dashed line ends at point 4.
        assert_eq!(shapes(|x| x > 3.5), [('-', 6), ('.', 5)]);
    }

    #[test]
    fn curve_of_a_model_without_error_has_no_band() {
        let mut sourced = prior();
        (sourced.model.spread, sourced.model.voltage_error_v) = (None, None);
        let pictures = all(&sourced);
        assert_eq!(pictures.len(), 4, "no error of the SOC");
        assert!(!pictures[0].1.draw(Size::WIDE).0.contains("interval"));
    }
}
