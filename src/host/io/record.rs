//! Many records at once, in reused memory.

use crate::monitor::Record;
use crate::quantity::Timestamp;

/// An unused place.
pub(super) const UNUSED: Record = Record::tick(Timestamp::ZERO);

/// Consecutive records in reused memory.
#[derive(Debug)]
pub struct Batch {
    /// All slots.
    pub(super) slots: Box<[Record]>,
    /// Number of filled slots.
    pub(super) len: usize,
    pub(super) carries_ticks: bool,
}

impl Batch {
    /// Most records at once: 12 KiB, which stay in the processor's nearest memory together with the estimators'.
    pub const MAX: usize = 128;

    /// Room for up to `max` (1 to [`MAX`](Self::MAX)) records. With more than one, the source may be read a little further
    /// than the records used say.
    pub fn new(max: usize) -> Self {
        Self { slots: vec![UNUSED; max.clamp(1, Self::MAX)].into_boxed_slice(), len: 0, carries_ticks: false }
    }

    /// The records.
    pub fn records(&self) -> &[Record] {
        &self.slots[..self.len]
    }

    /// Whether the log they are from carries its own ticks.
    pub fn carries_ticks(&self) -> bool {
        self.carries_ticks
    }
}
