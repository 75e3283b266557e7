//! Draws heat maps: one row per cell, columns of time, each value in one of nine colours, and a legend.

use super::Size;
use super::axis::Axis;
use super::plot::{Area, title};
use super::style::{STEPS, step_class};
use super::svg::{Svg, short, text_width};

/// Smallest and largest height of a row, pixels.
const ROW: (f64, f64) = (4.0, 20.0);

/// Values over rows and columns. A row is a cell (counted from 1); columns have equal width.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Heat {
    pub title: String,
    pub description: String,
    /// Axis of time; its `range` gives the start of the first and the end of the last column.
    pub x: Axis,
    /// Meaning of the values, with unit.
    pub label: String,
    /// Rows of values; `None` = unknown.
    pub rows: Vec<Vec<Option<f64>>>,
    /// Tool tips, one per row; may be empty.
    pub tips: Vec<String>,
    /// Decimals in the legend.
    pub decimals: usize,
}

impl Heat {
    /// Returns the elements and their height in pixels.
    pub(super) fn draw(&self, size: Size) -> (String, f64) {
        let mut svg = Svg::default();
        let top = title(&mut svg, &self.title, size.width);
        let values = || self.rows.iter().flatten().flatten().copied().filter(|value| value.is_finite());
        let (low, high) = Axis::default().ends(values(), false);
        let top = self.legend(&mut svg, top, size.width, (low, high));
        // The rows share a height of 300 pixels.
        let row = (300.0 / self.rows.len().max(1) as f64).clamp(ROW.0, ROW.1).floor();
        let left = text_width(&self.rows.len().to_string(), 11.5) + 12.0;
        let height = row * self.rows.len() as f64;
        let x = self.x.ends(std::iter::empty(), false);
        let area = Area { left, top, width: size.width - left - 22.0, height, x, y: (0.0, 1.0) };
        area.draw_x(&mut svg, &self.x);
        let every =
            [1_u32, 2, 5, 10, 20, 50, 100, 200].into_iter().find(|n| f64::from(*n) * row >= 13.0).unwrap_or(500);
        for cell in (1..=self.rows.len()).filter(|cell| *cell == 1 || cell % every as usize == 0) {
            svg.text(left - 6.0, top + (cell as f64 - 0.5) * row + 4.0, "t e", &cell.to_string());
        }
        svg.open_area((left, top), (area.width, height));
        svg.rect((0.0, 0.0), (area.width, height), "x", "");
        for (step, d) in self.paths(area.width, row, (low, high)).iter().enumerate() {
            svg.path(&step_class(step), d, "");
        }
        for (index, tip) in self.tips.iter().enumerate() {
            svg.rect((0.0, index as f64 * row), (area.width, row), "z", tip);
        }
        svg.close_area();
        (svg.0, top + height + 40.0)
    }

    /// Returns one path per colour. Neighbouring fields of the same colour are joined to one rectangle.
    fn paths(&self, width: f64, row: f64, ends: (f64, f64)) -> Vec<String> {
        let mut paths = vec![String::new(); STEPS.len()];
        for (index, values) in self.rows.iter().enumerate() {
            let column = width / values.len().max(1) as f64;
            let steps: Vec<Option<usize>> = values.iter().map(|value| step(*value, ends)).collect();
            let mut at = 0;
            for run in steps.chunk_by(|a, b| a == b) {
                if let Some(path) = run[0].and_then(|step| paths.get_mut(step)) {
                    let (x, long) = (at as f64 * column, run.len() as f64 * column);
                    let (x, y, long, row) = (short(x), short(index as f64 * row), short(long), short(row));
                    path.push_str(&format!("M{x} {y}h{long}v{row}h-{long}z"));
                }
                at += run.len();
            }
        }
        paths
    }

    fn legend(&self, svg: &mut Svg, top: f64, width: f64, (low, high): (f64, f64)) -> f64 {
        svg.text(0.0, top + 12.0, "t", &format!("cell (from 1), {}", self.label));
        let decimals = self.decimals;
        let (low, high) = (format!("{low:.decimals$}"), format!("{high:.decimals$}"));
        let needs = text_width(&low, 11.5) + text_width(&high, 11.5) + 18.0 * 9.0 + 110.0;
        let label_end = text_width(&self.label, 11.5) + 130.0;
        let (mut x, y) = if label_end + needs < width { (label_end, top) } else { (0.0, top + 18.0) };
        svg.text(x, y + 12.0, "l", &low);
        x += text_width(&low, 11.5) + 6.0;
        for step in 0..STEPS.len() {
            svg.rect((x, y + 3.0), (18.0, 10.0), &step_class(step), "");
            x += 18.0;
        }
        svg.text(x + 6.0, y + 12.0, "l", &high);
        x += text_width(&high, 11.5) + 18.0;
        svg.rect((x, y + 3.0), (14.0, 10.0), "x", "");
        svg.text(x + 20.0, y + 12.0, "l", "unknown");
        y + 26.0
    }
}

/// Returns the colour step of a value; `None` = the value is unknown.
fn step(value: Option<f64>, (low, high): (f64, f64)) -> Option<usize> {
    let part = (value.filter(|value| value.is_finite())? - low) / (high - low);
    Some(((part * STEPS.len() as f64) as usize).min(STEPS.len() - 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_values_are_blank_and_neighbours_share_a_rectangle() {
        let rows = vec![vec![Some(1.0), Some(1.0), None, Some(2.0)], vec![Some(f64::NAN), None, Some(1.5), Some(2.0)]];
        let heat = Heat { rows, x: Axis::number("d").within(0.0, 4.0), ..Heat::default() };
        let paths = heat.paths(40.0, 10.0, (1.0, 2.0));
        assert_eq!((paths[0].as_str(), paths[8].as_str()), ("M0 0h20v10h-20z", "M30 0h10v10h-10zM30 10h10v10h-10z"));
        assert_eq!(paths.iter().filter(|path| !path.is_empty()).count(), 3);
    }

    #[test]
    fn heat_map_of_96_cells_stays_small() {
        let row = |cell: usize| (0..120).map(|column| Some((cell * 7 + column * 13) as f64 % 9.0)).collect();
        let heat = Heat { rows: (0..96).map(row).collect(), x: Axis::number("d").within(0.0, 1.0), ..Heat::default() };
        let (text, _) = heat.draw(Size::WIDE);
        assert!(text.len() < 400_000, "{} bytes", text.len());
    }
}
