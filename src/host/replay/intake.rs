//! Summarises, for a replay, what happened to frames before they were decoded: end-to-end protection, dropped frames
//! and diagnostic answers.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::monitor::Monitor;
use crate::quantity::BusIndex;
use crate::status::document::{ControllerStatus, MessageFlood};

/// A protected message and the number of checks with each status.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ProtectedSummary {
    /// Interface.
    pub interface: String,
    /// Identifier in candump notation.
    pub id: String,
    /// Counts by status, including zeros.
    pub counts: BTreeMap<&'static str, u64>,
}

/// Counts of protected messages, dropped frames and diagnostic answers.
type Summaries = (Vec<ProtectedSummary>, Vec<MessageFlood>, Vec<ControllerStatus>);

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
