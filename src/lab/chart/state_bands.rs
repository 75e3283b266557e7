//! Draws states over time as bands, which show when each alarm was raised.

use super::Size;
use super::axis::Axis;
use super::plot::{Area, title};
use super::style::Ink;
use super::svg::{Svg, text_width};

const NAME: f64 = 16.0;
const BAR: f64 = 12.0;
/// Minimum width of a span (pixels). It keeps the shortest alarm visible.
const LEAST: f64 = 3.0;

/// A state with its start and end.
#[derive(Debug, Clone, PartialEq)]
pub struct Span {
    pub from: f64,
    pub to: f64,
    pub ink: Ink,
    /// Tool tip.
    pub tip: String,
}

/// The spans of one state.
#[derive(Debug, Clone, PartialEq)]
pub struct StateBand {
    pub name: String,
    pub spans: Vec<Span>,
}

/// Bands, one below the other.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StateBands {
    pub title: String,
    pub description: String,
    pub x: Axis,
    pub bands: Vec<StateBand>,
    /// Legend: each colour and its meaning.
    pub keys: Vec<(Ink, String)>,
}

impl StateBands {
    /// Returns the SVG elements and their total height (pixels).
    pub(super) fn draw(&self, size: Size) -> (String, f64) {
        let mut svg = Svg::default();
        let mut top = title(&mut svg, &self.title, size.width);
        let mut x = 0.0;
        for (ink, word) in &self.keys {
            svg.rect((x, top + 3.0), (20.0, 10.0), &ink.fill(), "");
            svg.text(x + 26.0, top + 12.0, "l", word);
            x += 38.0 + text_width(word, 11.5);
        }
        top += 26.0;
        let spans = self.bands.iter().flat_map(|band| &band.spans);
        let ends = self.x.ends(spans.flat_map(|span| [span.from, span.to]), false);
        let height = self.bands.len() as f64 * (NAME + BAR + 6.0);
        let area = Area { left: 8.0, top, width: size.width - 30.0, height, x: ends, y: (0.0, 1.0) };
        area.draw_x(&mut svg, &self.x);
        for (index, band) in self.bands.iter().enumerate() {
            let y = top + index as f64 * (NAME + BAR + 6.0);
            svg.text(area.left, y + 12.0, "l", &band.name);
            svg.open_area((area.left, y + NAME), (area.width, BAR));
            for span in &band.spans {
                let (from, to) = (area.px(span.from), area.px(span.to));
                svg.rect(
                    (from.min(area.width - LEAST), 0.0),
                    ((to - from).max(LEAST), BAR),
                    &span.ink.fill(),
                    &span.tip,
                );
            }
            svg.close_area();
        }
        (svg.0, top + height + 40.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shortest_alarm_at_the_end_is_visible() {
        let span = Span { from: 100.0, to: 100.0, ink: Ink::Red, tip: "severe".into() };
        let band = StateBand { name: "capacity_low".into(), spans: vec![span] };
        let bands = StateBands { x: Axis::number("d").within(0.0, 100.0), bands: vec![band], ..StateBands::default() };
        let (text, _) = bands.draw(Size { width: 330.0, height: 0.0 });
        assert!(text.contains("<rect x=\"297\" y=\"0\" width=\"3\""), "{text}");
    }
}
