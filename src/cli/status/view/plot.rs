//! Draws bars and small plots with characters, for the live view. All functions are pure.

/// Bars of one to eight eighths of a character's height.
const EIGHTHS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
/// Mark of an unknown value.
const UNKNOWN: char = '·';

/// Returns a bar of one character. `share` is the filled part of the character's height, 0 to 1.
pub(super) fn bar(share: Option<f64>) -> char {
    let Some(share) = share else { return UNKNOWN };
    // The product is 0 to 8; the cast turns NaN into 0.
    EIGHTHS[((share.clamp(0.0, 1.0) * 8.0) as usize).min(7)]
}

/// Draws the last `width` values as bars, scaled to the range of these values; pads on the left.
pub(super) fn sparkline(values: impl ExactSizeIterator<Item = Option<f64>>, width: usize) -> String {
    let skipped = values.len().saturating_sub(width);
    let values: Vec<Option<f64>> = values.skip(skipped).collect();
    let scale = ValueRange::of(values.iter().copied().flatten());
    let blank = " ".repeat(width.saturating_sub(values.len()));
    blank + &values.iter().map(|value| bar(value.and_then(|value| scale?.share(value)))).collect::<String>()
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ValueRange {
    pub(super) least: f64,
    pub(super) greatest: f64,
}

impl ValueRange {
    /// Returns the range of the values; `None` without values.
    pub(super) fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        values.fold(None, |so_far, value| match so_far {
            None => Some(Self { least: value, greatest: value }),
            Some(Self { least, greatest }) => Some(Self { least: least.min(value), greatest: greatest.max(value) }),
        })
    }

    /// Widens the range to at least this width around its centre.
    pub(super) fn at_least(self, width: f64) -> Self {
        let room = (0.5 * (width - (self.greatest - self.least))).max(0.0);
        Self { least: self.least - room, greatest: self.greatest + room }
    }

    /// Position of a value in the range, 0 to 1; 0.5 in an empty range.
    pub(super) fn share(&self, value: f64) -> Option<f64> {
        let range = self.greatest - self.least;
        Some(if range > 0.0 { (value - self.least) / range } else { 0.5 })
    }
}

/// Draws a gauge. It is full up to the lower end of the interval, hatched within the interval, and light above it. A
/// stroke marks the value.
pub(super) fn gauge(value: Option<f64>, low: Option<f64>, high: Option<f64>, width: usize) -> String {
    let (Some(value), Some(low), Some(high)) = (value, low, high) else { return UNKNOWN.to_string().repeat(width) };
    // The product is 0 to `width`; the cast turns NaN into 0.
    let column = |share: f64| (share.clamp(0.0, 1.0) * width as f64).round() as usize;
    let (low, high, at) = (column(low), column(high), column(value).min(width.saturating_sub(1)));
    let dot = |index: usize| match index {
        index if index == at => '┃',
        index if index < low => '█',
        index if index < high => '▒',
        _ => '░',
    };
    (0..width).map(dot).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sparkline_shows_latest_and_missing_values() {
        let values = [9.0, 0.0, 1.0, 2.0].map(Some);
        assert_eq!(sparkline(values.into_iter(), 3), "▁▅█");
        assert_eq!(sparkline([Some(1.0), None, Some(2.0)].into_iter(), 5), "  ▁·█");
        assert_eq!(sparkline([Some(1.0), Some(1.0)].into_iter(), 2), "▅▅");
        assert_eq!(sparkline(std::iter::empty(), 2), "  ");
    }

    #[test]
    fn gauge_shows_interval_or_unknown() {
        assert_eq!(gauge(Some(0.5), Some(0.3), Some(0.8), 10), "███▒▒┃▒▒░░");
        assert_eq!(gauge(Some(1.0), Some(1.0), Some(1.0), 4), "███┃");
        assert_eq!(gauge(None, Some(0.3), Some(0.8), 3), "···");
    }
}
