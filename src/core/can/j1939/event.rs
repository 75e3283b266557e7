//! Events of the node, for the log.

use serde::{Deserialize, Serialize};

use super::name::Name;

/// An event of the node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "node_event")]
pub enum NodeEvent {
    /// The node has its address; codes are sent from now on.
    Claimed { address: u8 },
    /// Another node took the address; codes are no longer sent.
    AddressLost {
        /// Its NAME; this node's own NAME if two nodes have the same configuration.
        to: Name,
    },
    /// Another node claimed the address, but has the lower priority.
    AddressDefended {
        /// Its NAME.
        against: Name,
    },
    /// The number of active codes that do not fit into one message changed.
    CodesLeftOut {
        /// The number of codes; 0 = all codes are sent again.
        codes: usize,
    },
}
