//! The signals that this program provides, and how each follows from the status document.
//!
//! In: a status document (units in its field names, current positive = discharge, SOC and SOH as fractions, cells from 0).
//! Out: VSS values: current positive = into the battery, percent, cells from 0. `None` = no value: something it needs is unknown.
//! An array has a value only when that of every cell is known: its places are the cells, and VSS has no unknown number.

mod own;
mod standard;

use packwatch_host::status::document::{CellStatus, StatusDocument};
use serde::Serialize;

use super::value::{DataType, Value, single};

/// Branch of VSS's own signals of the battery.
pub(crate) const STANDARD_BRANCH: &str = "Vehicle.Powertrain.TractionBattery";

/// Where a signal is defined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Origin {
    /// In VSS, below [`STANDARD_BRANCH`].
    Standard,
    /// In the overlay, below the configured branch.
    Overlay,
}

/// A signal.
#[derive(Debug)]
pub(crate) struct Signal {
    /// Its path below the branch.
    pub(crate) name: &'static str,
    pub(crate) origin: Origin,
    pub(crate) data_type: DataType,
    /// Name of the unit in VSS 5 and 6.
    pub(crate) unit: Option<&'static str>,
    /// For the overlay and the manual.
    pub(crate) description: &'static str,
    /// Fields of the status document that it follows from.
    pub(crate) fields: &'static str,
    /// Its value; `None` = none.
    pub(crate) value: fn(&StatusDocument) -> Option<Value>,
}

impl Signal {
    /// Its full path, with the overlay's signals below `branch`.
    pub(crate) fn path(&self, branch: &str) -> String {
        let branch = match self.origin {
            Origin::Standard => STANDARD_BRANCH,
            Origin::Overlay => branch,
        };
        format!("{branch}.{}", self.name)
    }
}

/// Every signal, those of VSS first.
pub(crate) fn all() -> impl Iterator<Item = &'static Signal> {
    standard::SIGNALS.iter().chain(own::SIGNALS)
}

/// The signals of the overlay.
pub(crate) fn of_overlay() -> impl Iterator<Item = &'static Signal> {
    own::SIGNALS.iter()
}

fn float(number: Option<f64>) -> Option<Value> {
    single(number).map(Value::Float)
}

/// A fraction in percent.
fn percent(fraction: Option<f64>) -> Option<Value> {
    float(fraction.map(|fraction| 100.0 * fraction))
}

/// A current or an offset with VSS's sign; 0 stays without a sign.
fn negated(number: Option<f64>) -> Option<f64> {
    number.map(|number| 0.0 - number)
}

fn number(number: Option<impl TryInto<u16>>) -> Option<Value> {
    number?.try_into().ok().map(Value::Uint16)
}

/// A word of the status document, as its JSON has it.
fn word(value: Option<impl Serialize>) -> Option<Value> {
    match serde_json::to_value(value?) {
        Ok(serde_json::Value::String(word)) => Some(Value::Text(word)),
        _ => None,
    }
}

/// One number per cell, in the order of the cells.
fn cell_numbers(document: &StatusDocument, value: fn(&CellStatus) -> Option<f64>) -> Option<Vec<f32>> {
    let numbers: Option<Vec<f32>> = in_order(document)?.iter().map(|cell| single(value(cell))).collect();
    numbers.filter(|numbers| !numbers.is_empty())
}

fn cells(document: &StatusDocument, value: fn(&CellStatus) -> Option<f64>) -> Option<Value> {
    cell_numbers(document, value).map(Value::Floats)
}

/// The cells, if they are numbered from 0 without a gap: a place in an array is the number of a cell.
fn in_order(document: &StatusDocument) -> Option<&[CellStatus]> {
    let cells = &document.cells;
    cells.iter().enumerate().all(|(index, cell)| usize::from(cell.cell) == index).then_some(cells)
}

/// Codes of the raised alarms, `RULE:SEVERITY` and of a cell `RULE:SEVERITY:cell3`; without any, only when every threshold was
/// judged.
fn alarm_codes(document: &StatusDocument) -> Option<Value> {
    let alarms = &document.alarms;
    let raised = alarms.list.iter().filter(|alarm| alarm.state.is_raised());
    let codes: Vec<String> = raised
        .map(|alarm| {
            let cell = alarm.cell.map_or_else(String::new, |cell| format!(":cell{}", cell.0));
            format!("{}:{}{cell}", alarm.rule.name(), alarm.severity.name())
        })
        .collect();
    // An empty list means "no error": only where that is known.
    let is_known = !codes.is_empty() || (alarms.raised == 0 && alarms.are_judged());
    is_known.then_some(Value::Texts(codes))
}

#[cfg(test)]
mod tests;
