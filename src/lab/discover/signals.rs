//! Collects the signals of a log with their values. Some signals are described by DBC files or by definitions of
//! diagnostic answers. Further signals are searched for in the undescribed bytes of diagnostic answers and, if there
//! are no DBC files, in all messages.

use super::PositiveDirection;
use super::capture::{AnswerKey, Answers, Capture, MessageKey, Payloads};
use super::label::PackLabel;
use super::log_signal::{LogSignal, SignalOrigin};
use super::{fields, raw};
use crate::can::dbc::{Database, Message, Signal};
use crate::can::decode::Binding;
use crate::can::unit::{Quantity, SignalUnit};
use crate::import::{DiagnosticSignal, DiagnosticTable};
use crate::quantity::{Channel, Fault};
use crate::wiring::evidence::{STEADY_A, Series, SignalLabel, recorded_value};

/// Smallest number of valid values of a signal.
const MIN_VALUES: u64 = 2;

#[derive(Debug, Default)]
pub(super) struct Descriptions {
    pub(super) databases: Vec<Database>,
    pub(super) tables: Vec<DiagnosticTable>,
    pub(super) label: PackLabel,
}

/// Returns all signals that have values, in a fixed order, and remarks on described battery signals without values.
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
        signals.extend(raw::signals(key, answers, &described, &mut rows, &descriptions.label));
    }
    if descriptions.databases.is_empty() {
        signals.extend(fields::signals(capture, &descriptions.label));
    }
    let (usable, empty): (Vec<LogSignal>, Vec<LogSignal>) = signals.into_iter().partition(has_values);
    let remarks = empty.iter().filter_map(remark).take(20).collect();
    (usable, remarks)
}

/// Returns a remark on a battery voltage or current that never has a valid value although it is in the log.
fn remark(signal: &LogSignal) -> Option<String> {
    let LogSignal { label, series, .. } = signal;
    let is_wanted = label.has_unit_of(Quantity::Voltage) || label.has_unit_of(Quantity::Current);
    let readings = series.bad();
    (label.is_of_pack() && is_wanted && readings >= MIN_VALUES).then(|| {
        format!("{}: all {readings} readings are out of range or not available: is its definition right?", signal.name)
    })
}

fn is_answer(table: &DiagnosticTable, key: &AnswerKey) -> bool {
    let extension = table.extension.map(|(_, response)| response);
    (table.response, extension, table.service, table.identifier)
        == (key.response, key.extension, key.service, key.identifier)
}

fn conversion(unit: &str) -> (f64, f64) {
    SignalUnit::parse(unit).map_or((1.0, 0.0), |unit| (unit.factor, unit.offset))
}

fn of_message(key: MessageKey, payloads: &Payloads, file: usize, message: &Message) -> Vec<LogSignal> {
    let of_signal = |signal: &Signal| {
        // A binding needs a channel, which has no effect here.
        let mut binding = Binding::new(key.0, message, signal, Channel::Current).ok()?;
        (binding.scale, binding.offset) = conversion(&signal.unit);
        let label = SignalLabel::new(&message.name, &signal.name, &signal.unit);
        // A percentage never reaches 1000, so a signal with this maximum counts tenths of a percent.
        if (label.says_soc() || label.says_soh()) && signal.layout.maximum == 1000.0 {
            binding.scale = 0.1;
        }
        let values = |binding: &Binding| {
            let present = payloads.iter().filter(|(_, payload)| binding.holds(payload) == Ok(true));
            Series::of(present.map(|(time_s, payload)| (time_s, recorded_value(payload, binding))))
        };
        let mut series = values(&binding);
        if label.has_unit_of(Quantity::Current)
            && let Some(offset) = missing_offset(&series, signal)
        {
            binding.offset += offset;
            series = values(&binding);
        }
        Some(LogSignal {
            name: format!("{}.{}", message.name, signal.name),
            bus: key.0,
            origin: SignalOrigin::Dbc(file),
            label,
            series,
            is_read_signed: false,
            conversion: (binding.scale, binding.offset),
            stated: signal.comment.as_deref().and_then(stated_direction),
        })
    };
    message.signals.iter().filter(|signal| signal.layout.length_bits > 2).filter_map(of_signal).collect()
}

/// Returns the offset (A) that is missing in the description of a current. A pack's current comes near zero at some
/// time, so an offset is missing if the values never come near zero.
fn missing_offset(series: &Series, signal: &Signal) -> Option<f64> {
    let factor = signal.layout.factor;
    if series.extent.min.abs().min(series.extent.max.abs()) < STEADY_A || factor <= 0.0 || signal.layout.offset != 0.0 {
        return None;
    }
    series.zero_code(factor).filter(|zero| *zero != 0.0).map(|zero| -zero * factor)
}

/// Returns the direction of a positive current that a DBC's comment states, such as "positive = charge".
fn stated_direction(comment: &str) -> Option<PositiveDirection> {
    let lower = comment.to_lowercase();
    lower.split([',', ';', '.', '\n', '/']).find_map(|clause| {
        let has = |words: &[&str]| words.iter().any(|word| clause.contains(word));
        let is_discharge = has(&["discharg", "entlad"]);
        let is_charge = has(&["charg", "laden", "ladung"]) && !is_discharge;
        let is_positive = match (has(&["positiv", "+", "> 0", ">0"]), has(&["negativ", "< 0", "<0"])) {
            (true, false) => true,
            (false, true) => false,
            _ => return None,
        };
        (is_charge || is_discharge).then_some(match is_charge == is_positive {
            true => PositiveDirection::Charge,
            false => PositiveDirection::Discharge,
        })
    })
}

fn of_definition(
    key: &AnswerKey,
    answers: &Answers,
    index: usize,
    table: &DiagnosticTable,
    signal: &DiagnosticSignal,
) -> Vec<LogSignal> {
    let conversion = conversion(&signal.unit);
    let each = (0..signal.count()).map(|n| {
        let single = signal.of_series(n);
        let label = SignalLabel::new(&table.name, &single.name, &signal.unit);
        let (series, is_read_signed) = values(answers, &single, conversion, label.has_unit_of(Quantity::Current));
        let name = format!("{}.{}", table.name, single.name);
        LogSignal {
            name,
            bus: key.bus,
            origin: SignalOrigin::Defined(index),
            label,
            series,
            is_read_signed,
            conversion,
            stated: None,
        }
    });
    each.collect()
}

/// Returns the values of a defined signal, and whether it is read as signed. If a signed current is read as unsigned, a
/// few negative amperes look like thousands. An unsigned current is therefore read as signed if this reduces its range
/// to less than a quarter.
fn values(answers: &Answers, signal: &DiagnosticSignal, conversion: (f64, f64), is_current: bool) -> (Series, bool) {
    let collect = |signal: &DiagnosticSignal| {
        let value = |data: &[u8]| {
            let value = signal.value(data).ok_or(Fault::OutOfRange)?;
            Ok(value * conversion.0 + conversion.1)
        };
        Series::of(answers.payloads.iter().map(|(time_s, data)| (time_s, value(data))))
    };
    let series = collect(signal);
    if signal.signed || !is_current || series.is_constant() {
        return (series, false);
    }
    let signed = collect(&signal.as_signed());
    let is_nearer = signed.bad() <= series.bad() && signed.extent.range() < series.extent.range() / 4.0;
    if is_nearer { (signed, true) } else { (series, false) }
}

fn has_values(signal: &LogSignal) -> bool {
    signal.series.count() >= MIN_VALUES
}
