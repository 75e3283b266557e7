//! Writes messages and signals as DBC text.
//!
//! In: a [`Database`]. Out: text that DBC tools load and that [`Database::parse`] parses to an equal database. Numbers
//! are written with all significant digits and without an exponent. An attribute is defined only if a message has it.

use std::fmt::Write as _;

use super::attributes::{
    BIT_RATE_SWITCH, CYCLE_TIME, DELAY_TIME, E2E_DATA_ID, E2E_PROFILE, E2E_PROFILES, FAST_CYCLE_TIME, FIRST_FD_FORMAT,
    FRAME_FORMAT, FRAME_FORMATS, J1939_FORMAT, NO_YES, REPETITIONS, SECOC_DATA_ID, SECOC_PROFILE, SECOC_PROFILES,
    profile_index, secoc_index,
};
use super::{Database, FrameFormat, Message, MuxCondition, Signal};
use crate::can::CanId;
use crate::can::signal::{ByteOrder, ValueType};

const NO_NODE: &str = "Vector__XXX";

impl Database {
    /// The text of the DBC. A signal's conditions must refer to multiplexors of the same message.
    pub fn to_dbc(&self) -> String {
        let mut text = String::from("VERSION \"\"\n\nNS_ :\n\nBS_:\n\nBU_:");
        for node in &self.nodes {
            // Writing to a `String` cannot fail.
            let _ = write!(text, " {node}");
        }
        text.push_str("\n\n");
        for message in &self.messages {
            write_message(message, &mut text);
            text.push('\n');
        }
        self.comments(&mut text);
        self.attributes(&mut text);
        self.value_tables(&mut text);
        self.floats(&mut text);
        for message in self.messages.iter().filter(|message| needs_ranges(message)) {
            write_ranges(message, &mut text);
        }
        text
    }

    /// The DBC as Latin-1, as DBC tools expect. UTF-8 is used if Latin-1 cannot represent the text or if its bytes
    /// would be parsed as UTF-8.
    pub fn to_dbc_bytes(&self) -> Vec<u8> {
        let text = self.to_dbc();
        let latin: Option<Vec<u8>> = text.chars().map(|c| u8::try_from(c).ok()).collect();
        latin
            .filter(|bytes| text.is_ascii() || std::str::from_utf8(bytes).is_err())
            .unwrap_or_else(|| text.into_bytes())
    }

    fn signals(&self) -> impl Iterator<Item = (&Message, &Signal)> {
        self.messages.iter().flat_map(|message| message.signals.iter().map(move |signal| (message, signal)))
    }

    fn comments(&self, text: &mut String) {
        if let Some(comment) = &self.comment {
            let _ = writeln!(text, "CM_ \"{}\";", quoted(comment));
        }
        for message in &self.messages {
            let id = message.id.dbc_number();
            for signal in &message.signals {
                if let Some(comment) = &signal.comment {
                    let _ = writeln!(text, "CM_ SG_ {id} {} \"{}\";", signal.name, quoted(comment));
                }
            }
            if let Some(comment) = &message.comment {
                let _ = writeln!(text, "CM_ BO_ {id} \"{}\";", quoted(comment));
            }
        }
    }

    fn attributes(&self, text: &mut String) {
        let is_fd = |message: &Message| message.format != FrameFormat::Classic;
        let format = |m: &Message| {
            let is_extended = usize::from(matches!(m.id, CanId::Extended(_)));
            let place = match m.format {
                FrameFormat::Classic if m.is_j1939 => J1939_FORMAT,
                FrameFormat::Classic => is_extended,
                FrameFormat::Fd { .. } => is_extended + FIRST_FD_FORMAT,
            };
            (place > 0).then(|| place.to_string())
        };
        let rate = |m: &Message| match m.format {
            FrameFormat::Fd { brs } => Some(u8::from(brs).to_string()),
            FrameFormat::Classic => None,
        };
        // The cycle times allow up to one hour, in ms.
        let cycle_time = "INT 0 3600000";
        let repetitions = "INT 0 999999";
        let word = |number: Option<u32>| number.map(|number| number.to_string());
        self.attribute(CYCLE_TIME, cycle_time, "0", |m| word(m.cycle_time_ms), text);
        self.attribute(REPETITIONS, repetitions, "0", |m| word(m.repetition.count), text);
        self.attribute(FAST_CYCLE_TIME, cycle_time, "0", |m| word(m.repetition.period_ms), text);
        self.attribute(DELAY_TIME, cycle_time, "0", |m| word(m.repetition.delay_ms), text);
        self.choice(FRAME_FORMAT, &FRAME_FORMATS, format, text);
        self.choice(BIT_RATE_SWITCH, &NO_YES, rate, text);
        self.choice(E2E_PROFILE, &E2E_PROFILES, |m| Some(profile_index(m.e2e?.profile).to_string()), text);
        self.attribute(E2E_DATA_ID, "INT 0 65535", "0", |m| Some(m.e2e?.data_id.to_string()), text);
        self.choice(SECOC_PROFILE, &SECOC_PROFILES, |m| Some(secoc_index(m.secoc?.profile).to_string()), text);
        self.attribute(SECOC_DATA_ID, "INT 0 65535", "0", |m| Some(m.secoc?.data_id.to_string()), text);
        if self.messages.iter().any(is_fd) {
            text.push_str(
                "BA_DEF_ \"BusType\" STRING ;\nBA_DEF_DEF_ \"BusType\" \"CAN\";\nBA_ \"BusType\" \"CAN FD\";\n",
            );
        }
    }

    /// Defines an attribute and writes its values. Writes nothing if no message has a value.
    fn attribute(
        &self,
        name: &str,
        kind: &str,
        default: &str,
        value: impl Fn(&Message) -> Option<String>,
        text: &mut String,
    ) {
        let values = self.messages.iter().filter_map(|message| Some((message.id.dbc_number(), value(message)?)));
        for (index, (id, value)) in values.enumerate() {
            if index == 0 {
                let _ = writeln!(text, "BA_DEF_ BO_ \"{name}\" {kind};\nBA_DEF_DEF_ \"{name}\" {default};");
            }
            let _ = writeln!(text, "BA_ \"{name}\" BO_ {id} {value};");
        }
    }

    /// Writes an enumeration attribute. The first value is the default.
    fn choice(&self, name: &str, words: &[&str], value: impl Fn(&Message) -> Option<String>, text: &mut String) {
        let quoted: Vec<String> = words.iter().map(|word| format!("\"{word}\"")).collect();
        self.attribute(name, &format!("ENUM {}", quoted.join(",")), &quoted[0], value, text);
    }

    fn value_tables(&self, text: &mut String) {
        for (message, signal) in self.signals().filter(|(_, signal)| !signal.values.is_empty()) {
            let _ = write!(text, "VAL_ {} {}", message.id.dbc_number(), signal.name);
            for (code, name) in &signal.values {
                let _ = write!(text, " {code} \"{}\"", quoted(name));
            }
            text.push_str(" ;\n");
        }
    }

    fn floats(&self, text: &mut String) {
        for (message, signal) in self.signals() {
            let kind = match signal.layout.value_type {
                ValueType::Unsigned | ValueType::Signed => continue,
                ValueType::Float32 => 1,
                ValueType::Float64 => 2,
            };
            let _ = writeln!(text, "SIG_VALTYPE_ {} {} : {kind};", message.id.dbc_number(), signal.name);
        }
    }
}

/// Escapes quotation marks unless they are already escaped. Appends a blank to a text that ends with a backslash,
/// because the backslash would escape the closing quotation mark.
fn quoted(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        if c == '"' && !safe.ends_with('\\') {
            safe.push('\\');
        }
        safe.push(c);
    }
    if safe.ends_with('\\') {
        safe.push(' ');
    }
    safe
}

fn write_message(message: &Message, text: &mut String) {
    let sender = message.sender.as_deref().unwrap_or(NO_NODE);
    let _ = writeln!(text, "BO_ {} {}: {} {sender}", message.id.dbc_number(), message.name, message.len_bytes);
    for signal in &message.signals {
        let layout = &signal.layout;
        let order = match layout.byte_order {
            ByteOrder::LittleEndian => '1',
            ByteOrder::BigEndian => '0',
        };
        let sign = match layout.value_type {
            ValueType::Unsigned => '+',
            ValueType::Signed | ValueType::Float32 | ValueType::Float64 => '-',
        };
        let receivers = if signal.receivers.is_empty() { NO_NODE.to_owned() } else { signal.receivers.join(",") };
        let _ = writeln!(
            text,
            " SG_ {}{} : {}|{}@{order}{sign} ({},{}) [{}|{}] \"{}\" {receivers}",
            signal.name,
            indicator(signal),
            layout.start_bit,
            layout.length_bits,
            layout.factor,
            layout.offset,
            layout.minimum,
            layout.maximum,
            quoted(&signal.unit),
        );
    }
}

/// The multiplexer indicator: ` M`, ` m3`, ` m3M` or nothing.
fn indicator(signal: &Signal) -> String {
    let code = signal.conditions.last().and_then(|condition| condition.ranges.first()).map(|range| range.0);
    match (code, signal.is_multiplexor) {
        (None, false) => String::new(),
        (None, true) => " M".to_owned(),
        (Some(code), false) => format!(" m{code}"),
        (Some(code), true) => format!(" m{code}M"),
    }
}

/// Whether the message needs `SG_MUL_VAL_` lines. The indicators cannot express ranges of codes, nested multiplexors,
/// or several top-level multiplexors.
fn needs_ranges(message: &Message) -> bool {
    let mut conditions = message.signals.iter().map(|signal| signal.conditions.as_slice());
    let plain = message.signals.iter().filter(|signal| signal.is_multiplexor && signal.conditions.is_empty());
    let is_simple = |chain: &[MuxCondition]| match chain {
        [] => true,
        [condition] => matches!(condition.ranges.as_slice(), [(low, high)] if low == high),
        _ => false,
    };
    plain.count() > 1 && conditions.clone().any(|chain| !chain.is_empty()) || !conditions.all(is_simple)
}

fn write_ranges(message: &Message, text: &mut String) {
    for signal in &message.signals {
        let Some(condition) = signal.conditions.last() else { continue };
        let Some(selector) = message.signals.get(condition.selector) else { continue };
        let ranges: Vec<String> = condition.ranges.iter().map(|(low, high)| format!("{low}-{high}")).collect();
        let (id, ranges) = (message.id.dbc_number(), ranges.join(", "));
        let _ = writeln!(text, "SG_MUL_VAL_ {id} {} {} {ranges};", signal.name, selector.name);
    }
}

#[cfg(test)]
mod tests;
