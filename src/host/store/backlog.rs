//! Queues history rows that wait for the disk, in limited memory.
//!
//! In: batches of rows. Out: the same batches, oldest first. If there is no room, the oldest rows of half-cycles (one
//! charge or discharge of one cell) are dropped first, because they are details. If no half-cycle is left, the oldest
//! other rows are dropped, except pack changes. Dropped rows are counted, and the count is written with the next rows.

use std::collections::VecDeque;

use super::rows::{HistoryRow, RowBatch};
use super::stamp::Stamp;

/// Maximum number of rows that wait for the disk. They take half a megabyte of memory. For a pack of 96 cells, they
/// hold about 25 half-cycles of each cell, which is several days of driving.
pub(super) const MAX_ROWS: usize = 5_000;

#[derive(Debug, Default)]
pub(super) struct Backlog {
    batches: VecDeque<RowBatch>,
    rows: usize,
    lost: LossCount,
    /// Numbers of dropped rows that the last `take` reported. `commit` subtracts them from `lost`.
    reported: LossCount,
}

#[derive(Debug, Clone, Copy, Default)]
struct LossCount {
    details: u64,
    rows: u64,
}

impl Backlog {
    pub(super) fn push(&mut self, batch: RowBatch) {
        self.rows += batch.rows.len();
        self.batches.push_back(batch);
        self.shrink();
    }

    /// Takes all rows. Adds a row with the time `now` that reports earlier losses, if any.
    pub(super) fn take(&mut self, now: &Stamp) -> Vec<RowBatch> {
        self.rows = 0;
        let mut batches: Vec<RowBatch> = self.batches.drain(..).collect();
        self.reported = self.lost;
        if self.lost() > 0 {
            let LossCount { details, rows } = self.lost;
            let detail = format!("while nothing could be written: {details} half-cycles, {rows} others");
            let row = HistoryRow::Own { reason: "rows_lost", detail };
            batches.push(RowBatch { stamp: *now, rows: vec![row] });
        }
        batches
    }

    /// Confirms that the rows of the last `take` are on disk, including the row that reports losses.
    pub(super) fn commit(&mut self) {
        let LossCount { details, rows } = std::mem::take(&mut self.reported);
        self.lost.details -= details;
        self.lost.rows -= rows;
    }

    /// Queues rows again after a write has failed. They become the oldest rows. The row that reports losses is dropped,
    /// because the next `take` reports the losses again.
    pub(super) fn put_back(&mut self, batches: Vec<RowBatch>) {
        self.reported = LossCount::default();
        let is_loss = |row: &HistoryRow| matches!(row, HistoryRow::Own { reason: "rows_lost", .. });
        for batch in batches.into_iter().rev().filter(|batch| !batch.rows.iter().any(is_loss)) {
            self.rows += batch.rows.len();
            self.batches.push_front(batch);
        }
        self.shrink();
    }

    /// Number of lost rows that the history does not yet report.
    pub(super) fn lost(&self) -> u64 {
        self.lost.details + self.lost.rows
    }

    fn shrink(&mut self) {
        let Some(mut excess) = self.rows.checked_sub(MAX_ROWS).filter(|&excess| excess > 0) else { return };
        for detail in [true, false] {
            for batch in &mut self.batches {
                let before = batch.rows.len();
                batch.rows.retain(|row| {
                    let is_dropped = excess > 0 && row.is_detail() == detail && !row.replaces_pack();
                    excess -= usize::from(is_dropped);
                    !is_dropped
                });
                let gone = before - batch.rows.len();
                self.rows -= gone;
                *(if detail { &mut self.lost.details } else { &mut self.lost.rows }) += gone as u64;
                if excess == 0 {
                    break;
                }
            }
        }
        self.batches.retain(|batch| !batch.rows.is_empty());
    }
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::{alarm, capacity, half_cycle};
    use super::*;
    use crate::alarm::Change;
    use crate::monitor::EventKind;
    use crate::quantity::Timestamp;

    fn batch(kinds: Vec<EventKind>) -> RowBatch {
        RowBatch { stamp: Stamp::replayed(Timestamp::ZERO), rows: kinds.into_iter().map(HistoryRow::Event).collect() }
    }

    fn count(batches: &[RowBatch], what: fn(&HistoryRow) -> bool) -> usize {
        batches.iter().flat_map(|batch| &batch.rows).filter(|row| what(row)).count()
    }

    #[test]
    fn oldest_details_are_dropped_first_and_counted() {
        let mut backlog = Backlog::default();
        backlog.push(batch(vec![alarm(Change::Raised)]));
        for cell in 0..4000 {
            backlog.push(batch(vec![half_cycle(cell), capacity(cell, Some(2.0), 2.0)]));
        }
        let batches = backlog.take(&Stamp::replayed(Timestamp::ZERO));
        assert_eq!(count(&batches, HistoryRow::is_detail), 999);
        assert_eq!(count(&batches, |row| !row.is_detail()), 4002);
        let first = batches.iter().flat_map(|batch| &batch.rows).find(|row| row.is_detail());
        assert_eq!(first, Some(&HistoryRow::Event(half_cycle(3001))));
        let Some(HistoryRow::Own { detail, .. }) = batches.last().and_then(|batch| batch.rows.last()) else { panic!() };
        assert!(detail.contains("3001 half-cycles, 0 others"), "{detail}");
        backlog.commit();
        assert!(backlog.take(&Stamp::replayed(Timestamp::ZERO)).is_empty());
    }

    #[test]
    fn unwritten_rows_are_returned_in_order() {
        let mut backlog = Backlog::default();
        backlog.push(batch(vec![capacity(1, Some(2.0), 2.0)]));
        let taken = backlog.take(&Stamp::replayed(Timestamp::ZERO));
        backlog.push(batch(vec![capacity(2, Some(2.0), 2.0)]));
        backlog.put_back(taken);
        let again = backlog.take(&Stamp::replayed(Timestamp::ZERO));
        let rows: Vec<&HistoryRow> = again.iter().flat_map(|batch| &batch.rows).collect();
        assert_eq!(
            rows,
            [1, 2].map(|cell| HistoryRow::Event(capacity(cell, Some(2.0), 2.0))).iter().collect::<Vec<_>>()
        );
    }
}
