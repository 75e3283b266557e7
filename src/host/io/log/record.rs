//! What a log is made of: [`Record`], an input that owns its frame, and [`Batch`], many of them at once.

use crate::can::Frame;
use crate::monitor::{BusEvent, Command, Downtime, Input};
use crate::quantity::{BusIndex, Timestamp};

/// What a slot holds before a record.
pub(super) const NOTHING: Record = Record::Tick { time: Timestamp::ZERO };

/// An input that owns its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Record {
    /// A frame.
    Frame {
        /// When.
        time: Timestamp,
        /// Where.
        bus: BusIndex,
        /// What.
        frame: Frame,
    },
    /// Only in journals.
    Tick {
        /// When.
        time: Timestamp,
    },
    /// An interface event.
    Bus {
        /// When.
        time: Timestamp,
        /// Where.
        bus: BusIndex,
        /// What.
        event: BusEvent,
    },
    /// The time between this and what came before is unknown.
    UnknownGap {
        /// The stamp from which the record goes on.
        time: Timestamp,
    },
    /// Somebody asked for something.
    Command {
        /// When.
        time: Timestamp,
        /// What.
        command: Command,
    },
    /// Whether files could be written changed.
    Store {
        /// When.
        time: Timestamp,
        /// They could.
        works: bool,
    },
    /// The recorded run took another configuration over here.
    Reload {
        /// When.
        time: Timestamp,
    },
    /// The recorded run took up a stored state here.
    Restore {
        /// When.
        time: Timestamp,
        /// How old the state was.
        away: Downtime,
    },
}

impl Record {
    /// As the core takes it; `None` for what is not its input.
    pub fn input(&self) -> Option<Input<'_>> {
        Some(match self {
            Self::Frame { time, bus, frame } => Input::Frame { time: *time, bus: *bus, frame },
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

/// Records in a row, of memory that is used again and again.
#[derive(Debug)]
pub struct Batch {
    /// All the room there is.
    pub(super) slots: Box<[Record]>,
    /// How many of them are filled.
    pub(super) len: usize,
    pub(super) carries_ticks: bool,
}

impl Batch {
    /// Most records at once: 12 KiB, which stay in the processor's nearest memory beside the estimators'.
    pub const MAX: usize = 128;

    /// Room for up to `max` (1 to [`MAX`](Self::MAX)) records. With more than one, the source may be read a little further
    /// than the records used say.
    pub fn new(max: usize) -> Self {
        Self { slots: vec![NOTHING; max.clamp(1, Self::MAX)].into_boxed_slice(), len: 0, carries_ticks: false }
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
