//! Events of the J1939 node, for the log.

use serde::{Deserialize, Serialize};

use super::name::Name;

/// An event of the node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "node_event")]
pub enum NodeEvent {
    /// The node has its address and starts to send codes.
    Claimed { address: u8 },
    /// Another node took the address. The node stops sending codes.
    AddressLost {
        /// NAME of the other node. It equals this node's own NAME if two nodes have the same configuration.
        to: Name,
    },
    /// Another node claimed the address, but has the higher NAME and therefore loses.
    AddressDefended {
        /// NAME of the other node.
        against: Name,
    },
    /// The number of active codes that do not fit into one message changed.
    CodesLeftOut {
        /// The number of codes; 0 = the message contains all codes again.
        codes: usize,
    },
}
