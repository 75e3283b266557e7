//! Finds the values of an event or of a history row by name.
//!
//! Events and the rows of a store use the same names for the same values. A value that is null or not finite is unknown
//! and returned as `None`. Finite numbers are returned unchanged.

use serde_json::{Map, Value};

use crate::monitor::EventKind;
use crate::quantity::catalogue::Quantity;
use crate::store::HistoryEntry;

#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Fields(Map<String, Value>);

impl Fields {
    pub(crate) fn of_event(kind: &EventKind) -> Self {
        match serde_json::to_value(kind) {
            Ok(Value::Object(fields)) => Self(fields),
            _ => Self::default(),
        }
    }

    pub(crate) fn of_entry(entry: &HistoryEntry) -> Self {
        let names = entry.kind.columns().iter().map(|name| (*name).to_owned());
        Self(names.zip(entry.values.iter().cloned()).collect())
    }

    pub(crate) fn number(&self, name: &str) -> Option<f64> {
        self.0.get(name)?.as_f64()
    }

    pub(crate) fn whole(&self, name: &str) -> Option<u32> {
        self.0.get(name)?.as_u64()?.try_into().ok()
    }

    pub(crate) fn pair(&self, mean: &str, std: &str) -> Option<(f64, f64)> {
        self.number(mean).zip(self.number(std))
    }

    pub(crate) fn quantity(&self, quantity: Quantity) -> Option<(f64, f64)> {
        let row = quantity.row();
        self.pair(row.key, row.std_key?)
    }

    /// Returns a text; a missing text is empty.
    pub(crate) fn text(&self, name: &str) -> &str {
        self.0.get(name).and_then(Value::as_str).unwrap_or_default()
    }

    /// Whether a flag is set. A store writes flags as 0 and 1.
    pub(crate) fn flag(&self, name: &str) -> bool {
        self.0.get(name).is_some_and(|value| value.as_bool().unwrap_or_else(|| value.as_f64().unwrap_or(0.0) != 0.0))
    }
}
