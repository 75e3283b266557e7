//! Events of the node, for the log.

use serde::{Deserialize, Serialize};

use super::name::Name;

/// A change worth a line in a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "node_event")]
pub enum NodeEvent {
    /// The node has its address; codes are sent from now on.
    Claimed {
        /// The address.
        address: u8,
    },
    /// Another node took the address; no codes are sent any more.
    AddressLost {
        /// Its NAME; this node's own when two nodes have the same configuration.
        to: Name,
    },
    /// Another node claimed the address and must give way.
    AddressDefended {
        /// Its NAME.
        against: Name,
    },
    /// The number of active codes beyond the capacity of one message changed.
    CodesLeftOut {
        /// Their number; 0 = all codes are sent again.
        codes: usize,
    },
}
