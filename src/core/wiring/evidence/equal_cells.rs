//! Finds cells whose voltages are always the same: one signal is configured for two cells, or a cell's value is copied.
//!
//! In: for each block of time, the mean voltage of each cell (V). Out: groups of cells that never differed, each with
//! the number of blocks in which the voltages changed. Equality is exact, because a copy has the same digits, while
//! two cells in series differ at least in the last digit.

#[derive(Debug, Clone, Default)]
pub(crate) struct EqualCells {
    groups: Vec<usize>,
    last_v: Vec<f64>,
    changes: Vec<u32>,
}

impl EqualCells {
    /// Adds the voltages of a block. Ignores the block if the voltage of a cell is missing.
    pub(crate) fn push(&mut self, cells_v: &[f64]) {
        let cells = cells_v.len();
        if cells < 2 || cells_v.iter().any(|v| !v.is_finite()) {
            return;
        }
        if self.groups.is_empty() {
            (self.groups, self.changes) = (vec![0; cells], vec![0; cells]);
            self.last_v = cells_v.to_vec();
        }
        for (cell, voltage_v) in cells_v.iter().enumerate() {
            self.changes[cell] += u32::from(self.last_v[cell] != *voltage_v);
        }
        self.last_v.copy_from_slice(cells_v);
        self.split();
    }

    fn split(&mut self) {
        let key = |cell: &usize| (self.groups[*cell], self.last_v[*cell].to_bits());
        let mut order: Vec<usize> = (0..self.groups.len()).collect();
        order.sort_by_key(key);
        let mut groups = vec![0; order.len()];
        for pair in order.windows(2) {
            groups[pair[1]] = groups[pair[0]] + usize::from(key(&pair[0]) != key(&pair[1]));
        }
        self.groups = groups;
    }

    /// Groups of at least two equal cells, each with the number of blocks in which the cells' voltages changed. Leaves
    /// out cells whose voltage changed in fewer than `fewest` blocks. Groups and cells are in ascending order.
    pub(crate) fn groups(&self, fewest: u32) -> Vec<(Vec<usize>, u32)> {
        let moved = (0..self.groups.len()).filter(|cell| self.changes[*cell] >= fewest);
        let mut found: Vec<(usize, Vec<usize>, u32)> = Vec::new();
        for cell in moved {
            match found.iter_mut().find(|(group, ..)| *group == self.groups[cell]) {
                Some((_, cells, _)) => cells.push(cell),
                None => found.push((self.groups[cell], vec![cell], self.changes[cell])),
            }
        }
        found.into_iter().filter(|(_, cells, _)| cells.len() > 1).map(|(_, cells, changes)| (cells, changes)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_that_never_differ_stay_grouped() {
        let mut cells = EqualCells::default();
        for block in 0..40 {
            let v = 3.7 + 0.001 * f64::from(block % 7);
            // The third cell differs once, the fourth never changes, and a block with a missing voltage is ignored.
            cells.push(&[v, v, if block == 20 { v + 0.001 } else { v }, 3.7, v]);
            cells.push(&[v, f64::NAN, v, 3.7, v]);
        }
        let groups = cells.groups(20);
        assert_eq!(groups.len(), 1);
        assert_eq!(groups[0].0, [0, 1, 4]);
        assert!(groups[0].1 >= 30 && cells.groups(1000).is_empty());
    }
}
