//! What a log contains: frames, error frames, and parts without a frame.

use std::fmt;

use packwatch_core::can::Frame;
use packwatch_core::quantity::Timestamp;

/// One part of a log.
#[derive(Debug, Clone, PartialEq)]
pub enum Item {
    /// A data frame or a remote frame, received or sent by the recorder.
    Frame {
        /// Time of the frame: Unix time if the log states a date, otherwise the time since the start of the log.
        time: Timestamp,
        /// Index into [`LogReader::channels`](crate::LogReader::channels).
        channel: u8,
        /// The frame.
        frame: Frame,
    },
    /// An error frame.
    ErrorFrame {
        /// Time of the error, stated as for a frame.
        time: Timestamp,
        /// Index into [`LogReader::channels`](crate::LogReader::channels).
        channel: u8,
        /// CAN_ERR_* class bits as in SocketCAN; 0 if the log does not state the kind of error.
        class: u32,
    },
    /// A CAN XL frame, which packwatch does not support.
    Xl,
    /// A valid part without a frame of a CAN bus, such as a header, a comment, a statistic or another kind of bus.
    Other,
    /// A part that violates the format. The text states what was found and what is allowed.
    Bad(String),
}

/// A channel of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Channel {
    /// The log names the interface, for example `can0`.
    Name(String),
    /// The log counts its channels.
    Number {
        /// Number as written in the log.
        written: u32,
        /// The same number, counted from 0.
        index: u32,
    },
}

/// A place in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Position {
    /// Line of a text file, from 1.
    Line(u64),
    /// Offset in a binary file, bytes from 0.
    Byte(u64),
}

impl fmt::Display for Position {
    /// The text between a file's name and a message: `:12` or `: byte 4711`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(line) => write!(f, ":{line}"),
            Self::Byte(offset) => write!(f, ": byte {offset}"),
        }
    }
}
