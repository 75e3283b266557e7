//! Defines the signals that this program provides, and derives the value of each from the status document.
//!
//! Input: a status document (units in its field names, positive current = discharge, SOC and SOH as fractions, cells
//! from 0). Output: VSS values (positive current = charge, percentages, cells from 0). `None` means that the value
//! depends on something unknown. An array has a value only if every cell has a value, because positions in the array
//! are cell numbers and a VSS array cannot contain an unknown number.

mod derived;

use std::borrow::Cow;
use std::sync::LazyLock;

use packwatch_host::monitor::CellView;
use packwatch_host::quantity::catalogue::{
    CellValues, PackValues, Part, Presentation, Quantity, QuantityRow, Unit, VssPath,
};
use packwatch_host::status::document::StatusDocument;

use super::value::{DataType, Value, single};

/// Branch of the battery signals that VSS defines.
pub(crate) const STANDARD_BRANCH: &str = "Vehicle.Powertrain.TractionBattery";

/// Where a signal is defined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Origin {
    /// Defined in VSS, below [`STANDARD_BRANCH`].
    Standard,
    /// Defined in the overlay (packwatch's extension of VSS), below the configured branch.
    Overlay,
}

#[derive(Debug)]
pub(crate) struct Signal {
    /// Path below the branch.
    pub(crate) name: Cow<'static, str>,
    pub(crate) origin: Origin,
    pub(crate) data_type: DataType,
    /// Name of the unit in VSS 5 and 6; `None` = no unit.
    pub(crate) unit: Option<&'static str>,
    /// Description for the overlay and the manual.
    pub(crate) description: Cow<'static, str>,
    /// Fields of the status document from which the signal is derived.
    pub(crate) fields: Cow<'static, str>,
    source: Source,
}

/// Source of a signal's value. A number from the catalogue of quantities is multiplied by the factor.
#[derive(Debug, Clone, Copy)]
enum Source {
    Document(fn(&StatusDocument) -> Option<Value>),
    Pack(Quantity, Part, f64),
    Cells(Quantity, Part, f64),
}

impl Signal {
    /// Full path; the overlay's signals are below `branch`.
    pub(crate) fn path(&self, branch: &str) -> String {
        let branch = match self.origin {
            Origin::Standard => STANDARD_BRANCH,
            Origin::Overlay => branch,
        };
        format!("{branch}.{}", self.name)
    }

    /// The signal's value; `None` = unknown.
    pub(crate) fn value(&self, document: &StatusDocument) -> Option<Value> {
        // Adding 0 turns -0 into 0.
        let scaled = |value: Option<f64>, factor: f64| single(value.map(|value| factor * value + 0.0));
        match self.source {
            Source::Document(value) => value(document),
            Source::Pack(quantity, part, factor) => {
                let value = scaled(document.pack.values.part(quantity, part), factor)?;
                if self.data_type != DataType::Uint32 {
                    return Some(Value::Float(value));
                }
                #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the range is checked")]
                (0.0..=1e9).contains(&value).then(|| Value::Uint32(value.round() as u32))
            }
            Source::Cells(quantity, part, factor) => {
                of_cells(document, |cell| scaled(cell.values.part(quantity, part), factor)).map(Value::Floats)
            }
        }
    }

    /// Whether the signal is a sum over the life of the battery.
    pub(crate) fn is_lifetime(&self) -> bool {
        self.fields.starts_with("pack.moved.")
    }

    /// Whether the signal is a quantity of the catalogue.
    pub(crate) fn is_quantity(&self) -> bool {
        !matches!(self.source, Source::Document(_))
    }
}

/// Every signal.
pub(crate) fn all() -> impl Iterator<Item = &'static Signal> {
    static SIGNALS: LazyLock<Vec<Signal>> = LazyLock::new(|| {
        let pack = PackValues::rows().flat_map(|(row, it)| signals_of(row, it, true));
        let cells = CellValues::rows().flat_map(|(row, it)| signals_of(row, it, false));
        derived::signals().into_iter().chain(pack).chain(cells).collect()
    });
    SIGNALS.iter()
}

pub(crate) fn of_overlay() -> impl Iterator<Item = &'static Signal> {
    all().filter(|signal| signal.origin == Origin::Overlay)
}

/// The signals of one quantity: the mean and, for some quantities, the standard deviation.
fn signals_of(row: &'static QuantityRow, it: &'static Presentation, is_pack: bool) -> impl Iterator<Item = Signal> {
    let (unit, factor) = vss_unit(row.unit);
    let (owner, data_type) = if is_pack { ("pack", DataType::Float) } else { ("cells", DataType::Floats) };
    let sign = if row.unit == Unit::Amperes { ", positive = into the battery" } else { "" };
    row.parts().map(move |(part, key)| {
        let (origin, name) = path(it.vss, part);
        // Times of standard VSS signals are whole seconds.
        let is_whole = origin == Origin::Standard && row.unit == Unit::Seconds;
        let about = match part {
            Part::Mean => format!("{}{sign}", it.about),
            Part::Std => format!("Standard deviation: {}", it.about),
        };
        // VSS arrays have no unit.
        let description = if is_pack {
            format!("{about}.")
        } else {
            format!("{about}, {}each cell.", unit.map_or(String::new(), |unit| format!("{unit}, ")))
        };
        let factor = if part == Part::Std { factor.abs() } else { factor };
        Signal {
            name,
            origin,
            data_type: if is_whole { DataType::Uint32 } else { data_type },
            unit: unit.filter(|_| is_pack),
            description: description.into(),
            fields: format!("{owner}.{key}").into(),
            source: if is_pack {
                Source::Pack(row.quantity, part, factor)
            } else {
                Source::Cells(row.quantity, part, factor)
            },
        }
    })
}

/// The path of a mean or of a standard deviation. A standard deviation is in the overlay and has the path of its mean,
/// with `StandardDeviation` appended.
fn path(path: VssPath, part: Part) -> (Origin, Cow<'static, str>) {
    match (path, part) {
        (VssPath::Standard(path), Part::Mean) => (Origin::Standard, path.into()),
        (VssPath::Overlay(path), Part::Mean) => (Origin::Overlay, path.into()),
        (VssPath::Standard(path) | VssPath::Overlay(path), Part::Std) => {
            (Origin::Overlay, format!("{path}StandardDeviation").into())
        }
    }
}

/// Unit in VSS, and the factor that converts a number to this unit.
const fn vss_unit(unit: Unit) -> (Option<&'static str>, f64) {
    match unit {
        Unit::Level | Unit::Fraction => (Some("percent"), 100.0),
        Unit::Ratio | Unit::Cycles | Unit::Count => (None, 1.0),
        Unit::Volts => (Some("V"), 1.0),
        Unit::Amperes => (Some("A"), -1.0),
        Unit::Celsius => (Some("Celsius"), 1.0),
        Unit::AmpereHours => (Some("Ah"), 1.0),
        Unit::WattHours => (Some("kWh"), 1e-3),
        Unit::Watts => (Some("W"), 1.0),
        Unit::Seconds => (Some("s"), 1.0),
        Unit::Days => (Some("day"), 1.0),
    }
}

/// Returns a value per cell. Array positions are cell numbers. If the document lists no cells, if a cell has no value,
/// or if the cell numbers have a gap, returns `None`.
fn of_cells<T>(document: &StatusDocument, value: impl Fn(&CellView) -> Option<T>) -> Option<Vec<T>> {
    let cells = document.cells.iter().enumerate();
    let values = cells.map(|(index, cell)| if cell.cell.index() == index { value(cell) } else { None });
    values.collect::<Option<Vec<T>>>().filter(|values| !values.is_empty())
}

#[cfg(test)]
mod tests;
