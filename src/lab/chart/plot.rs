//! Draws lines, bands, points and thresholds over one pair of axes.

use super::axis::Axis;
use super::style::Ink;
use super::svg::{PathBuilder, Svg, short, text_width};
use super::{Size, thin};

/// Font size of ticks and legend (pixels), as in the style sheet.
const SMALL: f64 = 11.5;
const ROW: f64 = 18.0;
const FOOT: f64 = 38.0;
const DOT: f64 = 2.6;

/// A value drawn as a point.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Point {
    pub x: f64,
    pub y: f64,
    /// Tool tip; may be empty.
    pub tip: String,
}

/// Shape of a layer. The x values must not decrease.
#[derive(Debug, Clone, PartialEq)]
pub enum Shape {
    /// Line through points (x, y).
    Line(Vec<(f64, f64)>),
    /// Dashed line through points (x, y).
    Dashed(Vec<(f64, f64)>),
    /// Band of (x, lower, upper).
    Band(Vec<(f64, f64, f64)>),
    Points(Vec<Point>),
    /// Texts next to points: above a positive y, below a negative y. A text that would touch the previous text is left
    /// out.
    Labels(Vec<Point>),
    /// Threshold: a horizontal line at this y.
    Level(f64),
    /// Events: vertical lines at these x, with tool tips.
    Moments(Vec<Point>),
}

/// One layer of a chart. Later layers are drawn above earlier layers.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer {
    /// Label in the legend; empty = not in the legend.
    pub label: String,
    pub ink: Ink,
    pub shape: Shape,
}

impl Layer {
    pub fn new(label: &str, ink: Ink, shape: Shape) -> Self {
        Self { label: label.to_owned(), ink, shape }
    }

    /// Creates a line through points (x, y).
    pub fn line(label: &str, ink: Ink, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        Self::new(label, ink, Shape::Line(points.into_iter().collect()))
    }

    /// Creates a band of (x, lower, upper).
    pub fn band(label: &str, ink: Ink, points: impl IntoIterator<Item = (f64, f64, f64)>) -> Self {
        Self::new(label, ink, Shape::Band(points.into_iter().collect()))
    }
}

/// Layers over one pair of axes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Chart {
    pub title: String,
    /// Description for readers who cannot see the picture.
    pub description: String,
    pub x: Axis,
    pub y: Axis,
    pub layers: Vec<Layer>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Area {
    pub(super) left: f64,
    pub(super) top: f64,
    pub(super) width: f64,
    pub(super) height: f64,
    pub(super) x: (f64, f64),
    pub(super) y: (f64, f64),
}

impl Area {
    pub(super) fn px(&self, x: f64) -> f64 {
        self.width * (x - self.x.0) / (self.x.1 - self.x.0)
    }

    fn py(&self, y: f64) -> f64 {
        self.height * (self.y.1 - y) / (self.y.1 - self.y.0)
    }

    /// Returns as many ticks as have room for their labels.
    fn x_ticks(&self, axis: &Axis) -> Vec<(f64, String)> {
        let fits = |ticks: &[(f64, String)]| {
            let widest = ticks.iter().map(|(_, word)| text_width(word, SMALL)).fold(0.0, f64::max);
            // Labels are at least 16 pixels apart.
            ticks.windows(2).all(|pair| self.px(pair[1].0) - self.px(pair[0].0) >= widest + 16.0)
        };
        let counts = (1..=10).rev().map(f64::from);
        let mut choices = counts.map(|count| axis.ticks(self.x, count));
        choices.find(|ticks| fits(ticks)).unwrap_or_default()
    }

    pub(super) fn draw_x(&self, svg: &mut Svg, axis: &Axis) {
        let bottom = self.top + self.height;
        for (x, word) in self.x_ticks(axis) {
            let at = self.left + self.px(x);
            svg.path("g", &format!("M{} {}V{}", short(at), short(self.top), short(bottom)), "");
            svg.text(at, bottom + 15.0, "t m", &word);
        }
        svg.path("a", &format!("M{} {}h{}", short(self.left), short(bottom), short(self.width)), "");
        svg.text(self.left + self.width, bottom + 31.0, "t e", &axis.caption(self.x));
    }
}

impl Chart {
    /// Creates a chart without a description.
    pub fn new(title: impl Into<String>, x: impl Into<Axis>, y: impl Into<Axis>, layers: Vec<Layer>) -> Self {
        Self { title: title.into(), description: String::new(), x: x.into(), y: y.into(), layers }
    }

    /// Returns the elements and their height (pixels).
    pub(super) fn draw(&self, size: Size) -> (String, f64) {
        let mut svg = Svg::default();
        let mut top = title(&mut svg, &self.title, size.width);
        top = self.legend(&mut svg, size.width, top) + 8.0;
        let x = self.x.ends(self.layers.iter().flat_map(Layer::xs), false);
        let y = self.y.ends(self.layers.iter().flat_map(Layer::ys), true);
        let height = size.height - 60.0 - FOOT;
        let y_ticks = self.y.ticks(y, height / 28.0);
        let left = y_ticks.iter().map(|(_, word)| text_width(word, SMALL)).fold(16.0, f64::max) + 8.0;
        // The right margin has room for half of the last tick label.
        let area = Area { left, top, width: size.width - left - 22.0, height, x, y };
        for (y, word) in y_ticks {
            let at = top + area.py(y);
            svg.path("g", &format!("M{} {}h{}", short(left), short(at), short(area.width)), "");
            svg.text(left - 6.0, at + 4.0, "t e", &word);
        }
        area.draw_x(&mut svg, &self.x);
        svg.open_area((left, top), (area.width, height));
        self.layers.iter().for_each(|layer| layer.draw(&mut svg, &area));
        svg.close_area();
        (svg.0, top + height + FOOT)
    }

    /// Draws the label of the y axis and the legend in rows. Returns their lower edge.
    fn legend(&self, svg: &mut Svg, width: f64, top: f64) -> f64 {
        svg.text(0.0, top + 12.0, "t", &self.y.label);
        let (mut x, mut y) = (text_width(&self.y.label, SMALL) + 18.0, top);
        for layer in self.layers.iter().filter(|layer| !layer.label.is_empty()) {
            let needs = 26.0 + text_width(&layer.label, SMALL) + 12.0;
            if x + needs > width && x > 0.0 {
                (x, y) = (0.0, y + ROW);
            }
            layer.key(svg, x, y + 8.0);
            svg.text(x + 26.0, y + 12.0, "l", &layer.label);
            x += needs;
        }
        y + ROW
    }
}

/// Draws the title in as many lines as it needs. Returns their lower edge.
pub(super) fn title(svg: &mut Svg, text: &str, width: f64) -> f64 {
    let mut y = 0.0;
    for line in wrapped(text, width, 14.5) {
        svg.text(0.0, y + 16.0, "q", &line);
        y += 18.0;
    }
    if y > 0.0 { y + 6.0 } else { 0.0 }
}

pub(super) fn wrapped(text: &str, width: f64, size: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if text_width(line, size) + text_width(word, size) + size < width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

impl Layer {
    fn xs(&self) -> Box<dyn Iterator<Item = f64> + '_> {
        match &self.shape {
            Shape::Line(points) | Shape::Dashed(points) => {
                Box::new(points.iter().filter(|p| p.1.is_finite()).map(|p| p.0))
            }
            Shape::Band(points) => Box::new(points.iter().filter(|p| (p.1 + p.2).is_finite()).map(|p| p.0)),
            Shape::Points(points) | Shape::Labels(points) | Shape::Moments(points) => {
                Box::new(points.iter().map(|p| p.x))
            }
            Shape::Level(_) => Box::new(std::iter::empty()),
        }
    }

    fn ys(&self) -> Box<dyn Iterator<Item = f64> + '_> {
        match &self.shape {
            Shape::Line(points) | Shape::Dashed(points) => {
                Box::new(points.iter().filter(|p| p.0.is_finite()).map(|p| p.1))
            }
            Shape::Band(points) => Box::new(points.iter().filter(|p| p.0.is_finite()).flat_map(|p| [p.1, p.2])),
            Shape::Points(points) | Shape::Labels(points) => Box::new(points.iter().map(|p| p.y)),
            Shape::Moments(_) => Box::new(std::iter::empty()),
            Shape::Level(y) => Box::new(std::iter::once(*y)),
        }
    }

    /// Draws the legend symbol of the layer, 20 pixels wide and centred at `y`.
    fn key(&self, svg: &mut Svg, x: f64, y: f64) {
        let line = format!("M{} {}h20", short(x), short(y));
        match &self.shape {
            Shape::Line(_) => svg.path(&format!("s {}", self.ink.stroke()), &line, ""),
            Shape::Dashed(_) | Shape::Level(_) => svg.path(&format!("s d {}", self.ink.stroke()), &line, ""),
            Shape::Band(_) => svg.rect((x, y - 5.0), (20.0, 10.0), &self.ink.band(), ""),
            Shape::Points(_) => svg.circle((x + 10.0, y), 3.0, &self.ink.fill(), ""),
            Shape::Labels(_) => {}
            Shape::Moments(_) => {
                let d = format!("M{} {}v12", short(x + 10.0), short(y - 6.0));
                svg.path(&format!("s {}", self.ink.stroke()), &d, "");
            }
        }
    }

    fn draw(&self, svg: &mut Svg, area: &Area) {
        let bins = area.width.max(1.0) as usize;
        match &self.shape {
            Shape::Line(points) => {
                svg.path(&format!("s {}", self.ink.stroke()), &line_path(points, area, bins), &self.label);
            }
            Shape::Dashed(points) => {
                svg.path(&format!("s d {}", self.ink.stroke()), &line_path(points, area, bins), &self.label);
            }
            Shape::Band(points) => svg.path(&self.ink.band(), &band_path(points, area, bins), &self.label),
            Shape::Points(points) => self.draw_points(svg, area, points),
            Shape::Labels(points) => draw_labels(svg, area, points),
            Shape::Level(y) => {
                let d = format!("M0 {}h{}", short(area.py(*y)), short(area.width));
                svg.path(&format!("s d {}", self.ink.stroke()), &d, &self.label);
            }
            Shape::Moments(points) => {
                for point in points.iter().filter(|point| point.x.is_finite()) {
                    let d = format!("M{} 0v{}", short(area.px(point.x)), short(area.height));
                    svg.path(&format!("s {}", self.ink.stroke()), &d, &point.tip);
                }
            }
        }
    }

    fn draw_points(&self, svg: &mut Svg, area: &Area, points: &[Point]) {
        let finite = || points.iter().filter(|point| point.x.is_finite() && point.y.is_finite());
        // If a layer has more than 400 points, they have no tool tips.
        if finite().count() <= 400 {
            return finite().for_each(|point| {
                // A point at the edge of the area is moved inwards, because the area would cut off half of the dot.
                let x = area.px(point.x);
                let x = if (-0.5..=area.width + 0.5).contains(&x) { x.clamp(DOT, area.width - DOT) } else { x };
                svg.circle((x, area.py(point.y)), DOT, &self.ink.fill(), &point.tip);
            });
        }
        let places: Vec<(f64, f64)> = finite().map(|point| (point.x, point.y)).collect();
        let mut path = PathBuilder::default();
        let bins = area.width.max(1.0) as usize;
        thin::line(&places, bins).into_iter().for_each(|(x, y)| path.dot(area.px(x), area.py(y)));
        svg.path(&format!("o {}", self.ink.stroke()), &path.d, &self.label);
    }
}

fn draw_labels(svg: &mut Svg, area: &Area, points: &[Point]) {
    let mut free = f64::NEG_INFINITY;
    for point in points.iter().filter(|point| point.x.is_finite() && point.y.is_finite()) {
        let half = text_width(&point.tip, SMALL) / 2.0;
        let x = area.px(point.x).min(area.width - half).max(half);
        if x - half < free {
            continue;
        }
        // Texts are at least 4 pixels apart.
        free = x + half + 4.0;
        let y = area.py(point.y) + if point.y < 0.0 { 13.0 } else { -5.0 };
        svg.text(x, y.min(area.height - 3.0).max(11.0), "t m", &point.tip);
    }
}

fn line_path(points: &[(f64, f64)], area: &Area, bins: usize) -> String {
    let mut path = PathBuilder::default();
    for run in points.split(|p| !(p.0.is_finite() && p.1.is_finite())).filter(|run| !run.is_empty()) {
        path.lift();
        let kept = thin::line(run, bins);
        // A single value is drawn as a short line.
        if let [only] = kept[..] {
            path.to(area.px(only.0) - 1.0, area.py(only.1));
            path.to(area.px(only.0) + 1.0, area.py(only.1));
        }
        kept.into_iter().for_each(|(x, y)| path.to(area.px(x), area.py(y)));
    }
    path.d
}

fn band_path(points: &[(f64, f64, f64)], area: &Area, bins: usize) -> String {
    let mut path = PathBuilder::default();
    for run in points.split(|p| !(p.0.is_finite() && p.1.is_finite() && p.2.is_finite())).filter(|run| !run.is_empty())
    {
        path.lift();
        let kept = thin::band(run, bins);
        kept.iter().for_each(|p| path.to(area.px(p.0), area.py(p.2)));
        kept.iter().rev().for_each(|p| path.to(area.px(p.0), area.py(p.1)));
        path.d.push('z');
    }
    path.d
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(layers: Vec<Layer>) -> Chart {
        Chart { title: "cell".into(), x: Axis::number("hours"), y: Axis::number("SOC, %"), layers, ..Chart::default() }
    }

    #[test]
    fn gap_interrupts_a_line_and_keeps_the_axes() {
        let points = vec![(0.0, 1.0), (1.0, 2.0), (2.0, f64::NAN), (3.0, 1.0), (f64::INFINITY, 9.0)];
        let layer = Layer::new("SOC & <truth>", Ink::Blue, Shape::Line(points));
        assert_eq!(Axis::default().ends(layer.xs(), false), (0.0, 3.0));
        let area = Area { left: 0.0, top: 0.0, width: 300.0, height: 100.0, x: (0.0, 3.0), y: (1.0, 2.0) };
        let Shape::Line(points) = &layer.shape else { panic!("a line") };
        assert_eq!(line_path(points, &area, 300), "M0 100l100-100M299 100l2 0l-1 0");
    }

    #[test]
    fn every_alarm_is_kept_and_labels_are_escaped() {
        let moments = (0..5000).map(|i| Point { x: f64::from(i), y: 0.0, tip: format!("alarm {i}") }).collect();
        let layers = vec![
            Layer::new("SOC & <truth>", Ink::Blue, Shape::Level(1.0)),
            Layer::new("alarms", Ink::Red, Shape::Moments(moments)),
        ];
        let (text, height) = chart(layers).draw(Size::WIDE);
        assert_eq!(text.matches("<title>alarm ").count(), 5000);
        assert!(text.contains("SOC &amp; &lt;truth&gt;") && height > 100.0);
    }

    #[test]
    fn empty_chart_is_still_a_picture() {
        let (text, _) = chart(Vec::new()).draw(Size::NARROW);
        assert!(text.contains("hours") && !text.contains("NaN"), "{text}");
    }

    #[test]
    fn long_legend_continues_in_the_next_row() {
        let layers = (0..6).map(|i| Layer::new(&format!("a rather long label {i}"), Ink::Blue, Shape::Level(1.0)));
        let chart = chart(layers.collect());
        let more = chart.draw(Size::NARROW).1 - chart.draw(Size { width: 2000.0, ..Size::NARROW }).1;
        // One label fits next to the name of the axis, then two labels per row.
        assert!((more - 3.0 * ROW).abs() < 0.1, "{more} pixels");
    }
}
