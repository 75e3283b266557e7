//! Collects the samples of cells that report one after another. When every cell has reported, the filters of all cells
//! run together.
//!
//! The result does not depend on how long a sample waits. A filter step uses the time and the charge of its sample, not
//! the time at which the step runs.

use crate::quantity::CellIndex;
use crate::sample::CellSample;

/// A batch: the cells that have reported since the pack's values were last combined, and their waiting samples.
#[derive(Debug)]
pub(crate) struct CellBatch {
    /// Samples that wait for their filter step, in the order of arrival, at most one per cell.
    pub(crate) waiting: Vec<CellSample>,
    has_reported: Vec<bool>,
    pub(crate) reported: usize,
}

impl CellBatch {
    pub(crate) fn new(cells: usize) -> Self {
        Self { waiting: Vec::with_capacity(cells), has_reported: vec![false; cells], reported: 0 }
    }

    pub(crate) fn restore(has_reported: Vec<bool>, waiting: Vec<CellSample>) -> Self {
        let reported = has_reported.iter().filter(|&&reported| reported).count();
        Self { waiting, has_reported, reported }
    }

    pub(crate) fn has_reported(&self, cell: usize) -> bool {
        self.has_reported[cell]
    }

    /// Whether the cell has not reported in this batch.
    #[inline]
    pub(crate) fn awaits(&self, cell: CellIndex) -> bool {
        self.has_reported.get(cell.index()) == Some(&false)
    }

    #[inline]
    pub(crate) fn add(&mut self, sample: CellSample) {
        debug_assert!(!self.has_reported[sample.cell.index()], "a second sample of {:?}", sample.cell);
        self.has_reported[sample.cell.index()] = true;
        self.reported += 1;
        self.waiting.push(sample);
    }

    #[inline]
    pub(crate) fn is_complete(&self) -> bool {
        self.reported == self.has_reported.len()
    }

    /// Starts the next batch, after the filters have used the samples of the last batch.
    pub(crate) fn begin(&mut self) {
        debug_assert!(self.waiting.is_empty(), "{} samples without their step", self.waiting.len());
        self.has_reported.fill(false);
        self.reported = 0;
    }
}
