//! Finds the rows of a table that have a lag window (the inputs of a forecast from this row). The lag window of a row
//! contains, for each column, the value in this row and the latest differences between consecutive rows.

use super::super::ColumnTable;

/// The lag windows of a table.
#[derive(Debug)]
pub struct LagWindows<'a> {
    table: &'a ColumnTable,
    columns: usize,
    lags: usize,
    /// For each row: the first row of its part (an independent section of the table), and the first row after this
    /// part.
    part: Vec<(usize, usize)>,
}

/// Time steps between consecutive rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowSpacing {
    /// Median step, in the unit of the time column.
    pub median: f64,
    /// 5 % and 95 % quantile of the steps.
    pub range: (f64, f64),
}

impl RowSpacing {
    /// Returns the spacing of a time column. Steps from one part of the table to the next do not count. `None` = no
    /// part has two consecutive times.
    pub fn of(table: &ColumnTable, column: usize) -> Option<Self> {
        let times: Vec<f64> = table.column(column).collect();
        let steps = (1..times.len()).filter(|row| table.parts.binary_search(row).is_err());
        let mut steps: Vec<f64> =
            steps.map(|row| times[row] - times[row - 1]).filter(|step| step.is_finite()).collect();
        steps.sort_by(f64::total_cmp);
        let at = |part: f64| steps.get((part * steps.len().saturating_sub(1) as f64).round() as usize).copied();
        Some(Self { median: at(0.5)?, range: (at(0.05)?, at(0.95)?) })
    }

    /// Whether nine of ten steps are within 10 % of the median.
    pub fn even(&self) -> bool {
        let near = |step: f64| (step - self.median).abs() <= 0.1 * self.median.abs();
        near(self.range.0) && near(self.range.1)
    }
}

impl<'a> LagWindows<'a> {
    /// Creates windows over the required columns of the table, with `lags` values per column.
    pub fn new(table: &'a ColumnTable, lags: usize) -> Self {
        let ends = table.parts.iter().skip(1).copied().chain([table.len()]);
        let spans = table.parts.iter().copied().zip(ends);
        let part = spans.flat_map(|(begin, end)| std::iter::repeat_n((begin, end), end - begin)).collect();
        Self { table, columns: table.width() - table.has.len(), lags, part }
    }

    /// Returns the number of values in a window.
    pub fn width(&self) -> usize {
        self.columns * self.lags
    }

    /// Returns the rows from `begin` on that have a window and a row to forecast: the row `steps` later must be in the
    /// same part and before `end`.
    pub fn between(&self, begin: usize, end: usize, steps: usize) -> Vec<usize> {
        let fits = |row: &usize| {
            let (first, last) = self.part[*row];
            *row + 1 >= first + self.lags && row + steps < last.min(end)
        };
        (begin..self.table.len()).filter(fits).collect()
    }

    /// Returns the last row before `end` that has a window.
    pub fn last_before(&self, end: usize) -> Option<usize> {
        (0..end.min(self.part.len())).rev().find(|row| *row + 1 >= self.part[*row].0 + self.lags)
    }

    /// Returns the value of a column in a row.
    pub fn value(&self, row: usize, column: usize) -> f64 {
        self.table.row(row)[column]
    }

    /// Returns the change of a column from this row to the row `steps` ahead.
    pub fn change(&self, row: usize, column: usize, steps: usize) -> f64 {
        self.value(row + steps, column) - self.value(row, column)
    }

    /// Returns the windows of `rows`, one after the other. For every column, a window has the value, then the
    /// differences, the latest first.
    pub fn features(&self, rows: &[usize]) -> Vec<f64> {
        let mut all = Vec::with_capacity(rows.len() * self.width());
        for &row in rows {
            for column in 0..self.columns {
                all.push(self.value(row, column));
                all.extend((1..self.lags).map(|lag| self.change(row - lag, column, 1)));
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> ColumnTable {
        ColumnTable {
            names: vec!["a".into(), "b".into(), "time_s".into()],
            values: (0..8).flat_map(|k| [f64::from(k * k), f64::from(10 * k), f64::from(k)]).collect(),
            lines: (2..10).collect(),
            has: vec![true],
            parts: vec![0, 5],
            ..ColumnTable::default()
        }
    }

    #[test]
    fn windows_contain_the_past_within_a_part() {
        let table = table();
        let windows = LagWindows::new(&table, 3);
        assert_eq!(windows.features(&[4]), [16.0, 7.0, 5.0, 40.0, 10.0, 10.0]);
        assert_eq!((windows.between(0, 8, 1), windows.between(0, 8, 2)), (vec![2, 3], vec![2]));
        assert_eq!((windows.between(0, 4, 1), windows.between(3, 8, 0)), (vec![2], vec![3, 4, 7]));
        assert_eq!((windows.last_before(7), windows.last_before(2), windows.width()), (Some(4), None, 6));
        assert_eq!(windows.change(2, 0, 2), 12.0);
    }

    #[test]
    fn steps_are_counted_within_parts() {
        let mut uneven = table();
        assert!(RowSpacing::of(&uneven, 2).expect("steps").even());
        uneven.values[3 * 5 + 2] = 1000.0;
        let steps = RowSpacing::of(&uneven, 2).expect("steps");
        assert!(!steps.even() && steps.median == 1.0, "{steps:?}");
    }
}
