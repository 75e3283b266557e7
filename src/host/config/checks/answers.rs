//! Checks `[[input.diagnostic]]`: the diagnostic requests and answers, and the signals in the answers.
//!
//! Each of these tables becomes one [`AnswerDefinition`]. The signals of a definition look like signals of a DBC, so
//! that `[input.*]` can name them in the same way. The module `polling` selects the answers that the core decodes.

use crate::can::CanId;
use crate::can::dbc::{FrameFormat, Message, Signal};
use crate::can::isotp::MAX_MESSAGE;
use crate::can::signal::{ByteOrder, SignalLayout, ValueType};
use crate::can::uds::{Controller, Question, Service};
use crate::config::schema::RawTables;
use crate::config::schema::keys::{AnswerSignalKeys, DiagnosticInput, WireOrder};
use crate::quantity::BusIndex;
use crate::wiring::AnswerSource;

/// One configured answer.
#[derive(Debug)]
pub(crate) struct AnswerDefinition {
    /// Path of the table that defines the answer, such as `input.diagnostic[2]`.
    pub table: String,
    /// CAN identifier of the requests and, with extended addressing, their first byte.
    request: (CanId, Option<u8>),
    /// CAN identifier of the answers and, with extended addressing, their first byte.
    response: (CanId, Option<u8>),
    service: Service,
    identifier: u16,
    /// Time between requests in each [`CarState`](crate::can::poll::CarState) (s).
    pub every_s: [Option<f64>; 3],
    /// The signals of the answer. Bit positions in the layout of a signal count from the first byte of that signal.
    pub message: Message,
    /// The first byte of each signal, counted after the echoed service and identifier.
    first_bytes: Vec<usize>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct AnswerPlace<'d> {
    pub definition: &'d AnswerDefinition,
    /// First byte of the signal, counted after the echoed service and identifier.
    pub first_byte: usize,
}

impl AnswerDefinition {
    /// Returns the diagnostic request on interface `bus` that asks for this answer.
    pub(crate) fn question(&self, bus: BusIndex) -> Question {
        let (request, request_extension) = self.request;
        let (response, response_extension) = self.response;
        let controller = Controller { bus, request, request_extension, response, response_extension };
        Question { controller, service: self.service, identifier: self.identifier }
    }

    /// The signals and their positions.
    pub(crate) fn signals(&self) -> impl Iterator<Item = (&Signal, AnswerPlace<'_>)> {
        let places = self.first_bytes.iter().map(|&first_byte| AnswerPlace { definition: self, first_byte });
        self.message.signals.iter().zip(places)
    }
}

impl AnswerPlace<'_> {
    /// The answer in words: `answer of 7EC to 22 01 01`.
    pub(crate) fn words(&self) -> String {
        let request = self.definition.question(BusIndex(0)).request();
        let bytes: Vec<String> = request.iter().map(|byte| format!("{byte:02X}")).collect();
        format!("answer of {} to {}", self.definition.response.0, bytes.join(" "))
    }

    /// The signal's source, for `packwatch doctor`.
    pub(crate) fn source(&self, bus: BusIndex) -> AnswerSource {
        AnswerSource { question: self.definition.question(bus), first_byte: self.first_byte }
    }

    /// Position of the signal's first bit in the answer, counted like the configuration key `bit`.
    pub(crate) fn bit(&self, layout: &SignalLayout) -> usize {
        let in_byte = match layout.byte_order {
            ByteOrder::BigEndian => 7 - layout.start_bit,
            ByteOrder::LittleEndian => 0,
        };
        8 * self.first_byte + usize::from(in_byte)
    }
}

/// The answers of all tables. Faulty answers are reported and left out.
pub(crate) fn definitions(raw: &RawTables) -> Vec<AnswerDefinition> {
    raw.diagnostics.iter().filter_map(definition).collect()
}

fn definition(keys: &DiagnosticInput) -> Option<AnswerDefinition> {
    let before = keys.place.faults.len();
    let Some(service) = Service::from_code(keys.service) else {
        keys.place.fault("service", "must be 0x01, 0x21 or 0x22: services that only read");
        return None;
    };
    if service.identifier_bytes() == 1 && keys.identifier > 0xFF {
        keys.place.fault("identifier", "must be 0 to 0xFF with this service");
    }
    let (request, response) = (can_id(keys.request), can_id(keys.response));
    if request == response {
        keys.place.fault("response", "must not be the identifier of the requests");
    }
    let head = 1 + service.identifier_bytes();
    let (mut signals, mut first_bytes) = (Vec::new(), Vec::new());
    for signal in &keys.signals.0 {
        for (name, bit) in numbered(signal) {
            let bit = usize::try_from(bit).unwrap_or(usize::MAX);
            if (bit + usize::from(signal.length)).div_ceil(8) + head > MAX_MESSAGE {
                signal.place.fault("bit", format!("must lie within an answer of {MAX_MESSAGE} bytes"));
                break;
            }
            if signals.iter().any(|other: &Signal| other.name == name) {
                signal.place.fault("name", format!("must be unique in its answer, but {name} already exists"));
            }
            signals.push(as_in_a_dbc(signal, name, bit));
            first_bytes.push(bit / 8);
        }
        check_numbers(signal);
    }
    let message = Message {
        id: response,
        name: keys.name.clone(),
        len_bytes: 8,
        sender: None,
        format: FrameFormat::Classic,
        is_j1939: false,
        e2e: None,
        secoc: None,
        signals,
        cycle_time_ms: None,
        repetition: Default::default(),
        comment: None,
    };
    (keys.place.faults.len() == before).then(|| AnswerDefinition {
        table: keys.place.path.clone(),
        request: (request, keys.request_extension),
        response: (response, keys.response_extension),
        service,
        identifier: keys.identifier,
        every_s: [keys.drive_every_s, keys.charge_every_s, keys.parked_every_s],
        message,
        first_bytes,
    })
}

/// An 11-bit identifier if the number fits, else a 29-bit identifier.
fn can_id(raw: u32) -> CanId {
    match u16::try_from(raw) {
        Ok(standard @ 0..=0x7FF) => CanId::Standard(standard),
        Ok(_) | Err(_) => CanId::Extended(raw),
    }
}

/// Returns the name and the first bit of each signal that a table declares.
fn numbered(keys: &AnswerSignalKeys) -> Vec<(String, u64)> {
    let first = u64::from(keys.bit);
    let has_number = keys.name.contains("{n}");
    let Some(numbers) = keys.numbers.as_ref() else {
        if has_number {
            keys.place.fault("name", "contains {n}, requires the key numbers");
        }
        return vec![(keys.name.clone(), first)];
    };
    if !has_number {
        keys.place.fault("name", "must contain {n} for the number");
        return Vec::new();
    }
    let step = u64::from(keys.step.unwrap_or(keys.length.into()));
    let name = |number: u16| keys.name.replace("{n}", &number.to_string());
    numbers.0.clone().zip(0_u64..).map(|(number, index)| (name(number), first + index * step)).collect()
}

fn check_numbers(keys: &AnswerSignalKeys) {
    let is_whole = keys.bit.is_multiple_of(8)
        && keys.length.is_multiple_of(8)
        && keys.step.is_none_or(|step| step.is_multiple_of(8));
    if keys.byte_order == WireOrder::Little && !is_whole {
        keys.place.fault("byte_order", "must be \"big\" for a signal that does not consist of whole bytes");
    }
    if keys.factor == 0.0 {
        keys.place.fault("factor", "must not be 0");
    }
    if let (Some(minimum), Some(maximum)) = (keys.minimum, keys.maximum)
        && minimum >= maximum
    {
        keys.place.fault("maximum", format!("must be above minimum = {minimum}"));
    }
    let largest = u64::MAX >> (64 - u32::from(keys.length.clamp(1, 64)));
    if keys.not_available.iter().any(|&code| code > largest) {
        keys.place.fault("not_available", format!("must be 0 to {largest:#X}, the signal's codes"));
    }
}

/// Returns the signal as a DBC would declare it. Bit positions in the layout count from the signal's first byte.
fn as_in_a_dbc(keys: &AnswerSignalKeys, name: String, bit: usize) -> Signal {
    let in_byte = u16::try_from(bit % 8).unwrap_or_default();
    let (byte_order, start_bit) = match keys.byte_order {
        WireOrder::Big => (ByteOrder::BigEndian, 7 - in_byte),
        WireOrder::Little => (ByteOrder::LittleEndian, 0),
    };
    let (minimum, maximum) = match (keys.minimum, keys.maximum) {
        (None, None) => (0.0, 0.0),
        (minimum, maximum) => (minimum.unwrap_or(f64::NEG_INFINITY), maximum.unwrap_or(f64::INFINITY)),
    };
    Signal {
        name,
        layout: SignalLayout {
            start_bit,
            length_bits: keys.length,
            byte_order,
            value_type: if keys.signed { ValueType::Signed } else { ValueType::Unsigned },
            factor: keys.factor,
            offset: keys.offset,
            minimum,
            maximum,
        },
        unit: keys.unit.clone(),
        receivers: Vec::new(),
        conditions: Vec::new(),
        is_multiplexor: false,
        values: keys.not_available.iter().map(|code| (code.cast_signed(), "not available".to_owned())).collect(),
        comment: None,
    }
}
