//! Plots as SVG: panels one below the other, each with lines, bands and a legend.
//!
//! In: points in the units that the axis labels name; a point that is not finite interrupts its line. Out: one SVG file,
//! written over what was there. A long series is cut down to its extremes in about a thousand bins along x, so that peaks survive
//! and the file stays small.

use std::ops::Range;
use std::path::Path;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

/// Width of a plot, pixels.
const WIDTH: u32 = 1100;
/// Height of one panel, pixels.
const PANEL_HEIGHT: u32 = 300;
/// Bins along x that a series is cut into: about one per pixel of the drawing area.
const BINS: usize = 1000;
/// Room above and below the data, fraction of their range.
const MARGIN: f64 = 0.05;

/// Colours that people with any colour vision can tell apart (Okabe and Ito).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Colour(u8, u8, u8);

impl Colour {
    pub(crate) const BLACK: Self = Self(0, 0, 0);
    pub(crate) const BLUE: Self = Self(0, 114, 178);
    pub(crate) const ORANGE: Self = Self(213, 94, 0);
    pub(crate) const GREEN: Self = Self(0, 158, 115);
    pub(crate) const SKY: Self = Self(86, 180, 233);

    fn rgb(self) -> RGBColor {
        RGBColor(self.0, self.1, self.2)
    }
}

/// A line through points.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Line {
    /// For the legend; empty = not in it.
    pub(crate) label: String,
    pub(crate) colour: Colour,
    /// (x, y), x not falling.
    pub(crate) points: Vec<(f64, f64)>,
}

/// The area between two lines.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Band {
    /// For the legend; empty = not in it.
    pub(crate) label: String,
    pub(crate) colour: Colour,
    /// (x, lower, upper), x not falling.
    pub(crate) points: Vec<(f64, f64, f64)>,
}

/// One pair of axes.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Panel {
    pub(crate) title: String,
    /// With unit.
    pub(crate) x_label: String,
    /// With unit.
    pub(crate) y_label: String,
    /// Below the lines.
    pub(crate) bands: Vec<Band>,
    pub(crate) lines: Vec<Line>,
    /// Ends of the y axis; `None` = from the data.
    pub(crate) y_range: Option<(f64, f64)>,
}

/// Why there is no plot.
#[derive(Debug, thiserror::Error)]
#[error("{path}: the plot cannot be written: {what}")]
pub struct PlotError {
    path: String,
    what: String,
}

/// Draws `panels` one below the other and writes them to `path`.
///
/// # Errors
/// The file cannot be written, or the drawing failed, with the reason.
pub(crate) fn write(path: &Path, panels: &[Panel]) -> Result<(), PlotError> {
    let failed = |what: String| PlotError { path: path.display().to_string(), what };
    let svg = draw(panels).map_err(failed)?;
    std::fs::write(path, svg).map_err(|e| failed(e.to_string()))
}

/// The SVG text.
fn draw(panels: &[Panel]) -> Result<String, String> {
    let mut svg = String::new();
    let count = panels.len().max(1);
    let height = PANEL_HEIGHT.saturating_mul(u32::try_from(count).unwrap_or(u32::MAX));
    {
        let root = SVGBackend::with_string(&mut svg, (WIDTH, height)).into_drawing_area();
        root.fill(&WHITE).map_err(|e| e.to_string())?;
        for (area, panel) in root.split_evenly((count, 1)).iter().zip(panels) {
            draw_panel(area, panel).map_err(|e| e.to_string())?;
        }
        root.present().map_err(|e| e.to_string())?;
    }
    Ok(svg)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Chart<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type DrawError<'b> = DrawingAreaErrorKind<<SVGBackend<'b> as DrawingBackend>::ErrorType>;

fn draw_panel<'b>(area: &Area<'b>, panel: &Panel) -> Result<(), DrawError<'b>> {
    let (x_range, y_range) = ranges(panel);
    let mut chart = ChartBuilder::on(area);
    chart
        .caption(&panel.title, ("sans-serif", 16))
        .margin(8)
        .margin_right(16)
        .x_label_area_size(36)
        .y_label_area_size(64);
    let (x_digits, y_digits) = (digits(&x_range), digits(&y_range));
    let mut chart = chart.build_cartesian_2d(x_range, y_range)?;
    chart
        .configure_mesh()
        .x_label_formatter(&|x| format!("{x:.x_digits$}"))
        .y_label_formatter(&|y| format!("{y:.y_digits$}"))
        .x_desc(&panel.x_label)
        .y_desc(&panel.y_label)
        .label_style(("sans-serif", 12))
        .axis_desc_style(("sans-serif", 13))
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.12))
        .draw()?;
    panel.bands.iter().try_for_each(|band| draw_band(&mut chart, band))?;
    panel.lines.iter().try_for_each(|line| draw_line(&mut chart, line))?;
    let labelled = panel.lines.iter().map(|l| &l.label).chain(panel.bands.iter().map(|b| &b.label));
    if labelled.filter(|label| !label.is_empty()).count() > 0 {
        chart
            .configure_series_labels()
            .position(if rises(panel) { SeriesLabelPosition::LowerRight } else { SeriesLabelPosition::UpperRight })
            .background_style(WHITE.mix(0.85))
            .border_style(BLACK.mix(0.2))
            .label_font(("sans-serif", 12))
            .draw()?;
    }
    Ok(())
}

fn draw_band<'b>(chart: &mut Chart<'_, 'b>, band: &Band) -> Result<(), DrawError<'b>> {
    let style = band.colour.rgb().mix(0.25).filled();
    let mut label = Some(band.label.as_str()).filter(|label| !label.is_empty());
    for run in finite_runs(&band.points, |p| p.0.is_finite() && p.1.is_finite() && p.2.is_finite()) {
        let lower = thin(&run.iter().map(|p| (p.0, p.1)).collect::<Vec<_>>());
        let upper = thin(&run.iter().map(|p| (p.0, p.2)).collect::<Vec<_>>());
        let outline: Vec<_> = lower.into_iter().chain(upper.into_iter().rev()).collect();
        let drawn = chart.draw_series(std::iter::once(Polygon::new(outline, style)))?;
        if let Some(label) = label.take() {
            drawn.label(label).legend(move |(x, y)| Rectangle::new([(x, y - 5), (x + 18, y + 5)], style));
        }
    }
    Ok(())
}

fn draw_line<'b>(chart: &mut Chart<'_, 'b>, line: &Line) -> Result<(), DrawError<'b>> {
    let style = line.colour.rgb().stroke_width(1);
    let mut label = Some(line.label.as_str()).filter(|label| !label.is_empty());
    for run in finite_runs(&line.points, |p| p.0.is_finite() && p.1.is_finite()) {
        let drawn = chart.draw_series(LineSeries::new(thin(run), style))?;
        if let Some(label) = label.take() {
            drawn.label(label).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style.stroke_width(2)));
        }
    }
    Ok(())
}

/// Decimals that tell about ten marks on an axis apart.
fn digits(range: &Range<f64>) -> usize {
    let step = (range.end - range.start) / 10.0;
    (0..6).find(|&digits| step >= 10.0_f64.powi(-digits)).map_or(6, |digits| digits as usize)
}

/// Whether the data end higher than they begin, so that the legend would hide them at the upper right.
fn rises(panel: &Panel) -> bool {
    let finite = |line: &&Line| line.points.iter().filter(|p| p.1.is_finite()).count() > 1;
    let change = |line: &Line| {
        let finite = || line.points.iter().map(|p| p.1).filter(|y| y.is_finite());
        finite().next_back().unwrap_or(0.0) - finite().next().unwrap_or(0.0)
    };
    panel.lines.iter().filter(finite).map(change).sum::<f64>() > 0.0
}

/// Stretches of points without a hole.
fn finite_runs<P>(points: &[P], finite: impl Fn(&P) -> bool) -> impl Iterator<Item = &[P]> {
    points.split(move |point| !finite(point)).filter(|run| !run.is_empty())
}

/// First, lowest, highest and last point of each of [`BINS`] bins along x, in their order; a short series as it is.
fn thin(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let (Some(first), Some(last)) = (points.first(), points.last()) else { return Vec::new() };
    if points.len() <= 4 * BINS {
        return points.to_vec();
    }
    let width = ((last.0 - first.0) / BINS as f64).max(f64::MIN_POSITIVE);
    let bin_of = |point: &(f64, f64)| ((point.0 - first.0) / width).floor();
    let mut kept = Vec::with_capacity(4 * BINS);
    for bin in points.chunk_by(|a, b| bin_of(a) == bin_of(b)) {
        let by_y = |a: &usize, b: &usize| bin[*a].1.total_cmp(&bin[*b].1);
        let lowest = (0..bin.len()).min_by(by_y).unwrap_or(0);
        let highest = (0..bin.len()).max_by(by_y).unwrap_or(0);
        let mut chosen = [0, lowest, highest, bin.len() - 1];
        chosen.sort_unstable();
        kept.extend(chosen.into_iter().map(|index| bin[index]));
    }
    kept.dedup();
    kept
}

/// Ends of both axes: the finite data with a margin in y; never empty.
fn ranges(panel: &Panel) -> (Range<f64>, Range<f64>) {
    let lines = panel.lines.iter().flat_map(|line| line.points.iter().copied());
    let bands = panel.bands.iter().flat_map(|band| band.points.iter().flat_map(|p| [(p.0, p.1), (p.0, p.2)]));
    let none = (f64::INFINITY, f64::NEG_INFINITY);
    let grow = |range: (f64, f64), value: f64| (range.0.min(value), range.1.max(value));
    let finite = lines.chain(bands).filter(|p| p.0.is_finite() && p.1.is_finite());
    let (x, y) = finite.fold((none, none), |(x, y), p| (grow(x, p.0), grow(y, p.1)));
    let x = opened(x, 0.0);
    let y = panel.y_range.map_or_else(|| opened(y, MARGIN), |y| opened(y, 0.0));
    (x, y)
}

/// A range as an axis needs it: not empty, with room at both ends.
fn opened((low, high): (f64, f64), margin: f64) -> Range<f64> {
    if low > high {
        return 0.0..1.0;
    }
    let width = high - low;
    // Too narrow for ticks that can be told apart: some room round the value.
    let room = if width <= 1e-9 * low.abs().max(1e-3) { 0.5 * low.abs().max(1.0) } else { margin * width };
    low - room..high + room
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(points: Vec<(f64, f64)>) -> Panel {
        let line = Line { label: "SOC & <truth>".into(), colour: Colour::BLUE, points };
        Panel {
            title: "cell".into(),
            x_label: "hours".into(),
            y_label: "%".into(),
            lines: vec![line],
            ..Panel::default()
        }
    }

    #[test]
    fn a_single_peak_survives_the_thinning() {
        let mut points: Vec<(f64, f64)> = (0..200_000).map(|i| (f64::from(i), 0.0)).collect();
        points[77_777].1 = 5.0;
        points[123_456].1 = -3.0;
        let kept = thin(&points);
        assert!(kept.len() <= 4 * BINS + 4, "{} points", kept.len());
        assert!(kept.contains(&(77_777.0, 5.0)) && kept.contains(&(123_456.0, -3.0)));
        assert!(kept.is_sorted_by(|a, b| a.0 <= b.0), "out of order");
        assert_eq!((kept.first(), kept.last()), (points.first(), points.last()));
    }

    #[test]
    fn a_hole_interrupts_a_line_and_does_not_stretch_the_axes() {
        let points = vec![(0.0, 1.0), (1.0, 2.0), (2.0, f64::NAN), (3.0, 1.0), (f64::INFINITY, 9.0)];
        assert_eq!(finite_runs(&points, |p| p.0.is_finite() && p.1.is_finite()).count(), 2);
        let (x, y) = ranges(&panel(points));
        assert_eq!((x, y), (0.0..3.0, 0.95..2.05));
    }

    #[test]
    fn nothing_and_a_constant_still_give_axes() {
        assert_eq!(ranges(&panel(Vec::new())), (0.0..1.0, 0.0..1.0));
        let (x, y) = ranges(&panel(vec![(4.0, 0.0)]));
        assert!(x.start < 4.0 && x.end > 4.0 && y.start < 0.0 && y.end > 0.0);
    }

    #[test]
    fn the_file_is_svg_with_escaped_labels_and_a_bad_path_is_told() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("plot.svg");
        let mut with_band = panel(vec![(0.0, 1.0), (1.0, 2.0)]);
        with_band.bands =
            vec![Band { label: "95 %".into(), colour: Colour::SKY, points: vec![(0.0, 0.5, 1.5), (1.0, 1.5, 2.5)] }];
        write(&path, &[with_band, panel(Vec::new())]).expect("drawn");
        let text = std::fs::read_to_string(&path).expect("readable");
        assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"));
        assert!(text.contains("SOC &amp; &lt;truth&gt;") && text.contains("<polygon"), "{text}");
        let error = write(&folder.path().join("no/such.svg"), &[]).expect_err("no folder");
        assert!(error.to_string().contains("such.svg: the plot cannot be written"), "{error}");
    }
}
