//! Holds batches of records in reused memory, so that reading a log allocates nothing per record.

use crate::monitor::Record;
use crate::quantity::Timestamp;

pub(super) const UNUSED: Record = Record::tick(Timestamp::ZERO);

/// Consecutive records in reused memory.
#[derive(Debug)]
pub struct Batch {
    pub(super) slots: Box<[Record]>,
    pub(super) len: usize,
    pub(super) carries_ticks: bool,
}

impl Batch {
    /// Maximum number of records in a batch. They take 12 KiB and fit into the first-level cache together with the
    /// estimators.
    pub const MAX: usize = 128;

    /// Creates a batch for up to `max` (1 to [`MAX`](Self::MAX)) records. If `max` is above 1, the source may have read
    /// beyond the records that the caller uses.
    pub fn new(max: usize) -> Self {
        Self { slots: vec![UNUSED; max.clamp(1, Self::MAX)].into_boxed_slice(), len: 0, carries_ticks: false }
    }

    /// The records.
    pub fn records(&self) -> &[Record] {
        &self.slots[..self.len]
    }

    /// Whether the log contains ticks, as journals do.
    pub fn carries_ticks(&self) -> bool {
        self.carries_ticks
    }
}
