//! Draws pictures of regressions and of forecasts.
//!
//! A regression has three charts: predicted over measured values, a section of rows with 95 % intervals, and the error
//! of every row. A forecast starts at a row, the origin. Its charts show the forecast after the origin with the 95 %
//! intervals (the fan). If later rows are known, they also show the error and the coverage of the forecasts by the
//! number of rows ahead.

use std::path::Path;

use super::forecast::{HorizonForecast, OutputForecast, TableForecast};
use super::{ColumnTable, CrossValidation, table};
use crate::chart::{self, Axis, Chart, Ink, Layer, Picture, PlotError, Point, Shape};

/// Number of rows in the chart with 95 % intervals. With more rows, single rows would not be visible.
const STRETCH: usize = 150;

/// Draws the cross-validation of every kernel as SVG files.
///
/// # Errors
/// A file cannot be written.
pub fn write_cross_validation(folder: &Path, data: &ColumnTable, all: &[CrossValidation]) -> Result<(), PlotError> {
    let output = data.names.last().map_or("", String::as_str);
    let truth: Vec<f64> = data.column(data.width() - 1).collect();
    for validated in all {
        let charts =
            [scatter(validated, &truth, output), stretch(validated, &truth, output), errors(validated, &truth, output)];
        write_charts(folder, &format!("cv_{}", slug(&validated.kernel)), charts.into())?;
    }
    Ok(())
}

/// Draws the forecasts of every output as SVG files.
///
/// # Errors
/// A file cannot be written.
pub fn write_forecast(folder: &Path, data: &ColumnTable, forecast: &TableForecast) -> Result<(), PlotError> {
    for output in &forecast.outputs {
        let mut charts = vec![fan(data, forecast, output)];
        if output.horizons.iter().any(|horizon| horizon.score.is_some()) {
            charts.extend([growth(output), coverage(output), held_out(data, output)]);
        }
        write_charts(folder, &format!("forecast_{}", slug(&output.name)), charts)?;
    }
    Ok(())
}

fn write_charts(folder: &Path, name: &str, charts: Vec<Chart>) -> Result<(), PlotError> {
    let pictures: Vec<Picture> = charts.into_iter().map(Picture::Chart).collect();
    chart::write_stack(&folder.join(format!("{name}.svg")), &pictures)
}

/// Makes a file name from the words of a text, joined by `_`. If the text contains `*`, `_product` is appended.
fn slug(text: &str) -> String {
    let words: Vec<&str> = text.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty()).collect();
    let joined = match text.contains('*') {
        true => format!("{}_product", words.join("_")),
        false => words.join("_"),
    };
    joined.chars().take(100).collect()
}

fn points(label: &str, ink: Ink, all: impl IntoIterator<Item = (f64, f64)>) -> Layer {
    let point = |(x, y)| Point { x, y, ..Point::default() };
    Layer::new(label, ink, Shape::Points(all.into_iter().map(point).collect()))
}

fn band(all: impl Iterator<Item = (f64, f64, f64)>) -> Layer {
    Layer::band("95 % interval", Ink::Blue, all)
}

fn scatter(validated: &CrossValidation, truth: &[f64], output: &str) -> Chart {
    // At most 3000 points are drawn.
    let every = truth.len().div_ceil(3000).max(1);
    let pairs = truth.iter().zip(&validated.folds.predictions).step_by(every);
    let mut pairs: Vec<(f64, f64)> = pairs.map(|(y, p)| (*y, p.mean)).collect();
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let ends = [pairs.first().map_or(0.0, |p| p.0), pairs.last().map_or(1.0, |p| p.0)];
    let label = if every == 1 { "held-out row".to_owned() } else { format!("held-out row, one of {every}") };
    let s = &validated.score;
    let (kernel, rmse, inside) = (&validated.kernel, s.rmse, 100.0 * s.coverage_95);
    let layers = vec![
        points(&label, Ink::Blue, pairs),
        Layer::line("equal", Ink::Plain, ends.into_iter().map(|end| (end, end))),
    ];
    let title = format!(
        "{}, {kernel}: predicted against measured; RMSE {rmse:.4}, {inside:.1} % inside the interval",
        stem(output)
    );
    Chart::new(
        title,
        format!("measured {}", table::label(output)),
        format!("predicted {}", table::label(output)),
        layers,
    )
}

fn stem(output: &str) -> String {
    table::label(output).split(',').next().unwrap_or_default().to_owned()
}

fn stretch(validated: &CrossValidation, truth: &[f64], output: &str) -> Chart {
    let begin = (truth.len() / 2).saturating_sub(STRETCH / 2);
    let rows = begin..(begin + STRETCH).min(truth.len());
    let at = |row: usize| &validated.folds.predictions[row];
    let layers = vec![
        band(rows.clone().map(|row| (row as f64 + 1.0, at(row).low_95, at(row).high_95))),
        Layer::line("predicted", Ink::Blue, rows.clone().map(|row| (row as f64 + 1.0, at(row).mean))),
        points("measured", Ink::Orange, rows.clone().map(|row| (row as f64 + 1.0, truth[row]))),
    ];
    let title = format!("Rows {} to {}, each predicted without itself", rows.start + 1, rows.end);
    Chart::new(title, "row", table::label(output), layers)
}

fn errors(validated: &CrossValidation, truth: &[f64], output: &str) -> Chart {
    let all = || truth.iter().zip(&validated.folds.predictions).enumerate();
    let half = |p: &crate::regress::Prediction| (p.high_95 - p.low_95) / 2.0;
    // The width of the interval varies from row to row, so it is averaged over a hundredth of the rows.
    let width = (truth.len() / 100).max(1);
    let halves = validated.folds.predictions.chunks(width).enumerate().map(|(k, chunk)| {
        let mean = chunk.iter().map(half).sum::<f64>() / chunk.len() as f64;
        ((k * width) as f64 + chunk.len() as f64 / 2.0, -mean, mean)
    });
    let layers =
        vec![points("error", Ink::Orange, all().map(|(row, (y, p))| (row as f64 + 1.0, p.mean - y))), band(halves)];
    let title = "Error of every row (the largest of many at one place), and the width of the interval";
    Chart::new(
        title,
        "row",
        format!("predicted - measured, {}", table::label(output).split(", ").nth(1).unwrap_or("")),
        layers,
    )
}

fn fan(data: &ColumnTable, forecast: &TableForecast, output: &OutputForecast) -> Chart {
    let most = output.horizons.last().map_or(1, |horizon| horizon.steps);
    let from = forecast.from;
    let value = |row: usize| data.row(row)[output.column];
    // The fan shows at least 60 rows before the origin.
    let rows = from.saturating_sub((2 * most).max(60))..(from + most + 1).min(data.len());
    let x = |row: usize| row as f64 - from as f64;
    let at = |horizon: &HorizonForecast| horizon.steps as f64;
    let now = [(0.0, value(from), value(from))];
    let fan = output.horizons.iter().map(|h| (at(h), h.at_origin.low_95, h.at_origin.high_95));
    let mean = output.horizons.iter().map(|h| (at(h), h.at_origin.mean));
    let layers = vec![
        band(now.into_iter().chain(fan)),
        Layer::line("measured", Ink::Plain, rows.map(|row| (x(row), value(row)))),
        Layer::line("forecast", Ink::Blue, [(0.0, value(from))].into_iter().chain(mean)),
    ];
    let title = format!("{}: forecast from row {} without any later data", stem(&output.name), from + 1);
    Chart::new(title, "rows after the origin", table::label(&output.name), layers)
}

fn growth(output: &OutputForecast) -> Chart {
    let over = |value: &dyn Fn(&HorizonForecast) -> Option<f64>| -> Vec<(f64, f64)> {
        output.horizons.iter().filter_map(|h| Some((h.steps as f64, value(h)?))).collect()
    };
    let layers = vec![
        Layer::line("persistence", Ink::Grey, over(&|h| h.persistence_rmse).into_iter()),
        Layer::line("forecast", Ink::Blue, over(&|h| h.score.map(|s| s.rmse)).into_iter()),
        Layer::line(
            "half of the mean 95 % interval",
            Ink::Green,
            over(&|h| h.score.map(|s| s.mean_width_95 / 2.0)).into_iter(),
        ),
    ];
    let title = "Error of the forecasts made after the origin";
    Chart::new(
        title,
        "rows ahead",
        format!("RMSE, {}", table::label(&output.name).split(", ").nth(1).unwrap_or("")),
        layers,
    )
}

fn coverage(output: &OutputForecast) -> Chart {
    let inside = |h: &HorizonForecast| h.score.map(|s| (h.steps as f64, 100.0 * s.coverage_95));
    let layers = vec![
        Layer::new("95 %", Ink::Grey, Shape::Level(95.0)),
        Layer::line("forecast", Ink::Blue, output.horizons.iter().filter_map(inside)),
    ];
    let title = "Share of the measured values inside the 95 % interval";
    Chart::new(title, "rows ahead", Axis::number("inside, %").within(0.0, 100.0), layers)
}

/// Draws the forecasts of the longest scored horizon (number of rows ahead) together with the measured values.
fn held_out(data: &ColumnTable, output: &OutputForecast) -> Chart {
    let Some(horizon) = output.horizons.iter().rfind(|h| h.score.is_some()) else { return Chart::default() };
    let for_row = |row: usize| (row + horizon.steps) as f64 + 1.0;
    let all = || horizon.held_out.iter();
    let layers = vec![
        band(all().map(|(row, p)| (for_row(*row), p.low_95, p.high_95))),
        Layer::line(
            "measured",
            Ink::Plain,
            all().map(|(row, _)| (for_row(*row), data.row(row + horizon.steps)[output.column])),
        ),
        Layer::line("forecast", Ink::Blue, all().map(|(row, p)| (for_row(*row), p.mean))),
    ];
    let title = format!("{} rows ahead: forecast and measured", horizon.steps);
    Chart::new(title, "row", table::label(&output.name), layers)
}
