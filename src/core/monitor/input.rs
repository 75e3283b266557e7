//! Inputs of the [`Monitor`](super::Monitor): frames, ticks, reports of interfaces and files, commands.

use serde::{Deserialize, Serialize};

use crate::alarm::{Rule, Selector};
use crate::can::Frame;
use crate::quantity::{BusIndex, Timestamp};

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

/// One input, with the driver's time. Inputs come in the order in which they happened; a
/// time a little before the latest one ([`MERGE_TOLERANCE_NS`]: buses merge out of order) is counted and treated as the
/// latest; further back, the clock was set back and how much time passed is unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Input<'a> {
    /// A frame was received.
    Frame {
        /// When the kernel received it.
        time: Timestamp,
        /// Interface it came on.
        bus: BusIndex,
        /// The frame.
        frame: &'a Frame,
    },
    /// A frame of an authenticated message was received, and its authenticator was checked
    /// ([`Monitor::mac_check`](super::Monitor::mac_check)).
    SecuredFrame {
        /// When the kernel received it.
        time: Timestamp,
        /// Interface it came on.
        bus: BusIndex,
        /// The frame.
        frame: &'a Frame,
        /// The freshness with which the authenticator is right; `None` = with none.
        freshness: Option<u64>,
    },
    /// Time passed. The driver ticks every [`TICK_PERIOD_MS`] while awake; cyclic frames and time-outs follow from ticks.
    Tick {
        /// Now.
        time: Timestamp,
    },
    /// An interface changed or lost something.
    Bus {
        /// When.
        time: Timestamp,
        /// Which interface.
        bus: BusIndex,
        /// Its report.
        event: BusEvent,
    },
    /// The record continues at `time`, but how much time really passed is unknown (a log without stamps between its parts).
    UnknownGap {
        /// Stamp of its continuation.
        time: Timestamp,
    },
    /// A command from this computer. Commands of the bus are frames.
    Command {
        /// When.
        time: Timestamp,
        /// The command.
        command: Command,
    },
    /// Whether the files of the learned state and the records can be written.
    Store {
        /// When.
        time: Timestamp,
        /// They can.
        works: bool,
    },
}

/// How long before the first input a stored state was taken ([`Monitor::restore`](super::Monitor::restore)).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Downtime {
    /// As long as the two stamps say. A state that was taken after "now" ([`MERGE_TOLERANCE_NS`] aside) has another clock's
    /// stamp: then the downtime is unknown.
    #[default]
    AsStamped,
    /// This long, s.
    Seconds(f64),
    /// Unknown: as after [`Input::UnknownGap`].
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

/// A command to the daemon.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "command")]
pub enum Command {
    /// Acknowledge alarms.
    Acknowledge(Selector),
    /// End latched alarms and forget past ones; learned values stay.
    Clear(Selector),
    /// Another pack is connected: forget the values learned of the old one.
    PackReplaced,
    /// Send no diagnostic requests, or send them again.
    Poll {
        /// Send none.
        standby: bool,
    },
    /// Send a rule's alarm frame, marked as a test, for a while.
    Test {
        /// Which rule.
        rule: Rule,
        /// How long, s.
        seconds: f64,
    },
}

/// Origin of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// This computer.
    Local,
    /// A frame.
    Bus(BusIndex),
}

impl Input<'_> {
    /// The driver's time of this input.
    pub fn time(&self) -> Timestamp {
        match *self {
            Input::Frame { time, .. }
            | Input::SecuredFrame { time, .. }
            | Input::Tick { time }
            | Input::Bus { time, .. }
            | Input::UnknownGap { time }
            | Input::Command { time, .. }
            | Input::Store { time, .. } => time,
        }
    }
}

/// Period of the driver's ticks, ms: ten times faster than the fastest sensible cyclic frame needs.
pub const TICK_PERIOD_MS: u32 = 10;

/// Steps back in time up to this are frames of several interfaces merged out of order, ns; beyond, the record's
/// clock was set back.
pub const MERGE_TOLERANCE_NS: i64 = 1_000_000_000;
