//! Defines a signal of the log. Its description (name, position, scaling) comes from a file or from the search.

use super::PositiveDirection;
use super::capture::AnswerKey;
use crate::can::CanId;
use crate::can::dbc::Signal;
use crate::can::unit::Quantity;
use crate::import::DiagnosticSignal;
use crate::quantity::BusIndex;
use crate::wiring::evidence::{Series, SignalLabel};

/// A field of a message: identifier, signal and, if the first byte selects a page (multiplexer), the value of that
/// byte.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MessageField {
    pub(super) id: CanId,
    pub(super) page: Option<u8>,
    pub(super) signal: Signal,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum SignalOrigin {
    /// A DBC file, given by its index.
    Dbc(usize),
    /// A definition of diagnostic answers, given by the index of its table.
    Defined(usize),
    /// A field that the search found in a diagnostic answer.
    Raw(AnswerKey, Box<DiagnosticSignal>),
    /// A field that the search found in a message.
    Field(Box<MessageField>),
}

#[derive(Debug)]
pub(super) struct LogSignal {
    pub(super) name: String,
    pub(super) bus: BusIndex,
    pub(super) origin: SignalOrigin,
    /// What the names and the unit of the signal say about its meaning.
    pub(super) label: SignalLabel,
    /// Values in V, A, degrees Celsius or percent; other units are not converted.
    pub(super) series: Series,
    /// Whether the signal is read as signed although its definition says unsigned.
    pub(super) is_read_signed: bool,
    /// Factor and offset from the description's unit to V, A, degrees Celsius or percent.
    pub(super) conversion: (f64, f64),
    /// Direction of a positive current according to the description.
    pub(super) stated: Option<PositiveDirection>,
}

impl LogSignal {
    /// Creates an unnamed field. Its label contains only the unit of the assumed quantity.
    pub(super) fn unnamed(
        name: String,
        bus: BusIndex,
        origin: SignalOrigin,
        quantity: Quantity,
        series: Series,
    ) -> Self {
        let label = SignalLabel::unnamed(quantity);
        Self { name, bus, origin, label, series, is_read_signed: false, conversion: (1.0, 0.0), stated: None }
    }
}

/// Returns the longest run of items in which `goes_with` holds between the first item and every other item. If several
/// runs are equally long, the last is returned. A `None` ends a run.
pub(super) fn longest_run<T>(items: impl Iterator<Item = Option<T>>, goes_with: impl Fn(&T, &T) -> bool) -> Vec<T> {
    let (mut best, mut run) = (Vec::new(), Vec::new());
    for item in items.chain([None]) {
        match item {
            Some(item) if run.first().is_none_or(|first| goes_with(first, &item)) => run.push(item),
            item => {
                let ended = std::mem::replace(&mut run, item.into_iter().collect());
                best = if ended.len() >= best.len() { ended } else { best };
            }
        }
    }
    best
}
