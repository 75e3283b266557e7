//! A signal that is in the log, and where it is described.

use super::capture::AnswerKey;
use crate::can::CanId;
use crate::can::dbc::Signal;
use crate::can::unit::Quantity;
use crate::import::DiagnosticSignal;
use crate::quantity::BusIndex;
use crate::wiring::evidence::{Series, SignalLabel};

/// A field of a message: its identifier, and the value of the first byte where that is a page.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MessageField {
    pub(super) id: CanId,
    pub(super) page: Option<u8>,
    pub(super) signal: Signal,
}

/// Where a signal is described.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum SignalOrigin {
    /// In a DBC file: its number.
    Dbc(usize),
    /// In a diagnostic answer that a definition describes: number of the table.
    Defined(usize),
    /// In an answer without a definition.
    Raw(AnswerKey, Box<DiagnosticSignal>),
    /// In a message without a DBC.
    Field(Box<MessageField>),
}

/// A signal that is in the log.
#[derive(Debug)]
pub(super) struct LogSignal {
    /// `Message.Signal`.
    pub(super) name: String,
    pub(super) bus: BusIndex,
    pub(super) origin: SignalOrigin,
    /// What its names and unit say.
    pub(super) label: SignalLabel,
    /// Values in V, A, degrees Celsius, per cent, or as they are.
    pub(super) series: Series,
    /// Its definition says unsigned, its values are of a signed number.
    pub(super) is_read_signed: bool,
    /// Factor and offset from the description's unit to V, A, degrees Celsius or per cent.
    pub(super) conversion: (f64, f64),
}

impl LogSignal {
    /// A field that no description names: places say nothing about a meaning.
    pub(super) fn unnamed(
        name: String,
        bus: BusIndex,
        origin: SignalOrigin,
        quantity: Quantity,
        series: Series,
    ) -> Self {
        let label = SignalLabel::unnamed(quantity);
        Self { name, bus, origin, label, series, is_read_signed: false, conversion: (1.0, 0.0) }
    }
}

/// The longest run of neighbours that go with the first of the run, of several the last; `None` ends a run.
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
