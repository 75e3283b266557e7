//! Defines the colours: CSS classes for strokes, fills and text, and their values on a light and a dark page.
//!
//! The colours follow Okabe and Ito, so that people with any colour vision can distinguish them. They are lighter on a
//! dark page.

use std::fmt::Write as _;

/// Colour of a drawn element.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ink {
    /// Colour of text, true values and measurements.
    Plain,
    Blue,
    Orange,
    Green,
    Purple,
    /// Colour of thresholds and of the most severe alarms.
    Red,
    /// Colour of warnings.
    Amber,
    Grey,
}

/// Name, light value and dark value of each colour.
const COLOURS: [(&str, &str, &str); 13] = [
    ("plain", "#1c1d20", "#eceef2"),
    ("blue", "#0072b2", "#5ab8f0"),
    ("orange", "#c65300", "#f59a55"),
    ("green", "#008761", "#3ccfa4"),
    ("purple", "#a0427f", "#e3a0cd"),
    ("red", "#b3142b", "#ff7f8a"),
    ("amber", "#b97a00", "#f0c04c"),
    ("grey", "#6b7078", "#a0a6b0"),
    ("page", "#ffffff", "#14161a"),
    ("card", "#f5f6f8", "#1d2026"),
    ("rule", "#d9dce1", "#353a43"),
    ("word", "#1c1d20", "#eceef2"),
    ("soft", "#5a5f68", "#a8aeb8"),
];

impl Ink {
    const ALL: [Self; 8] =
        [Self::Plain, Self::Blue, Self::Orange, Self::Green, Self::Purple, Self::Red, Self::Amber, Self::Grey];

    const fn name(self) -> &'static str {
        COLOURS[self as usize].0
    }

    /// Returns the class of a stroke.
    pub fn stroke(self) -> String {
        format!("k-{}", self.name())
    }

    /// Returns the class of a solid fill.
    pub fn fill(self) -> String {
        format!("f-{}", self.name())
    }

    /// Returns the class of a translucent fill.
    pub fn band(self) -> String {
        format!("b-{}", self.name())
    }
}

/// Returns the colours as CSS variables. The dark values apply if the viewer prefers a dark background.
pub fn variables() -> String {
    let list = |pick: fn(&(&str, &'static str, &'static str)) -> &'static str| {
        COLOURS.iter().fold(String::new(), |text, colour| text + &format!("--{}:{};", colour.0, pick(colour)))
    };
    format!(
        ":root{{color-scheme:light dark;{}}}@media screen and (prefers-color-scheme:dark){{:root{{{}}}}}",
        list(|colour| colour.1),
        list(|colour| colour.2)
    ) + &classes()
}

/// Returns the declaration of a colour. The light value comes first, for viewers without CSS variables (librsvg).
fn colour(property: &str, name: &str) -> String {
    let light = COLOURS.iter().find(|colour| colour.0 == name).map_or("", |colour| colour.1);
    format!("{property}:{light};{property}:var(--{name})")
}

fn classes() -> String {
    let mut text = format!(
        "text{{font-family:system-ui,-apple-system,'Segoe UI',Roboto,'DejaVu Sans',sans-serif;{}}}\
         .t{{font-size:11.5px;{}}}.e{{text-anchor:end}}.m{{text-anchor:middle}}\
         .q{{font-size:14px;font-weight:600}}.l{{font-size:11.5px}}\
         .g{{{};stroke-width:1;fill:none}}.a{{{};stroke-width:1;fill:none}}\
         .s{{fill:none;stroke-width:1.4;stroke-linejoin:round}}.d{{stroke-dasharray:6 4}}\
         .o{{stroke-width:4.5;stroke-linecap:round;fill:none}}.p{{{}}}",
        colour("fill", "word"),
        colour("fill", "soft"),
        colour("stroke", "rule"),
        colour("stroke", "grey"),
        colour("fill", "page"),
    );
    for ink in Ink::ALL {
        let name = ink.name();
        let (stroke, fill) = (colour("stroke", name), colour("fill", name));
        // Writing to a string cannot fail.
        let _ = write!(text, ".k-{name}{{{stroke}}}.f-{name}{{{fill}}}.b-{name}{{{fill};fill-opacity:.22}}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_variable_follows_its_plain_colour() {
        let style = variables();
        let uses: Vec<&str> = style.split("var(--").collect();
        assert!(uses.len() > 3 * Ink::ALL.len());
        for (before, after) in uses.iter().zip(&uses[1..]) {
            let name = after.split(')').next().unwrap();
            let light = COLOURS.iter().find(|colour| colour.0 == name).unwrap().1;
            let property = before.rsplit(['{', ';']).next().unwrap();
            assert!(before.ends_with(&format!("{property}{light};{property}")), "{name}: {before}");
        }
    }
}
