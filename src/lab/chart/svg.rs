//! Writes SVG elements as text, with few digits per coordinate.

use std::fmt::Write as _;

/// Escapes text for an element or an attribute.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            // XML does not allow most control characters.
            c if c.is_control() && c != '\n' && c != '\t' => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// Returns the approximate width of a text in a font of this size (pixels).
pub(super) fn text_width(text: &str, size: f64) -> f64 {
    // A character is on average 0.56 times as wide as the font size.
    text.chars().count() as f64 * size * 0.56
}

pub(super) fn short(value: f64) -> String {
    let tenths = (value * 10.0).round();
    // The limit is larger than any picture and keeps the text short.
    let tenths = tenths.clamp(-1e6, 1e6) as i64;
    match (tenths / 10, tenths.abs() % 10) {
        (whole, 0) => whole.to_string(),
        (0, tenth) => format!("{}.{tenth}", if tenths < 0 { "-" } else { "" }),
        (whole, tenth) => format!("{whole}.{tenth}"),
    }
}

/// Elements in drawing order.
#[derive(Debug, Default)]
pub(super) struct Svg(pub(super) String);

impl Svg {
    pub(super) fn text(&mut self, x: f64, y: f64, class: &str, text: &str) {
        let (x, y, text) = (short(x), short(y), escape(text));
        self.push(format_args!("<text x=\"{x}\" y=\"{y}\" class=\"{class}\">{text}</text>"));
    }

    pub(super) fn rect(&mut self, (x, y): (f64, f64), (width, height): (f64, f64), class: &str, tip: &str) {
        let (x, y, width, height) = (short(x), short(y), short(width.max(0.0)), short(height.max(0.0)));
        self.push(format_args!("<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" class=\"{class}\""));
        self.close("rect", tip);
    }

    pub(super) fn circle(&mut self, (x, y): (f64, f64), radius: f64, class: &str, tip: &str) {
        let (x, y, radius) = (short(x), short(y), short(radius));
        self.push(format_args!("<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\" class=\"{class}\""));
        self.close("circle", tip);
    }

    pub(super) fn path(&mut self, class: &str, d: &str, tip: &str) {
        if d.is_empty() {
            return;
        }
        self.push(format_args!("<path class=\"{class}\" d=\"{d}\""));
        self.close("path", tip);
    }

    /// Opens an area that clips its content. The content's origin is the upper left corner of the area.
    pub(super) fn open_area(&mut self, (x, y): (f64, f64), (width, height): (f64, f64)) {
        let (x, y, width, height) = (short(x), short(y), short(width), short(height));
        self.push(format_args!(
            "<svg x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\">"
        ));
    }

    pub(super) fn close_area(&mut self) {
        self.0.push_str("</svg>");
    }

    fn close(&mut self, element: &str, tip: &str) {
        match tip {
            "" => self.0.push_str("/>"),
            tip => {
                let tip = escape(tip);
                self.push(format_args!("><title>{tip}</title></{element}>"));
            }
        }
    }

    fn push(&mut self, text: std::fmt::Arguments<'_>) {
        // Writing to a string cannot fail.
        let _ = self.0.write_fmt(text);
    }
}

/// A path through points. The start is absolute and the steps are relative, which keeps the text short. Rounding errors
/// do not accumulate.
#[derive(Debug, Default)]
pub(super) struct PathBuilder {
    pub(super) d: String,
    last: Option<(f64, f64)>,
}

impl PathBuilder {
    pub(super) fn lift(&mut self) {
        self.last = None;
    }

    pub(super) fn to(&mut self, x: f64, y: f64) {
        let rounded = ((x * 10.0).round() / 10.0, (y * 10.0).round() / 10.0);
        match self.last {
            None => self.pair('M', rounded),
            Some(last) if last == rounded => return,
            Some(last) => self.pair('l', (rounded.0 - last.0, rounded.1 - last.1)),
        }
        self.last = Some(rounded);
    }

    /// Adds a dot, drawn by a stroke with round ends.
    pub(super) fn dot(&mut self, x: f64, y: f64) {
        self.pair('M', (x, y));
        self.d.push_str("h0");
    }

    fn pair(&mut self, command: char, (x, y): (f64, f64)) {
        let (x, y) = (short(x), short(y));
        self.d.push(command);
        self.d.push_str(&x);
        if !y.starts_with('-') {
            self.d.push(' ');
        }
        self.d.push_str(&y);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short_and_keep_their_sign() {
        assert_eq!([0.0, 12.34, -0.36, -7.0, 0.04, 1e12].map(short), ["0", "12.3", "-.4", "-7", "0", "100000"]);
    }

    #[test]
    fn relative_steps_do_not_accumulate_rounding() {
        let mut path = PathBuilder::default();
        (0..=1000).for_each(|i| path.to(f64::from(i) * 0.333, 0.0));
        let sum: f64 = path.d[1..].split(['l', ' ']).step_by(2).map(|x| x.parse::<f64>().unwrap()).sum();
        assert!((sum - 333.0).abs() < 0.05, "{sum}");
    }

    #[test]
    fn special_characters_are_escaped() {
        assert_eq!(escape("a<b>&\"\u{1}"), "a&lt;b&gt;&amp;&quot;\u{fffd}");
    }
}
