//! Records of a log: [`Record`], an input that owns its frame, and [`Batch`], many of them at once.

use crate::can::Frame;
use crate::monitor::{BusEvent, Command, Downtime, Input};
use crate::quantity::{BusIndex, Timestamp};

/// An input that owns its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Record {
    /// A frame.
    Frame {
        /// Time.
        time: Timestamp,
        /// Interface.
        bus: BusIndex,
        /// Content.
        frame: Frame,
    },
    /// A frame of an authenticated message; only in journals.
    SecuredFrame {
        /// Time.
        time: Timestamp,
        /// Interface.
        bus: BusIndex,
        /// Content.
        frame: Frame,
        /// The freshness with which its authenticator was right; `None` = with none.
        freshness: Option<u64>,
    },
    /// Only in journals.
    Tick {
        /// Time.
        time: Timestamp,
    },
    /// An interface event.
    Bus {
        /// Time.
        time: Timestamp,
        /// Interface.
        bus: BusIndex,
        /// Content.
        event: BusEvent,
    },
    /// The time between this record and the one before is unknown.
    UnknownGap {
        /// Stamp at which the log continues.
        time: Timestamp,
    },
    /// A command of a client.
    Command {
        /// Time.
        time: Timestamp,
        /// Content.
        command: Command,
    },
    /// Writing the store began to fail or to work.
    Store {
        /// Time.
        time: Timestamp,
        /// Whether it works.
        works: bool,
    },
    /// The recorded run changed to another configuration here.
    Reload {
        /// Time.
        time: Timestamp,
    },
    /// The recorded run restored a stored state here.
    Restore {
        /// Time.
        time: Timestamp,
        /// How old the state was.
        away: Downtime,
    },
}

impl Record {
    /// An unused place.
    pub(super) const UNUSED: Self = Self::Tick { time: Timestamp::ZERO };

    /// The input of the core; `None` for a record that is none.
    pub fn input(&self) -> Option<Input<'_>> {
        Some(match self {
            Self::Frame { time, bus, frame } => Input::Frame { time: *time, bus: *bus, frame },
            Self::SecuredFrame { time, bus, frame, freshness } => {
                Input::SecuredFrame { time: *time, bus: *bus, frame, freshness: *freshness }
            }
            Self::Tick { time } => Input::Tick { time: *time },
            Self::Bus { time, bus, event } => Input::Bus { time: *time, bus: *bus, event: *event },
            Self::UnknownGap { time } => Input::UnknownGap { time: *time },
            Self::Command { time, command } => Input::Command { time: *time, command: *command },
            Self::Store { time, works } => Input::Store { time: *time, works: *works },
            Self::Restore { .. } | Self::Reload { .. } => return None,
        })
    }

    /// Its stamp.
    pub fn time(&self) -> Timestamp {
        match *self {
            Self::Frame { time, .. }
            | Self::SecuredFrame { time, .. }
            | Self::Tick { time }
            | Self::Bus { time, .. }
            | Self::UnknownGap { time }
            | Self::Command { time, .. }
            | Self::Store { time, .. }
            | Self::Reload { time }
            | Self::Restore { time, .. } => time,
        }
    }

    pub(super) fn at(mut self, placed: Timestamp) -> Self {
        match &mut self {
            Self::Frame { time, .. }
            | Self::SecuredFrame { time, .. }
            | Self::Tick { time }
            | Self::Bus { time, .. }
            | Self::UnknownGap { time }
            | Self::Command { time, .. }
            | Self::Store { time, .. }
            | Self::Reload { time }
            | Self::Restore { time, .. } => *time = placed,
        }
        self
    }
}

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
        Self { slots: vec![Record::UNUSED; max.clamp(1, Self::MAX)].into_boxed_slice(), len: 0, carries_ticks: false }
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
