//! Counters of a link since the program's start: written by its task, read by others, without a lock.

use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};

/// State of an interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum LinkState {
    /// Not looked at yet.
    Unknown = 0,
    /// It does not exist.
    Missing = 1,
    /// It exists and is down.
    Down = 2,
    /// Frames may arrive.
    Up = 3,
}

/// The counts of one interface.
#[derive(Debug, Default)]
pub struct LinkCounters {
    state: AtomicU8,
    ups: AtomicU64,
    /// Frames the kernel had no room to keep for us.
    pub kernel_dropped: AtomicU64,
    /// Frames that found our own queue full.
    pub inbox_full: AtomicU64,
    /// Reads that are no valid frame.
    pub malformed: AtomicU64,
    /// Frames the kernel took from us.
    pub sent: AtomicU64,
    /// Frames of ours that found the queue to the interface full.
    pub send_queue_full: AtomicU64,
    /// Frames of ours the kernel did not take, or that had waited too long.
    pub send_failed: AtomicU64,
}

impl LinkCounters {
    /// Counts; a statistic, so nothing is ordered by it.
    pub fn add(counter: &AtomicU64, times: u64) {
        counter.fetch_add(times, Ordering::Relaxed);
    }

    /// Notes the interface's state, when it has changed.
    pub fn enter(&self, state: LinkState) {
        self.state.store(state as u8, Ordering::Relaxed);
        if state == LinkState::Up {
            Self::add(&self.ups, 1);
        }
    }

    /// The interface's state.
    pub fn state(&self) -> LinkState {
        match self.state.load(Ordering::Relaxed) {
            1 => LinkState::Missing,
            2 => LinkState::Down,
            3 => LinkState::Up,
            _ => LinkState::Unknown,
        }
    }

    /// Times it came up again after the first.
    pub fn reconnects(&self) -> u64 {
        self.ups.load(Ordering::Relaxed).saturating_sub(1)
    }
}
