//! Checks of frames before they are read, for the summary of a replay: end-to-end protection and dropped frames.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::monitor::Monitor;
use crate::quantity::BusIndex;
use crate::status::document::{ControllerStatus, MessageFlood};

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

/// What the checks of one monitor have counted.
type Summaries = (Vec<ProtectedSummary>, Vec<MessageFlood>, Vec<ControllerStatus>);

/// The protected messages, the dropped frames and the diagnostic answers of a monitor.
pub(super) fn summaries(monitor: &Monitor, interfaces: &[String]) -> Summaries {
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
    let controllers = monitor.controllers().map(|of| ControllerStatus {
        interface: name(of.controller.bus),
        id: of.controller.response.to_string(),
        counts: of.counts,
    });
    (protected.collect(), dropped.collect(), controllers.collect())
}
