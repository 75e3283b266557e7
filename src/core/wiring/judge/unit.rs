//! Converts the units of a DBC to the kinds of quantities that the checks distinguish.

use crate::can::unit::{Quantity, SignalUnit};
use crate::wiring::plan::Kind;

/// Kind of quantity, with factor and offset to the program's unit; `None` if the unit is not known or measures another
/// quantity.
pub(super) fn unit_of(text: &str) -> Option<(Kind, f64, f64)> {
    let unit = SignalUnit::parse(text)?;
    let kind = match unit.quantity {
        Quantity::Current => Kind::Current,
        Quantity::Voltage => Kind::Voltage,
        Quantity::Temperature => Kind::Temperature,
        Quantity::Other(_) => return None,
    };
    Some((kind, unit.factor, unit.offset))
}
