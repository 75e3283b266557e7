//! Signals of a log with their values: from DBC files, from definitions of diagnostic answers, and from fields of answers that
//! no definition describes.

use super::capture::{AnswerKey, Answers, Capture, MessageKey, Payloads};
use super::fields::{self, MessageField};
use super::raw;
use super::series::Series;
use super::words::{Dimension, Words, dimension};
use crate::can::dbc::{Database, Message, Signal};
use crate::can::signal::SignalPlan;
use crate::import::{DiagnosticSignal, DiagnosticTable};
use crate::quantity::BusIndex;

/// Fewest valid values of a signal; fewer are a coincidence.
const MIN_VALUES: usize = 2;

/// Most remarks.
const MAX_REMARKS: usize = 20;

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
    pub(super) dimension: Dimension,
    /// Words of the signal's own name.
    pub(super) words: Words,
    /// Whether the message's name places it at the traction battery.
    pub(super) is_pack_message: bool,
    /// Values in V, A, degrees Celsius, per cent, or as they are.
    pub(super) series: Series,
    /// Its definition says unsigned, its values are of a signed number.
    pub(super) is_read_signed: bool,
    /// Factor from the description's unit to V, A, degrees Celsius or per cent.
    pub(super) scale: f64,
}

/// Descriptions that the user gave.
#[derive(Debug, Default)]
pub(super) struct Descriptions {
    pub(super) databases: Vec<Database>,
    pub(super) tables: Vec<DiagnosticTable>,
}

/// Every signal of the log with values, in a fixed order, and remarks about described ones of the battery without any.
pub(super) fn signals(capture: &Capture, descriptions: &Descriptions) -> (Vec<LogSignal>, Vec<String>) {
    let mut signals = Vec::new();
    let mut rows = raw::CellRows::default();
    for (key, payloads) in &capture.messages {
        for (file, database) in descriptions.databases.iter().enumerate() {
            let messages = database.messages.iter().filter(|message| message.id == key.1);
            signals.extend(messages.flat_map(|message| of_message(*key, payloads, file, message)));
        }
    }
    for (key, answers) in &capture.answers {
        let fits = |table: &&(usize, &DiagnosticTable)| is_answer(table.1, key);
        let tables: Vec<_> = descriptions.tables.iter().enumerate().filter(|table| fits(&table)).collect();
        for (index, table) in &tables {
            signals.extend(table.signals.iter().flat_map(|signal| of_definition(key, answers, *index, table, signal)));
        }
        let described: Vec<(u32, u32)> =
            tables.iter().flat_map(|(_, table)| &table.signals).flat_map(DiagnosticSignal::spans).collect();
        signals.extend(raw::signals(key, answers, &described, &mut rows));
    }
    if descriptions.databases.is_empty() {
        signals.extend(fields::signals(capture));
    }
    let (usable, empty): (Vec<LogSignal>, Vec<LogSignal>) = signals.into_iter().partition(has_values);
    let remarks = empty.iter().filter_map(remark).take(MAX_REMARKS).collect();
    (usable, remarks)
}

/// What is wrong with a voltage or current of the battery that is in the log and never has a value.
fn remark(signal: &LogSignal) -> Option<String> {
    let is_battery = signal.words.says_pack() || signal.is_pack_message;
    let is_wanted = matches!(signal.dimension, Dimension::Voltage | Dimension::Current);
    let readings = signal.series.bad;
    (is_battery && is_wanted && readings >= MIN_VALUES).then(|| {
        format!(
            "{}: all {readings} readings are outside its range or not available: is its definition right?",
            signal.name
        )
    })
}

fn is_answer(table: &DiagnosticTable, key: &AnswerKey) -> bool {
    let extension = table.extension.map(|(_, response)| response);
    (table.response, extension, table.service, table.identifier)
        == (key.response, key.extension, key.service, key.identifier)
}

fn of_message(key: MessageKey, payloads: &Payloads, file: usize, message: &Message) -> Vec<LogSignal> {
    let is_pack_message = Words::new(&message.name).says_pack();
    let of_signal = |signal: &Signal| {
        let plan = signal.layout.plan().ok().filter(|_| signal.layout.length_bits > 2)?;
        let selectors = signal.conditions.iter().map(|condition| {
            Some((message.signals.get(condition.selector)?.layout.plan().ok()?, condition.ranges.as_slice()))
        });
        let selectors = selectors.collect::<Option<Vec<_>>>()?;
        let absent = signal.not_available_codes();
        let present: Vec<_> = payloads.iter().filter(|(_, payload)| holds(&selectors, payload)).collect();
        let (dimension, scale) = dimension(&signal.unit);
        let count = present.len();
        let readings = present.into_iter().map(|(time_s, payload)| {
            let is_absent = plan.raw(payload).is_ok_and(|code| absent.contains(&code));
            (time_s, plan.decode(payload).ok().filter(|_| !is_absent).map(|value| value * scale))
        });
        Some(LogSignal {
            name: format!("{}.{}", message.name, signal.name),
            bus: key.0,
            origin: SignalOrigin::Dbc(file),
            dimension,
            words: Words::new(&signal.name),
            is_pack_message,
            series: Series::collect(readings, count),
            is_read_signed: false,
            scale,
        })
    };
    message.signals.iter().filter_map(of_signal).collect()
}

/// Whether the multiplexors select the signal.
fn holds(selectors: &[(SignalPlan, &[(u64, u64)])], payload: &[u8]) -> bool {
    selectors.iter().all(|(plan, ranges)| {
        plan.raw(payload).is_ok_and(|code| ranges.iter().any(|(low, high)| (*low..=*high).contains(&code)))
    })
}

fn of_definition(
    key: &AnswerKey,
    answers: &Answers,
    index: usize,
    table: &DiagnosticTable,
    signal: &DiagnosticSignal,
) -> Vec<LogSignal> {
    let (dimension, scale) = dimension(&signal.unit);
    let each = (0..signal.count()).map(|n| {
        let single = signal.of_series(n);
        let (series, is_read_signed) = values(answers, &single, scale, dimension);
        LogSignal {
            name: format!("{}.{}", table.name, single.name),
            bus: key.bus,
            origin: SignalOrigin::Defined(index),
            dimension,
            words: Words::new(&single.name),
            is_pack_message: Words::new(&table.name).says_pack(),
            series,
            is_read_signed,
            scale,
        }
    });
    each.collect()
}

/// Values of a defined signal. A current that its definition calls unsigned is read as a signed number where that brings
/// values at both ends of its codes together: a few negative amperes look like thousands.
fn values(answers: &Answers, signal: &DiagnosticSignal, scale: f64, dimension: Dimension) -> (Series, bool) {
    let collect = |signal: &DiagnosticSignal| {
        let readings = answers.payloads.iter().map(|(time_s, data)| (time_s, signal.value(data).map(|v| v * scale)));
        Series::collect(readings, answers.payloads.len())
    };
    let series = collect(signal);
    if signal.signed || dimension != Dimension::Current || series.is_constant() {
        return (series, false);
    }
    let signed = collect(&signal.as_signed());
    let is_nearer = signed.bad <= series.bad && signed.high() - signed.low() < (series.high() - series.low()) / 4.0;
    if is_nearer { (signed, true) } else { (series, false) }
}

fn has_values(signal: &LogSignal) -> bool {
    signal.series.values.len() >= MIN_VALUES
}
