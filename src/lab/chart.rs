//! Draws pictures as SVG: lines, bands, points and thresholds over an axis of numbers or dates; states over time as
//! bands.
//!
//! A value that is not finite interrupts a line. Elements have CSS classes, whose colours the page or file defines for
//! a light and a dark background ([`style`]). A long series is reduced to the lowest and highest value of each pixel
//! column, so that peaks stay visible and files stay small. Labels never cover the data. Tool tips are `<title>`
//! elements and need no script.

mod axis;
mod files;
mod plot;
mod state_bands;
mod style;
mod svg;
mod thin;

pub use axis::{Axis, Scale};
pub use files::{PlotError, write_each, write_stack};
pub use plot::{Chart, Layer, Point, Shape};
pub use state_bands::{Span, StateBand, StateBands};
pub use style::{Ink, variables};
pub use svg::escape;

/// Width and height of a picture (pixels).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Size {
    pub width: f64,
    pub height: f64,
}

impl Size {
    /// Size for a screen or a page.
    pub const WIDE: Self = Self { width: 840.0, height: 290.0 };
    /// Size for a phone.
    pub const NARROW: Self = Self { width: 350.0, height: 270.0 };
}

/// A picture of any kind.
#[derive(Debug, Clone, PartialEq)]
pub enum Picture {
    Chart(Chart),
    StateBands(StateBands),
}

impl Picture {
    /// Returns the elements inside the `<svg>`, and their height (pixels).
    pub fn draw(&self, size: Size) -> (String, f64) {
        match self {
            Self::Chart(chart) => chart.draw(size),
            Self::StateBands(bands) => bands.draw(size),
        }
    }

    /// Returns the title.
    pub fn title(&self) -> &str {
        match self {
            Self::Chart(chart) => &chart.title,
            Self::StateBands(bands) => &bands.title,
        }
    }

    fn description(&self) -> &str {
        match self {
            Self::Chart(chart) => &chart.description,
            Self::StateBands(bands) => &bands.description,
        }
    }

    /// Returns an `<svg>` element for a page, which defines its colours.
    pub fn inline(&self, size: Size, class: &str) -> String {
        let (body, height) = self.draw(size);
        let (width, title) = (size.width, escape(self.title()));
        let description = escape(self.description());
        format!(
            "<svg class=\"{class}\" viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{title}\">\
             <desc>{description}</desc>{body}</svg>\n"
        )
    }
}
