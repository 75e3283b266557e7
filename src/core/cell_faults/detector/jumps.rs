//! Handles sudden changes: two exchanged channels, a replaced module, or a change of a single cell.

use super::{CellFaultDetector, Row, WatchedCell};
use crate::cell_faults::difference::{Jump, Observation, STATES};
use crate::cell_faults::fault::{CellFault, CellFaultKind};
use crate::filter::ScalarGaussian;
use crate::quantity::{CellIndex, Timestamp};

/// Jumps of several cells count as one event if they are at most this far apart (s).
const SAME_EVENT_S: f64 = 1800.0;
/// If two channels are exchanged, the previous state of each cell predicts the voltage of the other channel to within
/// this error (V).
const SWAP_V: f64 = 0.008;

impl CellFaultDetector {
    /// Handles the cells that have changed suddenly. If two channels have been exchanged, exchanges their states.
    /// Otherwise, raises the uncertainty of the changed cells: single cells or a group of neighbours.
    pub(super) fn handle_jumps(
        &mut self,
        time: Timestamp,
        row: &Row<'_>,
        jumped: &[(usize, Observation)],
        difference_v: impl Fn(usize) -> Option<f64>,
    ) {
        if jumped.is_empty() {
            return;
        }
        let is_recent = |cell: &WatchedCell| cell.jumped.is_some_and(|at| time.since(at) <= SAME_EVENT_S);
        let recent: Vec<usize> = (0..self.cells.len()).filter(|&cell| is_recent(&self.cells[cell])).collect();
        if let [a, b] = recent[..]
            && let (Some(a_v), Some(b_v)) = (difference_v(a), difference_v(b))
            && self.exchange_if_swapped(time, row, [a, b], [a_v, b_v])
        {
            return;
        }
        for (index, observed) in jumped {
            let has_neighbour = recent.iter().any(|other| other.abs_diff(*index) == 1);
            let jump = if has_neighbour && 2 * recent.len() <= self.cells.len() { Jump::Replaced } else { Jump::Alone };
            self.cells[*index].difference.open(jump, observed);
        }
    }

    /// If the channels of the cells `a` and `b` have been exchanged, exchanges their states and returns true.
    fn exchange_if_swapped(
        &mut self,
        time: Timestamp,
        row: &Row<'_>,
        [a, b]: [usize; 2],
        differences_v: [f64; 2],
    ) -> bool {
        let [of_a, of_b] = [self.cells[a].before_jump, self.cells[b].before_jump];
        let off = |means: &[f64; STATES], difference_v: f64| row.observation(means, 0.0, difference_v).innovation.abs();
        let as_before = off(&of_a, differences_v[0]).min(off(&of_b, differences_v[1]));
        let exchanged = off(&of_b, differences_v[0]).max(off(&of_a, differences_v[1]));
        if exchanged > SWAP_V || exchanged > 0.5 * as_before {
            return false;
        }
        let (low, high) = self.cells.split_at_mut(b);
        std::mem::swap(&mut low[a].difference, &mut high[0].difference);
        low[a].difference.settle(&of_b);
        high[0].difference.settle(&of_a);
        let cells = Some((CellIndex(a as u16), CellIndex(b as u16)));
        let is_same = |found: &CellFault| found.kind == CellFaultKind::SwappedChannels && found.cells == cells;
        if self.findings.iter().any(is_same) {
            self.findings.retain(|found| !is_same(found));
        } else {
            let size = ScalarGaussian { mean: 1.0, variance: 0.0 };
            let kind = CellFaultKind::SwappedChannels;
            self.insert(CellFault { kind, cells, since: time, reported: time, probability: 1.0, size });
        }
        for cell in [a, b] {
            self.cells[cell].jumped = None;
        }
        true
    }
}
