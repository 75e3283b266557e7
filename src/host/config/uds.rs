//! `[[input.diagnostic]]`: where a controller is asked, and where the signals are in its answers.
//!
//! In: the tables of the file. Out: one [`AnswerDefinition`] per table, with its signals as a DBC would describe them, so
//! that `[input.*]` names them as it names those of a DBC; and the [`Answer`]s that the core reads.

use super::Config;
use super::document::Faults;
use super::keys::{AnswerSignalKeys, DiagnosticInput, WireOrder};
use super::resolve::ResolvedSignal;
use super::tables::RawTables;
use crate::can::CanId;
use crate::can::dbc::{FrameFormat, Message, Signal};
use crate::can::isotp::MAX_MESSAGE;
use crate::can::poll::{FOREIGN_SILENCE_NS, PollConfig, PollRequest};
use crate::can::signal::{ByteOrder, LayoutFault, SignalLayout, ValueType};
use crate::can::uds::{Answer, AnswerSignal, Controller, Question, Service};
use crate::monitor::SupplyConfig;
use crate::quantity::{BusIndex, Channel};
use crate::wiring::AnswerSource;

/// One answer as it is configured.
#[derive(Debug)]
pub(crate) struct AnswerDefinition {
    /// Its table, `input.diagnostic[2]`.
    pub table: String,
    /// Identifier of requests and their first byte.
    request: (CanId, Option<u8>),
    /// Identifier of answers and their first byte.
    response: (CanId, Option<u8>),
    service: Service,
    identifier: u16,
    /// How often it is asked for, by [`CarState`](crate::can::poll::CarState), s.
    every_s: [Option<f64>; 3],
    /// Its signals; each layout begins at the signal's first byte.
    pub message: Message,
    /// Of each signal: its first byte behind the echoed service and identifier.
    first_bytes: Vec<usize>,
}

/// Position of a signal in an answer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AnswerPlace<'d> {
    /// The answer.
    pub definition: &'d AnswerDefinition,
    /// First byte behind the echoed service and identifier.
    pub first_byte: usize,
}

impl AnswerDefinition {
    /// What it answers on an interface.
    fn question(&self, bus: BusIndex) -> Question {
        let (request, request_extension) = self.request;
        let (response, response_extension) = self.response;
        let controller = Controller { bus, request, request_extension, response, response_extension };
        Question { controller, service: self.service, identifier: self.identifier }
    }

    /// The signals with their places.
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

    /// The signal's source for the doctor.
    pub(crate) fn source(&self, bus: BusIndex) -> AnswerSource {
        AnswerSource { question: self.definition.question(bus), first_byte: self.first_byte }
    }

    /// Position of the signal's first bit in the answer, as the file counts it.
    pub(crate) fn bit(&self, layout: &SignalLayout) -> usize {
        let in_byte = match layout.byte_order {
            ByteOrder::BigEndian => 7 - layout.start_bit,
            ByteOrder::LittleEndian => 0,
        };
        8 * self.first_byte + usize::from(in_byte)
    }
}

/// The answers that are read: those with a signal that an input uses.
pub(crate) fn answers(found: &[ResolvedSignal<'_>]) -> Result<Vec<Answer>, LayoutFault> {
    let mut answers: Vec<Answer> = Vec::new();
    for (resolved, place) in found.iter().filter_map(|resolved| Some((resolved, resolved.answer?))) {
        let question = place.definition.question(resolved.bus);
        let signal = AnswerSignal { first_byte: place.first_byte, binding: resolved.binding()? };
        match answers.iter_mut().find(|answer| answer.question == question) {
            Some(answer) => answer.signals.push(signal),
            None => answers.push(Answer { question, signals: vec![signal] }),
        }
    }
    Ok(answers)
}

/// The requests that are sent; `None` = none. Notes what they need and do not have.
pub(super) fn poll(raw: &RawTables, found: &[ResolvedSignal<'_>], faults: &mut Faults) -> Option<PollConfig> {
    let keys = raw.poll.as_ref().filter(|keys| keys.enabled)?;
    let mut requests: Vec<PollRequest> = Vec::new();
    for (resolved, place) in found.iter().filter_map(|resolved| Some((resolved, resolved.answer?))) {
        let question = place.definition.question(resolved.bus);
        let every_s = place.definition.every_s;
        if every_s == [None; 3] {
            continue;
        }
        let has_current = resolved.channel == Channel::Current;
        let has_voltages = matches!(resolved.channel, Channel::CellVoltage(_) | Channel::PackVoltage);
        match requests.iter_mut().find(|request| request.question == question) {
            Some(request) => {
                request.has_current |= has_current;
                request.has_voltages |= has_voltages;
            }
            None => requests.push(PollRequest { question, every_s, has_current, has_voltages }),
        }
    }
    if requests.is_empty() && !raw.broken {
        let what = "must be false: no answer that is read has drive_every_s, charge_every_s or parked_every_s";
        keys.place.fault(faults, "enabled", what);
    }
    let current = found.iter().find(|resolved| resolved.channel == Channel::Current).and_then(|it| it.answer);
    if let Some(place) = current.filter(|place| place.definition.every_s[2].is_none()) {
        let table = &place.definition.table;
        let what = format!(
            "must be false, or {table} must have parked_every_s: without the current nothing says that the car drives"
        );
        keys.place.fault(faults, "enabled", &what);
    }
    let watches_supply = raw.supply_voltage.is_some();
    Some(PollConfig { requests, max_requests_per_s: keys.max_requests_per_s, watches_supply })
}

/// What will be sent, in sentences.
pub(super) fn poll_words(config: &Config) -> Vec<String> {
    let Some(poll) = &config.monitor.poll else { return Vec::new() };
    let mut words: Vec<String> = poll.requests.iter().map(|request| request_words(config, request)).collect();
    words.push(format!(
        "at most {} requests a second, one at a time; nothing else can be sent to a controller",
        poll.max_requests_per_s
    ));
    let low_supply = |supply: SupplyConfig| format!(", while the supply is below {} V or not known", supply.minimum_v);
    words.push(format!(
        "silent for {} s after another tester's request, while the bus sleeps{}, and on standby",
        FOREIGN_SILENCE_NS / 1_000_000_000,
        config.monitor.supply.map(low_supply).unwrap_or_default()
    ));
    if config.monitor.supply.is_none() {
        words.push("the vehicle's supply voltage is not watched ([input.supply_voltage])".to_owned());
    }
    words
}

/// `can0: asks 7E4 for 22 01 01 every 1 s while driving, every 5 s while charging`.
fn request_words(config: &Config, request: &PollRequest) -> String {
    let Controller { bus, request: id, .. } = request.question.controller;
    let interface = config.interfaces.get(bus.index()).map_or("?", |interface| interface.name.as_str());
    let bytes: Vec<String> = request.question.request().iter().map(|byte| format!("{byte:02X}")).collect();
    let states = ["while driving", "while charging", "while parked and awake"];
    let period = |(every_s, state): (&Option<f64>, _)| every_s.map(|every_s| format!("every {every_s} s {state}"));
    let periods: Vec<String> = request.every_s.iter().zip(states).filter_map(period).collect();
    format!("{interface}: asks {id} for {} {}", bytes.join(" "), periods.join(", "))
}

/// The answers of all tables; those with a fault are noted and left out.
pub(super) fn definitions(raw: &RawTables, faults: &mut Faults) -> Vec<AnswerDefinition> {
    raw.diagnostics.iter().filter_map(|keys| definition(keys, faults)).collect()
}

fn definition(keys: &DiagnosticInput, faults: &mut Faults) -> Option<AnswerDefinition> {
    let before = faults.len();
    let Some(service) = Service::from_code(keys.service) else {
        keys.place.fault(faults, "service", "must be 0x01, 0x21 or 0x22: services that only read");
        return None;
    };
    if service.identifier_bytes() == 1 && keys.identifier > 0xFF {
        keys.place.fault(faults, "identifier", "must be 0 to 0xFF with this service");
    }
    let (request, response) = (can_id(keys.request), can_id(keys.response));
    if request == response {
        keys.place.fault(faults, "response", "must not be the identifier of the requests");
    }
    let head = 1 + service.identifier_bytes();
    let (mut signals, mut first_bytes) = (Vec::new(), Vec::new());
    for signal in &keys.signals.0 {
        for (name, bit) in numbered(signal, faults) {
            let bit = usize::try_from(bit).unwrap_or(usize::MAX);
            if (bit + usize::from(signal.length)).div_ceil(8) + head > MAX_MESSAGE {
                signal.place.fault(faults, "bit", &format!("must lie within an answer of {MAX_MESSAGE} bytes"));
                break;
            }
            if signals.iter().any(|other: &Signal| other.name == name) {
                signal.place.fault(faults, "name", &format!("must be unique in its answer, {name} is there already"));
            }
            signals.push(as_in_a_dbc(signal, name, bit));
            first_bytes.push(bit / 8);
        }
        check_numbers(signal, faults);
    }
    let message = Message {
        id: response,
        name: keys.name.clone(),
        len_bytes: 8,
        sender: None,
        format: FrameFormat::Classic,
        e2e: None,
        secoc: None,
        signals,
        cycle_time_ms: None,
        repetition: Default::default(),
        comment: None,
    };
    (faults.len() == before).then(|| AnswerDefinition {
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

/// An identifier of 11 bits, or of 29 where it needs them.
fn can_id(raw: u32) -> CanId {
    match u16::try_from(raw) {
        Ok(standard @ 0..=0x7FF) => CanId::Standard(standard),
        Ok(_) | Err(_) => CanId::Extended(raw),
    }
}

/// Name and first bit of each signal that a line stands for.
fn numbered(keys: &AnswerSignalKeys, faults: &mut Faults) -> Vec<(String, u64)> {
    let first = u64::from(keys.bit);
    let has_number = keys.name.contains("{n}");
    let Some(numbers) = keys.numbers.as_ref() else {
        if has_number {
            keys.place.fault(faults, "name", "has {n}, must have `numbers` that it counts through");
        }
        return vec![(keys.name.clone(), first)];
    };
    if !has_number {
        keys.place.fault(faults, "name", "must have {n} in place of the number");
        return Vec::new();
    }
    let step = u64::from(keys.step.unwrap_or(keys.length.into()));
    let name = |number: u16| keys.name.replace("{n}", &number.to_string());
    numbers.0.clone().zip(0_u64..).map(|(number, index)| (name(number), first + index * step)).collect()
}

fn check_numbers(keys: &AnswerSignalKeys, faults: &mut Faults) {
    let is_whole = keys.bit.is_multiple_of(8)
        && keys.length.is_multiple_of(8)
        && keys.step.is_none_or(|step| step.is_multiple_of(8));
    if keys.byte_order == WireOrder::Little && !is_whole {
        keys.place.fault(faults, "byte_order", "must be \"big\" for a signal that is not of whole bytes");
    }
    if keys.factor == 0.0 {
        keys.place.fault(faults, "factor", "must not be 0");
    }
    if let (Some(minimum), Some(maximum)) = (keys.minimum, keys.maximum)
        && minimum >= maximum
    {
        keys.place.fault(faults, "maximum", &format!("must be above minimum = {minimum}"));
    }
    let largest = u64::MAX >> (64 - u32::from(keys.length.clamp(1, 64)));
    if keys.not_available.iter().any(|&code| code > largest) {
        keys.place.fault(faults, "not_available", &format!("must be 0 to {largest:#X}, the signal's codes"));
    }
}

/// The signal with a layout that begins at its first byte.
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
