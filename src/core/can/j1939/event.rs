//! Events of the J1939 node, for the log.

use serde::{Deserialize, Serialize};

use super::name::Name;

/// An event for the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "node_event")]
pub enum NodeEvent {
    /// The node starts to send codes.
    Claimed { address: u8 },
    /// Another node took the address. The node stops sending codes.
    AddressLost {
        /// Equals this node's NAME if two nodes have the same configuration.
        to: Name,
    },
    /// A node with a higher NAME claimed the address and lost.
    AddressDefended { against: Name },
    /// The number of codes that do not fit into the message changed.
    CodesLeftOut {
        /// 0 = all codes fit.
        codes: usize,
    },
}
