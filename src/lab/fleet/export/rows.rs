//! Defines the rows of the exported tables.

use std::sync::Arc;

use serde_json::Value;

use crate::alarm::Rule;
use crate::cell::LossModes;
use crate::fields::Fields;
use crate::health::{RemainingLife, UseRecord};
use crate::monitor::Estimate;
use crate::quantity::Timestamp;
use crate::quantity::catalogue::RecordedPackValues;

pub(super) struct EstimateRow {
    pub(super) log: Arc<str>,
    pub(super) since_s: f64,
    pub(super) estimate: Estimate,
}

pub(super) struct HalfCycleRow {
    pub(super) log: Arc<str>,
    pub(super) time: Timestamp,
    pub(super) since_s: f64,
    pub(super) full_cycles: f64,
    /// Values of the event `HalfCycle`.
    pub(super) half: Fields,
    /// Values of the event `Capacity`.
    pub(super) capacity: Fields,
    /// Lithium and active material that the cell has lost; `None` = unknown.
    pub(super) losses: Option<LossModes>,
    pub(super) remaining: Option<RemainingLife>,
}

pub(super) struct AlarmRow {
    pub(super) log: Arc<str>,
    pub(super) time: Timestamp,
    pub(super) since_s: f64,
    pub(super) rule: Rule,
    /// Values of the event `Alarm`.
    pub(super) alarm: Fields,
}

pub(super) struct OutlookRow {
    pub(super) log: Arc<str>,
    pub(super) time: Timestamp,
    pub(super) since_s: f64,
    /// Values of the event `Outlook`.
    pub(super) values: RecordedPackValues,
}

pub(super) struct UseRow {
    pub(super) log: Arc<str>,
    /// Path of the number in the record of the pack's use, such as `rest.above_80_s`.
    pub(super) counter: String,
    pub(super) value: f64,
}

impl UseRow {
    pub(super) fn of_record(log: &Arc<str>, record: &UseRecord) -> Result<Vec<Self>, serde_json::Error> {
        let mut rows = Vec::new();
        let mut waiting = vec![(String::new(), serde_json::to_value(record)?)];
        while let Some((counter, value)) = waiting.pop() {
            let path = |name: &str| if counter.is_empty() { name.to_owned() } else { format!("{counter}.{name}") };
            match &value {
                Value::Object(members) => {
                    waiting.extend(members.iter().rev().map(|(name, value)| (path(name), value.clone())))
                }
                Value::Array(items) => {
                    let items = items.iter().enumerate().rev();
                    waiting.extend(items.map(|(index, value)| (path(&index.to_string()), value.clone())));
                }
                value => rows.extend(value.as_f64().map(|value| Self { log: log.clone(), counter, value })),
            }
        }
        Ok(rows)
    }
}
