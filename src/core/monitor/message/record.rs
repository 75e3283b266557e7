//! Records: inputs of the core, and contents of logs and journals: frames, ticks, reports of interfaces and files,
//! commands.

use serde::{Deserialize, Serialize};

use super::command::Command;
use crate::can::Frame;
use crate::quantity::{BusIndex, Timestamp};

/// Something that happened, with the driver's time. Logs and journals hold records, the core handles them.
///
/// Records come in the order in which they happened. A time slightly before the latest one (within
/// [`MERGE_TOLERANCE_NS`], because buses merge out of order) is counted and treated as the latest. Further back, the
/// clock was set back and the elapsed time is unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Record {
    /// Time on the driver's clock.
    pub time: Timestamp,
    /// Kind of the record.
    pub kind: RecordKind,
}

/// Kind of a record, with its data.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RecordKind {
    /// A frame was received.
    Frame {
        /// Interface that received it.
        bus: BusIndex,
        /// The frame.
        frame: Frame,
    },
    /// A frame of an authenticated message was received and its authenticator was checked
    /// ([`Monitor::mac_check`](crate::monitor::Monitor::mac_check)).
    SecuredFrame {
        /// Interface that received it.
        bus: BusIndex,
        /// The frame.
        frame: Frame,
        /// The freshness value that the authenticator confirms; `None` = no value fits.
        freshness: Option<u64>,
    },
    /// Time passed. The driver ticks every [`TICK_PERIOD_MS`] while awake; cyclic frames and time-outs depend on
    /// ticks.
    Tick,
    /// An interface changed its state or lost frames.
    Bus {
        /// The interface.
        bus: BusIndex,
        /// Its report.
        event: BusEvent,
    },
    /// The record continues after a gap of unknown length (a log without timestamps between its parts).
    UnknownGap,
    /// A command from this computer. Commands from the bus are frames.
    Command {
        /// The command.
        command: Command,
    },
    /// Writing the files of the learned state and the records started to fail, or works again.
    Store {
        /// Whether they can be written.
        works: bool,
    },
    /// The recorded run changed its configuration here. For the driver; the core ignores it.
    Reload,
    /// The recorded run restored a stored state here. For the driver; the core ignores it.
    Restore {
        /// Age of the state.
        away: Downtime,
    },
}

impl Record {
    /// A received frame.
    #[inline]
    pub const fn frame(time: Timestamp, bus: BusIndex, frame: &Frame) -> Self {
        Self { time, kind: RecordKind::Frame { bus, frame: *frame } }
    }

    /// A received frame with the result of checking its authenticator.
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

    /// A report on whether files can be written.
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
    /// The interface is up; frames may arrive.
    Up,
    /// The interface exists but is down.
    Down,
    /// The interface does not exist (missing at start, or removed).
    Missing,
    /// The kernel or a full queue of the daemon dropped frames since the last report.
    Dropped {
        /// Frames lost.
        frames: u64,
    },
    /// An error frame was received.
    ErrorFrame {
        /// Error class mask of the frame's identifier (`CAN_ERR_*` in linux/can/error.h).
        class: u32,
    },
    /// Frames of the daemon could not be sent (queue full, interface gone).
    SendFailed {
        /// Frames not sent.
        frames: u64,
    },
}

/// Time between a stored state and the first input ([`Monitor::restore`](crate::monitor::Monitor::restore)).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Downtime {
    /// The difference between the two timestamps. A state whose timestamp is after "now" by more than
    /// [`MERGE_TOLERANCE_NS`] was stored on another clock; the downtime is then unknown.
    #[default]
    AsStamped,
    /// This long, s.
    Seconds(f64),
    /// Unknown, as after [`RecordKind::UnknownGap`].
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

/// The text is not a downtime.
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

/// Largest step back in time that counts as frames of several interfaces merged out of order, ns. Beyond it, the clock
/// was set back.
pub const MERGE_TOLERANCE_NS: i64 = 1_000_000_000;
