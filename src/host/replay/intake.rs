//! Checks of frames before they are read, for the summary of a replay: end-to-end protection and dropped frames.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::monitor::Monitor;
use crate::quantity::BusIndex;
use crate::status::document::MessageFlood;

/// A protected message and how often each status of its check was given.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ProtectedSummary {
    /// Interface.
    pub interface: String,
    /// Identifier as candump writes it.
    pub id: String,
    /// Every status, zeros too.
    pub counts: BTreeMap<&'static str, u64>,
}

/// The protected messages and the dropped frames of a monitor.
pub(super) fn summaries(monitor: &Monitor, interfaces: &[String]) -> (Vec<ProtectedSummary>, Vec<MessageFlood>) {
    let name = |bus: BusIndex| interfaces.get(bus.index()).map_or("unknown", String::as_str).to_owned();
    let protected = monitor.protected().map(|of| ProtectedSummary {
        interface: name(of.bus),
        id: of.id.to_string(),
        counts: of.counts.iter().map(|(status, count)| (status.name(), count)).collect(),
    });
    let dropped = monitor.dropped().map(|of| MessageFlood {
        interface: name(of.bus),
        id: of.id.to_string(),
        dropped: of.dropped,
    });
    (protected.collect(), dropped.collect())
}
