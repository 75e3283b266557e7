//! Summarises a replay: counts, alarms, and the cells at the end.

use std::collections::BTreeMap;

use serde::Serialize;

use super::cells::CellSummary;
use super::intake::ProtectedSummary;
use crate::alarm::Change;
use crate::io::log::LogCounts;
use crate::monitor::{Event, EventKind};
use crate::quantity::CellIndex;
use crate::quantity::catalogue::RecordedValues;
use crate::status::document::{ControllerStatus, MessageFlood};

/// Maximum number of raised alarms that are listed. All raised alarms are counted.
const MAX_LISTED_ALARMS: usize = 1000;

/// Summary of a replay.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ReplaySummary {
    /// Counts of the lines and frames of the logs.
    #[serde(flatten)]
    pub log: LogCounts,
    /// Records before `from`, which were skipped.
    pub skipped_records: u64,
    /// Ticks passed to the core.
    pub ticks: u64,
    /// Number of estimates, counted only if they are written.
    pub estimates: u64,
    /// Frames that would be sent.
    pub frames_out: u64,
    /// Number of bad readings, counted when their signal becomes good again.
    pub bad_readings: u64,
    /// Protected input messages.
    pub protected: Vec<ProtectedSummary>,
    /// Messages whose frames were dropped because their rate was too high.
    pub dropped: Vec<MessageFlood>,
    /// Controllers that answer diagnostic requests.
    pub controllers: Vec<ControllerStatus>,
    /// Number of events by name. Alarms are counted by change.
    pub events: BTreeMap<String, u64>,
    /// The first 1,000 alarms raised.
    pub alarms_raised: Vec<Event>,
    /// State of the cells at the end.
    pub cells: Vec<CellSummary>,
    /// Learned offset of the current sensor at the end (A): reading minus true current, positive = discharge.
    pub current_offset_a: Option<f64>,
    /// Standard deviation of the learned offset (A).
    pub current_offset_std_a: Option<f64>,
    /// First stamp (s).
    pub first_s: Option<f64>,
    /// Last stamp (s).
    pub last_s: Option<f64>,
    /// Covered time (s), without gaps in which the recorder counts as asleep.
    pub awake_s: f64,
    /// Wall time (s).
    pub wall_s: f64,
    /// Awake time over wall time.
    pub times_real_time: f64,
    /// Frames read per second of wall time.
    pub frames_per_s: f64,
    /// Voltage readings that reached an estimator, per second of wall time.
    pub cell_steps_per_s: f64,
    /// Peak resident memory, KiB, if the system reports it.
    pub peak_memory_kib: Option<u64>,
    /// Why the replay says nothing about the battery, for example because no frame carries a configured signal.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
    /// Remarks for the user.
    pub notes: Vec<String>,
}

/// Counts an event, lists it if it is a raised alarm, and keeps the last learned values of each cell.
pub(super) fn note_event(
    summary: &mut ReplaySummary,
    learned: &mut BTreeMap<CellIndex, RecordedValues>,
    event: &Event,
) {
    let name = event.kind.name();
    let name = match event.kind {
        EventKind::Capacity { cell, values, .. } => {
            learned.insert(cell, values);
            name.to_owned()
        }
        EventKind::Alarm { change, .. } => {
            if change == Change::Raised && summary.alarms_raised.len() < MAX_LISTED_ALARMS {
                summary.alarms_raised.push(*event);
            }
            format!("{name}_{}", <&str>::from(change))
        }
        EventKind::SignalGood { bad_readings, .. } => {
            summary.bad_readings += bad_readings;
            name.to_owned()
        }
        _ => name.to_owned(),
    };
    *summary.events.entry(name).or_default() += 1;
}

/// Peak resident memory, from VmHWM in /proc/self/status, KiB.
pub(super) fn peak_memory_kib() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?.trim().strip_suffix("kB")?.trim().parse().ok()
}
