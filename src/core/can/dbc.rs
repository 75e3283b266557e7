//! Parses the text of a DBC file into messages and signals.
//!
//! In: text in the grammar of the `can-dbc` crate. Out: a [`Database`]. [`Database::to_dbc`] writes a database as text
//! that parses to an equal database.
//!
//! The parser leaves out a message if its text does not follow the grammar, a number is out of range or not finite, a
//! name is defined twice, or the multiplexing cannot be resolved. [`Database::left_out`] lists these faults with their
//! lines. If a text has no usable message and does not follow the grammar, parsing fails. A signal may extend beyond
//! its message. A frame of the message's length then gives [`Fault::ShortFrame`](crate::quantity::Fault::ShortFrame). A
//! signal layout may be invalid: [`SignalLayout::plan`] rejects it.

use std::collections::{HashMap, HashSet};

use crate::can::CanId;
use crate::can::e2e::Protection;
use crate::can::secoc::Authentication;
use crate::can::signal::{ByteOrder, SignalLayout, ValueType};

mod attributes;
mod statements;
mod write;

/// Pseudo message in which editors keep signals without a message.
const PSEUDO_MESSAGE: &str = "VECTOR__INDEPENDENT_SIG_MSG";

/// Maximum number of faults that are listed individually. A text with more faults is probably not a DBC.
const MAX_LISTED: usize = 20;

/// Maximum nesting depth of multiplexors. Deeper nesting is rejected as a loop.
const MAX_MULTIPLEX_DEPTH: usize = 8;

/// Reason why a text is not a usable DBC, or why a part of it is left out.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {what}")]
pub struct DbcError {
    /// Counted from 1.
    pub line: usize,
    pub what: String,
}

/// Messages of one DBC, in the file's order.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Database {
    /// From `BU_`.
    pub nodes: Vec<String>,
    /// From `CM_` without an object.
    pub comment: Option<String>,
    pub messages: Vec<Message>,
    /// Unusable messages and statements, sorted by line. If there are more than 20, entry 21 gives the number of the
    /// rest.
    pub left_out: Vec<DbcError>,
}

/// Kind of frame that carries a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FrameFormat {
    /// Classic frame, at most 8 bytes.
    #[default]
    Classic,
    /// CAN FD frame, at most 64 bytes.
    Fd { brs: bool },
}

/// How a message is repeated after an event. `None` = 0, or not stated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Repetition {
    /// Number of frames after the event's first frame (`GenMsgNrOfRepetition`).
    pub count: Option<u32>,
    /// Time between the repeated frames, ms (`GenMsgCycleTimeFast`).
    pub period_ms: Option<u32>,
    /// Minimum average time between two frames of the message, ms (`GenMsgDelayTime`).
    pub delay_ms: Option<u32>,
}

/// One message of a DBC.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// Extended if bit 31 of the number in the DBC is set.
    pub id: CanId,
    /// Unique in the database.
    pub name: String,
    /// Payload length, bytes.
    pub len_bytes: u16,
    pub sender: Option<String>,
    /// From `VFrameFormat` and `CANFD_BRS`.
    pub format: FrameFormat,
    /// Whether the identifier stands for a J1939 parameter group, which any source address may send (`VFrameFormat`).
    pub is_j1939: bool,
    /// From `E2EProfile` and `E2EDataId`, packwatch's own attributes.
    pub e2e: Option<Protection>,
    /// From `SecOCProfile` and `SecOCDataId`, packwatch's own attributes.
    pub secoc: Option<Authentication>,
    pub signals: Vec<Signal>,
    /// Cycle time, ms, above 0 (`GenMsgCycleTime` or its default).
    pub cycle_time_ms: Option<u32>,
    pub repetition: Repetition,
    /// From `CM_ BO_`.
    pub comment: Option<String>,
}

/// One signal of a message.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Unique in the message.
    pub name: String,
    pub layout: SignalLayout,
    /// May be empty.
    pub unit: String,
    pub receivers: Vec<String>,
    /// Conditions for the signal to be present, outermost multiplexor first. All of them must hold.
    pub conditions: Vec<MuxCondition>,
    /// Whether the presence of other signals depends on this signal.
    pub is_multiplexor: bool,
    /// Raw values and their names (`VAL_`).
    pub values: Vec<(i64, String)>,
    /// From `CM_ SG_`.
    pub comment: Option<String>,
}

/// Condition on one multiplexor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MuxCondition {
    /// Index in the message's `signals`.
    pub selector: usize,
    /// Ranges of raw codes, ends included. The selector's code must be in one of them.
    pub ranges: Vec<(u64, u64)>,
}

impl Database {
    /// Parses the text of a DBC. Returns the first fault if the text has no usable message and does not follow the
    /// grammar.
    pub fn parse(text: &str) -> Result<Self, DbcError> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        // The grammar requires a line end after every statement.
        let closed = if text.ends_with('\n') { text.to_owned() } else { format!("{text}\n") };
        let mut left_out = Vec::new();
        let (dbc, is_dbc) = statements::parse(&closed, &mut left_out)?;
        let messages = read_messages(&dbc, &closed, &mut left_out);
        left_out.sort_by_key(|fault| fault.line);
        if let (Some(fault), true) = (left_out.first(), messages.is_empty() && !is_dbc) {
            return Err(fault.clone());
        }
        if let Some(next) = left_out.get(MAX_LISTED) {
            let what = format!("{} more messages or statements from here on are left out", left_out.len() - MAX_LISTED);
            let rest = DbcError { line: next.line, what };
            left_out.truncate(MAX_LISTED);
            left_out.push(rest);
        }
        let nodes = dbc.nodes.iter().map(|node| node.0.clone()).collect();
        Ok(Self { nodes, comment: plain_comment(&dbc), messages, left_out })
    }

    /// Parses a DBC file. Bytes that are not valid UTF-8 are parsed as Latin-1, because a DBC does not state its
    /// encoding. UTF-16 is an error.
    pub fn parse_bytes(bytes: &[u8]) -> Result<Self, DbcError> {
        if is_utf_16(bytes) {
            let what = "the file is UTF-16 text, must be UTF-8 or Latin-1: save it in one of these encodings";
            return Err(DbcError { line: 1, what: what.to_owned() });
        }
        // Remove the UTF-8 byte-order mark, because some editors also put it before Latin-1 text.
        let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
        match std::str::from_utf8(bytes) {
            Ok(text) => Self::parse(text),
            Err(_) => Self::parse(&bytes.iter().copied().map(char::from).collect::<String>()),
        }
    }

    /// Finds a message by name.
    pub fn message(&self, name: &str) -> Option<&Message> {
        self.messages.iter().find(|message| message.name == name)
    }

    /// Finds a signal and its message by full name (`Message.Signal`).
    pub fn signal(&self, full_name: &str) -> Option<(&Message, &Signal)> {
        let (message, signal) = full_name.split_once('.')?;
        let message = self.message(message)?;
        Some((message, message.signal(signal)?))
    }
}

/// Whether the bytes start like UTF-16: with a byte-order mark or a Latin letter.
fn is_utf_16(bytes: &[u8]) -> bool {
    matches!(bytes, [0xFF, 0xFE, ..] | [0xFE, 0xFF, ..] | [0, _, ..] | [_, 0, ..])
}

impl Message {
    /// Finds a signal by name.
    pub fn signal(&self, name: &str) -> Option<&Signal> {
        self.signals.iter().find(|signal| signal.name == name)
    }
}

impl Signal {
    /// Raw codes whose name in the value table is "not available", "signal not available", "n/a" or "SNA". Ignores
    /// case; `_` counts as a blank.
    pub fn not_available_codes(&self) -> Vec<u64> {
        let mask = u64::MAX >> (64 - u32::from(self.layout.length_bits.clamp(1, 64)));
        let says_so = |name: &str| {
            let name = name.trim().to_ascii_lowercase().replace('_', " ");
            matches!(name.as_str(), "not available" | "signal not available" | "n/a" | "sna")
        };
        self.values.iter().filter(|(_, name)| says_so(name)).map(|(code, _)| code.cast_unsigned() & mask).collect()
    }
}

struct MessageFault {
    id: u32,
    message: String,
    signal: Option<String>,
    what: String,
}

impl MessageFault {
    /// Adds the line of the last definition of the message or signal.
    fn at(self, text: &str) -> DbcError {
        let (mut line, mut inside) = (1, false);
        for (number, content) in (1..).zip(text.lines()) {
            let mut words = content.split([' ', '\t', ':']).filter(|word| !word.is_empty());
            match (words.next(), words.next(), words.next()) {
                (Some("BO_"), Some(id), Some(name)) => {
                    inside = name == self.message && id.parse() == Ok(self.id);
                    if inside {
                        line = number;
                    }
                }
                (Some("SG_"), Some(name), _) if inside && Some(name) == self.signal.as_deref() => line = number,
                _ => {}
            }
        }
        DbcError { line, what: format!("message {} is left out: {}", self.message, self.what) }
    }
}

/// Properties of a signal that are stated outside its `SG_` definition.
#[derive(Default)]
struct Details<'a> {
    comment: Option<&'a str>,
    values: &'a [can_dbc::ValDescription],
    float: Option<can_dbc::SignalExtendedValueType>,
    multiplex: Vec<&'a can_dbc::ExtendedMultiplex>,
}

struct DetailTable<'a>(HashMap<(can_dbc::MessageId, &'a str), Details<'a>>);

impl<'a> DetailTable<'a> {
    fn new(dbc: &'a can_dbc::Dbc) -> Self {
        let mut table = Self(HashMap::new());
        for comment in &dbc.comments {
            if let can_dbc::Comment::Signal { message_id, name, comment } = comment {
                table.entry(*message_id, name).comment = Some(comment);
            }
        }
        for values in &dbc.value_descriptions {
            if let can_dbc::ValueDescription::Signal { message_id, name, value_descriptions } = values {
                table.entry(*message_id, name).values = value_descriptions;
            }
        }
        for kind in &dbc.signal_extended_value_type_list {
            table.entry(kind.message_id, &kind.signal_name).float = Some(kind.signal_extended_value_type);
        }
        for entry in &dbc.extended_multiplex {
            table.entry(entry.message_id, &entry.signal_name).multiplex.push(entry);
        }
        table
    }

    fn entry(&mut self, message: can_dbc::MessageId, signal: &'a str) -> &mut Details<'a> {
        self.0.entry((message, signal)).or_default()
    }

    fn get(&self, message: &can_dbc::Message, signal: &'a can_dbc::Signal) -> &Details<'a> {
        const NONE: &Details<'_> = &Details { comment: None, values: &[], float: None, multiplex: Vec::new() };
        self.0.get(&(message.id, signal.name.as_str())).unwrap_or(NONE)
    }
}

/// The usable messages, in the file's order. Of several messages with the same name, only the first is returned.
fn read_messages(dbc: &can_dbc::Dbc, text: &str, left_out: &mut Vec<DbcError>) -> Vec<Message> {
    let details = DetailTable::new(dbc);
    let mut names = HashSet::new();
    let mut messages = Vec::new();
    for message in dbc.messages.iter().filter(|message| message.name != PSEUDO_MESSAGE) {
        match read_message(dbc, &details, message) {
            Ok(_) if !names.insert(&message.name) => {
                let what = "the name is defined twice, names must be unique".to_owned();
                left_out.push(
                    MessageFault { id: message.id.raw(), message: message.name.clone(), signal: None, what }.at(text),
                );
            }
            Ok(message) => messages.push(message),
            Err(fault) => left_out.push(fault.at(text)),
        }
    }
    messages
}

fn read_message<'a>(
    dbc: &'a can_dbc::Dbc,
    details: &DetailTable<'a>,
    message: &'a can_dbc::Message,
) -> Result<Message, MessageFault> {
    let fault = |signal: Option<&str>, what: String| MessageFault {
        id: message.id.raw(),
        message: message.name.clone(),
        signal: signal.map(str::to_owned),
        what,
    };
    let mut names = HashSet::new();
    if let Some(twice) = message.signals.iter().find(|signal| !names.insert(&signal.name)) {
        return Err(fault(Some(&twice.name), format!("signal {} is defined twice", twice.name)));
    }
    let id = match message.id {
        can_dbc::MessageId::Standard(id) => CanId::standard(u32::from(id)),
        can_dbc::MessageId::Extended(id) => CanId::extended(id),
    };
    let id = id.ok_or_else(|| fault(None, "the identifier is out of range".to_owned()))?;
    // J1939 DBCs describe transport messages of up to 1,785 bytes, so lengths above 64 bytes are valid.
    let len_bytes =
        u16::try_from(message.size).map_err(|_| fault(None, format!("length {}, must be 0 to 65535", message.size)))?;
    let signals: Result<Vec<_>, _> =
        message.signals.iter().map(|signal| read_signal(details, message, signal)).collect();
    Ok(Message {
        id,
        name: message.name.clone(),
        len_bytes,
        sender: message.transmitter.clone(),
        format: attributes::format(dbc, message.id),
        is_j1939: attributes::is_j1939(dbc, message.id),
        e2e: attributes::e2e(dbc, message.id),
        secoc: attributes::secoc(dbc, message.id),
        signals: signals?,
        cycle_time_ms: attributes::positive(dbc, message.id, attributes::CYCLE_TIME),
        repetition: attributes::repetition(dbc, message.id),
        comment: dbc.message_comment(message.id).map(str::to_owned),
    })
}

fn plain_comment(dbc: &can_dbc::Dbc) -> Option<String> {
    dbc.comments.iter().find_map(|comment| match comment {
        can_dbc::Comment::Plain { comment } => Some(comment.clone()),
        _ => None,
    })
}

fn read_signal<'a>(
    details: &DetailTable<'a>,
    message: &'a can_dbc::Message,
    signal: &'a can_dbc::Signal,
) -> Result<Signal, MessageFault> {
    let fault = |what: String| MessageFault {
        id: message.id.raw(),
        message: message.name.clone(),
        signal: Some(signal.name.clone()),
        what: format!("signal {}: {what}", signal.name),
    };
    let finite = |name: &str, value: f64| {
        if value.is_finite() { Ok(value) } else { Err(fault(format!("{name} {value}, must be finite"))) }
    };
    let bits = |name: &str, n: u64| u16::try_from(n).map_err(|_| fault(format!("{name} {n}, must be 0 to 65535")));
    let own = details.get(message, signal);
    let layout = SignalLayout {
        start_bit: bits("start bit", signal.start_bit)?,
        length_bits: bits("length", signal.size)?,
        byte_order: match signal.byte_order {
            can_dbc::ByteOrder::LittleEndian => ByteOrder::LittleEndian,
            can_dbc::ByteOrder::BigEndian => ByteOrder::BigEndian,
        },
        value_type: match (own.float, signal.value_type) {
            (Some(can_dbc::SignalExtendedValueType::IEEEfloat32Bit), _) => ValueType::Float32,
            (Some(can_dbc::SignalExtendedValueType::IEEEdouble64bit), _) => ValueType::Float64,
            (_, can_dbc::ValueType::Signed) => ValueType::Signed,
            (_, can_dbc::ValueType::Unsigned) => ValueType::Unsigned,
        },
        factor: finite("factor", signal.factor)?,
        offset: finite("offset", signal.offset)?,
        minimum: finite("minimum", number(&signal.min))?,
        maximum: finite("maximum", number(&signal.max))?,
    };
    let layout = SignalLayout { minimum: lowest(&layout), ..layout };
    Ok(Signal {
        name: signal.name.clone(),
        layout,
        unit: signal.unit.clone(),
        receivers: signal.receivers.clone(),
        conditions: conditions(details, message, signal, 0).map_err(fault)?,
        is_multiplexor: matches!(
            signal.multiplexer_indicator,
            can_dbc::MultiplexIndicator::Multiplexor | can_dbc::MultiplexIndicator::MultiplexorAndMultiplexedSignal(_)
        ),
        values: own.values.iter().map(|value| (value.id, value.description.clone())).collect(),
        comment: own.comment.map(str::to_owned),
    })
}

/// The minimum of a signal. Some files state only the magnitude of both ends, such as "[0|819.2]" for a signal with the
/// offset -819.2. This range means -819.2 to 819.2.
fn lowest(layout: &SignalLayout) -> f64 {
    let is_size = layout.minimum == 0.0 && layout.offset < 0.0 && layout.maximum > 0.0;
    let is_symmetrical = (layout.offset + layout.maximum).abs() <= 0.01 * layout.maximum;
    if is_size && is_symmetrical { layout.offset } else { layout.minimum }
}

fn number(value: &can_dbc::NumericValue) -> f64 {
    match *value {
        can_dbc::NumericValue::Uint(value) => crate::can::signal::float_of(value),
        can_dbc::NumericValue::Int(value) => crate::can::signal::float_of_signed(value),
        can_dbc::NumericValue::Double(value) => value,
    }
}

/// The conditions of a signal, from the outermost multiplexor inwards. An `SG_MUL_VAL_` line gives the parent and the
/// ranges, and overrides the number after `m`. Without this line, the parent is the message's only multiplexor (`M`).
fn conditions<'a>(
    details: &DetailTable<'a>,
    message: &'a can_dbc::Message,
    signal: &'a can_dbc::Signal,
    depth: usize,
) -> Result<Vec<MuxCondition>, String> {
    use can_dbc::MultiplexIndicator as Indicator;
    if depth > MAX_MULTIPLEX_DEPTH {
        return Err(format!("multiplexors nested more than {MAX_MULTIPLEX_DEPTH} levels deep, or in a loop"));
    }
    let (selector, ranges) = match (details.get(message, signal).multiplex.as_slice(), signal.multiplexer_indicator) {
        ([entry], _) => {
            let ranges = entry.mappings.iter().map(|range| (range.min_value, range.max_value)).collect();
            (position(message, &entry.multiplexor_signal_name)?, ranges)
        }
        ([_, ..], _) => return Err("more than one SG_MUL_VAL_ line, one is allowed".to_owned()),
        ([], Indicator::Plain | Indicator::Multiplexor) => return Ok(Vec::new()),
        ([], Indicator::MultiplexedSignal(code) | Indicator::MultiplexorAndMultiplexedSignal(code)) => {
            (only_multiplexor(message)?, vec![(code, code)])
        }
    };
    let parent = message.signals.get(selector).ok_or("multiplexor not found")?;
    let mut chain = conditions(details, message, parent, depth + 1)?;
    chain.push(MuxCondition { selector, ranges });
    Ok(chain)
}

fn position(message: &can_dbc::Message, name: &str) -> Result<usize, String> {
    let found = message.signals.iter().position(|signal| signal.name == name);
    found.ok_or_else(|| format!("SG_MUL_VAL_ names multiplexor {name}, which the message does not have"))
}

fn only_multiplexor(message: &can_dbc::Message) -> Result<usize, String> {
    let is_plain = |signal: &can_dbc::Signal| signal.multiplexer_indicator == can_dbc::MultiplexIndicator::Multiplexor;
    let mut candidates = message.signals.iter().enumerate().filter(|(_, signal)| is_plain(signal));
    match (candidates.next(), candidates.next()) {
        (Some((index, _)), None) => Ok(index),
        (None, _) => Err("multiplexed, but the message has no multiplexor (M)".to_owned()),
        (Some(_), Some(_)) => {
            Err("multiplexed, but the message has several multiplexors (M): SG_MUL_VAL_ must name one".to_owned())
        }
    }
}

#[cfg(test)]
mod tests;
