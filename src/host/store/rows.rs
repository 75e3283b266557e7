//! Defines the tables of the history, and makes their rows from the core's events.
//!
//! A column that has the name of an event's field contains that field. Cells count from 0; units are in the names. A
//! number that is not finite is stored as NULL.

use std::sync::LazyLock;

use rusqlite::types::Value;

use super::stamp::Stamp;
use crate::monitor::EventKind;
use crate::quantity::catalogue::{RecordedPackValues, RecordedValues};

/// Value of `change` for an alarm that ended because no threshold monitors it any longer.
pub(super) const DROPPED: &str = "dropped";

#[derive(Debug, Clone, PartialEq)]
pub(super) enum HistoryRow {
    /// An event of the core: a half-cycle, a capacity, a new cell model, an alarm, a filter reset, another pack.
    Event(EventKind),
    /// A report of the store itself.
    Own {
        /// Name of the event, such as `damaged`, `state_damaged` or `rows_lost`.
        reason: &'static str,
        detail: String,
    },
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct RowBatch {
    pub stamp: Stamp,
    pub rows: Vec<HistoryRow>,
}

/// A table of the history.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum HistoryTable {
    /// Charges and discharges.
    HalfCycle,
    /// Learned capacities.
    Capacity,
    /// Loss modes of the cells.
    LossModes,
    /// Forecasts of the remaining life. Each forecast is for the cell that reaches its end of life first.
    RemainingLife,
    /// Energy and power of the pack after its charges and discharges.
    Outlook,
    /// Changes of the cell model that the daemon learns.
    Model,
    /// Changes of alarms.
    Alarm,
    /// Resets, pack changes, damage.
    Reset,
}

impl HistoryTable {
    /// All tables, in display order.
    pub const ALL: [Self; 8] = [
        Self::HalfCycle,
        Self::Capacity,
        Self::LossModes,
        Self::RemainingLife,
        Self::Outlook,
        Self::Model,
        Self::Alarm,
        Self::Reset,
    ];

    pub(super) fn sql_type(column: &str) -> &'static str {
        match column {
            "mode" | "state" | "chemistry" | "rule" | "severity" | "change" | "reason" | "detail" => "TEXT",
            "cell" | "taken_back" | "active" | "occurrences" | "acknowledged" => "INTEGER",
            _ => "REAL",
        }
    }

    /// Name in the database, in JSON and in CSV.
    pub const fn name(self) -> &'static str {
        match self {
            Self::HalfCycle => "half_cycle",
            Self::Capacity => "capacity",
            Self::LossModes => "loss_modes",
            Self::RemainingLife => "remaining_life",
            Self::Outlook => "outlook",
            Self::Model => "model",
            Self::Alarm => "alarm",
            Self::Reset => "reset",
        }
    }

    /// Columns of the table, without moment and number. The cell (from 0) comes first.
    pub fn columns(self) -> &'static [&'static str] {
        static CAPACITY: LazyLock<Vec<&str>> = LazyLock::new(|| {
            ["cell", "measured_ah", "measured_std_ah"].into_iter().chain(RecordedValues::keys()).collect()
        });
        // These values belong to the pack. As in the other tables, the first column contains the cell, here always
        // NULL.
        static OUTLOOK: LazyLock<Vec<&str>> =
            LazyLock::new(|| ["cell"].into_iter().chain(RecordedPackValues::keys()).collect());
        match self {
            Self::HalfCycle => &[
                "cell",
                "mode",
                "charge_ah",
                "swing",
                "swing_std",
                "duration_s",
                "mean_current_a",
                "mean_temperature_c",
            ],
            Self::Capacity => &CAPACITY,
            Self::LossModes => &["cell", "lli", "lli_std", "lam_ne", "lam_ne_std", "lam_pe", "lam_pe_std"],
            Self::RemainingLife => &["cell", "cycles", "cycles_low", "cycles_high", "days", "days_low", "days_high"],
            Self::Outlook => &OUTLOOK,
            Self::Model => {
                &["cell", "state", "capacity_ah", "capacity_std_ah", "residual_v", "chemistry", "taken_back"]
            }
            Self::Alarm => &[
                "cell",
                "rule",
                "severity",
                "change",
                "state",
                "active",
                "value",
                "probability",
                "threshold",
                "occurrences",
                "acknowledged",
            ],
            Self::Reset => &["cell", "reason", "capacity_ah", "capacity_std_ah", "detail"],
        }
    }
}

impl HistoryRow {
    /// The details of a report of the store itself; `None` = an event of the core.
    pub(super) fn detail(&self) -> Option<&str> {
        match self {
            Self::Own { detail, .. } => Some(detail),
            Self::Event(_) => None,
        }
    }

    /// Returns the row's table and the values of its columns; `None` = the history has no row for this event.
    pub(super) fn values(&self) -> Option<(HistoryTable, Vec<Value>)> {
        let text = |text: &str| Value::Text(text.to_owned());
        let kind = match self {
            Self::Own { reason, detail } => {
                let values = vec![Value::Null, text(reason), Value::Null, Value::Null, text(detail)];
                return Some((HistoryTable::Reset, values));
            }
            Self::Event(kind) => kind,
        };
        // Values of the columns that do not contain the event's field of the same name.
        let (table, own) = match kind {
            EventKind::HalfCycle { .. } => (HistoryTable::HalfCycle, vec![]),
            EventKind::Capacity { .. } => (HistoryTable::Capacity, vec![]),
            EventKind::LossModes { .. } => (HistoryTable::LossModes, vec![]),
            EventKind::RemainingLife { .. } => (HistoryTable::RemainingLife, vec![]),
            EventKind::Outlook { .. } => (HistoryTable::Outlook, vec![]),
            EventKind::Model { is_taken_back, .. } => {
                (HistoryTable::Model, vec![("taken_back", Value::Integer(i64::from(*is_taken_back)))])
            }
            EventKind::Alarm { .. } => (HistoryTable::Alarm, vec![]),
            // No threshold monitors this alarm any more, so the alarm has ended regardless of its value.
            EventKind::AlarmDropped { .. } => {
                let no = Value::Integer(0);
                let own = [("change", text(DROPPED)), ("state", text("inactive")), ("active", no.clone())];
                (HistoryTable::Alarm, own.into_iter().chain([("acknowledged", no)]).collect())
            }
            EventKind::FilterReset { .. } => (HistoryTable::Reset, vec![("reason", text("filter_reset"))]),
            EventKind::PackIdentity { identity } => {
                (HistoryTable::Reset, vec![("reason", text("pack_identity")), ("detail", text(&identity.to_string()))])
            }
            EventKind::PackReplaced { .. } => (HistoryTable::Reset, vec![("reason", text("pack_replaced"))]),
            _ => return None,
        };
        let fields = serde_json::to_value(kind).ok()?;
        let value = |column: &&str| match own.iter().find(|(name, _)| name == column) {
            Some((_, value)) => value.clone(),
            None => fields.get(*column).map_or(Value::Null, sql_value),
        };
        Some((table, table.columns().iter().map(value).collect()))
    }

    /// Whether the row is a detail, which is dropped first when the backlog is full.
    pub(super) const fn is_detail(&self) -> bool {
        matches!(self, Self::Event(EventKind::HalfCycle { .. } | EventKind::Outlook { .. }))
    }

    /// The identity of the connected pack, if this row contains it.
    pub(super) const fn pack_identity(&self) -> Option<f64> {
        match self {
            Self::Event(EventKind::PackIdentity { identity }) => Some(*identity),
            _ => None,
        }
    }

    /// Whether rows after this row belong to another pack.
    pub(super) const fn replaces_pack(&self) -> bool {
        matches!(self, Self::Event(EventKind::PackReplaced { .. }))
    }
}

/// The SQLite value of an event's field; NULL for arrays and objects.
fn sql_value(field: &serde_json::Value) -> Value {
    match field {
        serde_json::Value::Bool(flag) => Value::Integer(i64::from(*flag)),
        serde_json::Value::Number(number) => match number.as_i64() {
            Some(whole) => Value::Integer(whole),
            // SQLite does not store the sign of a zero, but the hash would include it.
            None => number.as_f64().map(|real| real + 0.0).into(),
        },
        serde_json::Value::String(text) => Value::Text(text.clone()),
        _ => Value::Null,
    }
}

#[cfg(test)]
pub(super) mod tests;
