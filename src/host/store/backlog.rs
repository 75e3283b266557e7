//! Rows that wait for the disk, in memory and bounded.
//!
//! When there is no room, detail goes before what was learned: the oldest half-cycles first, then the oldest of the
//! rest. What went is counted, and the count is written with the next rows.

use std::collections::VecDeque;

use super::rows::{Batch, Row};
use super::stamp::Stamp;

/// Rows kept while the disk takes none: half a megabyte of memory, and for a pack of 96 cells some 25 transitions, days
/// of driving.
pub(super) const MAX_ROWS: usize = 5_000;

/// Rows in waiting, oldest first.
#[derive(Debug, Default)]
pub(super) struct Backlog {
    batches: VecDeque<Batch>,
    rows: usize,
    lost: Lost,
    /// What the rows taken last say of it.
    telling: Lost,
}

/// Rows that went for want of room.
#[derive(Debug, Clone, Copy, Default)]
struct Lost {
    details: u64,
    rows: u64,
}

impl Backlog {
    /// Appends rows.
    pub(super) fn push(&mut self, batch: Batch) {
        self.rows += batch.rows.len();
        self.batches.push_back(batch);
        self.shrink();
    }

    /// Takes everything, with a row for what was lost before; `now` is that row's moment.
    pub(super) fn take(&mut self, now: &Stamp) -> Vec<Batch> {
        self.rows = 0;
        let mut batches: Vec<Batch> = self.batches.drain(..).collect();
        self.telling = self.lost;
        if self.lost() > 0 {
            let Lost { details, rows } = self.lost;
            let detail = format!("while nothing could be written: {details} half-cycles, {rows} others");
            let row = Row::Own { reason: "rows_lost", detail };
            batches.push(Batch { stamp: *now, rows: vec![row] });
        }
        batches
    }

    /// The rows taken last are written: what was lost has been told with them.
    pub(super) fn told(&mut self) {
        let Lost { details, rows } = std::mem::take(&mut self.telling);
        self.lost.details -= details;
        self.lost.rows -= rows;
    }

    /// Puts rows back that could not be written, before those that came since. What they say of losses is said again.
    pub(super) fn put_back(&mut self, batches: Vec<Batch>) {
        self.telling = Lost::default();
        let is_loss = |row: &Row| matches!(row, Row::Own { reason: "rows_lost", .. });
        for batch in batches.into_iter().rev().filter(|batch| !batch.rows.iter().any(is_loss)) {
            self.rows += batch.rows.len();
            self.batches.push_front(batch);
        }
        self.shrink();
    }

    /// Rows lost so far and not yet told.
    pub(super) fn lost(&self) -> u64 {
        self.lost.details + self.lost.rows
    }

    fn shrink(&mut self) {
        let Some(mut excess) = self.rows.checked_sub(MAX_ROWS).filter(|&excess| excess > 0) else { return };
        for detail in [true, false] {
            for batch in &mut self.batches {
                let before = batch.rows.len();
                batch.rows.retain(|row| {
                    let goes = excess > 0 && row.is_detail() == detail && !row.replaces_pack();
                    excess -= usize::from(goes);
                    !goes
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

    fn batch(kinds: Vec<EventKind>) -> Batch {
        Batch { stamp: Stamp::replayed(Timestamp::ZERO), rows: kinds.into_iter().map(Row::Event).collect() }
    }

    fn count(batches: &[Batch], what: fn(&Row) -> bool) -> usize {
        batches.iter().flat_map(|batch| &batch.rows).filter(|row| what(row)).count()
    }

    #[test]
    fn the_oldest_detail_goes_first_and_is_counted() {
        let mut backlog = Backlog::default();
        backlog.push(batch(vec![alarm(Change::Raised)]));
        for cell in 0..4000 {
            backlog.push(batch(vec![half_cycle(cell), capacity(cell, Some(2.0), 2.0)]));
        }
        let batches = backlog.take(&Stamp::replayed(Timestamp::ZERO));
        assert_eq!(count(&batches, Row::is_detail), 999);
        assert_eq!(count(&batches, |row| !row.is_detail()), 4002);
        let first = batches.iter().flat_map(|batch| &batch.rows).find(|row| row.is_detail());
        assert_eq!(first, Some(&Row::Event(half_cycle(3001))));
        let Some(Row::Own { detail, .. }) = batches.last().and_then(|batch| batch.rows.last()) else { panic!() };
        assert!(detail.contains("3001 half-cycles, 0 others"), "{detail}");
        backlog.told();
        assert!(backlog.take(&Stamp::replayed(Timestamp::ZERO)).is_empty());
    }

    #[test]
    fn rows_that_could_not_be_written_come_again_in_their_order() {
        let mut backlog = Backlog::default();
        backlog.push(batch(vec![capacity(1, Some(2.0), 2.0)]));
        let taken = backlog.take(&Stamp::replayed(Timestamp::ZERO));
        backlog.push(batch(vec![capacity(2, Some(2.0), 2.0)]));
        backlog.put_back(taken);
        let again = backlog.take(&Stamp::replayed(Timestamp::ZERO));
        let rows: Vec<&Row> = again.iter().flat_map(|batch| &batch.rows).collect();
        assert_eq!(rows, [1, 2].map(|cell| Row::Event(capacity(cell, Some(2.0), 2.0))).iter().collect::<Vec<_>>());
    }
}
