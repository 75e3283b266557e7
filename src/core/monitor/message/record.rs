//! Records: the inputs of the core and the contents of logs and journals. A record is a frame, a tick, a report about
//! an interface or about the files, a command, or a mark of a gap, a restore or a new configuration.

use serde::{Deserialize, Serialize};

use super::command::Command;
use crate::can::Frame;
use crate::quantity::{BusIndex, Timestamp};

/// Something that happened, with the time on the driver's clock. Logs and journals hold records; the core handles them.
///
/// Records arrive in the order in which they happened. A time up to [`MERGE_TOLERANCE_NS`] before the latest time is
/// possible, because the records of several buses may be merged out of order. The core counts such a record and handles
/// it at the latest time. A time further back means that the clock was set back, so the elapsed time is unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Record {
    pub time: Timestamp,
    pub kind: RecordKind,
}

/// Kind of a record, with its data.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RecordKind {
    /// A frame was received.
    Frame {
        /// Interface that received the frame.
        bus: BusIndex,
        frame: Frame,
    },
    /// A frame of an authenticated message was received and its authenticator was checked
    /// ([`Monitor::mac_check`](crate::monitor::Monitor::mac_check)).
    SecuredFrame {
        bus: BusIndex,
        frame: Frame,
        /// The freshness value for which the authenticator is correct; `None` if there is no such value.
        freshness: Option<u64>,
    },
    /// Time passed. The driver sends a tick every [`TICK_PERIOD_MS`] while the computer is awake. Cyclic frames and
    /// time-outs depend on ticks.
    Tick,
    /// An interface changed its state or lost frames.
    Bus {
        /// The interface.
        bus: BusIndex,
        /// Report of the interface.
        event: BusEvent,
    },
    /// The log continues after a gap of unknown length, for example between two parts without a common clock.
    UnknownGap,
    /// A command from this computer. Commands from the bus are frames.
    Command {
        /// The command.
        command: Command,
    },
    /// Writing the files (learned state and records) started to fail, or works again.
    Store {
        /// Whether the files can be written.
        works: bool,
    },
    /// The recorded run changed its configuration here. Only the driver uses this record.
    Reload,
    /// The recorded run restored a stored state here. Only the driver uses this record.
    Restore {
        /// Age of the state.
        away: Downtime,
    },
}

impl Record {
    /// Creates the record of a received frame.
    #[inline]
    pub const fn frame(time: Timestamp, bus: BusIndex, frame: &Frame) -> Self {
        Self { time, kind: RecordKind::Frame { bus, frame: *frame } }
    }

    /// Creates the record of a received frame whose authenticator was checked.
    pub const fn secured_frame(time: Timestamp, bus: BusIndex, frame: &Frame, freshness: Option<u64>) -> Self {
        Self { time, kind: RecordKind::SecuredFrame { bus, frame: *frame, freshness } }
    }

    /// Creates a tick.
    #[inline]
    pub const fn tick(time: Timestamp) -> Self {
        Self { time, kind: RecordKind::Tick }
    }

    /// Creates the record of an interface's report.
    pub const fn bus(time: Timestamp, bus: BusIndex, event: BusEvent) -> Self {
        Self { time, kind: RecordKind::Bus { bus, event } }
    }

    /// Creates the record of a gap of unknown length, which ends at `time`.
    pub const fn unknown_gap(time: Timestamp) -> Self {
        Self { time, kind: RecordKind::UnknownGap }
    }

    /// Creates the record of a command from this computer.
    pub const fn command(time: Timestamp, command: Command) -> Self {
        Self { time, kind: RecordKind::Command { command } }
    }

    /// Creates the record of a report on whether the files can be written.
    pub const fn store(time: Timestamp, works: bool) -> Self {
        Self { time, kind: RecordKind::Store { works } }
    }

    /// Creates the record of a change of configuration.
    pub const fn reload(time: Timestamp) -> Self {
        Self { time, kind: RecordKind::Reload }
    }

    /// Creates the record of a restored state.
    pub const fn restore(time: Timestamp, away: Downtime) -> Self {
        Self { time, kind: RecordKind::Restore { away } }
    }

    /// Whether the time that passed before this record is unknown.
    pub const fn is_unknown_gap(&self) -> bool {
        matches!(self.kind, RecordKind::UnknownGap)
    }
}

/// Report of an interface about something other than a data frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "bus_event")]
pub enum BusEvent {
    /// The interface is up; frames may arrive.
    Up,
    /// The interface exists but is down.
    Down,
    /// The interface does not exist (missing at start, or removed).
    Missing,
    /// The kernel or a full queue of the daemon dropped frames since the last report.
    Dropped {
        /// Number of frames lost.
        frames: u64,
    },
    /// An error frame was received.
    ErrorFrame {
        /// Error class mask of the frame's identifier (`CAN_ERR_*` in linux/can/error.h).
        class: u32,
    },
    /// Frames of the daemon could not be sent (queue full, interface gone).
    SendFailed {
        /// Number of frames not sent.
        frames: u64,
    },
}

/// Time between a stored state and the first input ([`Monitor::restore`](crate::monitor::Monitor::restore)).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Downtime {
    /// The downtime is the difference between the two timestamps. If the state's timestamp is later than the first
    /// input by more than [`MERGE_TOLERANCE_NS`], the state was stored on another clock and the downtime is unknown.
    #[default]
    AsStamped,
    /// The downtime in seconds.
    Seconds(f64),
    /// The downtime is unknown, as after [`RecordKind::UnknownGap`].
    Unknown,
}

/// Formats the downtime as in a journal: seconds, `-` for "as stamped", or `unknown`.
impl std::fmt::Display for Downtime {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::AsStamped => f.write_str("-"),
            Self::Seconds(seconds) => write!(f, "{seconds:?}"),
            Self::Unknown => f.write_str("unknown"),
        }
    }
}

/// Error: the text is not a downtime.
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

/// Period of the driver's ticks, ms: a tenth of the shortest sensible period of a cyclic frame.
pub const TICK_PERIOD_MS: u32 = 10;

/// Largest step back in time, ns, that can result from merging the frames of several interfaces out of order. A larger
/// step means that the clock was set back.
pub const MERGE_TOLERANCE_NS: i64 = 1_000_000_000;
