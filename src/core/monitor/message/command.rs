//! Commands to the daemon, from this computer or from the bus.

use serde::{Deserialize, Serialize};

use crate::alarm::{Rule, Selector};
use crate::quantity::BusIndex;

/// A command to the daemon.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "command")]
pub enum Command {
    /// Acknowledge alarms.
    Acknowledge(Selector),
    /// End latched alarms (which stay raised after their value is healthy again) and forget past alarms. Learned values
    /// are kept.
    Clear(Selector),
    /// Another pack is connected: forget the learned values of the old pack.
    PackReplaced,
    /// Stop or resume diagnostic requests.
    Poll {
        /// `true` = stop, `false` = resume.
        standby: bool,
    },
    /// Send a rule's alarm frame, marked as a test, for a while.
    Test {
        rule: Rule,
        /// Duration (s).
        seconds: f64,
    },
}

/// Origin of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// A program on this computer.
    Local,
    /// A frame on this interface.
    Bus(BusIndex),
}
