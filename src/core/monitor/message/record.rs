//! Records: what the core handles and what logs and journals hold: frames, ticks, reports of interfaces and files, commands.

use serde::{Deserialize, Serialize};

use super::command::Command;
use crate::can::Frame;
use crate::quantity::{BusIndex, Timestamp};

/// A record of what happened, with the driver's time: what a log or a journal holds, and what the core handles.
///
/// Records come in the order in which they happened; a time a little before the latest one ([`MERGE_TOLERANCE_NS`]: buses merge
/// out of order) is counted and treated as the latest; further back, the clock was set back and how much time passed is unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Record {
    /// When.
    pub time: Timestamp,
    /// What happened.
    pub kind: RecordKind,
}

/// What happened.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RecordKind {
    /// A frame was received.
    Frame {
        /// Interface it came on.
        bus: BusIndex,
        /// The frame.
        frame: Frame,
    },
    /// A frame of an authenticated message was received, and its authenticator was checked
    /// ([`Monitor::mac_check`](crate::monitor::Monitor::mac_check)).
    SecuredFrame {
        /// Interface it came on.
        bus: BusIndex,
        /// The frame.
        frame: Frame,
        /// The freshness with which the authenticator is right; `None` = with none.
        freshness: Option<u64>,
    },
    /// Time passed. The driver ticks every [`TICK_PERIOD_MS`] while awake; cyclic frames and time-outs follow from ticks.
    Tick,
    /// An interface changed or lost something.
    Bus {
        /// Which interface.
        bus: BusIndex,
        /// Its report.
        event: BusEvent,
    },
    /// The log continues here, but how much time really passed is unknown (a log without stamps between its parts).
    UnknownGap,
    /// A command from this computer. Commands of the bus are frames.
    Command {
        /// The command.
        command: Command,
    },
    /// Whether the files of the learned state and the records can be written.
    Store {
        /// They can.
        works: bool,
    },
    /// The recorded run changed to another configuration here: for the driver, the core ignores it.
    Reload,
    /// The recorded run restored a stored state here: for the driver, the core ignores it.
    Restore {
        /// How old the state was.
        away: Downtime,
    },
}

impl Record {
    /// A received frame.
    #[inline]
    pub const fn frame(time: Timestamp, bus: BusIndex, frame: &Frame) -> Self {
        Self { time, kind: RecordKind::Frame { bus, frame: *frame } }
    }

    /// A received frame with the outcome of the check of its authenticator.
    pub const fn secured_frame(time: Timestamp, bus: BusIndex, frame: &Frame, freshness: Option<u64>) -> Self {
        Self { time, kind: RecordKind::SecuredFrame { bus, frame: *frame, freshness } }
    }

    /// Time passed.
    #[inline]
    pub const fn tick(time: Timestamp) -> Self {
        Self { time, kind: RecordKind::Tick }
    }

    /// A report of an interface.
    pub const fn bus(time: Timestamp, bus: BusIndex, event: BusEvent) -> Self {
        Self { time, kind: RecordKind::Bus { bus, event } }
    }

    /// An unknown time passed before this record.
    pub const fn unknown_gap(time: Timestamp) -> Self {
        Self { time, kind: RecordKind::UnknownGap }
    }

    /// A command from this computer.
    pub const fn command(time: Timestamp, command: Command) -> Self {
        Self { time, kind: RecordKind::Command { command } }
    }

    /// A report whether files can be written.
    pub const fn store(time: Timestamp, works: bool) -> Self {
        Self { time, kind: RecordKind::Store { works } }
    }

    /// The recorded run changed to another configuration.
    pub const fn reload(time: Timestamp) -> Self {
        Self { time, kind: RecordKind::Reload }
    }

    /// The recorded run restored a stored state.
    pub const fn restore(time: Timestamp, away: Downtime) -> Self {
        Self { time, kind: RecordKind::Restore { away } }
    }

    /// Whether the time before the record is unknown.
    pub const fn is_unknown_gap(&self) -> bool {
        matches!(self.kind, RecordKind::UnknownGap)
    }
}

/// Report of an interface, in addition to data frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "bus_event")]
pub enum BusEvent {
    /// The interface is there and up; frames may come.
    Up,
    /// The interface exists but is down.
    Down,
    /// The interface does not exist (missing at start, or removed).
    Missing,
    /// The kernel or a full queue of ours dropped this many frames since the last report.
    Dropped {
        /// Frames lost.
        frames: u64,
    },
    /// An error frame; `class` is the error class mask of the frame's identifier (linux/can/error.h).
    ErrorFrame {
        /// CAN_ERR_* class bits.
        class: u32,
    },
    /// Frames of ours could not be sent (queue full, interface gone).
    SendFailed {
        /// Frames not sent.
        frames: u64,
    },
}

/// How long before the first input a stored state was taken ([`Monitor::restore`](crate::monitor::Monitor::restore)).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Downtime {
    /// As long as the two stamps say. A state that was taken after "now" ([`MERGE_TOLERANCE_NS`] aside) has another clock's
    /// stamp: then the downtime is unknown.
    #[default]
    AsStamped,
    /// This long, s.
    Seconds(f64),
    /// Unknown: as after [`RecordKind::UnknownGap`].
    Unknown,
}

/// As in a journal: seconds, `-` for "as stamped", or `unknown`.
impl std::fmt::Display for Downtime {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::AsStamped => f.write_str("-"),
            Self::Seconds(seconds) => write!(f, "{seconds:?}"),
            Self::Unknown => f.write_str("unknown"),
        }
    }
}

/// A text that is none of the three.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("must be seconds, 0 or more, or unknown")]
pub struct DowntimeParseError;

impl std::str::FromStr for Downtime {
    type Err = DowntimeParseError;

    fn from_str(text: &str) -> Result<Self, DowntimeParseError> {
        match text {
            "-" => Ok(Self::AsStamped),
            "unknown" => Ok(Self::Unknown),
            _ => text
                .parse()
                .ok()
                .filter(|s: &f64| s.is_finite() && *s >= 0.0)
                .map(Self::Seconds)
                .ok_or(DowntimeParseError),
        }
    }
}

/// Period of the driver's ticks, ms: ten times faster than the fastest sensible cyclic frame needs.
pub const TICK_PERIOD_MS: u32 = 10;

/// Steps back in time up to this are frames of several interfaces merged out of order, ns; beyond, the record's
/// clock was set back.
pub const MERGE_TOLERANCE_NS: i64 = 1_000_000_000;
