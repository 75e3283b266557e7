//! Counters of a link (the daemon's connection to one CAN interface) since the program's start. The task that receives
//! and the part that sends write the counters, and other tasks read them.

use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};

/// State of an interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkState {
    /// Not checked yet.
    #[default]
    Unknown,
    /// The interface does not exist.
    Missing,
    /// The interface exists and is down.
    Down,
    /// Frames may arrive.
    Up,
}

/// Frames of one interface that were sent or lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LinkCounts {
    /// Frames dropped by the kernel because its receive buffer was full.
    pub kernel_dropped: u64,
    /// Frames dropped by the daemon because its queue was full.
    pub queue_dropped: u64,
    /// Reads from the socket that did not return a valid frame.
    pub malformed: u64,
    /// Frames sent.
    pub sent: u64,
    /// Frames not sent because the queue to the interface was full.
    pub send_queue_full: u64,
    /// Frames not sent because the kernel rejected them or they had waited too long.
    pub send_failed: u64,
}

/// State and counts of one interface.
#[derive(Debug, Clone, Copy, Default)]
pub struct LinkHealth {
    /// The interface's state.
    pub state: LinkState,
    /// How often the interface came up.
    pub ups: u64,
    /// Sent and lost frames.
    pub counts: LinkCounts,
}

/// The health of one interface, shared between the interface's task and the daemon's loop.
#[derive(Debug, Default)]
pub(super) struct SharedHealth(Mutex<LinkHealth>);

impl SharedHealth {
    pub(super) fn count(&self, note: impl FnOnce(&mut LinkCounts)) {
        self.change(|health| note(&mut health.counts));
    }

    /// Sets the interface's state. Must be called only when the state has changed.
    pub(super) fn enter(&self, state: LinkState) {
        self.change(|health| {
            health.state = state;
            health.ups += u64::from(state == LinkState::Up);
        });
    }

    pub(super) fn change(&self, change: impl FnOnce(&mut LinkHealth)) -> LinkHealth {
        let mut health = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        change(&mut health);
        *health
    }
}
